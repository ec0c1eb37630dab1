"""Where a free run starts on a record, when the record's outputs were asked for it."""

from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.problem.data import Dataset
from sysid.problem.metrics import fit_percent

_ON_END = 1e-3  # of a range, this near to an end of which a start stands on it


@dataclass(frozen=True)
class Start:
    """An estimated initial state: its value, its first sample (NaN where unmeasured), its range."""

    state: str
    unit: str
    value: float
    first: float
    low: float
    high: float

    @property
    def on_end(self) -> bool:
        """Whether an end of the range decides it."""
        near = _ON_END * (self.high - self.low)
        return self.value < self.low + near or self.value > self.high - near


@dataclass(frozen=True)
class Starts:
    """Estimated initial states of a record, and fits [%] (n_outputs,) from its first sample.

    first_fit: None where no estimated state is measured.
    """

    estimates: tuple[Start, ...]
    first_fit: FloatArray | None


def estimated_starts(
    simulator: BatchSimulator, vector: FloatArray, record: Dataset, start: FloatArray
) -> Starts:
    """What is to be said of a start (n_states,) that was estimated from a record."""
    model, estimates, at_first = simulator.model, [], start.copy()
    for i, state in enumerate(model.states):
        ends = record.initial_range(model, i)
        if ends is None:
            continue
        first = np.nan
        if state.name in model.output_names:
            first = float(record.outputs[0, model.output_names.index(state.name)])
        if np.isfinite(first):
            at_first[i] = first
        estimates.append(Start(state.name, state.unit, float(start[i]), first, *ends))
    if not any(np.isfinite(estimate.first) for estimate in estimates):
        return Starts(tuple(estimates), None)
    run = simulator.trajectories(vector[None], record, None, at_first[None])[0]
    return Starts(tuple(estimates), fit_percent(record.outputs, run))
