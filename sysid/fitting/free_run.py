"""Free runs of a record's inputs, and where they start when the record does not say."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.engine.simulation import BatchSimulator
from sysid.fitting.moves import moved_by
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.problem.data import Dataset
from sysid.problem.space import SearchSpace

# Factor to the next accuracy where the errors of single steps add up, and the last accuracy.
_FINER, _FINEST = 0.1, 1e-9
_PART = 0.5  # of a deviation by which errors of the steps may move any quantity
_SHARE = 0.3  # of what is left of an output that they may be: more would show in it
# What is left of an output is no noise where errors of the steps do half of it, or so small.
_OWN, _NOTHING = 2.0, 1e-6
_FAR_MORE = 16  # times the steps that a search took, above which they would cost too much
_TELLING = 8192  # samples that tell where a record starts: of later ones a simulation costs more


def free_run(simulator: BatchSimulator, vector: FloatArray, record: Dataset) -> FloatArray:
    """Outputs of a record's inputs, (n_samples, n_outputs), from where the record starts.

    Initial states with a range are estimated from the record's outputs. The simulator's accuracy
    holds for the whole run, also where the errors of its steps add up; and they are small beside
    what the run leaves of outputs that were measured.

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
    return AccurateRun.of(simulator, vector, record).outputs


@dataclass(frozen=True)
class AccurateRun:
    """A free run, (n_samples, n_outputs), and what it is made of.

    simulator: accurate enough for it. start: (n_states,), where it begins.
    """

    simulator: BatchSimulator
    start: FloatArray
    outputs: FloatArray

    @classmethod
    def of(cls, simulator: BatchSimulator, vector: FloatArray, record: Dataset) -> Self:
        """As ``free_run``."""
        accuracy, start = simulator.accuracy, None
        while True:
            start = estimate_start(simulator, vector, record, start)
            steps = int(simulator.steps_of_each(vector, record, start[None]).max())
            few, many = (
                simulator.trajectories(vector, record, n, start[None])[0]
                for n in (steps, 2 * steps)
            )
            run = cls(simulator, start, few)
            if not run._errs(few - many, record, accuracy):
                return run
            taken = steps
            while steps <= taken:
                if simulator.accuracy < _FINEST:
                    return run
                simulator = simulator.finer(_FINER * simulator.accuracy)
                steps = int(simulator.steps_of_each(vector, record, start[None]).max())

    def _errs(self, error: FloatArray, record: Dataset, accuracy: float) -> bool:
        """Whether errors of the steps, (n_samples, n_outputs), are more than a run may have."""
        admitted = accuracy * np.maximum(np.max(np.abs(self.outputs), axis=0), 1e-300)
        seen = np.isfinite(record.outputs)
        left = np.where(seen, record.outputs - self.outputs, 0.0)
        squares, counts = np.sum(left**2, axis=0), seen.sum(axis=0)
        shown = np.where(counts > 0, _SHARE * np.sqrt(squares / np.maximum(counts, 1)), np.inf)
        return bool(np.any(np.sqrt(np.mean(error**2, axis=0)) > np.minimum(admitted, shown)))


def accurate(objective: Objective, chromosome: FloatArray) -> Objective:
    """The objective with simulations as accurate as they are meant to be, at a chromosome.

    The errors of single steps add up where little is damped; twice the steps show by how much.
    """
    accuracy = objective.simulator.accuracy
    while objective.simulator.accuracy >= _FINEST:
        steps = objective.steps_needed(chromosome[None])
        change = _change_by_steps(objective, chromosome, steps)
        if not np.max(np.sqrt(np.mean(change**2, axis=0))) > accuracy:
            break
        objective = objective.finer(_FINER * objective.simulator.accuracy)
    return objective


def fine_enough(objective: Objective, chromosome: FloatArray, rms: FloatArray) -> Objective:
    """The objective by as many steps as noise lets it tell, at a minimum (n_free,).

    Its descents still go by those that it has, or else by those that are given here.
    rms: (n_outputs,), of the errors there, none of which is zero. Errors of the steps that a
    search goes by are small beside an output, but may be large beside its noise, as of an encoder.
    """
    given, first = objective, objective.steps_needed(chromosome[None])
    last, changed = first, True
    while objective.simulator.accuracy > _FINEST and last.max() < _FAR_MORE * first.max():
        if changed and not _swayed(objective, chromosome, last, rms):
            break
        objective = objective.finer(_FINER * objective.simulator.accuracy)
        steps = objective.steps_needed(chromosome[None])
        changed, last = bool(np.any(steps != last)), steps
    if objective is given or given.slopes_by is not None:
        return objective
    return objective.with_slopes_by(given.simulator)


def noiseless(objective: Objective, chromosome: FloatArray, rms: FloatArray) -> bool:
    """Whether what is left of the outputs, (n_outputs,), at (n_free,) is the simulation's error.

    How small it is beside the outputs does not tell: they may stand far from zero.
    """
    change = _change_by_steps(objective, chromosome, objective.steps_needed(chromosome[None]))
    error = np.sqrt(np.mean(change**2, axis=0))
    return bool(np.all(rms < np.maximum(_OWN * error, _NOTHING)))


def _swayed(objective: Objective, chromosome: FloatArray, steps: IntArray, rms: FloatArray) -> bool:
    """Whether errors of so many steps (1, n_records) show, or move a quantity noticeably."""

    def in_noise(chromosomes: FloatArray) -> FloatArray:
        taken = np.repeat(steps, len(chromosomes), axis=0)
        return objective.residuals(chromosomes, taken).values / rms[:, None]

    change = _change_by_steps(objective, chromosome, steps) / rms
    if np.any(np.mean(change**2, axis=0) > _SHARE**2):
        return True
    if not np.linalg.norm(change) > _PART:
        return False
    return moved_by(change, in_noise, objective.space, chromosome) > _PART


def _change_by_steps(objective: Objective, chromosome: FloatArray, steps: IntArray) -> FloatArray:
    """Residuals (n_residuals, n_outputs) by steps (1, n_records) less those by twice as many."""
    few, many = (objective.residuals(chromosome[None], n).values for n in (steps, 2 * steps))
    change: FloatArray = (few - many)[..., 0]
    return change


def estimate_start(
    simulator: BatchSimulator,
    vector: FloatArray,
    record: Dataset,
    near: FloatArray | None = None,
) -> FloatArray:
    """Initial states (n_states,) of a record under parameters (n_parameters,).

    States with an ``initial_range`` are fitted to the measured outputs by least squares, of a long
    record to its beginning. near: (n_states,), where to look first, as of a coarser simulation.
    """
    model = simulator.model
    declared = record.initial_state(model)
    space = SearchSpace.of_starts(model, vector, record)
    head = record.part(0, min(record.n_samples, _TELLING), record.name)
    weights = np.asarray(np.isfinite(head.outputs).any(axis=0), dtype=np.float64)
    if not (space.estimated and weights.any()):
        return declared
    objective = Objective(simulator, space, [head], weights=weights)
    begin = space.with_nominal_starts(np.empty(0))
    if near is not None:
        begin = near[[state for _, state in space.estimated]]
    fitted = refine(objective, begin).chromosome
    start: FloatArray = space.starts(fitted[None], 0, declared)[0]
    return start
