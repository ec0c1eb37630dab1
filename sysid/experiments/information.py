"""Fisher information of an experiment before it is run.

With the tangents S of the outputs by the search coordinates and white noise of variance r on each
output it is F = S' S / r. Where a sample's instant is known to a deviation j only (``jitter`` of a
record), its error has the variance r + (j dy/dt)^2, the mean of that before and of that after it.
Starts that a record does not tell take their part of it away; the Schur complement is left.

Noise of a measured input moves the outputs by G n, which is not white. A fit divides each error by
the variance s = r + var(G n) of its sample (``criterion: compensated`` of an identification). With
J = S' S / s and the covariance C of S' e / s its estimate scatters by J^-1 C J^-1; what it tells is
the inverse of that.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import pinvh

from sysid.arrays import BoolArray, FloatArray
from sysid.engine.intervals import Intervals
from sysid.engine.scheme import LANES
from sysid.engine.simulation import BatchSimulator
from sysid.experiments.disturbance import with_disturbances
from sysid.experiments.error_filter import ErrorFilter
from sysid.identifiability import null_directions
from sysid.problem.data import Dataset
from sysid.problem.space import SearchSpace

# Share of the largest information above which a direction that tells nothing is told something.
_PHANTOM = 1e-10
_FEWER = 3  # times the integration steps there are of what noise does
_BURST = 1e3  # times its span, by which no output moves over the range of a parameter
# Share of the largest scatter, of coordinates of like scatter, below which a direction has none.
_LEAST, _TINY = 1e-9, 1e-300


class Informant:
    """Computes what a record would tell of the parameters.

    noise: (n_outputs,), standard deviations of the outputs' errors, infinite for one that does not
    count; input_noise: (n_inputs,), of the white noise on measured inputs. draws: of that noise, at
    least; up to a block more. Where they are fewer than coordinates they leave directions without
    noise: of the actuator's 19 in eight runs 16, 29 and 125 draws gave deviations of 0.75, 0.9 and
    0.98 of those of 253 draws (geometric mean).
    """

    def __init__(
        self,
        simulator: BatchSimulator,
        space: SearchSpace,
        noise: FloatArray,
        input_noise: FloatArray,
        draws: int = LANES,
    ) -> None:
        self._simulator, self._space, self._noise = simulator, space, noise
        self._draws = draws
        self._noisy, self._input_noise = np.flatnonzero(input_noise), input_noise
        self._disturbed = simulator
        if len(self._noisy):
            model = with_disturbances(simulator.model, self._noisy.tolist(), LANES)
            self._disturbed = BatchSimulator(model, threads=simulator.threads)

    def information(self, record: Dataset, chromosomes: FloatArray) -> FloatArray:
        """Of the search coordinates at chromosomes (n, n_free), (n, n_free, n_free).

        Of the record only inputs, first samples and jitter count. Not finite where a simulation
        failed.
        """
        n_free, unknown = len(self._space.index), self._unknown(record)
        # Draws fill the block that coordinates leave, and blocks of their own.
        n_draws = -(n_free + len(unknown)) % LANES if len(self._noisy) else 0
        passes = [self._slopes(record, chromosomes, n_free, unknown, n_draws)]
        while len(self._noisy) and n_draws < self._draws:
            passes.append(self._slopes(record, chromosomes, 0, (), LANES, seed=len(passes)))
            n_draws += LANES
        slopes = np.concatenate(passes, axis=-1)
        outputs = self._simulator.trajectories(self._space.full(chromosomes), record)
        slopes[self._burst(slopes[..., :n_free], outputs)] = np.nan
        errors = self.variances(record, outputs)
        joint = [
            self._joint(each, scatter, n_free + len(unknown))
            for each, scatter in zip(slopes, errors, strict=True)
        ]
        return np.array([without_starts(each, n_free) for each in joint])

    def tangents(
        self, record: Dataset, chromosome: FloatArray, n_steps: int | None = None
    ) -> FloatArray:
        """Slopes of the outputs, (n_samples, n_outputs, n_free + n_unknown), starts behind.

        chromosome: (n_free,). n_steps: integration steps per sample, default what it needs.
        """
        unknown, n_free = self._unknown(record), len(self._space.index)
        slopes = self._slopes(record, chromosome[None], n_free, unknown, 0, n_steps)
        return np.asarray(slopes[0])

    def error_filter(
        self, record: Dataset, vector: FloatArray, outputs: FloatArray, n_steps: int
    ) -> ErrorFilter:
        """Of the errors of a record that parameters (n_parameters,) are right of.

        outputs: (n_samples, n_outputs), what they say; n_steps: of the integration.
        """
        model, variances = self._simulator.model, self.variances(record, outputs[None])[0]
        if not len(self._noisy):
            return ErrorFilter.white(variances)
        intervals = Intervals(model, vector, record.inputs, record.dt, -(-n_steps // _FEWER))
        states = intervals.run(record.initial_state(model))
        error_filter = ErrorFilter.along(intervals, states, variances, self._input_noise)
        vectors = np.hstack([np.tile(vector, (LANES, 1)), np.eye(LANES)])
        moved = self._disturbed.trajectories(vectors, self._with_errors(record, LANES), n_steps)
        moved += np.sqrt(variances) * np.random.default_rng(0).standard_normal(moved.shape)
        return error_filter.loosened((moved - outputs).reshape(LANES, -1).T)

    def _with_errors(self, record: Dataset, count: int, seed: int = 0) -> Dataset:
        """A record with channels for so many draws of each measured input's noise."""
        places = self._noisy if count else self._noisy[:0]
        shape = record.n_samples, len(places), count
        errors = np.random.default_rng(seed).standard_normal(shape)
        channels = (errors * self._input_noise[places, None]).reshape(record.n_samples, -1)
        return replace(
            record,
            inputs=np.hstack([record.inputs, channels]),
            input_zero=np.zeros(0),
            input_noise=np.zeros(0),
        )

    def _unknown(self, record: Dataset) -> list[int]:
        """Places of the states whose start a record does not tell."""
        model = self._simulator.model
        return [i for i in range(len(model.states)) if record.initial_range(model, i)]

    def _slopes(
        self,
        record: Dataset,
        chromosomes: FloatArray,
        n_free: int,
        unknown: Sequence[int],
        n_draws: int,
        n_steps: int | None = None,
        seed: int = 0,
    ) -> FloatArray:
        """Tangents by search coordinates, unknown starts, and draws of the inputs' noise.

        n_free: number of the coordinates, or 0 for none. seed: of the draws. (n, n_samples,
        n_outputs, n_free + n_unknown + n_draws).
        """
        simulator = self._disturbed if n_draws else self._simulator
        model, vectors = simulator.model, self._space.full(chromosomes)
        n, n_starts = len(vectors), len(unknown)
        n_channels = LANES if n_draws else 0
        quiet = np.zeros((n, n_channels))
        along = np.zeros((n, n_free + n_starts + n_draws, len(model.parameters)))
        along[:, :n_free, : vectors.shape[1]] = self._space.directions(chromosomes)[:, :n_free]
        along[:, n_free + n_starts :, vectors.shape[1] :] = np.eye(n_draws, n_channels)
        moved = np.zeros((*along.shape[:2], len(model.states)))
        moved[:, np.arange(n_starts) + n_free, unknown] = 1.0
        if n_steps is None:
            steps = self._simulator.steps_of_each(vectors, record)[:, None]
        else:
            steps = np.full((n, 1), n_steps)
        (slopes,) = simulator.tangents(
            np.hstack([vectors, quiet]),
            [self._with_errors(record, n_channels, seed)],
            along,
            steps,
            start_directions=[moved],
        )
        return slopes

    def _burst(self, slopes: FloatArray, outputs: FloatArray) -> BoolArray:
        """Whether tangents have burst where the simulation has not, (n,).

        Steps that leave a state bounded, as on a saturating one, may still make more of its tangent
        with each; what moves by a thousand times its span over a parameter's range is no answer.
        """
        spans = np.maximum(np.ptp(outputs, axis=1), self._noise)
        largest = np.max(np.abs(slopes) * self._space.width, axis=(1, 3), initial=0.0)
        burst: BoolArray = np.any(largest > _BURST * spans, axis=1)
        return burst

    def variances(self, record: Dataset, outputs: FloatArray) -> FloatArray:
        """Variances of the samples' errors, inputs without noise, (n, n_samples, n_outputs).

        outputs: of so many simulations of the record, which say how much an instant's error does.
        """
        white = np.broadcast_to(self._noise**2, outputs.shape)
        if not record.jitter.any():
            return white
        rates = np.diff(outputs, axis=1) / record.dt
        return white + _mean_of_sides(rates**2) * record.jitter**2

    def _joint(self, slopes: FloatArray, errors: FloatArray, n: int) -> FloatArray:
        """Information of n coordinates and unknown starts together.

        slopes: (n_samples, n_outputs, n + n_draws), those by draws of the inputs' noise behind.
        errors: (n_samples, n_outputs), variances.
        """
        counted = np.isfinite(self._noise)
        of_outputs = errors[:, counted]
        slopes, changes = slopes[:, counted, :n], slopes[:, counted, n:]
        n_draws = changes.shape[-1]
        variances = of_outputs + np.sum(changes**2, axis=-1) / max(n_draws, 1)
        weighted = slopes / variances[..., None]
        quiet = (weighted * np.sqrt(of_outputs)[..., None]).reshape(-1, n)
        weighted, slopes = weighted.reshape(-1, n), slopes.reshape(-1, n)
        curvature: FloatArray = weighted.T @ slopes
        if not n_draws or not np.isfinite(curvature).all():
            return curvature
        pushes, score = weighted.T @ changes.reshape(-1, n_draws), quiet.T @ quiet
        scatter = score + pushes @ pushes.T / n_draws
        # Rounding along what no record tells must not come back divided by next to nothing.
        size = np.sqrt(np.maximum(np.diag(scatter), _TINY))
        inverse = pinvh(scatter / np.outer(size, size), rtol=_LEAST)
        effective: FloatArray = curvature @ (inverse / np.outer(size, size)) @ curvature
        return effective

    def null_directions(self, chromosome: FloatArray) -> FloatArray:
        """Directions of the search coordinates that no record tells, (k, n_free), of length one."""
        model, n_free = self._simulator.model, len(self._space.index)
        counted = [
            name for name, s in zip(model.output_names, self._noise, strict=True) if s < np.inf
        ]
        unknown = tuple(state.name for state in model.states if state.initial_range is not None)
        basis = null_directions(
            self._space.as_model().with_outputs(counted),
            self._space.full(chromosome),
            self._space.names[:n_free],
            unknown,
        )
        directions = basis[:, :n_free] / np.where(self._space.log, chromosome, 1.0)
        lengths = np.linalg.norm(directions, axis=1, keepdims=True)
        moving = lengths[:, 0] > 0.0
        normed: FloatArray = directions[moving] / lengths[moving]
        return normed


def tells_nothing_there(information: FloatArray, null: FloatArray) -> bool:
    """Whether information (n_free, n_free) has nothing along directions that no experiment tells.

    null: (k, n_free), directions of length one that the equations leave undetermined. What is there
    all the same is the simulation's error.
    """
    phantom = np.einsum("ki,ij,kj->k", null, information, null)
    return bool(np.all(phantom <= _PHANTOM * np.abs(information).max(initial=0.0)))


def without_starts(joint: FloatArray, n_free: int) -> FloatArray:
    """Information of the first coordinates where the others are unknown, (n_free, n_free)."""
    alone, cross, others = joint[:n_free, :n_free], joint[:n_free, n_free:], joint[n_free:, n_free:]
    if not len(others) or not np.isfinite(joint).all():
        return alone
    left: FloatArray = alone - cross @ pinvh(others) @ cross.T
    return left


def _mean_of_sides(between: FloatArray) -> FloatArray:
    """Of what is between samples, (n, n_samples - 1, ...), the mean of both sides of each."""
    sides = np.concatenate([between[:, :1], between, between[:, -1:]], axis=1)
    mean: FloatArray = 0.5 * (sides[:, :-1] + sides[:, 1:])
    return mean
