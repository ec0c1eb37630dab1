"""Simulation of whole populations: one call, all cores, errors accumulated on the fly."""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.engine.bends import bent
from sysid.engine.compiler import Filter, kalman_filter, kernels
from sysid.engine.filter_settings import FilterSettings
from sysid.engine.linear_response import LinearResponse
from sysid.engine.record_simulator import RecordSimulator, blocks_of
from sysid.engine.scheme import LANES
from sysid.engine.windows import with_integrals
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel
from sysid.threads import Workers, available_cores

_MOST_STEPS = 4096  # a sample, where accuracy is asked for
_MOST_RECORDS = 64  # that a simulator keeps ready


class Status(enum.IntEnum):
    """How a chromosome's simulation ended.

    >>> Status(2).name
    'OVER_BUDGET'
    """

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

    >>> result = BatchResult(np.array([[[0.5]], [[np.inf]]]), np.array([0, 1]), np.array([12, 96]))
    >>> result.sse[result.status == Status.OK].sum().item()
    0.5
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

    >>> from sysid.examples import lag
    >>> record = Dataset(np.ones(4), np.zeros(4), dt=0.05)  # a step, of which nothing was measured
    >>> simulator = BatchSimulator(lag())
    >>> y = simulator.trajectories(np.array([[1.0, 0.05], [1.0, 0.1]]), record)
    >>> y[:, :, 0].round(3).tolist()
    [[0.0, 0.632, 0.865, 0.95], [0.0, 0.393, 0.632, 0.777]]
    >>> result = simulator.errors(np.array([[1.0, 0.05], [1.0, -1e-4]]), [record])
    >>> result.sse[:, 0, 0].round(2).tolist()
    [2.05, inf]
    >>> [Status(status).name for status in result.status]
    ['OK', 'UNBOUNDED']
    """

    def __init__(
        self,
        model: ProcessModel,
        *,
        accuracy: float = 1e-3,
        threads: int | None = None,
        max_steps: int = 512,
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
        self.workers = Workers(self.threads)
        self._records: dict[tuple[int, bytes], RecordSimulator] = {}

    def finer(self, accuracy: float) -> BatchSimulator:
        """The same simulations at another accuracy, stiff ones given the steps."""
        return self._like(accuracy, max(self.max_steps, _MOST_STEPS))

    def within(self, max_steps: int) -> BatchSimulator:
        """The same simulations, with no more steps per sample than that, nor than before."""
        return self._like(self.accuracy, min(self.max_steps, max_steps))

    def of(self, model: ProcessModel) -> BatchSimulator:
        """The same simulations of another model."""
        return self._like(self.accuracy, self.max_steps, model)

    def _like(
        self, accuracy: float, most: int, model: ProcessModel | None = None
    ) -> BatchSimulator:
        return BatchSimulator(
            model or self.model, accuracy=accuracy, threads=self.threads, max_steps=most
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
            population = self._on(record, scales[r]).population(parameters[todo], start)
            sse[todo, r] = population.sse
            steps[todo] += population.spent
            status[todo[~np.isfinite(population.sse).all(axis=1)]] = Status.UNBOUNDED
            status[todo[population.over_budget]] = Status.OVER_BUDGET
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
        n_steps = n_steps or int(self.steps_of_each(parameters, record, starts).max())
        steps = np.full((len(parameters), 1), n_steps)
        outputs = self.residuals(parameters, [record], [None], steps, [starts]).values
        return np.ascontiguousarray(np.moveaxis(outputs, 2, 0))

    def residuals(
        self,
        parameters: FloatArray,
        records: Sequence[Dataset],
        scales: Sequence[FloatArray | None],
        n_steps: IntArray,
        starts: Sequence[FloatArray | None],
        *,
        keep: bool = True,
    ) -> Residuals:
        """Residuals of every parameter vector on every record at given steps.

        n_steps: (n, n_records), integration steps per sample; rows of like steps had better be
        neighbours, to share a block. scales, starts: as those of ``errors``; without a scale
        residuals are the outputs themselves. Without ``keep`` there are no values, only their
        sums of squares.
        """

        def simulate(
            r: int, simulator: RecordSimulator, values: FloatArray, lanes: IntArray, steps: int
        ) -> tuple[FloatArray, FloatArray]:
            return simulator.residuals(parameters, starts[r], lanes, steps, values)

        parameters = self._check(parameters, records)
        return self._gathered(simulate, parameters, records, scales, n_steps, starts, keep=keep)

    def innovations(
        self,
        parameters: FloatArray,
        records: Sequence[Dataset],
        scales: Sequence[FloatArray],
        n_steps: IntArray,
        starts: Sequence[FloatArray | None],
        settings: Sequence[FilterSettings],
        *,
        balanced: bool = True,
    ) -> Residuals:
        """As ``residuals``, of the innovations of an extended Kalman filter.

        settings: per record; noise, process, and what is corrected, are those of all. An innovation
        is scaled by the output's noise over its own standard deviation: without noise of inputs and
        process innovations are the residuals. With noise of the process, where ``balanced``, all of
        an output are multiplied by the geometric mean of those deviations: their sum of squares is
        then least where the likelihood of an output of unknown noise is largest. See
        ``filter_kernel``. Raises ModelError for equations that cannot be differentiated.
        """
        kalman = self._filter(records, settings)
        logarithms = np.zeros((len(parameters), len(records), len(self.model.outputs)))

        def simulate(
            r: int, simulator: RecordSimulator, values: FloatArray, lanes: IntArray, steps: int
        ) -> tuple[FloatArray, FloatArray]:
            sse, logarithms[lanes, r] = simulator.innovations(
                kalman, settings[r], parameters, starts[r], lanes, steps, values
            )
            return sse, np.where(np.isfinite(sse).all(axis=1), 0.0, np.inf)

        parameters = self._check(parameters, records)
        innovations = self._gathered(simulate, parameters, records, scales, n_steps, starts)
        if not (balanced and np.any(settings[0].process)):
            return innovations
        for r in range(len(records)):
            logarithms[:, r] = logarithms[_first_alike(parameters, starts[r], n_steps[:, r]), r]
        samples = sum(np.isfinite(record.outputs).sum(axis=0) for record in records)
        factor = np.exp(0.5 * logarithms.sum(axis=1) / np.maximum(samples, 1))
        return replace(
            innovations,
            values=innovations.values * factor.T,
            sse=innovations.sse * factor[:, None] ** 2,
        )

    def filter_response(
        self,
        vector: FloatArray,
        record: Dataset,
        scale: FloatArray,
        n_steps: int,
        start: FloatArray,
        settings: FilterSettings,
    ) -> LinearResponse:
        """How innovations of a record answer what is added to the equations and the outputs.

        Of one parameter vector, (n_parameters,), from one start, (n_states,). Other arguments as of
        ``innovations``, for one record.
        """
        kalman = self._filter([record], [settings])
        return self._on(record, scale).filter_response(kalman, settings, vector, start, n_steps)

    def _filter(self, records: Sequence[Dataset], settings: Sequence[FilterSettings]) -> Filter:
        averaged = tuple(sorted({j for record in records for j in self._on(record).averaged}))
        model = bent(self.model) if all(record.between.size for record in records) else self.model
        model = with_integrals(model, averaged) if averaged else model
        process = np.broadcast_to(settings[0].process, len(self.model.states))
        driven = tuple(np.flatnonzero(process).tolist())
        coloured = any(np.any(each.colour) for each in settings)
        jittered = any(np.any(each.shift) for each in settings)
        return kalman_filter(model, noisy_inputs(records), driven, averaged, coloured, jittered)

    def beyond_parabolas(
        self,
        parameters: FloatArray,
        record: Dataset,
        n_steps: int | None = None,
        starts: FloatArray | None = None,
    ) -> FloatArray:
        """By how much simulated means over windows are not those of parabolas between samples.

        As which outputs are averaged, though behind a step of an input they may run otherwise.
        Arguments and result, (n, n_samples, n_outputs), as of ``trajectories``.
        """
        parameters = self._check(parameters, [record])
        n_steps = n_steps or int(self.steps_of_each(parameters, record, starts).max())
        blocks = [
            self._on(record).beyond_parabolas(parameters, starts, lanes, n_steps)[..., : len(lanes)]
            for lanes in blocks_of(np.arange(len(parameters)))
        ]
        return np.ascontiguousarray(np.moveaxis(np.concatenate(blocks, axis=2), 2, 0))

    def tangents(
        self,
        parameters: FloatArray,
        records: Sequence[Dataset],
        directions: FloatArray,
        n_steps: IntArray,
        starts: Sequence[FloatArray | None] | None = None,
        start_directions: Sequence[FloatArray] | None = None,
        scales: Sequence[FloatArray] | None = None,
    ) -> list[FloatArray]:
        """How the outputs of free runs move along directions of the parameters and the starts.

        parameters: (n, n_parameters). directions: (n, n_directions, n_parameters), of each row of
        them. n_steps: (n, n_records), integration steps per sample, through which the tangents are
        exact. starts: per record, (n, n_states), default the record's own; start_directions: per
        record, (n, n_directions, n_states), default zero. scales: as of ``residuals``, whose
        tangents are returned then, zero where a sample was lost; default those of the outputs.
        Returns for each record (n, n_samples, n_outputs, n_directions), not finite where a
        simulation failed. Raises ModelError for equations that cannot be differentiated.

        >>> from sysid.examples import lag
        >>> record = Dataset(np.ones(4), np.zeros(4), dt=0.05)
        >>> along_gain, steps = np.array([[[1.0, 0.0]]]), np.ones((1, 1), dtype=int)
        >>> (tangents,) = BatchSimulator(lag()).tangents(lag().nominal, [record], along_gain, steps)
        >>> tangents.round(3).ravel()
        array([0.   , 0.632, 0.865, 0.95 ])
        """
        parameters = self._check(parameters, records)
        n, n_directions = directions.shape[:2]
        lanes = np.concatenate(_each_beside(parameters, directions), axis=1)
        values: list[FloatArray] = []
        tasks: list[tuple[int, RecordSimulator, FloatArray, slice, int]] = []
        for r, record in enumerate(records):
            start = None if starts is None else starts[r]
            if start is None:
                start = record.initial_state(self.model)[None]
            start = np.broadcast_to(start, (n, len(self.model.states)))
            moves = np.zeros((n, n_directions, len(self.model.states)))
            if start_directions is not None:
                moves = start_directions[r]
            rows = np.concatenate(_each_beside(start, moves), axis=1)
            values.append(np.empty((record.n_samples, len(self.model.outputs), len(rows))))
            steps = np.repeat(n_steps[:, r], n_directions)
            simulator = self._on(record, None if scales is None else scales[r])
            tasks += [(r, simulator, rows, *run) for run in _runs(steps)]

        def run(task: tuple[int, RecordSimulator, FloatArray, slice, int]) -> None:
            r, simulator, from_starts, rows, steps = task
            part = simulator.tangents(lanes[rows], from_starts[rows], steps)
            scale = 1.0 if scales is None else simulator.weights[..., None]
            np.multiply(part, scale, out=values[r][..., rows])

        self.workers.each(run, tasks)
        return [
            np.moveaxis(value.reshape(*value.shape[:2], n, n_directions), 2, 0) for value in values
        ]

    def _gathered(
        self,
        simulate: Callable[..., tuple[FloatArray, FloatArray]],
        parameters: FloatArray,
        records: Sequence[Dataset],
        scales: Sequence[FloatArray | None],
        n_steps: IntArray,
        starts: Sequence[FloatArray | None],
        *,
        keep: bool = True,
    ) -> Residuals:
        """What is simulated of every parameter vector on every record, in blocks side by side.

        Those that are alike on a record once: most do not know where the others start.
        """
        n, q = len(parameters), len(self.model.outputs)
        sse, excess = np.empty((n, len(records), q)), np.empty((n, len(records)))
        ends = np.cumsum([record.n_samples for record in records])
        values = np.empty((ends[-1] if keep else 0, q, n))
        tasks, copies = [], []
        for r, (record, end) in enumerate(zip(records, ends, strict=True)):
            part = values[end - record.n_samples : end]
            first = _first_alike(parameters, starts[r], n_steps[:, r])
            alone = np.flatnonzero(first == np.arange(n))
            simulator = self._on(record, scales[r])
            tasks += [
                (r, simulator, part, alone[run], steps) for run, steps in _runs(n_steps[alone, r])
            ]
            if len(alone) < n:
                copies.append((r, part, first))
        # What takes longest is begun first.
        tasks.sort(key=lambda task: -task[4] * task[1].record.n_samples)

        def run(task: tuple[int, RecordSimulator, FloatArray, IntArray, int]) -> None:
            r, lanes = task[0], task[3]
            sse[lanes, r], excess[lanes, r] = simulate(*task)

        def copy(task: tuple[int, FloatArray, IntArray]) -> None:
            r, part, first = task
            again = np.flatnonzero(first != np.arange(n))
            part[..., again] = part[..., first[again]]
            sse[again, r], excess[again, r] = sse[first[again], r], excess[first[again], r]

        self.workers.each(run, tasks)
        self.workers.each(copy, copies)
        return Residuals(values, sse, excess)

    def steps_needed(
        self,
        parameters: FloatArray,
        records: Sequence[Dataset],
        starts: Sequence[FloatArray | None],
    ) -> IntArray:
        """Integration steps per sample that each parameter vector needs, (n, n_records).

        starts: as those of ``errors``.
        """

        def needed(place: int) -> IntArray:
            return self.steps_of_each(parameters, records[place], starts[place])

        return np.stack(self.workers.results(needed, range(len(records))), axis=1)

    def steps_of_each(
        self, parameters: FloatArray, record: Dataset, starts: FloatArray | None = None
    ) -> IntArray:
        """Integration steps per sample that each parameter vector needs, (n,)."""
        parameters = self._check(parameters, [record])
        steps = self._on(record).steps_needed(parameters, starts)
        return np.minimum(steps, self.max_steps)

    def _on(self, record: Dataset, scale: FloatArray | None = None) -> RecordSimulator:
        """What simulates a record; without a scale residuals are the outputs themselves."""
        key = id(record), b"" if scale is None else scale.tobytes()
        simulator = self._records.get(key)
        if simulator is None:
            if len(self._records) >= _MOST_RECORDS:
                self._records.clear()
            simulator = RecordSimulator(
                self._kernels, record, scale, self.accuracy, self.max_steps, self.workers
            )
            # It holds the record, whose address stays its own as long.
            self._records[key] = simulator
        return simulator

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


def _each_beside(points: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, m) repeated for each of their directions (n, d, m), and these, (n d, m) each."""
    return np.repeat(points, directions.shape[1], axis=0), directions.reshape(-1, points.shape[1])


def noisy_inputs(records: Sequence[Dataset]) -> tuple[int, ...]:
    """Places of the inputs that are measured with noise in any of the records."""
    noise = np.max([record.input_noise for record in records], axis=0)
    return tuple(np.flatnonzero(noise).tolist())


def _first_alike(parameters: FloatArray, start: FloatArray | None, steps: IntArray) -> IntArray:
    """For each row the first that has its parameters, its start and its steps, (n,).

    Where all start alike they are taken to differ.
    """
    if start is None or not np.any(start != start[:1]):
        return np.arange(len(steps))
    rows = np.ascontiguousarray(np.hstack([parameters, start, steps[:, None]]))
    keys = rows.view(f"V{rows.itemsize * rows.shape[1]}")[:, 0]
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return np.asarray(first[inverse], dtype=np.int64)


def _runs(steps: IntArray) -> list[tuple[slice, int]]:
    """Up to LANES neighbours each that take the same steps, and these."""
    ends = [*(np.flatnonzero(np.diff(steps)) + 1).tolist(), len(steps)]
    return [
        (slice(i, min(i + LANES, end)), int(steps[begin]))
        for begin, end in zip([0, *ends[:-1]], ends, strict=True)
        for i in range(begin, end, LANES)
    ]
