"""How close a simulated output is to a measured one.

Inputs are (n_samples, n_outputs); lost samples (NaN in the measurement) do not count. Results
are (n_outputs,).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray


def rmse(
    measured: FloatArray, simulated: FloatArray, scale: FloatArray | float = 1.0
) -> FloatArray:
    """Root of the mean squared error, divided by ``scale`` (max|y| for tables 4.2 and 4.3)."""
    result: FloatArray = np.sqrt(_mean((simulated - measured) ** 2, measured)) / scale
    return result


def msd(measured: FloatArray, simulated: FloatArray, scale: FloatArray | float = 1.0) -> FloatArray:
    """Mean signed deviation, simulated minus measured, divided by ``scale``."""
    result: FloatArray = _mean(simulated - measured, measured) / scale
    return result


def fit_percent(measured: FloatArray, simulated: FloatArray) -> FloatArray:
    """100 (1 - ||y - y_sim|| / ||y - mean y||); 100 is perfect, 0 no better than the mean.

    An output that never changes has no spread to explain: NaN.
    """
    residual = np.sqrt(_mean((simulated - measured) ** 2, measured))
    spread = np.sqrt(_mean((measured - _mean(measured, measured)) ** 2, measured))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(spread > 0.0, 100.0 * (1.0 - residual / spread), np.nan)


def mean_known(values: FloatArray, axis: int | None = None) -> FloatArray:
    """Mean of the values that are not NaN; NaN where there is none."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        mean: FloatArray = np.where(known, values, 0.0).sum(axis=axis) / known.sum(axis=axis)
    return mean


def _mean(values: FloatArray, measured: FloatArray) -> FloatArray:
    """Mean over the samples that were measured; NaN for an output without any.

    A simulation that failed is no lost sample: its NaN stays.
    """
    counted = ~np.isnan(measured)
    with np.errstate(invalid="ignore"):
        total: FloatArray = np.where(counted, values, 0.0).sum(axis=0) / counted.sum(axis=0)
    return total


@dataclass(frozen=True)
class Metrics:
    """RMSE and MSD on outputs normalised by max|y| of the record, fit %, each (n_outputs,)."""

    rmse: FloatArray
    msd: FloatArray
    fit: FloatArray
    scale: FloatArray


def evaluate(measured: FloatArray, simulated: FloatArray) -> Metrics:
    """All metrics of one record; ``scale`` of the result is max|y| of ``measured``."""
    peak = np.max(np.where(np.isnan(measured), 0.0, np.abs(measured)), axis=0)
    scale = np.where(peak > 0.0, peak, 1.0)
    return Metrics(
        rmse=rmse(measured, simulated, scale),
        msd=msd(measured, simulated, scale),
        fit=fit_percent(measured, simulated),
        scale=scale,
    )
