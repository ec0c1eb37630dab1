"""How the simulated outputs move with the parameters, and with errors of the sensors' zero."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.objective import Objective
from sysid.problem.data import Dataset

# Central differences in search coordinates: truncation and rounding both near 1e-8.
_PERTURBATION = 1e-5
# Realisations of the inputs' noise: they give a variance to within 12 %.
_DRAWS = 128


@dataclass(frozen=True)
class Sensitivity:
    """Residuals and their slopes at a chromosome.

    residual: (n_residuals, n_outputs), simulated minus measured in parts of the output's scale,
    0 where a sample was lost; seen: of the same shape, where none was. slopes: (n_residuals,
    n_outputs, n_free), with respect to the natural logarithm of a parameter searched by
    logarithm, else to the parameter in units of ``coordinate_units``. lengths: residuals of each
    record, one after another.
    """

    residual: FloatArray
    seen: BoolArray
    slopes: FloatArray
    lengths: tuple[int, ...]


def common_steps(objective: Objective, chromosome: FloatArray) -> list[int]:
    """Integration steps per sample that serve a chromosome and its neighbours, for each record."""
    needed = objective.steps_needed(_with_neighbours(objective, chromosome))
    return [int(steps) for steps in needed.max(axis=0)]


def sensitivity(objective: Objective, chromosome: FloatArray, steps: list[int]) -> Sensitivity:
    """Residuals and slopes by central differences of simulations with equal steps.

    chromosome: (n_free,). A perturbed simulation that fails has slope zero.
    """
    residuals = objective.residuals(_with_neighbours(objective, chromosome), steps).values
    n = len(chromosome)
    slopes = (residuals[..., 1 : n + 1] - residuals[..., n + 1 :]) / (2.0 * _PERTURBATION)
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)
    lengths = tuple(record.n_samples for record in objective.records)
    seen = np.concatenate([np.isfinite(record.outputs) for record in objective.records])
    return Sensitivity(residuals[..., 0].copy(), seen, slopes, lengths)


def _with_neighbours(objective: Objective, chromosome: FloatArray) -> FloatArray:
    """A chromosome, then it with each coordinate moved up, then down, (1 + 2 n_free, n_free)."""
    space = objective.space
    at, units = space.encode(chromosome), coordinate_units(objective, chromosome)
    moved = np.diag(_PERTURBATION * units)
    return space.decode(np.concatenate([at[None], at + moved, at - moved]))


def coordinate_units(objective: Objective, chromosome: FloatArray) -> FloatArray:
    """What one unit of each coordinate of the slopes is in search coordinates, (n_free,)."""
    space = objective.space
    size = np.maximum(np.abs(chromosome), 0.05 * (space.upper - space.lower))
    return np.where(space.log, 1.0, size)


def zero_errors(
    objective: Objective, chromosome: FloatArray, steps: list[int], found: Sensitivity
) -> Iterator[FloatArray]:
    """Change of all residuals by one standard deviation of each sensor's zero error.

    Each is (n_residuals, n_outputs): a constant error of one channel of one record.
    """
    moves = _InputMoves(objective, chromosome, steps, found)
    for k, record in enumerate(objective.records):
        for j in np.flatnonzero(record.output_zero):
            change = np.zeros_like(found.residual)
            change[moves.rows(k), j] = record.output_zero[j] / objective.scales[k][j]
            yield change
        for j in np.flatnonzero(record.input_zero):
            error = np.zeros_like(record.inputs)
            error[:, j] = record.input_zero[j]
            yield moves.change(k, error)


def input_noises(
    objective: Objective, chromosome: FloatArray, steps: list[int], found: Sensitivity
) -> Iterator[FloatArray]:
    """Changes of all residuals, (n_residuals, n_outputs), whose outer products sum to what the
    noise on the measured inputs does: drawn at random, always the same."""
    rng = np.random.default_rng(0)
    moves = _InputMoves(objective, chromosome, steps, found)
    for k, record in enumerate(objective.records):
        if not np.any(record.input_noise):
            continue
        for _ in range(_DRAWS):
            error = rng.standard_normal(record.inputs.shape) * record.input_noise
            yield moves.change(k, error) / np.sqrt(_DRAWS)


class _InputMoves:
    """Simulations of a chromosome with other inputs."""

    def __init__(
        self, objective: Objective, chromosome: FloatArray, steps: list[int], found: Sensitivity
    ) -> None:
        self._objective, self._steps, self._found = objective, steps, found
        self._vector = objective.space.full(chromosome[None])
        model = objective.simulator.model
        self._starts = [
            objective.space.starts(chromosome[None], k, record.initial_state(model))
            for k, record in enumerate(objective.records)
        ]
        self._still: dict[int, FloatArray] = {}

    def rows(self, k: int) -> slice:
        """Where the residuals of record k stand."""
        end = sum(self._found.lengths[: k + 1])
        return slice(end - self._found.lengths[k], end)

    def change(self, k: int, error: FloatArray) -> FloatArray:
        """Change of the residuals by an error (n_samples, n_inputs) of record k's inputs."""
        record = self._objective.records[k]
        if k not in self._still:
            self._still[k] = self._simulated(k, record)
        moved = self._simulated(k, replace(record, inputs=record.inputs + error))
        change = np.zeros_like(self._found.residual)
        difference = (moved - self._still[k]) / self._objective.scales[k]
        change[self.rows(k)] = np.where(np.isfinite(difference), difference, 0.0)
        return change

    def _simulated(self, k: int, record: Dataset) -> FloatArray:
        outputs: FloatArray = self._objective.simulator.trajectories(
            self._vector, record, self._steps[k], self._starts[k]
        )[0]
        return outputs
