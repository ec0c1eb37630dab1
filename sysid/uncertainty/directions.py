"""Which directions of parameter space the data determine, and how well."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.objective import Objective
from sysid.uncertainty.colour import colour, score_covariance
from sysid.uncertainty.sensitivity import Sensitivity, input_noises, zero_errors

# Singular values below this share of the largest are rounding: the direction does nothing.
_EXACT = 1e-6
# Share of a coordinate in undetermined directions above which it is not determined itself.
PART = 1e-3
# A direction whose standard deviation (in logarithms, or in units of the value) exceeds this is
# not determined.
_VAGUE = 1.0


@dataclass(frozen=True)
class Directions:
    """The determined directions' covariance and a basis of the others.

    Coordinates are those of ``Sensitivity``. covariance: (n_free, n_free), undetermined
    directions and parameters held by a bound left out. lost: (n_lost, n_free), orthonormal;
    still: (n_lost,), which of them do not move the outputs at all. singular_values: of the
    weighted sensitivity, falling. held: (n_free,), parameters that a bound holds. curvature:
    (n_free, n_free), inverse of the curvature in the determined directions, what the covariance
    would be of white residuals of unit weight.
    """

    covariance: FloatArray
    lost: FloatArray
    still: BoolArray
    singular_values: FloatArray
    held: BoolArray
    curvature: FloatArray

    def inflation(self, place: int | None) -> float:
        """Variance of a coordinate in parts of what the curvature alone says; of all for None."""
        ratio = np.diag(self.covariance) / np.where(
            np.diag(self.curvature) > 0.0, np.diag(self.curvature), np.inf
        )
        if place is not None:
            return float(ratio[place])
        positive = ratio[ratio > 0.0]
        return float(np.median(positive)) if len(positive) else 1.0

    @property
    def rank(self) -> int:
        """How many directions the data determine."""
        return len(self.singular_values) - len(self.lost)


def directions(
    objective: Objective,
    chromosome: FloatArray,
    steps: list[int],
    found: Sensitivity,
    on_bound: BoolArray,
) -> Directions:
    """Singular value decomposition of the sensitivity, its directions weighed by their variance.

    on_bound: (n_free,), parameters at an end of their range. The estimate minimises the mean of
    the outputs' RMSEs, where each output weighs by the inverse of its own; its covariance is the
    sandwich of the curvature and the covariance of the score, in which the residuals' colour,
    the noise of the inputs and the sensors' zero errors enter (Ljung, "System Identification",
    sections 9.2 and 9.4).
    """
    n = found.slopes.shape[2]
    weight = objective.least_squares_weights(found.residual)
    rows = (found.slopes * np.sqrt(weight)[:, None]).reshape(-1, n)
    weighted = found.slopes * weight[:, None]
    noise = colour(found.residual, found.seen, found.lengths)
    score = score_covariance(weighted, found.lengths, noise)
    causes = (objective, chromosome, steps, found)
    score = _larger(score, _pushes(weighted, input_noises(*causes)))
    score += _pushes(weighted, zero_errors(*causes))
    told = _decompose(rows, score, np.zeros(n, dtype=bool))
    # What the data hardly feel, or feel only together with others, is not held by its bound.
    held = on_bound & (np.sum(told.lost**2, axis=0) < PART)
    return _decompose(rows, score, held) if held.any() else told


def _decompose(rows: FloatArray, score: FloatArray, held: BoolArray) -> Directions:
    """Directions of the parameters that are not held.

    rows: (n_rows, n_free), weighted sensitivity. score: its covariance, (n_free, n_free).
    """
    n, kept = rows.shape[1], np.flatnonzero(~held)
    _, values, vectors = np.linalg.svd(rows[:, kept], full_matrices=False)
    moving = values > _EXACT * values[0] if len(values) else np.zeros(0, dtype=bool)
    back = vectors / np.where(moving, values, np.inf)[:, None] ** 2
    variance = np.einsum("kj,jl,kl->k", back, score[np.ix_(kept, kept)], back)
    determined = moving & (variance < _VAGUE**2)
    strong = vectors[determined]
    inverse = np.zeros((n, n))
    inverse[np.ix_(kept, kept)] = (strong.T / values[determined] ** 2) @ strong
    lost = np.zeros((int((~determined).sum()), n))
    lost[:, kept] = vectors[~determined]
    return Directions(inverse @ score @ inverse, lost, ~moving[~determined], values, held, inverse)


def _pushes(weighted: FloatArray, changes: Iterable[FloatArray]) -> FloatArray:
    """Covariance of the score by changes of the residuals, (n_free, n_free)."""
    n = weighted.shape[2]
    pushes = [np.einsum("tip,ti->p", weighted, change) for change in changes]
    stacked = np.array(pushes).reshape(-1, n)
    covariance: FloatArray = stacked.T @ stacked
    return covariance


def _larger(seen: FloatArray, known: FloatArray) -> FloatArray:
    """A covariance as large in every direction as the larger of two.

    What the inputs' noise does is part of the residuals, but not all of it is seen there: slow
    changes are taken for parameters.
    """
    values, vectors = np.linalg.eigh(seen)
    root = np.sqrt(np.maximum(values, 1e-14 * max(values[-1], 1e-300)))
    relative = (vectors.T @ known @ vectors) / np.outer(root, root)
    ratio, axes = np.linalg.eigh(relative)
    back = (vectors * root) @ axes
    larger: FloatArray = (back * np.maximum(ratio, 1.0)) @ back.T
    return larger
