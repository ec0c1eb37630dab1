"""Relations hidden in undetermined directions: which parameters act only together, and how."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.uncertainty.directions import Directions
from sysid.uncertainty.sensitivity import Sensitivity, coordinate_units

Kind = Literal["product", "sum", "vague"]

# How far a relation is followed to prove it exact, and how little the outputs may move beside
# moving one of its parameters alone.
_FOLLOW = 0.2
_UNMOVED = 1e-3
_NOTHING = 3e-3  # entries of a direction below this are rounding
# Shares of a direction's largest entry above which a parameter may be part of what is exact.
_SHARES = (0.1, 0.03, 0.01, 0.003)
_NEARLY = 0.02  # of a whole number
_NEW = 0.1  # part of a direction that the rest must leave unexplained
# Singular values below this share of the largest may be nothing but errors of the slopes.
_WEAK = 0.05
_FIRMLY = 0.25  # share of such a direction's largest entry above which a parameter is part of it
_SHARE = 0.1  # entries of a vague direction below this share of its largest are not worth naming


@dataclass(frozen=True)
class Relation:
    """A direction, (n_free,), that leaves the outputs alone, followed as a product or a sum."""

    vector: FloatArray
    kind: Kind


def relations(
    sensitivity: Sensitivity, directions: Directions
) -> tuple[list[Relation], list[FloatArray]]:
    """Undetermined directions, made simple: exact relations, and those that the noise hides.

    Directions that do not move the outputs at all are made simple by themselves, the others up
    to these.
    """
    follower = _Follower(sensitivity)
    exact: list[Relation] = []
    vague: list[FloatArray] = []
    undetermined, inert = directions.undetermined, directions.inert
    for basis in (undetermined[inert], undetermined[~inert]):
        for vector in sparse(basis):
            relation = follower.exact(_simplest(vector, exact), exact)
            if relation is None:
                vague.append(vector)
            else:
                exact.append(relation)
    return exact, [_simplest(vector, exact) for vector in vague]


def overlooked_directions(
    sensitivity: Sensitivity, undetermined: FloatArray, rivals: Sequence[FloatArray] = ()
) -> FloatArray:
    """Exact directions that errors of the slopes let look determined, (n, n_free), orthonormal.

    Dry friction makes the slope of each parameter jagged while all of them together, followed
    in whole numbers, move nothing. undetermined: (n, n_free), orthonormal. rivals: other minima;
    one that is another point of the same valley lies along such a direction.
    """
    follower = _Follower(sensitivity)
    space, chromosome = sensitivity.objective.space, sensitivity.chromosome
    _, values, vectors = np.linalg.svd(sensitivity.rows, full_matrices=False)
    units = coordinate_units(sensitivity.objective, chromosome)
    ways = [(space.encode(rival) - space.encode(chromosome)) / units for rival in rivals]
    basis = [*undetermined]
    for vector in [*ways, *vectors[values < _WEAK * values[0]]]:
        for candidate in follower.rounded(vector):
            rest = _beyond(candidate, basis)
            new = np.linalg.norm(rest) > _NEW * np.linalg.norm(candidate)
            if new and follower.kind(candidate) != "vague":
                basis.append(rest / np.linalg.norm(rest))
    return np.array(basis[len(undetermined) :]).reshape(-1, len(chromosome))


def overlapping(supports: list[BoolArray]) -> list[list[int]]:
    """Indices of supports that hang together through shared parameters."""
    groups: list[list[int]] = []
    for i, support in enumerate(supports):
        near = [g for g in groups if any(np.any(supports[k] & support) for k in g)]
        groups = [g for g in groups if g not in near] + [sorted([i, *itertools.chain(*near)])]
    return groups


class _Follower:
    """Follows directions by simulations, to see whether they leave the outputs alone."""

    def __init__(self, sensitivity: Sensitivity) -> None:
        self.sensitivity = sensitivity
        self.chromosome, self.increments = sensitivity.chromosome, sensitivity.increments
        # Whole powers of the parameters move them by their values, whole multiples by one.
        self.units = (self.chromosome, np.ones_like(self.chromosome))

    def exact(self, vector: FloatArray, relations: list[Relation]) -> Relation | None:
        """The exact relation that a direction is but for errors, unless among ``relations``."""
        size = np.abs(vector)
        groups = [np.flatnonzero(size > share * size.max()).tolist() for share in _SHARES]
        for members, _ in itertools.groupby(groups):
            for candidate in self._candidates(vector, members):
                kind = self.kind(candidate)
                if kind != "vague" and _is_new(candidate, relations):
                    return Relation(candidate, kind)
        return None

    def _candidates(self, vector: FloatArray, members: list[int]) -> Iterator[FloatArray]:
        """Directions of these parameters alone that may be the exact one near ``vector``."""
        # Slopes at kinks mix what does nothing with what does little: so it is sought anew
        # without the other parameters, and with whole numbers for what is near them.
        best = np.zeros_like(vector)
        rows = self.sensitivity.rows[:, members]
        best[members] = np.linalg.svd(rows, full_matrices=False)[2][-1]
        yield best
        for unit in self.units:
            if np.all(unit[members] != 0.0):
                whole = _whole(best[members] * self.increments[members] / unit[members])
                if whole is not None:
                    snapped = np.zeros_like(vector)
                    snapped[members] = whole * unit[members] / self.increments[members]
                    yield snapped / np.max(np.abs(snapped))

    def rounded(self, vector: FloatArray) -> Iterator[FloatArray]:
        """Directions of small whole powers, or multiples, of the parameters near ``vector``."""
        taking = np.abs(vector) > _FIRMLY * np.max(np.abs(vector))
        for unit in self.units:
            usable = taking & (unit != 0.0)
            if not usable.any():
                continue
            ratios = np.zeros_like(vector)
            np.divide(vector * self.increments, unit, out=ratios, where=usable)
            for factor in (1.0, 2.0):
                whole = np.round(factor * ratios / np.max(np.abs(ratios)))
                if np.count_nonzero(whole) > 1:
                    yield whole * unit / self.increments

    def kind(self, vector: FloatArray) -> Kind:
        """Follow a direction as a product and as a sum; which of them leaves the outputs alone."""
        step = vector * self.increments
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(step != 0.0, step / self.chromosome, 0.0)
        if not np.all(np.isfinite(relative)):
            return "vague"
        relative *= _FOLLOW / np.max(np.abs(relative))
        alone = np.zeros_like(relative)
        largest = np.argmax(np.abs(relative))
        alone[largest] = relative[largest]
        moved = self.chromosome * np.stack(
            [np.ones_like(relative), np.exp(relative), 1.0 + relative, 1.0 + alone]
        )
        objective = self.sensitivity.objective
        residuals = objective.residuals(moved, self.sensitivity.steps).values
        counted = residuals[:, objective.weights > 0.0]
        change = np.sqrt(np.mean((counted[..., 1:] - counted[..., :1]) ** 2, axis=(0, 1)))
        product, total, reference = change
        if product < _UNMOVED * reference:
            return "product"
        return "sum" if total < _UNMOVED * reference else "vague"


def _is_new(vector: FloatArray, relations: list[Relation]) -> bool:
    """Whether a direction is no mixture of those of the relations."""
    if not relations:
        return True
    basis = np.linalg.qr(np.stack([relation.vector for relation in relations]).T)[0]
    return bool(np.linalg.norm(_beyond(vector, [*basis.T])) > _NEW * np.linalg.norm(vector))


def _beyond(vector: FloatArray, basis: Sequence[FloatArray]) -> FloatArray:
    """What orthonormal directions leave unexplained of a direction."""
    axes = np.array(basis).reshape(-1, len(vector))
    return vector - axes.T @ (axes @ vector)


def _whole(ratios: FloatArray) -> FloatArray | None:
    """Small whole numbers that are nearly in these ratios, if there are."""
    ratios = ratios / np.min(np.abs(ratios)) if np.all(ratios != 0.0) else np.full(1, np.nan)
    for factor in (1.0, 2.0, 3.0):
        whole = np.round(factor * ratios)
        if np.all(np.abs(factor * ratios - whole) < _NEARLY * np.abs(whole)):
            return whole
    return None


def main_parameters(vector: FloatArray) -> IntArray:
    """Parameters that a vague direction is named after: those with a large share in it."""
    size = np.abs(vector)
    return np.flatnonzero(size > _SHARE * size.max())


def _simplest(vector: FloatArray, exact: list[Relation]) -> FloatArray:
    """A direction of the fewest parameters that adding exact ones, which do nothing, allows."""
    for relation in exact:
        ways = [vector]
        for j in np.flatnonzero(relation.vector):
            way = vector - vector[j] / relation.vector[j] * relation.vector
            ways.append(np.where(np.abs(way) < _NOTHING * np.max(np.abs(way)), 0.0, way))
        vector = min(ways, key=lambda way: len(main_parameters(way)))
    return vector


def sparse(basis: FloatArray) -> FloatArray:
    """The same space spanned by rows with as many zeros as elimination gives."""
    rows = basis.copy()
    left = list(range(len(rows)))
    while left:
        pivot = np.unravel_index(int(np.argmax(np.abs(rows[left]))), (len(left), rows.shape[1]))
        row, column = left.pop(int(pivot[0])), int(pivot[1])
        rows[row] /= rows[row, column]
        rest = [i for i in range(len(rows)) if i != row]
        rows[rest] -= np.outer(rows[rest, column], rows[row])
    rows[np.abs(rows) < _NOTHING] = 0.0
    return rows
