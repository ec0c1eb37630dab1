"""Free runs that precise measurements hold near the data, whose minima are easy to find.

Where a shaft sticks it rings, and where friction turns it over is decided by little: far from the
true parameters errors of free runs go up and down with them, and descents end where they begin. A
state that is measured with hardly any noise need not run free while a minimum is looked for:

    dx_i/dt = f_i(x, u, p) + l (y_i - x_i)

forgets where it has been within 1 / l, and all else is driven by what was measured (Abarbanel,
Creveling, Farsian & Kostuk, "Dynamical state and parameter estimation", SIAM Journal on Applied
Dynamical Systems 8, 2009). Right parameters leave as little as they do of free runs.

What is found so may still be far from where a free run is beside the data: a pendulum that turns
over takes another number of turns. So l is made small by steps, and descents follow (a homotopy, as
of Vyasarayani, Uchida, Carvalho & McPhee, "Parameter identification in dynamic systems using the
homotopy optimization approach", Multibody System Dynamics 26, 2011).
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import Refinement, begin, refine_each
from sysid.problem.data import Dataset
from sysid.problem.model import Input, ProcessModel

Rates = Callable[[Any, Any, Any], tuple[Any, ...]]

_PRECISE = 1e-3  # noise in parts of how a channel varies
_FORGETTING = 0.25  # of what a state has been, in a sample
_LET_GO = (0.08, 0.025, 8e-3, 2.5e-3)  # the same while it is let go
_SEEN = 0.5  # of the samples of a record


def nudged(
    simulator: BatchSimulator, records: Sequence[Dataset], forgetting: float = _FORGETTING
) -> tuple[BatchSimulator, list[Dataset]] | None:
    """What simulates a model held by its precise measurements, and records that have them.

    forgetting: share of what a state has been that is forgotten in a sample. None where no state
    is measured so.
    """
    model = simulator.model
    places = tuple(
        i
        for i, name in enumerate(model.state_names)
        if name in model.output_names
        and all(_is_precise(record, model.output_names.index(name)) for record in records)
    )
    if not places:
        return None
    rate = forgetting / min(record.dt for record in records)
    driven = [_with_measured(record, model, places, rate) for record in records]
    return simulator.of(_nudged(model, places)), driven


def held(objective: Objective, forgetting: float = _FORGETTING) -> Objective | None:
    """An objective by runs that measurements hold, None where no state is measured so."""
    driven = nudged(objective.simulator, objective.records, forgetting)
    if driven is None:
        return None
    simulator, records = driven
    return objective.simulated_by(simulator).on(records)


def let_go(free: Objective, chromosomes: Sequence[FloatArray]) -> list[Refinement]:
    """Minima of free runs beside those of runs that are held, (n_free,), as these are let go."""
    for forgetting in _LET_GO:
        objective = held(free, forgetting)
        assert objective is not None
        ends = refine_each(objective, [begin(objective, each) for each in chromosomes])
        chromosomes = [end.chromosome for end in ends if np.isfinite(end.error)]
    return refine_each(free, [begin(free, each) for each in chromosomes])


def _is_precise(record: Dataset, output: int) -> bool:
    values = record.outputs[:, output]
    seen = values[np.isfinite(values)]
    least = record.sample_noise(output, seen) / _PRECISE
    return len(seen) >= _SEEN * len(values) and bool(np.std(seen) > least)


def _with_measured(
    record: Dataset, model: ProcessModel, places: tuple[int, ...], rate: float
) -> Dataset:
    """A record with what was measured of states among its inputs, means at the middle of theirs.

    Before them stands the rate by which they draw the states, so that one kernel does for all.
    """
    none = np.zeros((len(record.inputs), len(places) + 1))
    start, columns = record.initial_state(model), [record.inputs, none[:, :1] + rate]
    for i in places:
        j = model.output_names.index(model.state_names[i])
        seen = np.isfinite(record.outputs[:, j])
        late = record.windows[:, j].mean(axis=1)[seen] if record.windows.size else 0.0
        at, values = record.time[seen] + late, record.outputs[seen, j]
        columns.append(np.interp(record.time, at, values, left=start[i])[:, None])
    return replace(
        record,
        inputs=np.hstack(columns),
        input_zero=np.append(record.input_zero, none[0]),
        input_noise=np.append(record.input_noise, none[0]),
        between=np.hstack([record.between, none]) if record.between.size else record.between,
        changes=np.hstack([record.changes, none]) if record.changes.size else record.changes,
        last_part=np.append(record.last_part, none[0]),
    )


@functools.lru_cache(maxsize=8)  # one model for the same question: its kernels are kept by it
def _nudged(model: ProcessModel, places: tuple[int, ...]) -> ProcessModel:
    """The model with inputs more: a rate, and what each state at a place is drawn to by it."""
    n, derivative, output = len(model.inputs), model.derivative, model.output

    def rates(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        return derivative(x, u[:n], p)

    def outputs(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        return output(x, u[:n], p)  # type: ignore[misc]

    drawn: Rates = rates
    measured: list[Input] = []
    for column, i in enumerate(places, n + 1):
        drawn = _drawn(drawn, i, n, column)
        state = model.states[i]
        measured.append(Input(f"measured {state.name}", state.unit, "foh"))
    return replace(
        model,
        inputs=(*model.inputs, Input("rate", "1/s", "zoh"), *measured),
        derivative=drawn,
        output=None if output is None else outputs,
        variants=None,
    )


def _drawn(rates: Rates, i: int, rate: int, measured: int) -> Rates:
    """Rates of which one draws its state to an input, by the rate in another."""

    def drawn(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        free = rates(x, u, p)
        return (*free[:i], free[i] + u[rate] * (u[measured] - x[i]), *free[i + 1 :])

    return drawn
