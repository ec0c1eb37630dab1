"""Do the residuals still hold something that the model should have explained?

Autocorrelation (are they white?) and correlation with past and present inputs (is there
dynamics left in them?), each with 95 % bands (Ljung, "System Identification", section 16.6).
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.uncertainty.estimate import Z95

LAGS = 50  # at which correlations are tested
_LEAST_VARIANCE = 0.05  # of a correlation, in parts of 1/n: estimated ones can turn out negative


@dataclass(frozen=True)
class ResidualTest:
    """Correlations of the residuals of one record.

    lags: (n_lags,), samples, from 0. auto: (n_lags, n_outputs), autocorrelation, 1 at lag 0;
    auto_band: (n_outputs,), half width of its 95 % band. cross: (n_lags, n_outputs, n_inputs),
    correlation of the residual with the input so many samples before, in parts of the product of
    their deviations; cross_band: (n_outputs, n_inputs); chance: likewise, probability of
    correlations so large at all lags together, were nothing left; 1 where that is not tested.
    tested: (n_inputs,), inputs that say something: they change, and are not themselves measured
    with noise, which stands in the residuals as well. Of inputs that act after their sample the
    correlations at lag 0 are none: it is not the plant that makes them, but whoever made the input.
    """

    lags: IntArray
    auto: FloatArray
    auto_band: FloatArray
    cross: FloatArray
    cross_band: FloatArray
    chance: FloatArray
    tested: BoolArray

    @property
    def white(self) -> FloatArray:
        """Share of the lags above 0 inside the band, (n_outputs,); 0.95 is expected."""
        share: FloatArray = np.mean(np.abs(self.auto[1:]) <= self.auto_band, axis=0)
        return share

    @property
    def independent(self) -> FloatArray:
        """Share of lags inside the band, (n_outputs, n_inputs), 0.95 expected; NaN if untested."""
        return np.where(self.tested, np.mean(np.abs(self.cross) <= self.cross_band, axis=0), np.nan)


def residual_test(
    residual: FloatArray,
    inputs: FloatArray,
    input_noise: FloatArray | None = None,
    n_lags: int = LAGS,
    systematic: FloatArray | None = None,
    later: BoolArray | None = None,
) -> ResidualTest:
    """Correlations of measured minus simulated, (n, n_outputs), NaN where a sample was lost.

    inputs: (n, n_inputs); input_noise: (n_inputs,), standard deviation of the noise that they were
    measured with. n_lags: at most a quarter of the record is used. systematic: (n, n_outputs, k),
    independent errors, by a standard deviation each, that a right model may make and that go with
    the inputs: its bands are wider by them. later: (n_inputs,), inputs that act after their sample.
    """
    n_lags = max(2, min(n_lags, len(residual) // 4))
    seen = np.isfinite(residual)
    e, u = _standard(residual), _standard(inputs)
    counted = np.maximum(seen.sum(axis=0), 1)
    auto = autocorrelations(e)
    cross = np.stack([_products(e, u, k) for k in range(n_lags)]) / counted[:, None]
    if later is not None:
        cross[0, :, later] = 0.0
    # Both being coloured widens the band: sum over k of R_e(k) R_u(k) / n is the variance.
    covariance = _coloured(auto, u, n_lags) / counted[:, None]
    variance = np.maximum(covariance[0], _LEAST_VARIANCE / counted[:, None])
    if systematic is not None:
        widening = _systematic_variance(systematic, residual, u, n_lags)
        covariance, variance = covariance + widening, variance + widening
    noisy = np.zeros(inputs.shape[1]) if input_noise is None else np.asarray(input_noise)
    tested = (noisy == 0.0) & np.any(u != 0.0, axis=0)
    return ResidualTest(
        lags=np.arange(n_lags),
        auto=auto[:n_lags],
        auto_band=Z95 / np.sqrt(counted),
        cross=cross,
        cross_band=Z95 * np.sqrt(variance),
        chance=np.where(tested, _chance(cross, variance, covariance), 1.0),
        tested=tested,
    )


def autocorrelations(values: FloatArray) -> FloatArray:
    """Of columns of mean zero, (n, k), at lags from 0 on and, behind them, from -1 back, (2 n, k).

    0 of a column that never changes.
    """
    correlations: FloatArray = np.fft.irfft(_spectrum(values), axis=0)
    return correlations


def _spectrum(values: FloatArray) -> FloatArray:
    """That of the autocorrelations of columns of unit variance, (n + 1, k)."""
    squares = np.maximum(np.sum(values**2, axis=0), 1.0)
    spectrum: FloatArray = np.abs(np.fft.rfft(values, 2 * len(values), axis=0)) ** 2 / squares
    return spectrum


def _coloured(auto: FloatArray, u: FloatArray, n_lags: int) -> FloatArray:
    """Covariances of correlations that many lags apart, (n_lags, n_outputs, n_inputs), times n.

    auto: (2 n, n_outputs), as of ``autocorrelations``. Sums over all j of R_e(j) R_u(j + lag), by
    Parzen's window as far as they can be told: of slow residuals and inputs that change seldom,
    correlations are wide, and all lags tell the same.
    """
    farthest, window = 2 * n_lags, np.zeros(len(auto))
    window[:farthest] = _parzen(np.arange(farthest) / farthest)
    window[-farthest + 1 :] = window[farthest - 1 : 0 : -1]
    smooth, driving = np.fft.rfft(window[:, None] * auto, axis=0).real, _spectrum(u)
    covariances = np.zeros((n_lags, auto.shape[1], u.shape[1]))
    for j, i in np.ndindex(covariances.shape[1:]):
        covariances[:, j, i] = np.fft.irfft(smooth[:, j] * driving[:, i])[:n_lags]
    return covariances


def _parzen(part: FloatArray) -> FloatArray:
    """Parzen's weights of lags in parts of the farthest, whose spectrum is nowhere negative."""
    near = 1.0 - 6.0 * part**2 * (1.0 - part)
    weights: FloatArray = np.where(part < 0.5, near, 2.0 * (1.0 - part) ** 3)
    return weights


def _chance(cross: FloatArray, variance: FloatArray, covariance: FloatArray) -> FloatArray:
    """Probability of correlations, (n_lags, n_outputs, n_inputs), so large in the mean square.

    variance: (n_outputs, n_inputs); covariance: as cross, of correlations that many lags apart.
    Squares of what is correlated sum to a chi-square of fewer degrees of freedom.
    """
    n_lags = len(cross)
    pairs = 2.0 * np.arange(n_lags, 0, -1)
    pairs[0] = n_lags
    correlation = covariance / variance
    correlation[0] = 1.0  # of the least variance, too
    freedom = n_lags**2 / np.tensordot(pairs, correlation**2, 1)
    chance: FloatArray = chdtrc(freedom, np.mean(cross**2, axis=0) / variance * freedom)
    return chance


def _systematic_variance(
    systematic: FloatArray, residual: FloatArray, u: FloatArray, n_lags: int
) -> FloatArray:
    """Largest variance, over the lags, of correlations that systematic errors make, (q, m)."""
    deviation = np.nanstd(residual, axis=0)
    scaled = systematic / np.where(deviation > 0.0, deviation, np.inf)[:, None]
    n, q, count = scaled.shape
    scaled = np.where(np.isfinite(scaled), scaled - scaled.mean(axis=0), 0.0).reshape(n, -1)
    largest = np.zeros((q, u.shape[1]))
    for lag in range(n_lags):
        correlations = (_products(scaled, u, lag) / n).reshape(q, count, u.shape[1])
        largest = np.maximum(largest, np.sum(correlations**2, axis=1))
    return largest


def _standard(values: FloatArray) -> FloatArray:
    """Zero mean and unit variance in each column; 0 where a sample is missing."""
    seen = np.isfinite(values)
    count = np.maximum(seen.sum(axis=0), 1)
    centred = np.where(seen, values - np.where(seen, values, 0.0).sum(axis=0) / count, 0.0)
    deviation = np.sqrt(np.sum(centred**2, axis=0) / count)
    # What rounding leaves of a column that never changes is no signal.
    largest = np.max(np.where(seen, np.abs(values), 0.0), axis=0, initial=0.0)
    steady = deviation <= 1e-12 * largest
    return np.where(steady, 0.0, centred / np.where(steady, 1.0, deviation))


def _products(a: FloatArray, b: FloatArray, lag: int) -> FloatArray:
    """Sum of a(t) b(t - lag), (n_a, n_b)."""
    return a[lag:].T @ b[: len(b) - lag]
