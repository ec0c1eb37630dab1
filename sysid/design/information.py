"""Fisher information of an experiment before it is run.

With the tangents S of the outputs by the search coordinates and white noise of variance r on each
output it is F = S' S / r. Starts that a record does not tell take their part of it away; the Schur
complement is left.

Noise of a measured input moves the outputs by G n, which is not white. A fit divides each error by
the variance s = r + var(G n) of its sample (``criterion: compensated`` of an identification). With
J = S' S / s and the covariance C of S' e / s its estimate scatters by J^-1 C J^-1; what it tells is
the inverse of that.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import pinvh

from sysid.arrays import FloatArray, IntArray
from sysid.engine.simulation import BatchSimulator
from sysid.identifiability import null_directions
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError
from sysid.problem.space import SearchSpace

# Share of the largest information above which a direction that tells nothing is told something.
_PHANTOM = 1e-10
# Realisations of the inputs' noise: they give a variance to within a quarter.
_DRAWS = 32


@dataclass(frozen=True)
class Informant:
    """Computes what a record would tell of the parameters.

    noise: (n_outputs,), standard deviations of the outputs' errors, infinite for one that does not
    count; input_noise: (n_inputs,), of the white noise on measured inputs.
    """

    simulator: BatchSimulator
    space: SearchSpace
    noise: FloatArray
    input_noise: FloatArray

    def information(self, record: Dataset, chromosomes: FloatArray) -> FloatArray:
        """Of the search coordinates at chromosomes (n, n_free), (n, n_free, n_free).

        Of the record only inputs, first samples and lost samples count. Not finite where a
        simulation failed.
        """
        vectors, n_free = self.space.full(chromosomes), len(self.space.index)
        steps = self.simulator.steps_of_each(vectors, record)
        slopes = self._slopes(record, chromosomes, steps)
        changes = self._input_changes(record, vectors, steps)
        joint = [self._joint(*each) for each in zip(slopes, changes, strict=True)]
        return np.array([_without_starts(each, n_free) for each in joint])

    def _slopes(self, record: Dataset, chromosomes: FloatArray, steps: IntArray) -> FloatArray:
        """Tangents by the search coordinates, then by the starts that the record does not tell.

        (n, n_samples, n_outputs, n_free + n_unknown).
        """
        model, vectors = self.simulator.model, self.space.full(chromosomes)
        n, n_free = len(vectors), len(self.space.index)
        unknown = [i for i in range(len(model.states)) if record.initial_range(model, i)]
        by_starts = np.zeros((n, len(unknown), vectors.shape[1]))
        along = np.concatenate([self._directions(chromosomes), by_starts], axis=1)
        moved = np.zeros((n, along.shape[1], len(model.states)))
        moved[:, np.arange(len(unknown)) + n_free, unknown] = 1.0
        (slopes,) = self.simulator.tangents(
            vectors, [record], along, steps[:, None], start_directions=[moved]
        )
        return slopes

    def _input_changes(self, record: Dataset, vectors: FloatArray, steps: IntArray) -> FloatArray:
        """Changes of the outputs by noise of the inputs, always the same draws of it.

        (n, n_draws, n_samples, n_outputs), no draws where no input is noisy.
        """
        shape = record.outputs.shape
        if not self.input_noise.any():
            return np.zeros((len(vectors), 0, *shape))
        errors = np.random.default_rng(0).standard_normal((_DRAWS, *record.inputs.shape))
        disturbed = [replace(record, inputs=record.inputs + self.input_noise * e) for e in errors]
        records = [record, *disturbed]
        each = np.repeat(steps[:, None], len(records), axis=1)
        nothing = [None] * len(records)
        outputs = self.simulator.residuals(vectors, records, nothing, each, nothing).values
        runs = np.moveaxis(outputs.reshape(len(records), *shape, len(vectors)), -1, 0)
        changes: FloatArray = runs[:, 1:] - runs[:, :1]
        return changes

    def _joint(self, slopes: FloatArray, changes: FloatArray) -> FloatArray:
        """Information of coordinates and unknown starts together, by slopes (n_samples, n_outputs,
        n) and changes (n_draws, n_samples, n_outputs).
        """
        counted = np.isfinite(self.noise)
        of_outputs = self.noise[counted] ** 2
        n_draws, n = len(changes), slopes.shape[-1]
        slopes, changes = slopes[:, counted], changes[..., counted]
        variances = of_outputs + np.sum(changes**2, axis=0) / max(n_draws, 1)
        weighted = slopes / variances[..., None]
        curvature: FloatArray = np.einsum("tip,tir->pr", weighted, slopes, optimize=True)
        if not n_draws or not np.isfinite(curvature).all():
            return curvature
        pushes = changes.reshape(n_draws, -1) @ weighted.reshape(-1, n)
        score = np.einsum("tip,i,tir->pr", weighted, of_outputs, weighted, optimize=True)
        effective: FloatArray = curvature @ pinvh(score + pushes.T @ pushes / n_draws) @ curvature
        return effective

    def null_directions(self, chromosome: FloatArray) -> FloatArray:
        """Directions of the search coordinates that no record tells, (k, n_free), of length one."""
        model, n_free = self.simulator.model, len(self.space.index)
        counted = [
            name for name, s in zip(model.output_names, self.noise, strict=True) if s < np.inf
        ]
        unknown = tuple(state.name for state in model.states if state.initial_range is not None)
        basis = null_directions(
            self.space.as_model().with_outputs(counted),
            self.space.full(chromosome),
            self.space.names[:n_free],
            unknown,
        )
        directions = basis[:, :n_free] / np.where(self.space.log, chromosome, 1.0)
        lengths = np.linalg.norm(directions, axis=1, keepdims=True)
        moving = lengths[:, 0] > 0.0
        normed: FloatArray = directions[moving] / lengths[moving]
        return normed

    def _directions(self, chromosomes: FloatArray) -> FloatArray:
        """How parameters move with each search coordinate, (n, n_free, n_parameters)."""
        space = self.space
        increments = np.where(space.log, chromosomes, 1.0)
        directions = np.zeros((*chromosomes.shape, len(space.base)))
        for k, place in enumerate(space.index):
            directions[:, k, place] = increments[:, k]
        for tie in space.ties:
            directions[:, :, tie.index] = tie.factor * directions[:, :, tie.source]
        return directions


def refuse_phantoms(information: FloatArray, null: FloatArray) -> None:
    """Raise ModelError where information (n_free, n_free) tells what no experiment can.

    null: (k, n_free), directions of length one that the equations leave undetermined.
    """
    phantom = np.einsum("ki,ij,kj->k", null, information, null)
    largest = float(np.abs(information).max(initial=0.0))
    if np.any(phantom > _PHANTOM * largest):
        raise ModelError(
            "the simulation tells a direction apart that the equations leave undetermined, with "
            f"{phantom.max():.2g} of {largest:.2g}: its error passes for information; lower the "
            "accuracy's figure"
        )


def _without_starts(joint: FloatArray, n_free: int) -> FloatArray:
    """Information of the first coordinates where the others are unknown, (n_free, n_free)."""
    alone, cross, others = joint[:n_free, :n_free], joint[:n_free, n_free:], joint[n_free:, n_free:]
    if not len(others) or not np.isfinite(joint).all():
        return alone
    left: FloatArray = alone - cross @ pinvh(others) @ cross.T
    return left
