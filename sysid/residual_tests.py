"""Do the residuals still hold something that the model should have explained?

Autocorrelation (are they white?) and correlation with past and present inputs (is there
dynamics left in them?), each with 95 % bands (Ljung, "System Identification", section 16.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.model import FloatArray

_Z95 = 1.959963984540054


@dataclass(frozen=True)
class ResidualTest:
    """Correlations of the residuals of one record.

    lags: (n_lags,), from 0. auto: (n_lags, n_outputs), autocorrelation, 1 at lag 0; auto_band:
    (n_outputs,), half width of its 95 % band. cross: (n_lags, n_outputs, n_inputs), correlation
    of the residual with the input that many samples before, in parts of the product of their
    deviations; cross_band: (n_outputs, n_inputs). An input that never changes has correlation 0.
    """

    lags: FloatArray
    auto: FloatArray
    auto_band: FloatArray
    cross: FloatArray
    cross_band: FloatArray

    @property
    def white(self) -> FloatArray:
        """Share of the lags above 0 inside the band, per output; 0.95 is expected."""
        share: FloatArray = np.mean(np.abs(self.auto[1:]) <= self.auto_band, axis=0)
        return share

    @property
    def independent(self) -> FloatArray:
        """Share of the lags inside the band, (n_outputs, n_inputs); 0.95 is expected."""
        share: FloatArray = np.mean(np.abs(self.cross) <= self.cross_band, axis=0)
        return share


def residual_test(residual: FloatArray, inputs: FloatArray, n_lags: int = 50) -> ResidualTest:
    """Correlations of measured minus simulated, (n, n_outputs), NaN where a sample was lost.

    inputs: (n, n_inputs). n_lags: at most a quarter of the record is used.
    """
    n = len(residual)
    n_lags = max(2, min(n_lags, n // 4))
    seen = np.isfinite(residual)
    e = _standard(np.where(seen, residual, np.nan))
    u = _standard(inputs)
    lags = np.arange(n_lags)
    auto = np.stack([_correlation(e, e, int(k)) for k in lags])
    own = np.stack([auto[:, j, j] for j in range(e.shape[1])], axis=1)
    cross = np.stack([_correlation(e, u, int(k)) for k in lags])
    counted = np.maximum(seen.sum(axis=0), 1)
    inputs_own = np.stack([np.diagonal(_correlation(u, u, int(k))) for k in lags])
    # Both being coloured widens the band: the variance of their correlation is
    # sum over k of R_e(k) R_u(k) / N.
    both = np.einsum("ko,ki->koi", own[1:], inputs_own[1:])
    variance = np.maximum(1.0 + 2.0 * both.sum(axis=0), 0.05) / counted[:, None]
    return ResidualTest(
        lags.astype(np.float64), own, _Z95 / np.sqrt(counted), cross, _Z95 * np.sqrt(variance)
    )


def _standard(values: FloatArray) -> FloatArray:
    """Zero mean and unit variance in each column; 0 where a sample is missing."""
    centred = values - np.nanmean(values, axis=0)
    deviation = np.sqrt(np.nanmean(centred**2, axis=0))
    scaled = centred / np.where(deviation > 0.0, deviation, 1.0)
    return np.where(np.isfinite(scaled), scaled, 0.0)


def _correlation(a: FloatArray, b: FloatArray, lag: int) -> FloatArray:
    """Mean of a(t) b(t - lag), (n_a, n_b)."""
    product: FloatArray = a[lag:].T @ b[: len(b) - lag] / len(a)
    return product
