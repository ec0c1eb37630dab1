"""Combinations that stay the same along tied directions, in their simplest form.

A combination is determined where its gradient is orthogonal to the tied directions at every
point. Each smallest set of members whose directions leave room for such a gradient has just one:
for it a product is sought first, then a sum, then sums of two monomials, and of more, each a linear
problem over random points.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from sysid.arrays import FloatArray
from sysid.identifiability.combination import Combination, Term

_ZERO = 1e-9  # what double precision leaves of an exact zero
_MOST_MEMBERS = 5  # of a combination
_MOST_TERMS = 6  # a longer sum says less than numbers
_MOST_MONOMIALS = 45  # in one ansatz, each of which needs a point

Powers = tuple[float, ...]


@dataclass(frozen=True)
class Sample:
    """Members' values at a point, (m,), and the tied directions there, (k, m)."""

    values: FloatArray
    directions: FloatArray

    def of(self, members: Sequence[int]) -> "Sample":
        """What it says of some of the members."""
        return Sample(self.values[list(members)], self.directions[:, list(members)])

    @property
    def slopes(self) -> FloatArray:
        """The tied directions of the members' logarithms, each of length one."""
        slopes = self.directions / self.values
        lengths = np.linalg.norm(slopes, axis=1, keepdims=True)
        moving: FloatArray = slopes / np.where(lengths > 0.0, lengths, 1.0)
        return moving


# Gives so many points at which a group is tied.
Sampler = Callable[[int], list[Sample]]


def combinations_of(
    names: Sequence[str],
    units: Mapping[str, str],
    fixed: Mapping[str, float],
    count: int,
    samples: Sampler,
) -> list[Combination]:
    """Up to ``count`` independent combinations of the members of a group, the simplest first.

    units: by name, in the order in which the names stand in a product. fixed: values of the
    model's fixed parameters. samples: gives so many points at which the group is tied.
    """
    chosen: list[Combination] = []
    gradients = np.zeros((0, len(names)))
    for members, gradient in _circuits(samples(1)[0].slopes):
        if len(chosen) == count:
            break
        trial = np.vstack([gradients, gradient])
        if np.linalg.matrix_rank(trial, tol=1e-6) == len(chosen):
            continue
        terms = _terms(members, samples)
        if terms:
            named = [
                Term(
                    tuple((names[i], row[i]) for i in _as_declared(names, units) if row[i]), factor
                )
                for row, factor in terms
            ]
            chosen.append(Combination.of(named, units, fixed))
            gradients = trial
    return chosen


def _as_declared(names: Sequence[str], units: Mapping[str, str]) -> list[int]:
    order = list(units)
    return sorted(range(len(names)), key=lambda i: order.index(names[i]))


def _circuits(slopes: FloatArray) -> Iterator[tuple[tuple[int, ...], FloatArray]]:
    """Smallest sets of members of which something is determined, and its gradient, (m,).

    slopes: (k, m), the tied directions of the logarithms. What is determined of such a set is one
    combination, whose gradient is orthogonal to the directions; that of the logarithms is given.
    """
    m = slopes.shape[1]
    for size in range(2, min(m, _MOST_MEMBERS) + 1):
        for members in itertools.combinations(range(m), size):
            null = _null_rows(slopes[:, members])
            if len(null) == 1 and np.all(null[0] != 0.0):
                gradient = np.zeros(m)
                gradient[list(members)] = null[0] / np.linalg.norm(null[0])
                yield members, gradient


def _terms(members: Sequence[int], samples: Sampler) -> list[tuple[Powers, float]]:
    """Powers of all of the group, and coefficients, of the simplest form of a circuit's invariant.

    Empty where none of the forms fits.
    """
    m = samples(1)[0].directions.shape[1]

    def sampled(n: int) -> list[Sample]:
        return [sample.of(members) for sample in samples(n)]

    form = next(_forms(len(members), sampled), None)
    if form is None:
        return []
    terms = []
    for row, coefficient in zip(*form, strict=True):
        powers = [0.0] * m
        for place, power in zip(members, row, strict=True):
            powers[place] = power
        terms.append((tuple(powers), coefficient))
    return terms


def _forms(m: int, samples: Sampler) -> Iterator[tuple[list[Powers], list[float]]]:
    """Powers and coefficients of the terms of invariants, the simplest forms first."""
    for exponents in _products(m, samples(3)):
        yield [exponents], [1.0]
    yield from _sums(_plain(m), samples)
    yield from _pairs(m, samples(4))
    for powers in (_polynomials(m), _ratios(m)):
        if len(powers) <= _MOST_MONOMIALS:
            yield from _sums(powers, samples)


def _products(m: int, samples: Sequence[Sample]) -> Iterator[Powers]:
    """Exponents that are orthogonal to the directions of the logarithms."""
    rows = np.concatenate([sample.slopes for sample in samples])
    for row in _null_rows(rows):
        whole = _as_whole(row)
        if whole is not None:
            yield whole


def _sums(powers: Sequence[Powers], samples: Sampler) -> Iterator[tuple[list[Powers], list[float]]]:
    """Invariants that are linear in these monomials, those of the fewest terms first."""
    table = np.array(powers)
    per_point = table.shape[1] - 1  # a circuit moves in all directions but one
    points = samples(-(-len(powers) // per_point) + 3)
    rows = np.concatenate([s.directions @ _slopes(s.values, table).T for s in points])
    sizes = np.max(np.abs(rows), axis=0)
    sizes[sizes == 0.0] = 1.0
    rows = rows / sizes
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows / np.where(lengths > 0.0, lengths, 1.0)
    basis = [row / sizes for row in _null_rows(rows)]
    for row in sorted(basis, key=np.count_nonzero):
        used = np.flatnonzero(row).tolist()
        if len(used) <= _MOST_TERMS:
            yield [powers[i] for i in used], _tidy(row[used])


def _pairs(m: int, samples: Sequence[Sample]) -> Iterator[tuple[list[Powers], list[float]]]:
    """Invariant sums of two monomials, whose slopes along the directions are in one ratio."""
    powers = sorted(_monomials(m), key=_complexity)
    table = np.array(powers)
    slopes = np.concatenate([s.directions @ _slopes(s.values, table).T for s in samples])
    moving = np.linalg.norm(slopes, axis=0)
    unit = slopes / np.where(moving > 0.0, moving, 1.0)
    alike = np.abs(unit.T @ unit) > 1.0 - _ZERO
    places: list[list[int]] = np.argwhere(np.triu(alike, 1) & (moving > 0.0)).tolist()
    for i, j in sorted(places, key=lambda p: _complexity(powers[p[0]]) + _complexity(powers[p[1]])):
        # The cosine's error is quadratic in the angle's: look at what is left itself.
        ratio = float(slopes[:, i] @ slopes[:, j]) / float(slopes[:, j] @ slopes[:, j])
        if np.max(np.abs(slopes[:, i] - ratio * slopes[:, j])) < _ZERO * moving[i]:
            yield [powers[i], powers[j]], _tidy(np.array([1.0, -ratio]))


def _slopes(values: FloatArray, powers: FloatArray) -> FloatArray:
    """Gradients of monomials, (n_monomials, m), of values that are not zero."""
    monomials = np.prod(values**powers, axis=1, keepdims=True)
    slopes: FloatArray = monomials * powers / values
    return slopes


def _null_rows(rows: FloatArray) -> FloatArray:
    """Null space of rows, each vector a one in a column of its own; late columns give the ones."""
    n = rows.shape[1]
    _, values, vectors = np.linalg.svd(rows)
    rank = int(np.sum(values > _ZERO * max(values[0], 1e-300) * 10.0)) if len(values) else 0
    basis, pivots = vectors[rank:].copy(), 0
    for column in range(n - 1, -1, -1):
        if pivots == len(basis):
            break
        row = pivots + int(np.argmax(np.abs(basis[pivots:, column])))
        if abs(basis[row, column]) < 1e-6:
            continue
        basis[[pivots, row]] = basis[[row, pivots]]
        basis[pivots] /= basis[pivots, column]
        for i in range(len(basis)):
            if i != pivots:
                basis[i] -= basis[i, column] * basis[pivots]
        pivots += 1
    basis[np.abs(basis) < 1e-7] = 0.0
    return basis[:pivots]


def _tidy(coefficients: FloatArray) -> list[float]:
    """The first of them one, and those near simple fractions exactly these."""
    scaled = coefficients / coefficients[0]
    fractions = [Fraction(value).limit_denominator(12) for value in scaled.tolist()]
    return [
        float(f) if abs(float(f) - value) < 1e-7 * abs(value) else value
        for f, value in zip(fractions, scaled.tolist(), strict=True)
    ]


def _as_whole(row: FloatArray) -> Powers | None:
    """Exponents in whole numbers, the first positive; None where they are in no simple ratio."""
    fractions = [Fraction(value).limit_denominator(12) for value in row.tolist()]
    if any(abs(float(f) - v) > 1e-7 for f, v in zip(fractions, row.tolist(), strict=True)):
        return None
    factor = int(np.lcm.reduce([f.denominator for f in fractions]))
    first = next(f for f in fractions if f)
    return tuple(float(f * factor * (1 if first > 0 else -1)) for f in fractions)


def _complexity(powers: Powers) -> float:
    return sum(map(abs, powers)) + 0.1 * sum(power < 0.0 for power in powers)


def _plain(m: int) -> list[Powers]:
    return [tuple(float(i == j) for j in range(m)) for i in range(m)]


def _polynomials(m: int) -> list[Powers]:
    """Monomials of degree one and two."""
    places = [(i,) for i in range(m)]
    pairs = itertools.combinations_with_replacement(range(m), 2)
    return [tuple(float(p.count(i)) for i in range(m)) for p in [*places, *pairs]]


def _ratios(m: int) -> list[Powers]:
    """Parameters, and products of two of them over a third."""
    triples = [
        (i, j, k)
        for i, j in itertools.combinations_with_replacement(range(m), 2)
        for k in range(m)
        if k not in (i, j)
    ]
    return _plain(m) + [
        tuple(float((place == i) + (place == j) - (place == k)) for place in range(m))
        for i, j, k in triples
    ]


def _monomials(m: int) -> list[Powers]:
    """Monomials of up to three members to the power of one, or of two with squares."""
    monomials = []
    for size, choices in ((1, (-2, -1, 1, 2)), (2, (-2, -1, 1, 2)), (3, (-1, 1))):
        for places in itertools.combinations(range(m), size):
            for chosen in itertools.product(choices, repeat=size):
                powers = [0.0] * m
                for place, power in zip(places, chosen, strict=True):
                    powers[place] = float(power)
                monomials.append(tuple(powers))
    return monomials
