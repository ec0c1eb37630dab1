"""What residuals are like where no floor is known: shared by outputs, or larger in fast motion.

Sensors err each by themselves. An error that two outputs share came through the plant: a force, a
voltage, a friction that the model lacks. And sensors err as much in slow as in fast motion; more in
fast motion is what instants do that are not those of the clock, or a time constant that is wrong.
"""

import numpy as np
from scipy.stats import spearmanr

from sysid.arrays import BoolArray, FloatArray
from sysid.judging.residual_tests import residual_test
from sysid.uncertainty.estimate import Z95

_LAGS = 20  # at which two outputs' residuals are compared
# Deviations of chance beyond which the largest of so many correlations is none of it.
_SURE = 4.5
_EXPECTED = 0.5  # of a residual's deviation, from where what a right model leaves may explain it


def shared_errors(residual: FloatArray, systematic: FloatArray) -> FloatArray:
    """Largest correlation, at any lag, of each output's residuals with another's, (n_outputs,).

    residual: (n, n_outputs), NaN where a sample was lost; systematic: (n, n_outputs, k), errors of
    a right model, by a standard deviation each. 0 where chance or these explain it.

    >>> rng = np.random.default_rng(0)
    >>> apart, push = rng.standard_normal((500, 2)), rng.standard_normal((500, 1))
    >>> pushed, nothing = apart + push, np.zeros((500, 2, 0))
    >>> [shared_errors(e, nothing).round(1).tolist() for e in (apart, pushed)]
    [[0.0, 0.0], [0.5, 0.5]]
    """
    q = residual.shape[1]
    test = residual_test(residual, np.where(np.isfinite(residual), residual, 0.0), n_lags=_LAGS)
    sure = np.abs(test.cross) > _SURE / Z95 * test.cross_band
    sizes = np.where(sure, np.abs(test.cross), 0.0).max(axis=0) * ~np.eye(q, dtype=np.bool_)
    explained = _explained(residual, systematic)
    sizes[explained | explained[:, None]] = 0.0
    largest: FloatArray = np.maximum(sizes, sizes.T).max(axis=0, initial=0.0)
    return largest


def errors_by_speed(
    residual: FloatArray, simulated: FloatArray, systematic: FloatArray
) -> FloatArray:
    """Rank correlation of the residuals' size with the outputs' rate of change, (n_outputs,).

    residual, simulated: (n, n_outputs), systematic: (n, n_outputs, k) as of ``shared_errors``. 0
    where chance explains it, or what a right model leaves.
    """
    trend = np.zeros(residual.shape[1])
    rates = np.abs(np.gradient(simulated, axis=0))
    for j in np.flatnonzero(~_explained(residual, systematic)):
        seen = np.isfinite(residual[:, j])
        errors, speeds = np.abs(residual[seen, j]), rates[seen, j]
        if seen.sum() < 50 or not np.ptp(errors) or not np.ptp(speeds):
            continue
        correlation = float(spearmanr(errors, speeds).statistic)
        trend[j] = correlation if correlation > _SURE / np.sqrt(seen.sum()) else 0.0
    return trend


def _explained(residual: FloatArray, systematic: FloatArray) -> BoolArray:
    """Outputs whose residuals may be what a right model leaves, (n_outputs,)."""
    seen = np.isfinite(residual)
    squares = np.sum(np.where(seen, residual, 0.0) ** 2, axis=0)
    size = np.sqrt(squares / np.maximum(seen.sum(axis=0), 1))
    expected = np.sqrt(np.mean(np.sum(systematic**2, axis=2), axis=0))
    explained: BoolArray = ~(expected < _EXPECTED * size)
    return explained
