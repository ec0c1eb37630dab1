"""How large the errors of a right model are, and of what they consist: the floor of its residuals.

Noise of the outputs, as a calibration found it; noise of measured inputs, simulated through the
plant; what the parameters' own uncertainty makes of a free run, the noise of the samples that it
starts at, errors of the channels' zeros, and the error of its simulation.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.special import chdtrc

from sysid.arrays import BoolArray, FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.fitting.means import Run, each_mean_once, scatter
from sysid.judging.evidence import independent_of_each
from sysid.problem.data import Dataset
from sysid.problem.metrics import mean_known
from sysid.problem.space import SearchSpace
from sysid.uncertainty.sensitivity import each_alone

# Realisations of the inputs' noise. They give a variance to within 22 %, and to within 6 % where a
# test is to say that errors are larger.
_DRAWS, _MANY = 40, 640
_ABOVE = 1.25  # of root mean squares in parts of those expected, less than which is let pass
_STEP = 1e-5  # of a search coordinate, for slopes
_EVEN = 0.1  # of a mean square, what is not passed on at least
# Times the mean square of what was left, beyond which a draw is not what has happened; of the draws
# those that may be, at least, to tell what did.
_FAR, _LIKE = 9.0, 0.25
_FINER = 1e-2  # part of the accuracy at which the error of a simulation shows


class Runs(Protocol):
    """Free runs, (n, n_samples, n_outputs), of parameter vectors on a record."""

    def __call__(self, vectors: FloatArray, given: Dataset = ...) -> FloatArray:
        """The runs of vectors, (n, n_parameters)."""


@dataclass(frozen=True)
class ExpectedErrors:
    """Errors that a right model makes on a record.

    noise: (n_outputs,), variance by the sensors' noise, of inputs and outputs; NaN where that of
    the output is not known. chance: (n_outputs,), variance of that variance from one log to the
    next, by the noise of inputs, which a plant passes on slowly or at times. systematic:
    (n_samples, n_outputs, k), errors that go with the inputs, each by one standard deviation of
    what makes it: the sample that a state starts at, the zero of a channel, the simulation, and
    last ``n_directions`` of the parameters. passed_on: (n_samples, n_outputs), variance by noise of
    inputs at each sample, as far as it can have acted: what is left of an unstable motion does not
    tell of another one, into which more noise would have led.
    """

    noise: FloatArray
    chance: FloatArray
    systematic: FloatArray
    passed_on: FloatArray
    n_directions: int = 0

    @property
    def freedom(self) -> FloatArray:
        """Degrees of freedom of the mean square, (n_outputs,), were sensors' noise white."""
        each = np.mean(self.systematic**2, axis=0)
        chance = self.chance + 2.0 * np.sum(each**2, axis=1)
        with np.errstate(divide="ignore"):
            freedom: FloatArray = 2.0 * self.variance**2 / chance
        return freedom

    @property
    def variance(self) -> FloatArray:
        """Mean square that is to be expected, (n_outputs,); NaN where the noise is not known."""
        variance: FloatArray = self.noise + np.mean(np.sum(self.systematic**2, axis=2), axis=0)
        return variance

    @property
    def of_exact_parameters(self) -> "ExpectedErrors":
        """What is left of them where the parameters are known exactly."""
        rest = self.systematic.shape[2] - self.n_directions
        return replace(self, systematic=self.systematic[:, :, :rest], n_directions=0)

    def evened(self, residual: FloatArray) -> FloatArray:
        """Residuals (n_samples, n_outputs) as large at every sample, were the model right.

        A plant passes noise of its inputs on at times, as where motion turns: what is left of it
        follows the motion, and is no pattern of what the model lacks.
        """
        seen = np.isfinite(residual)
        squares = np.sum(np.where(seen, residual, 0.0) ** 2, axis=0)
        mean = squares / np.maximum(seen.sum(axis=0), 1)
        even = np.maximum(mean - self.passed_on.mean(axis=0), _EVEN * mean) + self.passed_on
        parts = np.divide(mean, even, out=np.ones_like(even), where=even > 0.0)
        evened: FloatArray = residual * np.sqrt(parts)
        return evened


@dataclass(frozen=True)
class FloorTest:
    """Residuals in parts of what is to be expected, (n_outputs,) each.

    ratio: root mean squares, NaN without a known noise. p_value: of one so large by chance, with
    as many degrees of freedom as the colour of the residuals leaves.
    """

    ratio: FloatArray
    p_value: FloatArray

    @property
    def known(self) -> BoolArray:
        """Outputs that can be tested."""
        return np.isfinite(self.ratio)

    def above(self, chance: float) -> BoolArray:
        """Outputs whose residuals are larger, noticeably and by less than a chance."""
        with np.errstate(invalid="ignore"):
            above: BoolArray = (self.ratio > _ABOVE) & (self.p_value < chance)
        return above


def expected_errors(
    simulator: BatchSimulator,
    space: SearchSpace,
    chromosome: FloatArray,
    record: Dataset,
    start: FloatArray,
    covariance: FloatArray | None,
    closely: bool = False,
) -> ExpectedErrors:
    """Expected errors of a free run under an identified chromosome (n_free,) from a start.

    start: (n_states,). covariance: (n_free, n_free) of its coordinates, as ``Uncertainty`` has it;
    None for exact parameters. closely: from more draws of the inputs' noise, which take their time.
    """
    vector = space.full(chromosome[None])[0]

    def runs(vectors: FloatArray, given: Dataset = record) -> FloatArray:
        simulated: FloatArray = simulator.trajectories(vectors, given, n_steps, start[None])
        return np.where(np.isfinite(simulated), simulated, 0.0)

    n_steps = int(simulator.steps_of_each(vector[None], record, start[None]).max())
    undisturbed = runs(vector[None])[0]
    fine = simulator.finer(max(_FINER * simulator.accuracy, 1e-12))
    exact = fine.trajectories(vector[None], record, None, start[None])[0]
    error = np.where(np.isfinite(exact), exact - undisturbed, 0.0)
    systematic = [error[..., None]]
    for i, deviation in _noisy_starts(simulator, record, undisturbed).items():
        moved = start.copy()
        moved[i] += deviation
        run = simulator.trajectories(vector[None], record, n_steps, moved[None])[0]
        change = np.where(np.isfinite(run), run - undisturbed, 0.0)
        systematic.append(change[..., None])
    systematic.extend(_by_zeros(runs, vector, record, undisturbed))
    directions = np.zeros((*undisturbed.shape, 0))
    if covariance is not None:
        directions = _by_parameters(runs, space, chromosome, covariance)
    jitter = _by_jitter(record, lambda given: runs(vector[None], given)[0])
    variance = record.output_noise**2 + jitter
    variance = np.where(variance > 0.0, variance, np.nan)
    chance, passed_on = np.zeros(len(variance)), np.zeros_like(undisturbed)
    if np.any(record.input_noise):
        squares, passed_on = _by_input_noise(
            runs, vector, record, undisturbed, _MANY if closely else _DRAWS
        )
        variance, chance = variance + squares.mean(axis=0), squares.var(axis=0, ddof=1)
    errors = np.concatenate([*systematic, directions], axis=2)
    return ExpectedErrors(variance, chance, errors, passed_on, directions.shape[2])


def _by_jitter(record: Dataset, run: Run) -> FloatArray:
    """Variance of each output whose windows' ends are known so well only, (n_outputs,)."""
    if not record.jitter.any():
        return np.zeros(record.outputs.shape[1])
    once = each_mean_once(record)
    single = once.jitter > 0.0
    counts = np.maximum(single.sum(axis=0), 1)
    variance: FloatArray = (
        np.sum(np.where(single, scatter(once, run).variance, 0.0), axis=0) / counts
    )
    return variance


def _noisy_starts(simulator: BatchSimulator, record: Dataset, run: FloatArray) -> dict[int, float]:
    """Standard deviation of the first sample at which a state starts, by the state's place.

    run: (n_samples, n_outputs), the free run.
    """
    return {
        i: record.sample_noise(j, record.outputs[:, j] - run[:, j])
        for i, j in enumerate(record.starts_at_samples(simulator.model))
        if j is not None
    }


def _by_zeros(
    runs: Runs, vector: FloatArray, record: Dataset, undisturbed: FloatArray
) -> Iterator[FloatArray]:
    """Errors (n_samples, n_outputs, 1) by a deviation of each channel's zero that has one.

    A plant sums up that of an input: of a long record it moves the outputs as much as noise does.
    """
    for error in each_alone(record.output_zero):
        yield np.broadcast_to(error, undisturbed.shape)[..., None]
    for error in each_alone(record.input_zero):
        moved = runs(vector[None], replace(record, inputs=record.inputs + error))[0]
        yield (moved - undisturbed)[..., None]


def _by_parameters(
    runs: Runs, space: SearchSpace, chromosome: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Errors (n_samples, n_outputs, k) by a deviation of each direction of the parameters."""
    n = len(space.index)
    at = space.encode(chromosome)
    size = np.maximum(np.abs(chromosome), 0.05 * (space.upper - space.lower))
    moved = np.diag(_STEP * np.where(space.log, 1.0, size))[:n]
    pairs = space.full(space.decode(np.concatenate([at + moved, at - moved])))
    up, down = np.split(runs(pairs), 2)
    slopes = np.moveaxis((up - down) / (2.0 * _STEP), 0, 2) / np.where(space.log, 1.0, size)[:n]
    values, vectors = np.linalg.eigh(covariance[:n, :n])
    errors: FloatArray = slopes @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return errors


def _by_input_noise(
    runs: Runs, vector: FloatArray, record: Dataset, undisturbed: FloatArray, n: int
) -> tuple[FloatArray, FloatArray]:
    """Squares of each output by noise of the inputs: the mean of each of n draws, of each sample.

    (n, n_outputs) and (n_samples, n_outputs). Of each sample those of the draws by which an output
    errs no more than it has, nothing where these are few.
    """
    rng, squares = np.random.default_rng(0), np.zeros((n, undisturbed.shape[1]))
    each, count = np.zeros_like(undisturbed), np.zeros(undisturbed.shape[1])
    most = _FAR * mean_known((record.outputs - undisturbed) ** 2, 0)
    for draw in squares:
        noise = rng.standard_normal(record.inputs.shape) * record.input_noise
        disturbed = runs(vector[None], replace(record, inputs=record.inputs + noise))[0]
        square = (disturbed - undisturbed) ** 2
        draw[:] = np.mean(square, axis=0)
        like = draw <= most
        each += np.where(like, square, 0.0)
        count += like
    return squares, np.where(count < _LIKE * n, 0.0, each / np.maximum(count, 1.0))


def floor_test(
    residual: FloatArray, expected: ExpectedErrors, independent: FloatArray | None = None
) -> FloorTest:
    """Chi-square tests of residuals (n_samples, n_outputs), NaN where a sample was lost.

    independent: (n_outputs,), as of ``independent_of_each``, where they have been counted.

    >>> rng = np.random.default_rng(0)
    >>> noise = rng.standard_normal((1000, 2)) * [1.0, 3.0]
    >>> nothing, none = np.zeros((1000, 2, 0)), np.zeros((1000, 2))
    >>> expected = ExpectedErrors(np.ones(2), np.zeros(2), nothing, none)
    >>> test = floor_test(noise, expected)
    >>> test.ratio.round().tolist(), (test.p_value < 0.01).tolist()
    ([1.0, 3.0], [False, True])
    """
    variance, most = expected.variance, expected.freedom
    counts = independent_of_each(residual) if independent is None else independent
    ratio, p_value = np.full(len(variance), np.nan), np.full(len(variance), np.nan)
    for j in np.flatnonzero(variance > 0.0):
        measured = residual[np.isfinite(residual[:, j]), j]
        if len(measured) < 2:
            continue
        square = float(np.mean(measured**2)) / float(variance[j])
        freedom = min(float(counts[j]), float(most[j]))
        ratio[j], p_value[j] = np.sqrt(square), chdtrc(freedom, square * freedom)
    return FloorTest(ratio, p_value)
