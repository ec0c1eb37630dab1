"""Relations hidden in undetermined directions: which parameters act only together, and how."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sysid.model import BoolArray, FloatArray, IntArray
from sysid.objective import Objective

Kind = Literal["product", "sum", "vague"]

# How far a relation is followed to prove it exact, and how little the outputs may move beside
# what moving one of its parameters alone does.
_FOLLOW = 0.2
_UNMOVED = 1e-3
_NOTHING = 3e-3  # entries of a direction below this are rounding
_SHARE = 0.1  # entries of a vague direction below this share of its largest are not worth naming


@dataclass(frozen=True)
class Relation:
    """A direction that leaves the outputs alone.

    vector: (n_free,), in coordinates. kind: how it goes on beyond the first step; ``product``
    and ``sum`` are exact, ``vague`` is only hidden by the noise.
    """

    vector: FloatArray
    kind: Kind

    @property
    def exact(self) -> bool:
        """Whether no data of this kind could ever tell."""
        return self.kind != "vague"

    @property
    def support(self) -> BoolArray:
        """Parameters that take part, (n_free,)."""
        taking: BoolArray = self.vector != 0.0
        return taking


def relations(
    objective: Objective,
    chromosome: FloatArray,
    steps: list[int],
    slope: FloatArray,
    lost: FloatArray,
    still: BoolArray,
) -> list[Relation]:
    """The undetermined directions as simple ones, each followed to see what it is.

    slope: (n_free,), change of each parameter per unit of its coordinate. lost: (n_lost, n_free);
    still: (n_lost,), which of them do not move the outputs at all. These are made simple by
    themselves, the others up to them.
    """
    hidden = sparse(lost[still])
    felt = [_simplest(vector, hidden) for vector in sparse(lost[~still])]
    return [
        Relation(vector, _kind(objective, chromosome, steps, vector * slope))
        for vector in (*hidden, *felt)
    ]


def overlapping(supports: list[BoolArray]) -> list[list[int]]:
    """Indices of supports that hang together through shared parameters."""
    groups: list[list[int]] = []
    for i, support in enumerate(supports):
        near = [g for g in groups if any(np.any(supports[k] & support) for k in g)]
        groups = [g for g in groups if g not in near] + [sorted([i, *itertools.chain(*near)])]
    return groups


def _kind(objective: Objective, chromosome: FloatArray, steps: list[int], step: FloatArray) -> Kind:
    """Follow a direction as a product and as a sum; what leaves the outputs alone."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(step != 0.0, step / chromosome, 0.0)
    if not np.all(np.isfinite(relative)):
        return "vague"
    relative *= _FOLLOW / np.max(np.abs(relative))
    alone = np.where(np.abs(relative) == np.max(np.abs(relative)), relative, 0.0)
    moved = chromosome * np.stack(
        [np.ones_like(relative), np.exp(relative), 1.0 + relative, 1.0 + alone]
    )
    residuals = objective.residuals(moved, steps)
    change = np.sqrt(np.mean((residuals[1:] - residuals[0]) ** 2, axis=(1, 2)))
    if change[0] < _UNMOVED * change[2]:
        return "product"
    return "sum" if change[1] < _UNMOVED * change[2] else "vague"


def named(vector: FloatArray) -> IntArray:
    """Parameters that a vague direction is about: those of no small share in it."""
    size = np.abs(vector)
    return np.flatnonzero(size > _SHARE * size.max())


def _simplest(vector: FloatArray, hidden: FloatArray) -> FloatArray:
    """A direction about as few parameters as moves along hidden ones, which do nothing, allow."""
    for relation in hidden:
        ways = [vector]
        for j in np.flatnonzero(relation):
            way = vector - vector[j] / relation[j] * relation
            ways.append(np.where(np.abs(way) < _NOTHING * np.max(np.abs(way)), 0.0, way))
        vector = min(ways, key=lambda way: len(named(way)))
    return vector


def sparse(basis: FloatArray) -> FloatArray:
    """The same space spanned by rows with as many zeros as elimination gives."""
    rows = basis.copy()
    left = list(range(len(rows)))
    while left:
        pivot = np.unravel_index(int(np.argmax(np.abs(rows[left]))), (len(left), rows.shape[1]))
        row, column = left.pop(int(pivot[0])), int(pivot[1])
        rows[row] /= rows[row, column]
        others = [i for i in range(len(rows)) if i != row]
        rows[others] -= np.outer(rows[others, column], rows[row])
    rows[np.abs(rows) < _NOTHING] = 0.0
    return rows
