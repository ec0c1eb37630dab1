"""Free runs that precise measurements hold near the data, whose minima are easy to find.

Where a shaft sticks it rings, and where friction turns it over is decided by little: far from the
true parameters errors of free runs go up and down with them, and descents end where they begin. A
state that is measured with hardly any noise need not run free while a minimum is looked for:

    dx_i/dt = f_i(x, u, p) + l (y_i - x_i)

forgets where it has been within 1 / l, and all else is driven by what was measured (Abarbanel,
Creveling, Farsian & Kostuk, "Dynamical state and parameter estimation", SIAM Journal on Applied
Dynamical Systems 8, 2009). Right parameters leave as little as they do of free runs.
"""

import functools
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.engine.simulation import BatchSimulator
from sysid.gassi.excerpt import Excerpt
from sysid.problem.data import Dataset
from sysid.problem.model import Input, ProcessModel

_PRECISE = 1e-3  # noise in parts of how a channel varies
_FORGETTING = 0.25  # of what a state has been, in a sample
_SEEN = 0.5  # of the samples of a record


def nudged(simulator: BatchSimulator, excerpt: Excerpt) -> tuple[BatchSimulator, Excerpt] | None:
    """What simulates a model held by its precise measurements, and an excerpt that has them.

    None where no state is measured so.
    """
    model, records = simulator.model, excerpt.records
    places = tuple(
        i
        for i, name in enumerate(model.state_names)
        if name in model.output_names
        and all(_is_precise(record, model.output_names.index(name)) for record in records)
    )
    if not places:
        return None
    rate = _FORGETTING / min(record.dt for record in records)
    driven = tuple(_with_measured(record, model, places) for record in records)
    return simulator.of(_nudged(model, places, rate)), replace(excerpt, records=driven, cut=False)


def _is_precise(record: Dataset, output: int) -> bool:
    values = record.outputs[:, output]
    seen = values[np.isfinite(values)]
    least = record.sample_noise(output, seen) / _PRECISE
    return len(seen) >= _SEEN * len(values) and bool(np.std(seen) > least)


def _with_measured(record: Dataset, model: ProcessModel, places: tuple[int, ...]) -> Dataset:
    """A record with what was measured of states among its inputs, means at the middle of theirs."""
    start, columns = record.initial_state(model), [record.inputs]
    for i in places:
        j = model.output_names.index(model.state_names[i])
        seen = np.isfinite(record.outputs[:, j])
        late = record.windows[:, j].mean(axis=1)[seen] if record.windows.size else 0.0
        at, values = record.time[seen] + late, record.outputs[seen, j]
        columns.append(np.interp(record.time, at, values, left=start[i])[:, None])
    none = np.zeros((len(record.inputs), len(places)))
    return replace(
        record,
        inputs=np.hstack(columns),
        input_zero=np.append(record.input_zero, none[0]),
        input_noise=np.append(record.input_noise, none[0]),
        between=np.hstack([record.between, none]) if record.between.size else record.between,
    )


@functools.lru_cache(maxsize=8)  # one model for the same question: its kernels are kept by it
def _nudged(model: ProcessModel, places: tuple[int, ...], rate: float) -> ProcessModel:
    """The model with inputs more, each of which draws the state at a place to it by a rate."""
    for i in places:
        model = _drawn(model, i, rate)
    return model


def _drawn(model: ProcessModel, i: int, rate: float) -> ProcessModel:
    n, state = len(model.inputs), model.states[i]
    derivative, output = model.derivative, model.output

    def rates(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        free = derivative(x, u[:n], p)
        return (*free[:i], free[i] + rate * (u[n] - x[i]), *free[i + 1 :])

    def outputs(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        return output(x, u[:n], p)  # type: ignore[misc]

    return replace(
        model,
        inputs=(*model.inputs, Input(f"measured {state.name}", state.unit, "foh")),
        derivative=rates,
        output=None if output is None else outputs,
        variants=None,
    )
