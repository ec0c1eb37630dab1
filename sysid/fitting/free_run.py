"""Where a free run starts when the record does not say."""

from __future__ import annotations

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.problem.data import Dataset
from sysid.problem.space import SearchSpace

# How accuracies go on where the errors of single steps add up, and where that ends.
FINER, FINEST = 0.1, 1e-9


def free_run(simulator: BatchSimulator, vector: FloatArray, record: Dataset) -> FloatArray:
    """Outputs of a record's inputs, (n_samples, n_outputs), from where the record starts.

    Initial states that the model leaves to be estimated are, from the record's outputs. The
    simulator's accuracy holds for the whole run, also where the errors of its steps add up.
    """
    wanted = simulator.accuracy
    while True:
        start = estimate_start(simulator, vector, record)
        outputs: FloatArray = simulator.trajectories(vector, record, starts=start[None])[0]
        twice = 2 * int(simulator.steps_of_each(vector, record).max())
        finer = simulator.trajectories(vector, record, twice, start[None])[0]
        error = np.sqrt(np.mean((finer - outputs) ** 2, axis=0))
        size = np.maximum(np.max(np.abs(finer), axis=0), 1e-300)
        if not np.max(error / size) > wanted or simulator.accuracy < FINEST:
            return outputs
        simulator = simulator.finer(FINER * simulator.accuracy)


def estimate_start(simulator: BatchSimulator, vector: FloatArray, record: Dataset) -> FloatArray:
    """Initial states of one record under known parameters, (n_states,).

    States with an ``initial_range`` are fitted to the record's outputs by least squares; the
    others come from the first sample or as declared. Without a single measured sample nothing
    is fitted.
    """
    model = simulator.model
    own = record.initial_state(model)
    space = SearchSpace.of_starts(model, vector, record)
    weights = np.asarray(np.isfinite(record.outputs).any(axis=0), dtype=np.float64)
    if not (space.estimated and weights.any()):
        return own
    objective = Objective(simulator, space, [record], weights=weights)
    begin = space.with_nominal_starts(np.empty(0))
    found = refine(objective, begin).chromosome
    start: FloatArray = space.starts(found[None], 0, own)[0]
    return start
