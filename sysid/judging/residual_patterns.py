"""What residuals are like where no floor is known: shared, larger in fast motion, standing alone.

Sensors err each by themselves. An error that two outputs share came through the plant: a force, a
voltage, a friction that the model lacks. And sensors err as much in slow as in fast motion; more in
fast motion is what instants do that are not those of the clock, or a time constant that is wrong.
Single errors far from those beside them are outliers too small to be seen in the samples.
"""

import numpy as np
from scipy.special import bdtrc

from sysid.arrays import BoolArray, FloatArray
from sysid.judging.residual_tests import autocorrelations, residual_test
from sysid.problem.channels import MEDIAN_OF_NORMAL, off_neighbours, resolution
from sysid.uncertainty.estimate import Z95

_LAGS = 20  # at which two outputs' residuals are compared
# Deviations of chance beyond which the largest of so many correlations is none of it.
_SURE = 4.5
# Deviations of chance, and part of another correlation, beyond which one is there as well.
_LIKELY, _PART = 1.5, 0.2
_EXPECTED = 0.5  # of a residual's deviation, from where what a right model leaves may explain it
# Robust deviations from its neighbours at which an error stands alone, the share of such that does
# little harm (Student's noise of four degrees of freedom has 0.3 %), and the chance of more.
_ALONE, _HEAVY, _BY_CHANCE = 6.0, 1e-2, 1e-4


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
    past = np.abs(np.diff(simulated, axis=0, prepend=simulated[:1]))
    for j in np.flatnonzero(~_explained(residual, systematic)):
        seen = np.isfinite(residual[:, j])
        errors, speeds = np.abs(residual[seen, j]), rates[seen, j]
        if seen.sum() < 50 or not all(map(np.ptp, (errors, speeds, past[seen, j]))):
            continue
        ranks, fast = _ranks(errors), _ranks(speeds)
        correlation, chance = float(np.corrcoef(ranks, fast)[0, 1]), _by_chance(ranks, fast)
        # What comes after an error may answer it, as under feedback; what was before does not.
        before = float(np.corrcoef(ranks, _ranks(past[seen, j]))[0, 1])
        sure = correlation > _SURE * chance and before > max(_LIKELY * chance, _PART * correlation)
        trend[j] = correlation if sure else 0.0
    return trend


def _by_chance(ranks: FloatArray, others: FloatArray) -> float:
    """Standard deviation of the correlation of two series (n,) that have nothing in common.

    Slow ones go together for a while: as of Bartlett's in ``residual_test``.
    """
    both = np.stack([ranks - ranks.mean(), others - others.mean()], axis=1)
    common = float(np.sum(np.prod(autocorrelations(both), axis=1)))
    return float(np.sqrt(max(common, 1.0) / len(ranks)))


def errors_alone(residual: FloatArray, outputs: FloatArray) -> FloatArray:
    """Share of each output's errors that stand alone, (n_outputs,), 0 where chance explains it.

    residual, outputs: (n, n_outputs), NaN where a sample was lost. One stands alone where it is six
    robust deviations, and more than an output's resolution, from the mean of its neighbours, and
    the farthest of the three.

    >>> rng = np.random.default_rng(0)
    >>> noise = rng.standard_normal((500, 2))
    >>> noise[10::25, 1] += 12.0
    >>> errors_alone(noise, 100.0 + noise).round(2).tolist()
    [0.0, 0.04]
    """
    n, share = len(residual), np.zeros(residual.shape[1])
    apart = off_neighbours(residual)
    sizes = np.abs(np.where(np.isfinite(apart), apart, 0.0))
    for j in np.flatnonzero(sizes.any(axis=0)):
        size = sizes[:, j]
        limit = _ALONE / MEDIAN_OF_NORMAL * float(np.median(size[size > 0.0]))
        # What moves slowly is rounded up by a whole step at once.
        limit = max(limit, resolution(outputs[:, j]))
        beside = np.maximum(np.roll(size, 1), np.roll(size, -1))
        count = int(np.sum((size > limit) & (size > beside)))
        if bdtrc(count - 1, n, _HEAVY) < _BY_CHANCE:
            share[j] = count / n
    return share


def _explained(residual: FloatArray, systematic: FloatArray) -> BoolArray:
    """Outputs whose residuals may be what a right model leaves, (n_outputs,)."""
    seen = np.isfinite(residual)
    squares = np.sum(np.where(seen, residual, 0.0) ** 2, axis=0)
    size = np.sqrt(squares / np.maximum(seen.sum(axis=0), 1))
    expected = np.sqrt(np.mean(np.sum(systematic**2, axis=2), axis=0))
    explained: BoolArray = ~(expected < _EXPECTED * size)
    return explained


def _ranks(values: FloatArray) -> FloatArray:
    """Rank of each value (n,), the mean of their ranks for equal ones."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * (counts - 1))[place], dtype=np.float64)
