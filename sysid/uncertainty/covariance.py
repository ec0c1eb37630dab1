"""Covariance of the identified coordinates, and which directions no data of this kind tell.

The estimate minimises the mean of the outputs' RMSEs, where each output weighs by the inverse of
its error; its covariance is the sandwich of the curvature and the covariance of the score, in
which the residuals' colour, the noise of the inputs, the sensors' zero errors and the noise of the
samples that runs start at enter (Ljung, "System Identification", sections 9.2 and 9.4).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from sysid.arrays import BoolArray, FloatArray
from sysid.uncertainty.colour import colour, score_covariance
from sysid.uncertainty.sensitivity import (
    Sensitivity,
    averages_errors,
    bend_errors,
    input_noises,
    parabola_errors,
    raised_noises,
    spans,
    start_errors,
    zero_errors,
)
from sysid.uncertainty.spread import LogSpread, spread

# Singular values below this share of the largest are rounding: the direction does nothing.
_ROUNDING = 1e-6
# Share of a quantity's gradient in directions that do nothing above which it is not felt itself.
_PART = 1e-3


@dataclass(frozen=True)
class SimulatedScore:
    """Covariance of the score by what simulations tell, whatever the residuals' colour.

    by_inputs: (n_free, n_free), by noise of the inputs, which residuals hold as well; by_rest: by
    all that they do not hold.
    """

    by_inputs: FloatArray
    by_rest: FloatArray


@dataclass(frozen=True)
class Covariance:
    """Covariance ``matrix`` (n_free, n_free) of the search coordinates, up to the ties.

    Of what the ``ties`` (n, n_free) leave alone it is the covariance; of the tied themselves it
    says nothing. score: (n_free, n_free), covariance of the error's slope, by which that is;
    simulated: what simulations tell of it. curvature: what it would be of white residuals of unit
    weight. newton_step: (n_free,), to where slopes and curvature have the minimum, beyond the ends
    of ranges too. flat: (n, n_free), orthonormal, further directions that do not move the outputs,
    in coordinates times ``sizes``, (n_free,). singular_values: of the rest of the sensitivity, its
    columns of length one, falling. spread: between logs, or parts of one, where it is more than
    chance.
    """

    ties: FloatArray
    score: FloatArray
    simulated: SimulatedScore
    matrix: FloatArray
    curvature: FloatArray
    newton_step: FloatArray
    flat: FloatArray
    sizes: FloatArray
    singular_values: FloatArray
    spread: LogSpread | None

    @property
    def rank(self) -> int:
        """How many directions the data determine."""
        return len(self.singular_values) - len(self.flat)

    def deviation(self, gradient: FloatArray) -> float:
        """Standard deviation of what changes so (n_free,) with the coordinates, perhaps infinite.

        Where logs differ by more than chance it is the wider one by their spread, in parts of
        the normal distribution's quantile.
        """
        if self.idle(gradient):
            return float("inf")
        deviation = float(np.sqrt(max(float(gradient @ self.matrix @ gradient), 0.0)))
        return deviation if self.spread is None else self.spread.deviation(gradient, deviation)

    def inflation(self, gradient: FloatArray) -> float:
        """Variance in parts of what the curvature alone gives, their median of what is idle."""
        deviation, curved = self.deviation(gradient), float(gradient @ self.curvature @ gradient)
        if np.isfinite(deviation) and curved > 0.0:
            return deviation**2 / curved
        plain, curvature = np.diag(self.matrix), np.diag(self.curvature)
        ratios = plain[curvature > 0.0] / curvature[curvature > 0.0]
        return float(np.median(ratios)) if len(ratios) else 1.0

    def idle(self, gradient: FloatArray) -> bool:
        """Whether what changes so with the coordinates is not felt at all by these data."""
        scaled = np.divide(
            gradient, self.sizes, out=np.zeros_like(gradient), where=self.sizes > 0.0
        )
        if np.any(gradient[self.sizes == 0.0]):
            return True
        return bool(np.sum((self.flat @ scaled) ** 2) > _PART * np.sum(scaled**2))


def covariance(
    sensitivity: Sensitivity,
    ties: FloatArray,
    held: BoolArray | None = None,
    simulated: SimulatedScore | None = None,
    score: FloatArray | None = None,
) -> Covariance:
    """Covariance at an identified chromosome.

    ties: (n, n_free), directions of the coordinates that leave the outputs of any data alone.
    held: (n_free,), parameters whose value a bound decides. simulated: that of another covariance
    of the same sensitivity, which need not be simulated once more; score: likewise, where the
    residuals' colour is to be the same as well.
    """
    residual, slopes = sensitivity.residual, sensitivity.slopes
    weight = sensitivity.objective.least_squares_weights(residual)
    weighted = slopes * weight[:, None]
    if simulated is None:
        simulated = _simulated_score(sensitivity, weight, weighted, ties)
    if score is None:
        score = _score(sensitivity, weighted, held, simulated)
    felt = _felt(sensitivity, weight, ties, held)
    inverse = felt.back @ felt.back.T
    return Covariance(
        ties,
        score,
        simulated,
        inverse @ score @ inverse,
        inverse,
        _foretold(sensitivity, weight, felt),
        felt.flat,
        felt.sizes,
        felt.singular_values,
        spread(sensitivity, weighted, felt.back, score),
    )


@dataclass(frozen=True)
class _Felt:
    """Directions that the outputs feel; back: (n_free, rank), in them the curvature is one.

    The others as of ``Covariance``.
    """

    back: FloatArray
    flat: FloatArray
    sizes: FloatArray
    singular_values: FloatArray


def _felt(
    local: Sensitivity, weight: FloatArray, ties: FloatArray, held: BoolArray | None = None
) -> _Felt:
    """Those that move the outputs, as they weigh, across the ties and without what is held."""
    rows = (local.slopes * np.sqrt(weight)[:, None]).reshape(-1, local.slopes.shape[2])
    sizes = np.linalg.norm(rows, axis=0)
    moving = sizes > _ROUNDING**2 * np.max(sizes * spans(local.objective, local.chromosome))
    sizes = np.where(moving if held is None else moving & ~held, sizes, 0.0)
    basis = _complement(ties, sizes)
    scaled = np.divide(rows, sizes, out=np.zeros_like(rows), where=sizes > 0.0)
    _, values, axes = np.linalg.svd(scaled @ basis, full_matrices=False)
    felt = values > _ROUNDING * values[0] if len(values) else np.zeros(0, dtype=bool)
    back = basis @ (axes[felt].T / values[felt])
    back = np.divide(back, sizes[:, None], out=np.zeros_like(back), where=sizes[:, None] > 0.0)
    return _Felt(back, axes[~felt] @ basis.T, sizes, values)


def _foretold(local: Sensitivity, weight: FloatArray, felt: _Felt) -> FloatArray:
    """Step (n_free,) to the minimum that slopes foretell."""
    score = np.einsum("tip,ti,i->p", local.slopes, local.residual, weight)
    step: FloatArray = -felt.back @ (felt.back.T @ score)
    return step


def _score(
    sensitivity: Sensitivity,
    weighted: FloatArray,
    held: BoolArray | None,
    simulated: SimulatedScore,
) -> FloatArray:
    """Covariance of the score by all noise, (n_free, n_free).

    weighted: slopes times weights; held: (n_free,), coordinates that were not fitted.
    """
    residual, fitted = sensitivity.residual, sensitivity.slopes
    if held is not None:
        fitted = fitted[..., ~held]
    seen, lengths = sensitivity.seen, sensitivity.lengths
    noise = colour(residual, seen, lengths, fitted)
    score = score_covariance(weighted, seen, lengths, noise, residual)
    # Not all that the inputs' noise does is seen in residuals: parameters take up slow changes.
    return larger(score, simulated.by_inputs) + simulated.by_rest


def _simulated_score(
    sensitivity: Sensitivity, weight: FloatArray, weighted: FloatArray, ties: FloatArray
) -> SimulatedScore:
    """What simulations tell of the score's covariance; weighted: slopes times weights."""
    by_inputs = _score_covariance_by_inputs(sensitivity, weighted)
    starts = (change for _, change in start_errors(sensitivity))
    constant = zero_errors(sensitivity), starts, parabola_errors(sensitivity)
    errors = (*constant, averages_errors(sensitivity), bend_errors(sensitivity))
    pushes = [_score_covariance_by(weighted, each) for each in errors]
    raised = np.array([*noise_pushes(sensitivity, weight, ties)]).reshape(-1, weighted.shape[2])
    return SimulatedScore(by_inputs, sum(pushes, raised.T @ raised))


def noise_pushes(local: Sensitivity, weight: FloatArray, ties: FloatArray) -> Iterator[FloatArray]:
    """Changes (n_free,) of a filter's score by a standard deviation of each output's noise.

    Those that move the estimate as far as the minima that slopes foretell lie apart. A filter that
    corrects itself jumps at kinks: a single slope there may outweigh a score, and hardly moves a
    minimum.
    """
    raised = [*raised_noises(local, weight)]
    if not raised:
        return
    curvature = np.einsum("tip,tir,i->pr", local.slopes, local.slopes, weight, optimize=True)
    minimum = _foretold(local, weight, _felt(local, weight, ties))
    for moved, weights, share in raised:
        there = _foretold(moved, weights, _felt(moved, weights, ties))
        yield curvature @ (minimum - there) * share


def _complement(ties: FloatArray, sizes: FloatArray) -> FloatArray:
    """Orthonormal basis, (n_free, n), of scaled coordinates that move and are across the ties."""
    resting = np.diag(np.where(sizes > 0.0, 0.0, 1.0))[sizes == 0.0]
    along = ties * sizes
    lengths = np.linalg.norm(along, axis=1, keepdims=True)
    along = along[lengths[:, 0] > 0.0] / lengths[lengths[:, 0] > 0.0]
    across: FloatArray = null_space(np.concatenate([along, resting]).reshape(-1, len(sizes)))
    return across


def _score_covariance_by_inputs(sensitivity: Sensitivity, weighted: FloatArray) -> FloatArray:
    """Covariance of the score by the noise of the inputs, (n_free, n_free)."""
    covariance = np.zeros((weighted.shape[2], weighted.shape[2]))
    for rows, changes in input_noises(sensitivity):
        pushes = np.tensordot(weighted[rows], changes, axes=([0, 1], [0, 1]))
        covariance += pushes @ pushes.T
    return covariance


def _score_covariance_by(weighted: FloatArray, changes: Iterable[FloatArray]) -> FloatArray:
    """Covariance of the score by independent changes of the residuals, (n_free, n_free)."""
    pushes = [np.einsum("tip,ti->p", weighted, change) for change in changes]
    stacked = np.array(pushes).reshape(-1, weighted.shape[2])
    covariance: FloatArray = stacked.T @ stacked
    return covariance


def larger(seen: FloatArray, stated: FloatArray) -> FloatArray:
    """A covariance as large in every direction as the larger of two."""
    values, vectors = np.linalg.eigh(seen)
    root = np.sqrt(np.maximum(values, 1e-14 * max(values[-1], 1e-300)))
    relative = (vectors.T @ stated @ vectors) / np.outer(root, root)
    ratio, axes = np.linalg.eigh(relative)
    back = (vectors * root) @ axes
    larger: FloatArray = (back * np.maximum(ratio, 1.0)) @ back.T
    return larger
