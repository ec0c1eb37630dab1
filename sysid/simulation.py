"""Simulation of whole populations: one call, all cores, errors accumulated on the fly."""

from __future__ import annotations

import enum
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from sysid._compile import kernels
from sysid._kernel import LANES
from sysid.data import Dataset
from sysid.model import FloatArray, IntArray, ModelError, ProcessModel

# Classical RK4 with |lambda| h at this value leaves a normalised RMS error below 1e-3 on the
# models shipped here (benchmarks/simulation.py prints the distribution); its global error
# goes with the fourth power of the step.
_STEP_AT_1E3 = 0.6
_MAX_STEPS = 512
_SNAPSHOTS = 6
# Steps per sample come from a ladder so that chromosomes of like need share a block, while
# each one's result depends on nothing but itself.
_LADDER = np.unique(np.round(2.0 ** np.arange(0, 9.01, 0.5)).astype(np.int64))


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
        self._step_limit = _STEP_AT_1E3 * (accuracy / 1e-3) ** 0.25

    def errors(
        self,
        parameters: FloatArray,
        records: Sequence[Dataset],
        scales: Sequence[FloatArray] | None = None,
    ) -> BatchResult:
        """Sum of squared residuals of every parameter vector on every record.

        parameters: (n, n_parameters). scales: per record, (n_outputs,) divisors of the
        residuals, default 1. Never raises for a chromosome that fails; see ``status``.
        """
        parameters = self._check(parameters, records)
        scales = scales or [np.ones(len(self.model.outputs))] * len(records)
        n = len(parameters)
        sse = np.full((n, len(records), len(self.model.outputs)), np.inf)
        status = np.full(n, Status.OK, dtype=np.int64)
        steps = np.zeros(n, dtype=np.int64)
        with ThreadPoolExecutor(self.threads) as pool:
            for r, record in enumerate(records):
                runner = _Runner(self, record, scales[r], pool)
                todo = np.flatnonzero(status == Status.OK)
                result = runner.population(parameters[todo])
                sse[todo, r] = result.sse[:, 0]
                status[todo] = result.status
                steps[todo] += result.steps
        sse[status != Status.OK] = np.inf
        return BatchResult(sse, status, steps)

    def trajectories(
        self, parameters: FloatArray, record: Dataset, n_steps: int | None = None
    ) -> FloatArray:
        """Simulated outputs, (n, n_samples, n_outputs), not finite where a simulation failed.

        n_steps: integration steps per sample, the same for all; default what the most
        demanding of them needs, so that outputs differ by their parameters alone.
        """
        parameters = self._check(parameters, [record])
        n, q = len(parameters), len(self.model.outputs)
        outputs = np.full((n, record.n_samples, q), np.nan)
        with ThreadPoolExecutor(self.threads) as pool:
            runner = _Runner(self, record, np.ones(q), pool)
            n_steps = n_steps or runner.common_steps(parameters)
            list(
                pool.map(
                    lambda lanes: runner.record_block(parameters, lanes, n_steps, outputs),
                    _blocks(np.arange(n)),
                )
            )
        return outputs

    def steps_needed(self, parameters: FloatArray, record: Dataset) -> int:
        """Integration steps per sample that serve all the given parameter vectors."""
        parameters = self._check(parameters, [record])
        with ThreadPoolExecutor(self.threads) as pool:
            runner = _Runner(self, record, np.ones(len(self.model.outputs)), pool)
            return runner.common_steps(parameters)

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
    """One record's simulations: choice of steps, blocks of lanes, threads."""

    def __init__(
        self,
        simulator: BatchSimulator,
        record: Dataset,
        scale: FloatArray,
        pool: ThreadPoolExecutor,
    ) -> None:
        self.simulator = simulator
        self.record = record
        self.pool = pool
        self.kernels = simulator._kernels
        self.x0 = record.initial_state(simulator.model)
        missing = ~np.isfinite(record.outputs)
        self.y = np.where(missing, 0.0, record.outputs)
        self.w = np.where(missing, 0.0, 1.0 / scale)
        self.every = max(1, record.n_samples // _SNAPSHOTS)
        # Where an input is largest is where a model driven through it is fastest.
        peaks = np.argmax(np.abs(record.inputs), axis=0) if record.inputs.shape[1] else []
        self.extremes: IntArray = np.unique(np.array([0, *peaks], dtype=np.int64))

    def population(self, parameters: FloatArray) -> BatchResult:
        """Simulate each with the steps it needs; look again at the states it went through."""
        n = len(parameters)
        sse = np.full((n, 1, self.y.shape[1]), np.inf)
        status = np.full(n, Status.OK, dtype=np.int64)
        spent = np.zeros(n, dtype=np.int64)
        steps = self._initial_steps(parameters)
        status[steps > self.simulator.max_steps] = Status.OVER_BUDGET
        todo = np.flatnonzero(status == Status.OK)
        # Second round: those whose own trajectory turned out faster than its start.
        for _ in range(2):
            if len(todo) == 0:
                break
            needed = self._round(parameters, steps, todo, sse, spent)
            over = needed > self.simulator.max_steps
            status[todo[over]] = Status.OVER_BUDGET
            again = (needed > 1.3 * steps[todo]) & ~over
            steps[todo[again]] = needed[again]
            todo = todo[again]
        finite = np.all(np.isfinite(sse), axis=(1, 2))
        status[(status == Status.OK) & ~finite] = Status.UNBOUNDED
        return BatchResult(sse, status, spent)

    def common_steps(self, parameters: FloatArray) -> int:
        """One number of steps per sample for all, within the budget."""
        steps = np.minimum(self._initial_steps(parameters), self.simulator.max_steps)
        chosen = int(steps.max())
        snapshots = self._block(parameters, np.arange(min(len(parameters), LANES)), chosen)[1]
        needed = self._needed(parameters[:LANES], snapshots)  # a sample of them is enough here
        return int(min(max(chosen, needed.max()), self.simulator.max_steps))

    def record_block(
        self, parameters: FloatArray, lanes: IntArray, n_steps: int, outputs: FloatArray
    ) -> None:
        record = np.empty((self.record.n_samples, self.y.shape[1], LANES))
        record[:] = np.nan
        self._run(parameters, lanes, n_steps, record, np.empty((0, 0, 0)))
        outputs[lanes] = np.moveaxis(record, 2, 0)[: len(lanes)]

    def _round(
        self,
        parameters: FloatArray,
        steps: IntArray,
        todo: IntArray,
        sse: FloatArray,
        spent: IntArray,
    ) -> IntArray:
        needed = np.zeros(len(parameters), dtype=np.int64)
        tasks = [
            (lanes, int(rung))
            for rung in np.unique(steps[todo])[::-1]
            for lanes in _blocks(todo[steps[todo] == rung])
        ]

        def run(task: tuple[IntArray, int]) -> None:
            lanes, rung = task
            errors, snapshots = self._block(parameters, lanes, rung)
            sse[lanes, 0] = errors
            needed[lanes] = self._needed(parameters[lanes], snapshots)
            spent[lanes] += rung * (self.record.n_samples - 1)

        list(self.pool.map(run, tasks))
        return needed[todo]

    def _block(
        self, parameters: FloatArray, lanes: IntArray, n_steps: int
    ) -> tuple[FloatArray, FloatArray]:
        snapshots = np.zeros((_SNAPSHOTS, len(self.x0), LANES))
        errors = self._run(parameters, lanes, n_steps, np.empty((0, 0, 0)), snapshots)
        return errors, snapshots

    def _run(
        self,
        parameters: FloatArray,
        lanes: IntArray,
        n_steps: int,
        record: FloatArray,
        snapshots: FloatArray,
    ) -> FloatArray:
        padded = np.resize(lanes, LANES)
        p = np.ascontiguousarray(parameters[padded].T)
        x0 = np.repeat(self.x0[:, None], LANES, axis=1)
        sse = np.empty((self.y.shape[1], LANES))
        self.kernels.simulate(
            _aligned(self.kernels.work_size),
            self.record.inputs,
            self.y,
            self.w,
            x0,
            p,
            self.record.dt,
            n_steps,
            sse,
            record,
            self.every if len(snapshots) else 0,
            snapshots,
        )
        return sse.T[: len(lanes)]

    def _initial_steps(self, parameters: FloatArray) -> IntArray:
        """Steps from the spectrum at the start of the record, under its largest inputs."""
        states = np.broadcast_to(self.x0[:, None], (len(self.extremes), len(self.x0), LANES))
        rates = np.empty(len(parameters))

        def run(lanes: IntArray) -> None:
            rates[lanes] = self._rates(self.extremes, states, parameters[lanes])

        list(self.pool.map(run, _blocks(np.arange(len(parameters)))))
        return self._rungs(rates)

    def _needed(self, parameters: FloatArray, snapshots: FloatArray) -> IntArray:
        """Steps from the spectrum at states the simulations went through."""
        instants = np.minimum(np.arange(len(snapshots)) * self.every, self.record.n_samples - 1)
        return self._rungs(self._rates(instants, snapshots, parameters))

    def _rates(self, instants: IntArray, states: FloatArray, parameters: FloatArray) -> FloatArray:
        rates = np.zeros(len(parameters))
        p = np.ascontiguousarray(parameters.T)
        self.kernels.spectrum(self.record.inputs[instants], np.ascontiguousarray(states), p, rates)
        return rates

    def _rungs(self, rates: FloatArray) -> IntArray:
        """Steps per sample from the spectral bound, rounded up on the ladder."""
        ratio = np.maximum(rates * self.record.dt / self.simulator._step_limit, 1.0)
        ratio[~np.isfinite(ratio)] = np.inf
        top = int(_LADDER[-1])
        rung = np.searchsorted(_LADDER, np.minimum(ratio, top) - 1e-9)
        beyond = self.simulator.max_steps + 1
        within = np.minimum(_LADDER[np.minimum(rung, len(_LADDER) - 1)], beyond)
        return np.where(ratio > top, beyond, within)


def _aligned(size: int) -> FloatArray:
    """Floats starting on a cache line: vector loads that straddle lines take twice as long."""
    raw = np.empty(size + 8)
    start = (-raw.ctypes.data % 64) // 8
    return raw[start : start + size]


def _blocks(lanes: IntArray) -> list[IntArray]:
    return [lanes[i : i + LANES] for i in range(0, len(lanes), LANES)]


def available_cores() -> int:
    """Cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
