"""Free runs of a record's inputs, and where they start when the record does not say."""

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.problem.data import Dataset
from sysid.problem.space import SearchSpace

# Factor to the next accuracy where the errors of single steps add up, and the last accuracy.
FINER, FINEST = 0.1, 1e-9


def free_run(simulator: BatchSimulator, vector: FloatArray, record: Dataset) -> FloatArray:
    """Outputs of a record's inputs, (n_samples, n_outputs), from where the record starts.

    Initial states with a range are estimated from the record's outputs. The simulator's accuracy
    holds for the whole run, also where the errors of its steps add up.

    >>> from sysid import BatchSimulator, Dataset, Input, Output, Parameter, ProcessModel, State
    >>> model = ProcessModel(
    ...     name="lag",
    ...     states=(State("y", "V"),),
    ...     inputs=(Input("u", "V"),),
    ...     outputs=(Output("y", "V"),),
    ...     parameters=(Parameter("tau", "s", 0.1, 0.01, 1.0, "log"),),
    ...     derivative=lambda x, u, p: ((u[0] - x[0]) / p[0],),
    ... )
    >>> record = Dataset(np.ones(4), np.zeros(4), 0.1)
    >>> free_run(BatchSimulator(model), model.nominal, record)[:, 0].round(3)
    array([0.   , 0.632, 0.865, 0.95 ])
    """
    accuracy = simulator.accuracy
    while True:
        start = estimate_start(simulator, vector, record)
        outputs: FloatArray = simulator.trajectories(vector, record, starts=start[None])[0]
        twice = 2 * int(simulator.steps_of_each(vector, record).max())
        finer = simulator.trajectories(vector, record, twice, start[None])[0]
        error = np.sqrt(np.mean((finer - outputs) ** 2, axis=0))
        size = np.maximum(np.max(np.abs(finer), axis=0), 1e-300)
        if not np.max(error / size) > accuracy or simulator.accuracy < FINEST:
            return outputs
        simulator = simulator.finer(FINER * simulator.accuracy)


def estimate_start(simulator: BatchSimulator, vector: FloatArray, record: Dataset) -> FloatArray:
    """Initial states (n_states,) of a record under parameters (n_parameters,).

    States with an ``initial_range`` are fitted to the measured outputs by least squares.
    """
    model = simulator.model
    declared = record.initial_state(model)
    space = SearchSpace.of_starts(model, vector, record)
    weights = np.asarray(np.isfinite(record.outputs).any(axis=0), dtype=np.float64)
    if not (space.estimated and weights.any()):
        return declared
    objective = Objective(simulator, space, [record], weights=weights)
    fitted = refine(objective, space.with_nominal_starts(np.empty(0))).chromosome
    start: FloatArray = space.starts(fitted[None], 0, declared)[0]
    return start
