"""What the records of a difference equation must have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.problem.data import Dataset
from sysid.problem.model import ModelError


def check_alike(records: Sequence[Dataset]) -> None:
    """Raise ModelError unless all have the same columns and sample time, and finite outputs."""
    first = records[0]
    for record in records:
        check_columns(record, first.inputs.shape[1], first.outputs.shape[1], first.name)
        check_sample_time(record, first.dt, first.name)
        if np.any(np.isinf(record.outputs)):
            row = int(np.argmax(np.isinf(record.outputs).any(axis=1)))
            raise ModelError(
                f"{record.name}: an output is infinite in row {row}; mark lost samples with NaN"
            )


def check_columns(record: Dataset, n_inputs: int, n_outputs: int, other: str) -> None:
    """Raise ModelError unless a record has as many columns as another, or as the model."""
    found = (record.inputs.shape[1], record.outputs.shape[1])
    if found != (n_inputs, n_outputs):
        raise ModelError(
            f"{record.name}: {found[0]} inputs and {found[1]} outputs, but {other} has "
            f"{n_inputs} and {n_outputs}; give records of the same signals"
        )


def check_sample_time(record: Dataset, dt: float, other: str) -> None:
    """Raise ModelError unless a record has the sample time dt [s] of another, or the model's."""
    if not np.isclose(record.dt, dt, rtol=1e-6, atol=0.0):
        raise ModelError(
            f"{record.name}: its sample time is {record.dt} s, that of {other} {dt} s; a "
            "difference equation holds for one sample time, so resample the record"
        )
