"""Fisher information of an experiment before it is run.

With the tangents S of the outputs by the search coordinates and white noise of variance r on each
output it is F = S' S / r. Where a sample's instant is known to a deviation j only (``jitter`` of a
record), its error has the variance r + (j dy/dt)^2, the mean of that before and of that after it.
Starts that a record does not tell take their part of it away; the Schur complement is left.

Noise of a measured input moves the outputs by G n, which is not white. Where it is known when the
outputs are measured a fit goes by the innovations of a filter, and V = R + G G' takes the place of
R: F = S' V^-1 S, by an ``ErrorFilter`` that foretells errors from those before. Else a fit divides
each error by the variance s = r + var(G n) of its sample (``compensated``). With J = S' S / s and
the covariance C of S' e / s its estimate scatters by J^-1 C J^-1; what it tells is the inverse.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import pinvh

from sysid.arrays import BoolArray, FloatArray, IntArray
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
# Share of the largest scatter, of coordinates of like scatter, below which a direction has none.
_LEAST, _TINY = 1e-9, 1e-300
_BURST = 1e3  # times its span, by which no output moves over the range of a parameter


class Informant:
    """Computes what a record would tell of the parameters.

    noise: (n_outputs,), standard deviations of the outputs' errors, infinite for one that does not
    count; input_noise: (n_inputs,), of the white noise on measured inputs. draws: of that noise, at
    least, where it is not filtered. Where they are fewer than coordinates they leave directions
    without noise: of the actuator's 19 in eight runs 16, 29 and 125 draws gave deviations of 0.75,
    0.9 and 0.98 of those of 253 draws (geometric mean).
    """

    def __init__(
        self,
        simulator: BatchSimulator,
        space: SearchSpace,
        noise: FloatArray,
        input_noise: FloatArray,
        draws: int = 2 * LANES,
    ) -> None:
        self._simulator, self._space, self._noise = simulator, space, noise
        self._blocks = -(-draws // LANES)
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
        n_free, vectors = len(self._space.index), self._space.full(chromosomes)
        steps = self._simulator.steps_of_each(vectors, record)
        slopes = self._slopes(record, chromosomes, steps)
        outputs = self._simulator.trajectories(vectors, record)
        slopes[self._burst(slopes[..., :n_free], outputs)] = np.nan
        timed = record.jitter.any() or record.windows.size
        joint_of = self._by_filter if timed or not len(self._noisy) else self._by_compensation
        runs = zip(vectors, outputs, slopes, steps, strict=True)
        joint = [joint_of(record, *run) if _are_finite(run) else _nothing(run[2]) for run in runs]
        return np.array([without_starts(each, n_free) for each in joint])

    def tangents(
        self, record: Dataset, chromosome: FloatArray, n_steps: int | None = None
    ) -> FloatArray:
        """Slopes of the outputs, (n_samples, n_outputs, n_free + n_unknown), starts behind.

        chromosome: (n_free,). n_steps: integration steps per sample, default what it needs.
        """
        if n_steps is None:
            steps = self._simulator.steps_of_each(self._space.full(chromosome[None]), record)
        else:
            steps = np.array([n_steps])
        return np.asarray(self._slopes(record, chromosome[None], steps)[0])

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
        moved = self._pushes(record, vector, outputs, n_steps)
        moved += np.sqrt(variances) * np.random.default_rng(0).standard_normal(moved.shape)
        return error_filter.loosened(moved.reshape(LANES, -1).T)

    def _pushes(
        self, record: Dataset, vector: FloatArray, outputs: FloatArray, n_steps: int, seed: int = 0
    ) -> FloatArray:
        """What draws of the inputs' noise change in outputs, (LANES, n_samples, n_outputs)."""
        vectors = np.hstack([np.tile(vector, (LANES, 1)), np.eye(LANES)])
        errors = self._with_errors(record, seed)
        moved: FloatArray = self._disturbed.trajectories(vectors, errors, n_steps) - outputs
        return moved

    def _with_errors(self, record: Dataset, seed: int) -> Dataset:
        """A record with channels for a block of draws of each measured input's noise."""
        shape = record.n_samples, len(self._noisy), LANES
        errors = np.random.default_rng(seed).standard_normal(shape)
        channels = (errors * self._input_noise[self._noisy, None]).reshape(record.n_samples, -1)
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

    def _slopes(self, record: Dataset, chromosomes: FloatArray, steps: IntArray) -> FloatArray:
        """Tangents by search coordinates and unknown starts.

        steps: (n,), of the integration. (n, n_samples, n_outputs, n_free + n_unknown).
        """
        simulator, vectors = self._simulator, self._space.full(chromosomes)
        n, n_free, unknown = len(vectors), len(self._space.index), self._unknown(record)
        along = np.zeros((n, n_free + len(unknown), vectors.shape[1]))
        along[:, :n_free] = self._space.directions(chromosomes)[:, :n_free]
        moved = np.zeros((*along.shape[:2], len(simulator.model.states)))
        moved[:, np.arange(len(unknown)) + n_free, unknown] = 1.0
        (slopes,) = simulator.tangents(
            vectors, [record], along, steps[:, None], start_directions=[moved]
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

    def _by_filter(
        self, record: Dataset, vector: FloatArray, outputs: FloatArray, slopes: FloatArray, n: int
    ) -> FloatArray:
        """Information of coordinates and unknown starts together, (p, p).

        outputs: (n_samples, n_outputs) under parameters (n_parameters,); slopes: (n_samples,
        n_outputs, p). n: steps of the integration.
        """
        error_filter = self.error_filter(record, vector, outputs, n)
        if not error_filter.finite:
            return _nothing(slopes)
        whitened = error_filter.of(slopes.reshape(-1, slopes.shape[2]))
        joint: FloatArray = whitened.T @ whitened
        return joint

    def _by_compensation(
        self, record: Dataset, vector: FloatArray, outputs: FloatArray, slopes: FloatArray, n: int
    ) -> FloatArray:
        """The same as a fit scatters that divides each error by its deviation."""
        counted, p = np.isfinite(self._noise), slopes.shape[2]
        of_outputs = self.variances(record, outputs[None])[0][:, counted]
        seeds = range(self._blocks)
        pushes = np.concatenate([self._pushes(record, vector, outputs, n, seed) for seed in seeds])
        if not np.isfinite(pushes).all():  # noise leads it to where no simulation does
            return np.zeros((p, p))
        pushes, slopes = pushes[..., counted], slopes[:, counted].reshape(-1, p)
        variances = of_outputs + np.mean(pushes**2, axis=0)
        weighted = slopes / variances.reshape(-1, 1)
        quiet = weighted * np.sqrt(of_outputs).reshape(-1, 1)
        curvature = weighted.T @ slopes
        scores = weighted.T @ pushes.reshape(len(pushes), -1).T
        scatter = quiet.T @ quiet + scores @ scores.T / len(pushes)
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


def _are_finite(run: Sequence[FloatArray]) -> bool:
    """Whether a simulation, its outputs and its slopes, has come to its end."""
    return all(bool(np.isfinite(part).all()) for part in run)


def _nothing(slopes: FloatArray) -> FloatArray:
    """What a run that has failed tells of coordinates and starts: nothing is known of that."""
    return np.full((slopes.shape[2],) * 2, np.nan)


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
