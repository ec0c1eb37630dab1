"""Which directions of parameter space the data determine, and how well."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sysid.arrays import BoolArray, FloatArray
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
    """The determined directions' covariance and a basis of the undetermined ones.

    Coordinates are those of ``Sensitivity``. covariance: (n_free, n_free), undetermined
    directions and parameters held by a bound left out. undetermined: (n, n_free), orthonormal;
    inert: (n,), which of them do not move the outputs at all. singular_values: of the weighted
    sensitivity, falling. held: (n_free,), parameters that a bound holds. curvature: (n_free,
    n_free), inverse of the curvature in the determined directions, what the covariance would be
    of white residuals of unit weight.
    """

    covariance: FloatArray
    undetermined: FloatArray
    inert: BoolArray
    singular_values: FloatArray
    held: BoolArray
    curvature: FloatArray

    @property
    def rank(self) -> int:
        """How many directions the data determine."""
        return len(self.singular_values) - len(self.undetermined)

    @property
    def undetermined_share(self) -> FloatArray:
        """Share of each coordinate in undetermined directions, (n_free,)."""
        share: FloatArray = np.sum(self.undetermined**2, axis=0)
        return share

    def inflation(self, place: int | None) -> float:
        """Variance of a coordinate in parts of what the curvature alone gives; median for None."""
        curvature = np.diag(self.curvature)
        ratio = np.diag(self.covariance) / np.where(curvature > 0.0, curvature, np.inf)
        if place is not None:
            return float(ratio[place])
        positive = ratio[ratio > 0.0]
        return float(np.median(positive)) if len(positive) else 1.0


def directions(sensitivity: Sensitivity) -> Directions:
    """Singular value decomposition of the sensitivity, its directions weighed by their variance.

    The estimate minimises the mean of the outputs' RMSEs, where each output weighs by the inverse
    of its error; its covariance is the sandwich of the curvature and the covariance of the score,
    in which the residuals' colour, the noise of the inputs and the sensors' zero errors enter
    (Ljung, "System Identification", sections 9.2 and 9.4).
    """
    objective, residual, slopes = sensitivity.objective, sensitivity.residual, sensitivity.slopes
    weight = objective.least_squares_weights(residual)
    rows = (slopes * np.sqrt(weight)[:, None]).reshape(-1, slopes.shape[2])
    weighted = slopes * weight[:, None]
    noise = colour(residual, sensitivity.seen, sensitivity.lengths)
    score = score_covariance(weighted, sensitivity.lengths, noise)
    # Not all that the inputs' noise does is seen in residuals: parameters take up slow changes.
    score = _larger(score, _score_covariance_by(weighted, input_noises(sensitivity)))
    score += _score_covariance_by(weighted, zero_errors(sensitivity))
    free = _decompose(rows, score, np.zeros(slopes.shape[2], dtype=bool))
    # What the data hardly feel, or feel only together with others, is not held by its bound.
    held = objective.space.on_bound(sensitivity.chromosome) & (free.undetermined_share < PART)
    return _decompose(rows, score, held) if held.any() else free


def _decompose(rows: FloatArray, score: FloatArray, held: BoolArray) -> Directions:
    """Directions of what is not held: rows are the weighted sensitivity, (n_rows, n_free)."""
    n, kept = rows.shape[1], np.flatnonzero(~held)
    _, values, vectors = np.linalg.svd(rows[:, kept], full_matrices=False)
    moving = values > _EXACT * values[0] if len(values) else np.zeros(0, dtype=bool)
    back = vectors / np.where(moving, values, np.inf)[:, None] ** 2
    variance = np.einsum("kj,jl,kl->k", back, score[np.ix_(kept, kept)], back)
    determined = moving & (variance < _VAGUE**2)
    strong = vectors[determined]
    inverse = np.zeros((n, n))
    inverse[np.ix_(kept, kept)] = (strong.T / values[determined] ** 2) @ strong
    rest = np.zeros((int((~determined).sum()), n))
    rest[:, kept] = vectors[~determined]
    return Directions(inverse @ score @ inverse, rest, ~moving[~determined], values, held, inverse)


def _score_covariance_by(weighted: FloatArray, changes: Iterable[FloatArray]) -> FloatArray:
    """Covariance of the score by independent changes of the residuals, (n_free, n_free)."""
    pushes = [np.einsum("tip,ti->p", weighted, change) for change in changes]
    stacked = np.array(pushes).reshape(-1, weighted.shape[2])
    covariance: FloatArray = stacked.T @ stacked
    return covariance


def _larger(seen: FloatArray, stated: FloatArray) -> FloatArray:
    """A covariance as large in every direction as the larger of two."""
    values, vectors = np.linalg.eigh(seen)
    root = np.sqrt(np.maximum(values, 1e-14 * max(values[-1], 1e-300)))
    relative = (vectors.T @ stated @ vectors) / np.outer(root, root)
    ratio, axes = np.linalg.eigh(relative)
    back = (vectors * root) @ axes
    larger: FloatArray = (back * np.maximum(ratio, 1.0)) @ back.T
    return larger
