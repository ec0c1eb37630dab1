"""Simulations of one record: the steps that each parameter vector needs, and blocks of lanes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.engine.bends import in_parts, splines_of, with_bends, with_changes
from sysid.engine.compiler import Filter, Kernels, explained_errors, kernels
from sysid.engine.compiler import tangents as compiled_tangents
from sysid.engine.filter_kernel import FilterKernel
from sysid.engine.filter_settings import FilterSettings
from sysid.engine.intervals import Intervals, IntervalSlopes
from sysid.engine.linear_response import LinearResponse, filter_response
from sysid.engine.scheme import LANES, work_area
from sysid.engine.windows import (
    Ends,
    add_beyond,
    average,
    compared,
    ends_of,
    weights_of_mean,
    weights_of_sums,
    with_integrals,
)
from sysid.problem.data import Dataset
from sysid.threads import Workers

# Steps are first chosen from a bound on the fastest rate of the nonlinear part; this far along
# |lambda| h the scheme is stable and seldom inaccurate.
_RATE_LIMIT = 1.0
# Error estimate per step (RMS over the record, normalised) that keeps the error itself below
# the accuracy: over 1000 chromosomes of the actuator's box 98.7 % end below it, the median at a
# twentieth of it.
_ESTIMATE_LIMIT = 0.1
# The estimate falls with the third power of the step where the equations are smooth.
_ESTIMATE_ORDER = 3.0
_MAX_ROUNDS = 6
_MOST_KNOWN = 1024  # parameter vectors whose steps are kept
# A trial on the record's first eighth saves one on all of it, except where it is too short to
# tell anything.
_PILOT_PART = 8
_PILOT_LEAST = 32  # samples
# Steps per sample come from a ladder so that chromosomes of like need share a block, while
# each one's result depends on nothing but itself.
_LADDER = np.unique(np.round(2.0 ** np.arange(0, 20.01, 0.5)).astype(np.int64))
_ALL_LANES = np.arange(LANES)
_UNTRACED = np.empty((0, 0)), np.empty((0, 0))
# Of a sample, in which a free run tells what averaged outputs are but no parabola, and in which
# inputs change.
_PARTS = 8
_AT_ONCE = 1024  # samples of which that many are kept
_BEFORE = 1e-6  # samples before its first by which a window may begin for the arithmetic's sake


@dataclass(frozen=True)
class Population:
    """Parameter vectors, (n, n_parameters), each simulated with the steps that it needs.

    n_steps: (n,), integration steps per sample. over_budget: (n,), whether that is more than
    there may be. sse: (n, n_outputs), sums of squared residuals. spent: (n,), integration steps
    of all attempts.
    """

    parameters: FloatArray
    starts: FloatArray | None
    n_steps: IntArray
    over_budget: BoolArray
    sse: FloatArray
    spent: IntArray


_Means = tuple[FloatArray, dict[int, FloatArray]]


@dataclass(eq=False)
class RecordSimulator:
    """Simulates one record under many parameter vectors.

    scale: (n_outputs,), divisors of the residuals; None for residuals that are the outputs
    themselves. Residuals of lost samples are 0. Initial states, where they are given to a method
    (``starts``), are (n, n_states); default the record's own.
    """

    kernels: Kernels
    record: Dataset
    scale: FloatArray | None
    accuracy: float
    max_steps: int
    workers: Workers

    def __post_init__(self) -> None:
        record, model = self.record, self.kernels.model
        self._start = record.initial_state(model)
        self._starting = record.starts_at_samples(model)
        self._inputs = with_bends(model, record, splines_of(model))
        missing = ~np.isfinite(record.outputs)
        outputs = np.where(missing, 0.0, record.outputs)
        self._peak = np.abs(outputs).max(axis=0)
        if self.scale is None:
            self._measured, self._weights = np.zeros_like(outputs), np.ones_like(outputs)
        else:
            self._measured, self._weights = outputs, np.where(missing, 0.0, 1.0 / self.scale)
        windows = np.zeros((*outputs.shape, 2))
        if record.windows.size:
            windows = record.windows / record.dt  # in samples
        self.averaged = np.flatnonzero(windows.any(axis=(0, 2))).tolist()
        self._windows = np.ascontiguousarray(np.moveaxis(windows, 1, 0))
        self._in_parts: tuple[FloatArray, dict[int, Ends]] | None = None
        self._steps_of: dict[bytes, int] = {}
        self._means_of: dict[tuple[tuple[int, ...], bool], _Means] = {}
        self._inputs_of: dict[tuple[int, ...], FloatArray] = {}
        if self.averaged and self.scale is not None:
            # What a window saw before the record is not known.
            early = np.arange(len(windows))[:, None] + windows[..., 0] < -_BEFORE
            self._weights = np.where(early, 0.0, self._weights)
        averaging = with_integrals(model, self.averaged) if self.averaged else model
        self._integrating = kernels(averaging)
        self._parts = _PARTS if record.last_part.any() else 1
        self._driving, self._compared = self._inputs, (self._measured, self._weights)
        if self._parts > 1:
            self._driving = with_changes(in_parts(model, self._inputs, _PARTS), record, _PARTS)
            self._compared = self._finely(self._measured), self._finely(self._weights)
        # Measured outputs and weights that leave outputs, and integrals of them, as they are.
        shape = len(self._driving), outputs.shape[1] + len(self.averaged)
        self._unmeasured = np.zeros(shape), np.ones(shape)
        self._weight = self._weights.max(axis=0)
        # Where an input is largest is where a model driven through it is fastest.
        peaks = np.argmax(np.abs(record.inputs), axis=0) if record.inputs.shape[1] else []
        self._extremes = record.inputs[np.unique(np.array([0, *peaks], dtype=np.int64))]

    def _finely(self, table: FloatArray) -> FloatArray:
        """A table of the samples, zero at the parts between them."""
        fine = np.zeros((len(self._driving), table.shape[1]))
        fine[:: self._parts] = table
        return fine

    def population(self, parameters: FloatArray, starts: FloatArray | None = None) -> Population:
        """Simulate each with the steps that it needs, (n, n_parameters).

        A simulation that does not stay finite is tried once more with much finer steps: when
        those fail too it is the model, not the scheme, that is unbounded.
        """
        n, limit = len(parameters), self.max_steps
        steps = _rungs(self._rates(parameters, starts) * self.record.dt / _RATE_LIMIT)
        steps = np.maximum(steps, self.kernels.batch.fewest_steps)
        over, blown = steps > limit, np.zeros(n, dtype=bool)
        sse = np.full((n, self._measured.shape[1]), np.inf)
        population = Population(parameters, starts, steps, over, sse, np.zeros(n, dtype=np.int64))
        todo = np.flatnonzero(~over)
        # The record's start tells cheaply what most of them need; whether it is enough the whole
        # record says.
        pilot = self.record.n_samples // _PILOT_PART
        if pilot >= _PILOT_LEAST:
            excess = self._attempt(population, todo, pilot)
            more = _finer(steps[todo], excess)
            raised = np.isfinite(excess) & (excess > 1.0) & (more <= limit)
            steps[todo[raised]] = more[raised]
        for _ in range(_MAX_ROUNDS):
            if len(todo) == 0:
                break
            excess = self._attempt(population, todo, self.record.n_samples)
            finite = np.isfinite(excess)
            more = _finer(steps[todo], excess)
            again = ~(excess <= 1.0)
            # Finite but not accurate within the budget is too stiff; not finite is unbounded.
            over[todo[again & finite & (more > limit)]] = True
            again &= (more <= limit) & (finite | ~blown[todo])
            blown[todo] |= ~finite
            steps[todo[again]] = more[again]
            todo = todo[again]
        return population

    def steps_needed(self, parameters: FloatArray, starts: FloatArray | None = None) -> IntArray:
        """Integration steps per sample that each needs, (n,), also beyond what there may be.

        starts: (n, n_states) or (1, n_states), default the record's own; where something is stiff
        hangs on them. Those that were asked for lately are known: a fit begins where another ended.
        """
        from_starts = self._start[None] if starts is None else starts
        from_starts = np.broadcast_to(from_starts, (len(parameters), from_starts.shape[1]))
        keys = [row.tobytes() for row in np.hstack([parameters, from_starts])]
        unknown = [i for i, key in enumerate(keys) if key not in self._steps_of]
        if unknown:
            if len(self._steps_of) > _MOST_KNOWN:
                self._steps_of.clear()
                unknown = list(range(len(keys)))
            steps = self.population(parameters[unknown], from_starts[unknown]).n_steps.tolist()
            self._steps_of.update(zip([keys[i] for i in unknown], steps, strict=True))
        return np.array([self._steps_of[key] for key in keys], dtype=np.int64)

    def residuals(
        self,
        parameters: FloatArray,
        starts: FloatArray | None,
        lanes: IntArray,
        n_steps: int,
        values: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Simulate up to LANES rows of the parameters at so many steps per sample.

        values: (n_samples, n_outputs, n) of all rows, filled with the residuals of these; without
        samples none are kept. Returns the residuals' sums of squares, (n, n_outputs), and error
        estimates in parts of what the accuracy allows, (n,).
        """
        n_samples, keep = self.record.n_samples, len(values) > 0
        sse, estimates, kept = self.block(parameters, starts, lanes, n_steps, n_samples, keep=keep)
        if keep:
            values[..., _neighbours(lanes)] = kept[..., : len(lanes)]
        return sse, self._excess(sse, estimates, np.full(len(lanes), n_steps * (n_samples - 1)))

    def innovations(
        self,
        kalman: Filter,
        settings: FilterSettings,
        parameters: FloatArray,
        starts: FloatArray | None,
        lanes: IntArray,
        n_steps: int,
        values: FloatArray,
        traces: tuple[FloatArray, FloatArray] = _UNTRACED,
    ) -> tuple[FloatArray, FloatArray]:
        """As ``residuals``, of the innovations of a filter, in parts of the outputs' noise.

        A state that starts at the first sample of an output has that sample's error. traces: filled
        with the kernel's work area before each sample's outputs, (n_samples, work_rows), and its
        states after them. Returns with the sums of squares those of the logarithms of the
        innovations' variances in parts of the outputs', (n, n_outputs).
        """
        record, kernel, model = self.record, kalman.kernel, self.kernels.model
        padded = lanes.take(_ALL_LANES, mode="wrap")
        first = [*self._starting, *[None] * kernel.n_states]
        (mean, cut), weights = self._taken_in(kernel, settings)
        unit, variances, shift = self._variances(kernel, settings)
        of_first = variances[0] + shift[0] ** 2
        spread = [0.0 if (j := first[i]) is None else of_first[j] for i in kernel.reached]
        driven, noisy = list(kernel.variation.driven), list(kernel.variation.noisy)
        process = np.broadcast_to(settings.process, len(model.states))
        intensity = process[driven] ** 2 / record.dt
        of_inputs, colour = record.input_noise[noisy] ** 2, self._colour(kernel, settings)
        start = np.zeros((kernel.n_states, LANES))
        start[: len(model.states)] = self._initial(starts, padded)
        kept = np.empty((*variances.shape, LANES))
        sums = np.empty((2 * variances.shape[1], LANES))
        work = work_area(kernel.work_rows * LANES)
        inputs = self._inputs_of.get(tuple(kernel.splines))
        if inputs is None:  # the same in every run of a fit
            inputs = with_bends(model, record, kernel.splines)
            self._inputs_of[tuple(kernel.splines)] = inputs
        measured = self._after_the_last(cut, parameters, starts, lanes, n_steps)
        if self._parts > 1:
            measured -= self._beyond_means(parameters, starts, lanes, n_steps)
        if settings.exact:
            measured -= self.beyond_parabolas(parameters, starts, lanes, n_steps)
        with explained_errors(model):
            kalman.innovations(
                work, work.reshape(-1, LANES), kernel.tables, inputs, measured, weights,
                variances, unit, mean, shift, self._lasting(settings), of_inputs, colour,
                intensity, np.array(spread), float(settings.corrects), start,
                np.ascontiguousarray(parameters[padded].T), record.dt, n_steps,
                -(-len(lanes) // (LANES // 2)), sums, kept, *traces,
            )  # fmt: skip
        values[..., _neighbours(lanes)] = kept[..., : len(lanes)]
        sse, logarithms = (half.T[: len(lanes)] for half in np.split(sums, 2))
        return sse, logarithms

    def _taken_in(
        self, kernel: FilterKernel, settings: FilterSettings
    ) -> tuple[_Means, FloatArray]:
        """As of ``_means``, and weights (n_samples, n_outputs) of what a filter takes in."""
        key = tuple(kernel.averaged), settings.corrects
        if key not in self._means_of:  # the same in every run of a fit
            self._means_of[key] = self._means(*key)
        means, weights = self._means_of[key], self._weights * settings.trust
        starting = [j for j in self._starting if j is not None]
        over = [j for j in self.averaged if j not in means[1]]
        weights[0, starting + over] = 0.0  # of the latter no mean is over yet
        return means, weights

    def _variances(
        self, kernel: FilterKernel, settings: FilterSettings
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Variances of the outputs, (n_outputs,), and of each sample, (n_samples, n_outputs).

        The latter beside what means that are late are more, which is the third.
        """
        unit, shape = settings.noise**2, self._measured.shape
        shift = np.zeros(shape)
        timed = list(kernel.late)
        shift[:, timed] = np.broadcast_to(settings.shift, shape)[:, timed]
        return unit, np.full(shape, unit + settings.scatter) - shift**2, shift

    def _lasting(self, settings: FilterSettings) -> FloatArray:
        """How much of how late means were goes on from the sample before, as of ``_variances``."""
        return np.ascontiguousarray(np.broadcast_to(settings.jitter_colour, self._measured.shape))

    def _colour(self, kernel: FilterKernel, settings: FilterSettings) -> FloatArray:
        """Colour of the noisy inputs' noise."""
        each: FloatArray = np.broadcast_to(settings.colour, len(self.record.input_noise))
        return each[list(kernel.variation.noisy)]

    def filter_response(
        self,
        kalman: Filter,
        settings: FilterSettings,
        vector: FloatArray,
        start: FloatArray,
        n_steps: int,
    ) -> LinearResponse:
        """How innovations answer disturbances under parameters (n_parameters,) from a start."""
        kernel, record = kalman.kernel, self.record
        n, n_states = record.n_samples, kernel.variation.n_states
        before, after = np.zeros((n, kernel.work_rows)), np.zeros((n, n_states))
        unit, variances, shift = self._variances(kernel, settings)
        self.innovations(
            kalman, settings, vector[None], start[None], np.zeros(1, dtype=np.int64), n_steps,
            np.empty((*variances.shape, 1)), (before, after),
        )  # fmt: skip
        intervals = Intervals(kalman.model, vector, record.inputs, record.dt, n_steps)
        mean, _ = self._means(self.averaged, settings.corrects)
        return filter_response(
            kernel, self.averaged, IntervalSlopes(intervals, after), before, mean,
            self._taken_in(kernel, settings)[1], variances, shift, self._lasting(settings), unit,
            self._colour(kernel, settings), settings.corrects,
        )  # fmt: skip

    @property
    def weights(self) -> FloatArray:
        """Parts of an output that make its residual, (n_samples, n_outputs), 0 of lost samples."""
        return self._weights

    def tangents(self, parameters: FloatArray, starts: FloatArray, n_steps: int) -> FloatArray:
        """Tangents of the outputs of up to LANES rows at so many steps per sample.

        parameters: (n, 2 n_parameters), each behind its own the direction in which they move;
        starts: likewise (n, 2 n_states). Returns (n_samples, n_outputs, n). Raises ModelError as
        ``compiler.tangents``.
        """
        model, q = self.kernels.model, self._measured.shape[1]
        tangents = compiled_tangents(
            with_integrals(model, self.averaged) if self.averaged else model
        )
        kernel, n = tangents.kernel, len(parameters)
        nothing = np.zeros((n, len(self.averaged)))
        at, moves = np.split(starts, 2, axis=1)
        starts = np.hstack([at, nothing, moves, nothing])
        padded = np.arange(LANES) % n
        fine = np.empty((len(self._driving), q + len(self.averaged), LANES))
        work = work_area(kernel.work_rows * LANES)
        with explained_errors(model):
            tangents.simulate(
                work, work.reshape(-1, LANES), kernel.tables, self._driving, *self._unmeasured,
                np.ascontiguousarray(starts[padded].T), np.ascontiguousarray(parameters[padded].T),
                *self._pace(n_steps, self._parts), np.empty((2 * kernel.n_outputs, LANES)), fine,
            )  # fmt: skip
        kept = np.ascontiguousarray(fine[:: self._parts])
        self._average(kept, [integral / self.record.dt for integral in kept[:, q:].swapaxes(0, 1)])
        return kept[:, :q, :n]

    def block(
        self,
        parameters: FloatArray,
        starts: FloatArray | None,
        lanes: IntArray,
        n_steps: int,
        n_samples: int,
        *,
        keep: bool,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Sums of squared residuals and of error estimates of up to LANES rows, (n, n_outputs).

        n_samples: how much of the record is simulated. With them the residuals if they are to be
        kept, (n_samples, n_outputs, LANES).
        """
        if self.averaged:
            return self._averaged_block(parameters, starts, lanes, n_steps, n_samples)
        rows = self._rows(n_samples)
        residuals = np.empty((rows if keep else 0, self._measured.shape[1], LANES))
        run = tuple(part[:rows] for part in (self._driving, *self._compared))
        start, pace = self._initial(starts, lanes), self._pace(n_steps, self._parts)
        sums, estimates, _ = self._run(
            self.kernels, parameters, start, lanes, *pace, run, residuals
        )
        return sums, estimates, residuals[:: self._parts]

    def _rows(self, n_samples: int) -> int:
        """Rows of what drives so many samples, parts between them included."""
        return (n_samples - 1) * self._parts + 1

    def _pace(self, n_steps: int, parts: int) -> tuple[float, int]:
        """Time of a part of a sample, and integration steps in it, by those in a sample."""
        return self.record.dt / parts, -(-n_steps // parts)

    def _average(self, outputs: FloatArray, integrals: Sequence[FloatArray]) -> None:
        """Put means over windows in place of averaged outputs, by integrals."""
        for j, integral in zip(self.averaged, integrals, strict=True):
            outputs[:, j] = average(outputs[:, j], integral, self._windows[j, : len(outputs)])

    def _means(self, averaged: Sequence[int], corrects: bool) -> _Means:
        """Weights (n_samples, n_outputs, 2, 4) as of ``weights_of_sums`` for a filter.

        And those (n_samples, 3) of outputs whose means are cut off at the sample before.
        """
        mean = np.zeros((*self._measured.shape, 2, 4))
        mean[..., 0, 1] = 1.0
        cut: dict[int, FloatArray] = {}
        for j in self.averaged:
            seen = self._weights[:, j] > 0.0
            seen[0] = False
            sums = weights_of_sums(self._windows[j], seen) if corrects else None
            if j in averaged and sums is not None:
                mean[:, j] = sums
            elif j in averaged:
                mean[:, j, 0, :3] = cut[j] = weights_of_mean(self._windows[j])
            else:
                cut[j] = mean[:, j, 0, :3].copy()
        mean[..., 2] /= self.record.dt
        return mean, cut

    def _after_the_last(
        self,
        cut: Mapping[int, FloatArray],
        parameters: FloatArray,
        starts: FloatArray | None,
        lanes: IntArray,
        n_steps: int,
    ) -> FloatArray:
        """Measured outputs for each lane, (n_samples, n_outputs, LANES), as a filter takes them in.

        Those that are cut are by what a window saw since the sample before; the free run says what
        more it saw. cut: weights as of ``weights_of_mean``.
        """
        measured = np.repeat(self._measured[..., None], LANES, axis=2)
        if cut:
            instant, integrals, _ = self._integrated(
                parameters, starts, lanes, n_steps, len(measured)
            )
            for j, integral in zip(self.averaged, integrals, strict=True):
                if j not in cut:
                    continue
                output, (before, now, between) = instant[:, j], cut[j].T[..., None]
                with np.errstate(over="ignore", invalid="ignore"):  # a free run that diverges
                    last = now * output
                    last[1:] += before[1:] * output[:-1] + between[1:] * np.diff(integral, axis=0)
                    measured[:, j] += last - average(output, integral, self._windows[j])
        return measured

    def _beyond_means(
        self, parameters: FloatArray, starts: FloatArray | None, lanes: IntArray, n_steps: int
    ) -> FloatArray:
        """What inputs that change between samples do beside their means, by free runs.

        (n_samples, n_outputs, LANES).
        """
        runs = []
        for by_means in (False, True):
            outputs, integrals, _ = self._integrated(
                parameters, starts, lanes, n_steps, self.record.n_samples, by_means=by_means
            )
            self._average(outputs, integrals)
            runs.append(outputs)
        beyond: FloatArray = runs[0] - runs[1]
        return beyond

    def beyond_parabolas(
        self,
        parameters: FloatArray,
        starts: FloatArray | None,
        lanes: IntArray,
        n_steps: int,
    ) -> FloatArray:
        """By how much means of free runs are not those of parabolas between samples.

        (n_samples, n_outputs, LANES).
        """
        beyond = np.zeros((*self._measured.shape, LANES))
        if not self.averaged:
            return beyond
        if self._in_parts is None:
            ends = {j: ends_of(self._windows[j]) for j in self.averaged}
            inputs = self._driving
            if self._parts == 1:
                inputs = in_parts(self.kernels.model, self._inputs, _PARTS)
            self._in_parts = inputs, ends
        (inputs, ends), (dt, steps) = self._in_parts, self._pace(n_steps, _PARTS)
        state = self._integrating_start(starts, lanes)
        q = self._measured.shape[1]
        kept = np.empty((_AT_ONCE * _PARTS + 1, q + len(self.averaged), LANES))
        signals = np.zeros(kept.shape[:2]), np.ones(kept.shape[:2])
        for first in range(0, self.record.n_samples - 1, _AT_ONCE):
            part = inputs[first * _PARTS :][: len(kept)]
            run = part, *(signal[: len(part)] for signal in signals)
            outputs = kept[: len(part)]
            *_, state = self._run(
                self._integrating, parameters, state, lanes, dt, steps, run, outputs
            )
            for m, j in enumerate(self.averaged):
                integral = outputs[:, q + m] / dt
                add_beyond(beyond[:, j], ends[j], first, _PARTS, outputs[:, j], integral)
        return beyond

    def _integrated(
        self,
        parameters: FloatArray,
        starts: FloatArray | None,
        lanes: IntArray,
        n_steps: int,
        n_samples: int,
        *,
        by_means: bool = False,
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        """Outputs (n_samples, n_outputs, LANES) at their instants, and integrals of the averaged.

        Each (n_samples, LANES), over the sample time. With them the error estimates of the
        outputs, (n, n_outputs). by_means: of inputs that change between samples.
        """
        parts = 1 if by_means else self._parts
        inputs = self._inputs if by_means else self._driving
        q, more, rows = self._measured.shape[1], len(self.averaged), (n_samples - 1) * parts + 1
        fine = np.empty((rows, q + more, LANES))
        start, pace = self._integrating_start(starts, lanes), self._pace(n_steps, parts)
        run = tuple(part[:rows] for part in (inputs, *self._unmeasured))
        _, estimates, _ = self._run(self._integrating, parameters, start, lanes, *pace, run, fine)
        kept = fine[::parts]
        integrals = [kept[:, q + i] / self.record.dt for i in range(more)]
        return kept[:, :q], integrals, estimates[:, :q]

    def _integrating_start(self, starts: FloatArray | None, lanes: IntArray) -> FloatArray:
        """Initial states of the model with integrals, (n_states, n_lanes)."""
        nothing = np.zeros((len(self.averaged), len(lanes)))
        return np.vstack([self._initial(starts, lanes), nothing])

    def _averaged_block(
        self,
        parameters: FloatArray,
        starts: FloatArray | None,
        lanes: IntArray,
        n_steps: int,
        n_samples: int,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As ``block``, of outputs over the record's windows."""
        outputs, integrals, estimates = self._integrated(
            parameters, starts, lanes, n_steps, n_samples
        )
        self._average(outputs, integrals)
        sums = compared(outputs, self._measured[:n_samples], self._weights[:n_samples])
        return sums.T[: len(lanes)], estimates, outputs

    def _run(
        self,
        kernels: Kernels,
        parameters: FloatArray,
        start: FloatArray,
        lanes: IntArray,
        dt: float,
        n_steps: int,
        record: tuple[FloatArray, ...],
        residuals: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As ``block``, of outputs at their instants, and the states in the end.

        start: (n_states, n) of the kernels' model. record: inputs, and of this model measured
        outputs and weights, at samples that are dt apart.
        """
        padded = lanes.take(_ALL_LANES, mode="wrap")
        start = np.ascontiguousarray(start.take(_ALL_LANES, axis=1, mode="wrap"))
        n_outputs = record[1].shape[1]
        sums = np.empty((2 * n_outputs, LANES))
        work = work_area(kernels.batch.work_rows * LANES)
        rows = work.reshape(-1, LANES)
        arguments = (
            work, rows, kernels.batch.tables, *record, start,
            np.ascontiguousarray(parameters[padded].T), dt, n_steps, sums, residuals,
        )  # fmt: skip
        with explained_errors(kernels.model):
            kernels.simulate(*arguments)
            if residuals.size and not np.isfinite(sums[:n_outputs].sum(axis=0)).any():
                # When all have blown up it stops, and leaves the rest as it is.
                residuals.fill(np.nan)
                kernels.simulate(*arguments)
        squares, estimates = (half.T[: len(lanes)] for half in np.split(sums, 2))
        return squares, estimates, rows[: len(start), : len(lanes)]

    def _attempt(self, population: Population, todo: IntArray, n_samples: int) -> FloatArray:
        """Simulate part of a population, at its steps; error estimates in parts of the allowed."""
        steps = population.n_steps
        tasks = [
            (lanes, int(rung))
            for rung in np.unique(steps[todo])[::-1]
            for lanes in blocks_of(todo[steps[todo] == rung])
        ]
        estimates = np.zeros_like(population.sse)

        def run(task: tuple[IntArray, int]) -> None:
            lanes, rung = task
            population.sse[lanes], estimates[lanes], _ = self.block(
                population.parameters, population.starts, lanes, rung, n_samples, keep=False
            )

        self.workers.each(run, tasks)
        taken = steps[todo] * (n_samples - 1)
        population.spent[todo] += taken
        return self._excess(population.sse[todo], estimates[todo], taken)

    def _excess(self, sse: FloatArray, estimates: FloatArray, taken: IntArray) -> FloatArray:
        """Error estimates (n,) in parts of what is allowed, infinite after a failure."""
        with np.errstate(all="ignore"):
            per_step = np.sqrt(estimates / taken[:, None]) / self._size(sse)
        excess = np.max(per_step, axis=1) / (_ESTIMATE_LIMIT * self.accuracy)
        return np.where(np.isfinite(sse).all(axis=1), excess, np.inf)

    def _size(self, sse: FloatArray) -> FloatArray:
        """Size of each output, (n, n_outputs): its measured peak, of zeros the simulated RMS."""
        simulated = np.sqrt(sse / len(self._weights)) / self._weight
        unmeasured = np.where(self._weight > 0.0, simulated, np.inf)  # then no error matters
        size = np.where(self._peak > 0.0, self._peak, unmeasured)
        return np.where(size > 0.0, size, 1.0)

    def _rates(self, parameters: FloatArray, starts: FloatArray | None) -> FloatArray:
        """Fastest rate at the start of the record, under its largest inputs [1/s]."""
        rates = np.zeros(len(parameters))

        def run(lanes: IntArray) -> None:
            rate = np.zeros(len(lanes))
            start = self._initial(starts, lanes)
            states = np.broadcast_to(start, (len(self._extremes), *start.shape)).copy()
            p = np.ascontiguousarray(parameters[lanes].T)
            with explained_errors(self.kernels.model):
                self.kernels.spectrum(self._extremes, states, p, rate)
            rates[lanes] = rate

        self.workers.each(run, blocks_of(np.arange(len(parameters))))
        return rates

    def _initial(self, starts: FloatArray | None, lanes: IntArray) -> FloatArray:
        """Initial states of some chromosomes, (n_states, n_lanes)."""
        if starts is None:
            return np.repeat(self._start[:, None], len(lanes), axis=1)
        rows = lanes if len(starts) > 1 else np.zeros_like(lanes)
        return np.ascontiguousarray(np.asarray(starts, dtype=np.float64)[rows].T)


def _finer(steps: IntArray, excess: FloatArray) -> IntArray:
    """Steps per sample for those whose error estimates exceed what is allowed."""
    factor = np.where(np.isfinite(excess), excess ** (1.0 / _ESTIMATE_ORDER), 8.0)
    return _rungs(1.1 * np.clip(factor, 1.2, 8.0) * steps)


def _rungs(steps: FloatArray) -> IntArray:
    """Steps per sample rounded up on the ladder; more than any budget when not finite."""
    wanted = np.where(np.isfinite(steps), np.maximum(steps, 1.0), np.inf)
    rung = np.searchsorted(_LADDER, np.minimum(wanted, _LADDER[-1]) - 1e-9)
    return np.where(wanted > _LADDER[-1], np.iinfo(np.int64).max, _LADDER[rung])


def _neighbours(lanes: IntArray) -> slice | IntArray:
    """Lanes as a slice where they are neighbours, which takes less."""
    first, last = int(lanes[0]), int(lanes[-1])
    return slice(first, last + 1) if last - first == len(lanes) - 1 else lanes


def blocks_of(lanes: IntArray) -> list[IntArray]:
    """Lanes in groups that are simulated at once."""
    return [lanes[i : i + LANES] for i in range(0, len(lanes), LANES)]
