"""Simulation of whole populations: one call, all cores, errors accumulated on the fly."""

from __future__ import annotations

import enum
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.engine.compiler import kernels
from sysid.engine.lanes import LANES, work_area
from sysid.engine.setup import Setup
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel
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
# A trial on the record's first eighth saves one on all of it, except where it is too short to
# tell anything.
_PILOT_PART = 8
_PILOT_LEAST = 32  # samples
_MAX_STEPS = 512
_MOST_STEPS = 4096  # a sample, where accuracy is asked for
# Steps per sample come from a ladder so that chromosomes of like need share a block, while
# each one's result depends on nothing but itself.
_LADDER = np.unique(np.round(2.0 ** np.arange(0, 20.01, 0.5)).astype(np.int64))
_EVERY_LANE = np.arange(LANES)
_MOST_SETUPS = 64  # records that a simulator keeps ready


class Status(enum.IntEnum):
    """How a chromosome's simulation ended."""

    OK = 0
    UNBOUNDED = 1
    """The response left the floating-point range."""
    OVER_BUDGET = 2
    """Too stiff: it needs more integration steps per sample than the budget allows."""


@dataclass(frozen=True)
class BatchResult:
    """Outcome of a population on one or more records.

    sse: (n_chromosomes, n_records, n_outputs), sum of squared weighted residuals, infinite
    where the status is not OK. status: (n_chromosomes,), of ``Status``. steps:
    (n_chromosomes,), integration steps spent.
    """

    sse: FloatArray
    status: IntArray
    steps: IntArray


@dataclass(frozen=True)
class Residuals:
    """Weighted residuals at given steps.

    values: (n_residuals, n_outputs, n_chromosomes), records one after another, 0 where a sample
    was lost; not finite where a simulation failed. sse: (n_chromosomes, n_records, n_outputs),
    their sums of squares. excess: (n_chromosomes, n_records), error estimates in parts of what
    the accuracy allows: up to 1 the steps were enough.
    """

    values: FloatArray
    sse: FloatArray
    excess: FloatArray


class BatchSimulator:
    """Free-run simulation of many parameter vectors of one process model.

    accuracy: normalised RMS error against the exact solution that the step size aims at.
    threads: default all cores this process may use. max_steps: budget of integration steps per
    sample; a chromosome that needs more is reported OVER_BUDGET. The result for a chromosome
    depends on neither the number of threads nor the rest of the population.
    """

    def __init__(
        self,
        model: ProcessModel,
        *,
        accuracy: float = 1e-3,
        threads: int | None = None,
        max_steps: int = _MAX_STEPS,
    ) -> None:
        if not 1e-12 <= accuracy <= 0.1:
            raise ModelError(f"accuracy {accuracy:g} is outside [1e-12, 0.1]")
        if threads is not None and threads < 1:
            raise ModelError(f"threads is {threads}; it must be at least 1")
        self.model = model
        self.accuracy = accuracy
        self.threads = threads or available_cores()
        self.max_steps = max_steps
        self._kernels = kernels(model)
        self._workers = Workers(self.threads)
        self._setups: dict[tuple[int, bytes], Setup] = {}

    def finer(self, accuracy: float) -> BatchSimulator:
        """The same simulations at another accuracy, stiff ones given the steps."""
        return BatchSimulator(
            self.model,
            accuracy=accuracy,
            threads=self.threads,
            max_steps=max(self.max_steps, _MOST_STEPS),
        )

    def errors(
        self,
        parameters: FloatArray,
        records: Sequence[Dataset],
        scales: Sequence[FloatArray] | None = None,
        starts: Sequence[FloatArray] | None = None,
    ) -> BatchResult:
        """Sum of squared residuals of every parameter vector on every record.

        parameters: (n, n_parameters). scales: per record, (n_outputs,) divisors of the
        residuals, default 1. starts: per record, (n, n_states), initial states; default the
        record's own. Never raises for a chromosome that fails; see ``status``.
        """
        parameters = self._check(parameters, records)
        scales = scales or [np.ones(len(self.model.outputs))] * len(records)
        n = len(parameters)
        sse = np.full((n, len(records), len(self.model.outputs)), np.inf)
        status = np.full(n, Status.OK, dtype=np.int64)
        steps = np.zeros(n, dtype=np.int64)
        for r, record in enumerate(records):
            todo = np.flatnonzero(status == Status.OK)
            start = None if starts is None else starts[r][todo]
            result = self._runner(record, scales[r], start).population(parameters[todo])
            sse[todo, r] = result.sse[:, 0]
            status[todo] = result.status
            steps[todo] += result.steps
        sse[status != Status.OK] = np.inf
        return BatchResult(sse, status, steps)

    def trajectories(
        self,
        parameters: FloatArray,
        record: Dataset,
        n_steps: int | None = None,
        starts: FloatArray | None = None,
    ) -> FloatArray:
        """Simulated outputs, (n, n_samples, n_outputs), not finite where a simulation failed.

        n_steps: integration steps per sample, the same for all; default what the most
        demanding of them needs, so that outputs differ by their parameters alone. starts:
        (n, n_states), initial states; default the record's own.
        """
        parameters = self._check(parameters, [record])
        runner = self._runner(record, None, starts)
        n_steps = n_steps or int(runner.steps_of_each(parameters).max())
        outputs = np.empty((record.n_samples, len(self.model.outputs), len(parameters)))
        each = np.full(len(parameters), n_steps)

        def run(task: tuple[slice, int]) -> None:
            rows, steps = task
            runner.residuals(parameters, rows, steps, outputs[..., rows])

        self._workers.each(run, _runs(each))
        return np.ascontiguousarray(np.moveaxis(outputs, 2, 0))

    def residuals(
        self,
        parameters: FloatArray,
        records: Sequence[Dataset],
        scales: Sequence[FloatArray],
        n_steps: IntArray,
        starts: Sequence[FloatArray],
        *,
        keep: bool = True,
    ) -> Residuals:
        """Residuals of every parameter vector on every record at given steps.

        n_steps: (n, n_records), integration steps per sample; rows of like steps had better be
        neighbours, to share a block. scales, starts: as those of ``errors``. Without ``keep``
        there are no values, only their sums of squares.
        """
        parameters = self._check(parameters, records)
        n, q = len(parameters), len(self.model.outputs)
        sse, excess = np.empty((n, len(records), q)), np.empty((n, len(records)))
        ends = np.cumsum([record.n_samples for record in records])
        values = np.empty((ends[-1] if keep else 0, q, n))
        tasks = []
        for r, (record, end) in enumerate(zip(records, ends, strict=True)):
            runner = self._runner(record, scales[r], starts[r])
            part = values[end - record.n_samples : end]
            tasks += [(runner, part, r, *run) for run in _runs(n_steps[:, r])]
        # What takes longest is begun first.
        tasks.sort(key=lambda task: -task[4] * task[0].setup.record.n_samples)

        def run(task: tuple[_Runner, FloatArray, int, slice, int]) -> None:
            runner, part, r, rows, steps = task
            found = runner.residuals(parameters, rows, steps, part[..., rows])
            sse[rows, r], excess[rows, r] = found

        self._workers.each(run, tasks)
        return Residuals(values, sse, excess)

    def steps_of_each(self, parameters: FloatArray, record: Dataset) -> IntArray:
        """Integration steps per sample that each parameter vector needs, (n,)."""
        parameters = self._check(parameters, [record])
        return self._runner(record).steps_of_each(parameters)

    def _runner(
        self,
        record: Dataset,
        scale: FloatArray | None = None,
        starts: FloatArray | None = None,
    ) -> _Runner:
        key = id(record), b"" if scale is None else scale.tobytes()
        setup = self._setups.get(key)
        if setup is None:
            if len(self._setups) >= _MOST_SETUPS:
                self._setups.clear()
            # It holds the record, whose address stays its own as long.
            setup = self._setups[key] = Setup.of(self.model, record, scale)
        return _Runner(self, setup, starts)

    def _check(self, parameters: FloatArray, records: Sequence[Dataset]) -> FloatArray:
        if not records:
            raise ModelError("no record to simulate on")
        for record in records:
            record.check(self.model)
        parameters = np.atleast_2d(np.asarray(parameters, dtype=np.float64))
        if parameters.ndim != 2 or parameters.shape[1] != len(self.model.parameters):
            raise ModelError(
                f"parameters have shape {parameters.shape}, expected "
                f"(n, {len(self.model.parameters)})"
            )
        return parameters


class _Runner:
    """One record's simulations: choice of steps, blocks of lanes."""

    def __init__(self, simulator: BatchSimulator, setup: Setup, starts: FloatArray | None) -> None:
        """starts: (n, n_states), rows as those of the parameters; default the record's own."""
        self.simulator = simulator
        self.setup = setup
        self.kernels = simulator._kernels
        # One row stands for all.
        given = setup.start[None] if starts is None else starts
        self.starts: FloatArray = np.asarray(given, dtype=np.float64)

    def population(self, parameters: FloatArray) -> BatchResult:
        """Simulate each with the steps it needs, and again with more where it needed more."""
        n = len(parameters)
        sse = np.full((n, 1, self.setup.measured.shape[1]), np.inf)
        spent = np.zeros(n, dtype=np.int64)
        over = self._choose(parameters, sse, spent)[1]
        status = np.full(n, Status.OK, dtype=np.int64)
        status[~np.all(np.isfinite(sse), axis=(1, 2))] = Status.UNBOUNDED
        status[over] = Status.OVER_BUDGET
        return BatchResult(sse, status, spent)

    def steps_of_each(self, parameters: FloatArray) -> IntArray:
        """Steps per sample that each needs, within the budget, (n,)."""
        sse = np.empty((len(parameters), 1, self.setup.measured.shape[1]))
        spent = np.zeros(len(parameters), dtype=np.int64)
        steps = self._choose(parameters, sse, spent)[0]
        return np.minimum(steps, self.simulator.max_steps)

    def residuals(
        self, parameters: FloatArray, rows: slice, n_steps: int, values: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Error sums (n, n_outputs) of up to LANES rows and error estimates in parts of what is
        allowed, (n,); values gets their residuals.

        values: (n_samples, n_outputs, n), or without samples to keep none.
        """
        record = np.full((len(values), values.shape[1], LANES), np.nan)
        lanes = np.arange(rows.start, rows.stop)
        sums, estimates = self._run(parameters, lanes, n_steps, record)
        values[:] = record[..., : len(lanes)]
        taken = np.full(len(lanes), n_steps * (self.setup.record.n_samples - 1))
        return sums, self._excess(sums, estimates, taken)

    def _choose(
        self, parameters: FloatArray, sse: FloatArray, spent: IntArray
    ) -> tuple[IntArray, BoolArray]:
        """Simulate all, filling sse and spent; steps per sample each took, and who is too stiff.

        A simulation that does not stay finite is tried once more with much finer steps: when
        those fail too it is the model, not the scheme, that is unbounded.
        """
        limit = self.simulator.max_steps
        steps = _rungs(self._rates(parameters) * self.setup.record.dt / _RATE_LIMIT)
        steps = np.maximum(steps, self.kernels.fewest_steps)
        over = steps > limit
        blown = np.zeros(len(parameters), dtype=bool)
        todo = np.flatnonzero(~over)
        # The record's start tells cheaply what most of them need; whether it is enough the whole
        # record says.
        pilot = self.setup.record.n_samples // _PILOT_PART
        if pilot >= _PILOT_LEAST:
            excess = self._round(parameters, steps, todo, sse, spent, pilot)
            more = _finer(steps[todo], excess)
            raised = np.isfinite(excess) & (excess > 1.0) & (more <= limit)
            steps[todo[raised]] = more[raised]
        for _ in range(_MAX_ROUNDS):
            if len(todo) == 0:
                break
            excess = self._round(parameters, steps, todo, sse, spent)
            finite = np.isfinite(excess)
            more = _finer(steps[todo], excess)
            again = ~(excess <= 1.0)
            # Finite but not accurate within the budget is too stiff; not finite is unbounded.
            over[todo[again & finite & (more > limit)]] = True
            again &= (more <= limit) & (finite | ~blown[todo])
            blown[todo] |= ~finite
            steps[todo[again]] = more[again]
            todo = todo[again]
        return steps, over

    def _round(
        self,
        parameters: FloatArray,
        steps: IntArray,
        todo: IntArray,
        sse: FloatArray,
        spent: IntArray,
        n_samples: int | None = None,
    ) -> FloatArray:
        """Simulate some; their error estimates in parts of what the accuracy allows.

        n_samples: of the record's start, default the whole record.
        """
        tasks = [
            (lanes, int(rung))
            for rung in np.unique(steps[todo])[::-1]
            for lanes in _blocks(todo[steps[todo] == rung])
        ]
        estimates = np.zeros((len(parameters), self.setup.measured.shape[1]))

        def run(task: tuple[IntArray, int]) -> None:
            lanes, rung = task
            sums = self._run(parameters, lanes, rung, np.empty((0, 0, 0)), n_samples)
            sse[lanes, 0], estimates[lanes] = sums

        self.simulator._workers.each(run, tasks)
        taken = steps[todo] * ((n_samples or self.setup.record.n_samples) - 1)
        spent[todo] += taken
        return self._excess(sse[todo, 0], estimates[todo], taken)

    def _excess(self, errors: FloatArray, estimates: FloatArray, taken: IntArray) -> FloatArray:
        """Error estimates in parts of what the accuracy allows, (n,), infinite after a failure.

        errors, estimates: (n, n_outputs), sums over a simulation; taken: (n,), its steps.
        """
        with np.errstate(all="ignore"):
            per_step = np.sqrt(estimates / taken[:, None]) / self._size(errors)
        excess = np.max(per_step, axis=1) / (_ESTIMATE_LIMIT * self.simulator.accuracy)
        return np.where(np.isfinite(errors).all(axis=1), excess, np.inf)

    def _size(self, errors: FloatArray) -> FloatArray:
        """What is large for each output of each chromosome, (n, n_outputs).

        Where nothing but zeros was measured it is the RMS of the simulated output, and where
        nothing was measured at all no error matters.
        """
        weight, peak = self.setup.weight, self.setup.peak
        own = np.sqrt(errors / len(self.setup.weights)) / weight
        size = np.where(peak > 0.0, peak, np.where(weight > 0.0, own, np.inf))
        filled: FloatArray = np.where(size > 0.0, size, 1.0)
        return filled

    def _run(
        self,
        parameters: FloatArray,
        lanes: IntArray,
        n_steps: int,
        record: FloatArray,
        n_samples: int | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Error sums and estimate sums of up to LANES chromosomes, (n, n_outputs) each."""
        setup = self.setup
        padded = lanes.take(_EVERY_LANE, mode="wrap")
        p = np.ascontiguousarray(parameters[padded].T)
        start = self._start(padded)
        q = setup.measured.shape[1]
        sums = np.empty((2 * q, LANES))
        work = work_area(self.kernels.work_rows * LANES)
        self.kernels.simulate(
            work,
            work.reshape(-1, LANES),
            self.kernels.tables,
            setup.inputs[:n_samples],
            setup.measured[:n_samples],
            setup.weights[:n_samples],
            start,
            p,
            setup.record.dt,
            n_steps,
            sums,
            record,
        )
        return sums[:q].T[: len(lanes)], sums[q:].T[: len(lanes)]

    def _start(self, lanes: IntArray) -> FloatArray:
        """Initial states of some chromosomes, (n_states, n_lanes)."""
        rows = lanes if len(self.starts) > 1 else np.zeros_like(lanes)
        return np.ascontiguousarray(self.starts[rows].T)

    def _rates(self, parameters: FloatArray) -> FloatArray:
        """Fastest rate at the start of the record, under its largest inputs [1/s]."""
        rates = np.zeros(len(parameters))
        setup = self.setup
        inputs = setup.record.inputs[setup.extremes]

        def run(lanes: IntArray) -> None:
            rate = np.zeros(len(lanes))
            start = self._start(lanes)
            states = np.broadcast_to(start, (len(inputs), *start.shape)).copy()
            p = np.ascontiguousarray(parameters[lanes].T)
            self.kernels.spectrum(inputs, states, p, rate)
            rates[lanes] = rate

        self.simulator._workers.each(run, _blocks(np.arange(len(parameters))))
        return rates


def _finer(steps: IntArray, excess: FloatArray) -> IntArray:
    """Steps per sample for those whose error estimates exceed what is allowed."""
    finite = np.isfinite(excess)
    factor = np.where(finite, excess ** (1.0 / _ESTIMATE_ORDER), 8.0)
    return _rungs(1.1 * np.clip(factor, 1.2, 8.0) * steps)


def _rungs(steps: FloatArray) -> IntArray:
    """Steps per sample rounded up on the ladder; more than any budget when not finite."""
    wanted = np.where(np.isfinite(steps), np.maximum(steps, 1.0), np.inf)
    rung = np.searchsorted(_LADDER, np.minimum(wanted, _LADDER[-1]) - 1e-9)
    return np.where(wanted > _LADDER[-1], np.iinfo(np.int64).max, _LADDER[rung])


def _blocks(lanes: IntArray) -> list[IntArray]:
    return [lanes[i : i + LANES] for i in range(0, len(lanes), LANES)]


def _runs(steps: IntArray) -> list[tuple[slice, int]]:
    """Up to LANES neighbours each that take the same steps, and these."""
    ends = [*(np.flatnonzero(np.diff(steps)) + 1).tolist(), len(steps)]
    begins = [0, *ends[:-1]]
    return [
        (slice(i, min(i + LANES, end)), int(steps[begin]))
        for begin, end in zip(begins, ends, strict=True)
        for i in range(begin, end, LANES)
    ]


def available_cores() -> int:
    """Cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
