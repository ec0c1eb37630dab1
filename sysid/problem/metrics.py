"""How close a simulated output is to a measured one.

Inputs are (n_samples, n_outputs); lost samples (NaN in the measurement) do not count. Results
are (n_outputs,).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import BoolArray, FloatArray

FITTED = 50.0  # fit [%] below which a model explains little
_ROUNDING = 1e-12


def rmse(
    measured: FloatArray, simulated: FloatArray, scale: FloatArray | float = 1.0
) -> FloatArray:
    """Root of the mean squared error, divided by ``scale`` (max|y| for tables 4.2 and 4.3).

    >>> rmse(np.zeros((2, 1)), np.array([[3.0], [-3.0]]), scale=2.0).tolist()
    [1.5]
    """
    return np.sqrt(_mean((simulated - measured) ** 2, measured)) / scale


def msd(measured: FloatArray, simulated: FloatArray, scale: FloatArray | float = 1.0) -> FloatArray:
    """Mean signed deviation, simulated minus measured, divided by ``scale``.

    >>> msd(np.zeros((2, 1)), np.array([[3.0], [-1.0]])).tolist()
    [1.0]
    """
    return _mean(simulated - measured, measured) / scale


def fit_percent(measured: FloatArray, simulated: FloatArray) -> FloatArray:
    """100 (1 - ||y - y_sim|| / ||y - mean y||); 100 is perfect, 0 no better than the mean.

    An output that never changes has no spread to explain: NaN.

    >>> y = np.array([[1.0], [3.0]])
    >>> fit_percent(y, y).tolist(), fit_percent(y, 0.0 * y + 2.0).tolist()
    ([100.0], [0.0])
    >>> fit_percent(np.full((1000, 1), 0.1), np.zeros((1000, 1))).tolist()
    [nan]
    """
    spread = rmse(measured, _mean(measured, measured))
    rounding = _ROUNDING * np.sqrt(
        _mean(measured**2, measured)
    )  # of the mean of what never changes
    with np.errstate(divide="ignore", invalid="ignore"):
        fit = 100.0 * (1.0 - rmse(measured, simulated) / spread)
    return np.where(spread > rounding, fit, np.nan)


def mean_known(
    values: FloatArray | Sequence[FloatArray],
    axis: int | None = None,
    counted: BoolArray | None = None,
) -> FloatArray:
    """Mean of the values that are ``counted``, by default that are not NaN; NaN of none."""
    values = np.asarray(values)
    counted = ~np.isnan(values) if counted is None else counted
    with np.errstate(invalid="ignore"):
        mean: FloatArray = np.where(counted, values, 0.0).sum(axis=axis) / counted.sum(axis=axis)
    return mean


def _mean(values: FloatArray, measured: FloatArray) -> FloatArray:
    """Mean over the measured samples; a simulation that failed is no lost sample: its NaN stays."""
    return mean_known(values, 0, ~np.isnan(measured))


@dataclass(frozen=True)
class Metrics:
    """RMSE and MSD on outputs normalised by max|y| of the record, fit %, each (n_outputs,).

    >>> y = np.array([[0.0], [4.0]])
    >>> metrics = evaluate(y, y + 1.0)
    >>> metrics.rmse.tolist(), metrics.fit.tolist(), metrics.scale.tolist()
    ([0.25], [50.0], [4.0])
    """

    rmse: FloatArray
    msd: FloatArray
    fit: FloatArray
    scale: FloatArray

    @property
    def rmse_absolute(self) -> FloatArray:
        """RMSE in the outputs' units."""
        return self.rmse * self.scale


def evaluate(measured: FloatArray, simulated: FloatArray) -> Metrics:
    """All metrics of a record; ``scale`` of the result is max|y| of ``measured``.

    >>> evaluate(np.array([[0.0], [4.0]]), np.array([[1.0], [3.0]])).fit.tolist()
    [50.0]
    """
    peak = np.max(np.where(np.isnan(measured), 0.0, np.abs(measured)), axis=0)
    scale = np.where(peak > 0.0, peak, 1.0)
    errors = rmse(measured, simulated, scale), msd(measured, simulated, scale)
    return Metrics(*errors, fit_percent(measured, simulated), scale)
