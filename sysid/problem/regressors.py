"""Signals computed from a record's, as further inputs of linear models.

A linear model cannot multiply. What its owner knows to act as a product, such as the torque of a
brake, current times the sign of the speed, may be given to it as an input:

    def regressors(record):
        return {"current*sign(omega)": record["current"] * np.sign(record["omega"])}

record: as in ``sysid.problem.guesses``. Of measured outputs this is more than a free run is given.
"""

from dataclasses import replace

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.data import Dataset
from sysid.problem.guesses import Measured
from sysid.problem.model import ModelError, ProcessModel
from sysid.time_limit import AT_LENGTH, time_limit


def with_regressors(model: ProcessModel, record: Dataset) -> tuple[Dataset, tuple[str, ...]]:
    """The record with the model's ``regressors`` behind its inputs, and their names.

    Each stands a row later than what it is computed from, so that no output ever explains itself
    by its own sample; what was lost is held. Raises ModelError for one that is no such signal.

    >>> from dataclasses import replace
    >>> from sysid.examples import lag, lag_record
    >>> model = replace(lag(), regressors=lambda record: {"y^2": record["y"] ** 2})
    >>> with_regressors(model, lag_record())[0].inputs[:3].round(2).tolist()
    [[0.27, 0.0], [0.27, 0.0], [0.27, 0.03]]
    """
    signals = _signals(model, Measured(record, model))
    columns = [_delayed(name, signal, record) for name, signal in signals.items()]
    inputs = np.column_stack((record.inputs, *columns))
    unknown = np.zeros(len(columns))
    extended = replace(
        record,
        inputs=inputs,
        input_zero=np.append(record.input_zero, unknown),
        input_noise=np.append(record.input_noise, unknown),
    )
    return extended, tuple(signals)


def _signals(model: ProcessModel, record: Measured) -> dict[str, object]:
    if model.regressors is None:
        return {}
    try:
        with time_limit(AT_LENGTH):
            return dict(model.regressors(record))
    except ModelError:
        raise
    except Exception as error:
        where = f"model {model.name}: regressors(record)"
        raise ModelError(f"{where} fails: {type(error).__name__}: {error}") from error


def _delayed(name: str, signal: object, record: Dataset) -> FloatArray:
    """The signal (n_samples,) of the row before, lost samples as the last before or first after."""
    values = np.asarray(signal, dtype=np.float64)
    if values.shape != (record.n_samples,) or not np.isfinite(values).any():
        raise ModelError(
            f"{record.name}: regressor {name!r} has shape {values.shape}; give {record.n_samples} "
            "numbers, one for each row, NaN where one was lost"
        )
    measured = np.flatnonzero(np.isfinite(values))
    rows = np.arange(-1, record.n_samples - 1)
    place = np.searchsorted(measured, rows, side="right") - 1
    return np.asarray(values[measured[np.maximum(place, 0)]], dtype=np.float64)
