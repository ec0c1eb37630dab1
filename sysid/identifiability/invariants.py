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


# Powers and coefficients of the terms of a sum.
Form = tuple[list[Powers], list[float]]
# Gives so many points at which a group is tied alike; ArithmeticError where there are not so many.
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
    order = sorted(range(len(names)), key=lambda i: list(units).index(names[i]))
    chosen: list[Combination] = []
    gradients = np.zeros((0, len(names)))

    def independent(gradient: FloatArray) -> bool:
        trial = np.vstack([gradients, gradient / np.linalg.norm(gradient)])
        return bool(np.linalg.matrix_rank(trial, tol=1e-6) == len(trial))

    try:
        values = samples(1)[0].values
        for powers, coefficients in _simplest(samples, independent):
            gradient = np.array(coefficients) @ _slopes(values, np.array(powers)) * values
            if independent(gradient):
                gradients = np.vstack([gradients, gradient / np.linalg.norm(gradient)])
                terms = [
                    Term(tuple((names[i], row[i]) for i in order if row[i]), coefficient)
                    for row, coefficient in zip(powers, coefficients, strict=True)
                ]
                chosen.append(Combination.of(terms, units, fixed))
            if len(chosen) == count:
                break
    except ArithmeticError:
        pass  # elsewhere the group is tied in another way: no form holds throughout
    return chosen


def _simplest(samples: Sampler, independent: Callable[[FloatArray], bool]) -> Iterator[Form]:
    """Forms of invariants of a group: of the smallest sets of members first, then of all.

    independent: whether a gradient, by the logarithms, says more than those before it.
    """
    slopes = samples(1)[0].slopes
    m = slopes.shape[1]
    for members, gradient in _circuits(slopes):
        if independent(gradient):

            def of_members(n: int, members: tuple[int, ...] = members) -> list[Sample]:
                return [sample.of(members) for sample in samples(n)]

            for few, coefficients in itertools.islice(_forms(len(members), of_members), 1):
                powers = np.zeros((len(few), m))
                powers[:, members] = few
                yield list(map(tuple, powers.tolist())), coefficients
    for exponents in _products(samples(3)):
        yield [exponents], [1.0]
    yield from _sums(_plain(m), samples)


def _circuits(slopes: FloatArray) -> Iterator[tuple[tuple[int, ...], FloatArray]]:
    """Smallest sets of members that do not move in all directions, and the way they never move.

    slopes: (k, m), the tied directions of the logarithms. Some combination of such a set may be
    determined; then that way, (m,), is its gradient.
    """
    m = slopes.shape[1]
    for size in range(2, min(m, _MOST_MEMBERS) + 1):
        for members in itertools.combinations(range(m), size):
            null = _null_rows(slopes[:, members])
            if len(null) == 1 and np.all(null[0] != 0.0):
                gradient = np.zeros(m)
                gradient[list(members)] = null[0]
                yield members, gradient


def _forms(m: int, samples: Sampler) -> Iterator[Form]:
    """Forms of the invariant of a circuit of m members, the simplest first."""
    for exponents in _products(samples(3)):
        yield [exponents], [1.0]
    yield from _sums(_plain(m), samples)
    yield from _pairs(m, samples(4))
    for powers in (_polynomials(m), _ratios(m)):
        if len(powers) <= _MOST_MONOMIALS:
            yield from _sums(powers, samples)


def _products(samples: Sequence[Sample]) -> Iterator[Powers]:
    """Exponents that are orthogonal to the directions of the logarithms."""
    rows = np.concatenate([sample.slopes for sample in samples])
    for row in _null_rows(rows):
        whole = _as_whole(row)
        if whole is not None:
            yield whole


def _sums(powers: Sequence[Powers], samples: Sampler) -> Iterator[Form]:
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


def _pairs(m: int, samples: Sequence[Sample]) -> Iterator[Form]:
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
