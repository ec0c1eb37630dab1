"""The error that identification minimises, for whole populations.

With e_j the residuals of output j, simulated minus measured in parts of its scale, n_j their
number and w_j its weight, the weights summing to one:

    E = sum_j w_j r_j        r_j = |e_j| / sqrt(n_j)

This is (4.22) with the sum inside each root divided by the number of samples, so that it does not
grow with the record's length; for one record the two rank chromosomes alike, (4.22) being
sqrt(n_samples) times this.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.engine.compiler import is_differentiable
from sysid.engine.simulation import BatchResult, BatchSimulator, Residuals
from sysid.fitting.slopes import SlopeBlock, Slopes
from sysid.problem.data import Dataset, output_scale
from sysid.problem.metrics import FITTED
from sysid.problem.model import ModelError
from sysid.problem.space import SearchSpace

# Floors below which outputs' errors are smoothed, in parts of the error.
FLOORS = (1e-1, 1e-2, 1e-3)
# Whether records count by their samples or each alike.
Balance = Literal["samples", "logs"]

# Integration steps per sample that are never too many, and how many times those of most are, and of
# chromosomes that have proved to be good.
_FEW_STEPS, _FAR_MORE, _MORE = 64, 8, 2


@dataclass(frozen=True)
class Responses:
    """Residuals of n chromosomes in parts of the outputs' scales.

    values: (n_residuals, n_outputs, n), 0 where a sample was lost, not finite where a simulation
    failed. rms: (n, n_outputs). excess: (n,), as of ``Point``.
    """

    values: FloatArray
    rms: FloatArray
    excess: FloatArray

    def joined(self, more: Responses) -> Responses:
        """Errors of these and of more chromosomes, without residuals."""
        rms = np.concatenate([self.rms, more.rms])
        return Responses(self.values[..., :0], rms, np.concatenate([self.excess, more.excess]))


@dataclass(frozen=True)
class Linearisation:
    """Residuals at a point, and how they change beside it.

    residual: (n_residuals, n_outputs). slopes: by coordinates in parts of their ranges. rms:
    (n_outputs,). excess: as of ``Point``. errors: (n_free,), of the neighbours that slopes are
    differences to, infinite of those without a number.
    """

    residual: FloatArray
    slopes: Slopes
    rms: FloatArray
    excess: float
    errors: FloatArray


def smoothed(rms: FloatArray, floor: float) -> FloatArray:
    """Root mean squares, those below the floor f by the parabola (r^2 / f + f) / 2.

    No crease is left then where an output is explained exactly (Huber, "Robust estimation of a
    location parameter", Annals of Mathematical Statistics 35, 1964).
    """
    return np.where(rms > floor, rms, 0.5 * (rms**2 / floor + floor))


class Objective:
    """Mean over outputs of the RMSE on outputs normalised by max|y|, the E above.

    Several records count as one long one, or with ``balance`` "logs" each alike: the mean under
    the root is then one of the records' means. ``weights``: (n_outputs,), relative importance of
    the outputs, default equal. ``scales``: divisors of the residuals, per record (n_outputs,):
    max|y|, times a factor that balances the records. ``smooth``: whether outputs' errors stay
    smoothed by the first of ``FLOORS``, as where weights go by the errors: what is below it is an
    output that is explained too well to decide, and a crease would only lead descents astray.
    ``given``: (n, n_parameters), independent
    changes of the fixed parameters, one standard deviation each, which the intervals count.
    ``slopes_by``: coarser simulations that descents take slopes and steps by, if any.
    ``exact_slopes``: whether slopes are tangents, rather than differences of simulations.
    """

    def __init__(
        self,
        simulator: BatchSimulator,
        space: SearchSpace,
        records: Sequence[Dataset],
        *,
        per_log: bool = False,
        balance: Balance = "samples",
        weights: FloatArray | None = None,
        given: FloatArray | None = None,
    ) -> None:
        n_parameters = len(simulator.model.parameters)
        self.given = np.zeros((0, n_parameters)) if given is None else given
        self.simulator = simulator
        self.space = space
        self.records = list(records)
        q = len(simulator.model.outputs)
        relative = np.ones(q) if weights is None else np.asarray(weights, dtype=np.float64)
        self.weights = relative / relative.sum()
        counts = np.array([np.isfinite(record.outputs).sum(axis=0) for record in self.records])
        self.counts = counts.sum(axis=0)
        self.scales = _balanced(output_scale(self.records, per_log), counts, balance)
        unseen = np.flatnonzero((self.weights > 0.0) & (self.counts == 0))
        if len(unseen):
            name = simulator.model.output_names[unseen[0]]
            raise ModelError(f"no record has a measured sample of output {name!r}")
        self.smooth = False
        self.slopes_by: BatchSimulator | None = None
        self.exact_slopes = False
        self._counter = [0]

    @property
    def simulations(self) -> int:
        """Simulations of one chromosome on all records until now."""
        return self._counter[0]

    def resume_count(self, simulations: int) -> None:
        """Count on from a number of simulations done before."""
        self._counter[0] = simulations

    def over(self, space: SearchSpace) -> Objective:
        """The same objective over another space of the same model; counts go on together."""
        return self._with(space=space)

    def weighed(self, weights: FloatArray) -> Self:
        """The same objective with other weights of the outputs, (n_outputs,), 0 of those unseen."""
        seen = np.where(self.counts > 0, weights, 0.0)
        return self._with(weights=seen / seen.sum(), smooth=True)

    def on(self, records: Sequence[Dataset], places: Sequence[int] | None = None) -> Objective:
        """The same objective, scales included, on parts of its records.

        places: which of its records each is a part of; default the first ones, in order.
        """
        counts = sum(np.isfinite(record.outputs).sum(axis=0) for record in records)
        scales = [self.scales[place] for place in places or range(len(records))]
        return self._with(records=list(records), counts=counts, scales=scales)

    @property
    def scales_of_each(self) -> FloatArray:
        """Unit of each residual, (n_residuals, n_outputs)."""
        parts = zip(self.scales, self.records, strict=True)
        return np.concatenate([np.broadcast_to(s, record.outputs.shape) for s, record in parts])

    @property
    def coupled(self) -> bool:
        """Whether residuals of a record depend on the others."""
        return False

    def of_record(self, place: int, record: Dataset) -> Objective:
        """The same objective of a record alone, in the place of another, over the same space."""
        return self.on([record], [place]).over(self.space.of_record(place))

    @property
    def free_run(self) -> Objective:
        """The objective of the free run's errors: this one."""
        return self

    def sparing(self, good: Sequence[FloatArray] = ()) -> Objective:
        """The same objective, in which chromosomes fail that are far slower to simulate than most.

        A few that are stiff would take most of a search's time. Most are taken to need the steps
        of the middle of the ranges. good: chromosomes (n_free,) that must not fail, nor what is
        near them: a run that drives a plant to its ends may be stiff at the true parameters alone.
        """
        middle = self.space.decode(np.mean(self.space.coded_bounds, axis=0))
        vectors = self.space.full(np.stack([middle, *good]))
        steps = np.max([self.simulator.steps_of_each(vectors, r) for r in self.records], axis=0)
        most = max(_FEW_STEPS, _FAR_MORE * int(steps[0]), _MORE * int(steps[1:].max(initial=0)))
        return self._with(simulator=self.simulator.within(most))

    def finer(self, accuracy: float) -> Self:
        """The same objective by simulations of another accuracy, stiff ones given the steps."""
        return self._with(simulator=self.simulator.finer(accuracy))

    def with_slopes_by(self, simulator: BatchSimulator) -> Self:
        """The same objective, whose descents go by coarser simulations, and end by its own."""
        return self._with(slopes_by=simulator)

    @property
    def coarse(self) -> Self:
        """The objective by the simulations that descents go by, this one if by its own."""
        if self.slopes_by is None:
            return self
        return self._with(simulator=self.slopes_by, slopes_by=None)

    def as_fine_as(self, finer: Objective) -> Self:
        """The same objective by another's simulations of the same model, and its slopes."""
        return self._with(simulator=finer.simulator, slopes_by=finer.slopes_by)

    def simulated_by(self, simulator: BatchSimulator) -> Self:
        """The same objective by other simulations, slopes too; counts go on together."""
        return self._with(simulator=simulator, slopes_by=None, exact_slopes=False)

    def evaluate(self, chromosomes: FloatArray) -> tuple[FloatArray, BatchResult]:
        """Error of each chromosome, (n,), infinite where its simulation failed; and the batch."""
        result = self.simulator.errors(
            self.space.full(chromosomes), self.records, self.scales, self._starts(chromosomes)
        )
        self._counter[0] += len(chromosomes)
        return self.error_of(self._roots(result.sse.sum(axis=1))), result

    def rms(self, chromosomes: FloatArray) -> FloatArray:
        """RMSE of each output in parts of its scale, (n, n_outputs), infinite where it failed."""
        return self._roots(self.evaluate(chromosomes)[1].sse.sum(axis=1))

    def residuals(
        self, chromosomes: FloatArray, n_steps: Sequence[int] | IntArray, *, keep: bool = True
    ) -> Responses:
        """Residuals at given integration steps per sample, records one after another.

        n_steps: (n_records,), or of each chromosome (n, n_records). Without ``keep`` no values.
        """
        steps = np.broadcast_to(n_steps, (len(chromosomes), len(self.records)))
        simulated = self._simulated(chromosomes, steps, keep=keep)
        self._counter[0] += len(chromosomes)
        rms = self._roots(simulated.sse.sum(axis=1))
        return Responses(simulated.values, rms, simulated.excess.max(axis=1))

    def with_exact_slopes(self) -> Self:
        """The same objective with exact slopes, if its equations can be differentiated."""
        return self._with(exact_slopes=is_differentiable(self.simulator.model))

    def tangents(
        self, chromosomes: FloatArray, n_steps: IntArray, unit: FloatArray | float = 1.0
    ) -> list[Slopes]:
        """Slopes of the residuals of free runs by search coordinates, through the steps exact.

        n_steps: (n, n_records). unit: (n_free,), moves of the coordinates that they are by. For
        each chromosome a block a record, as of ``residuals``.
        """
        space, model = self.space, self.simulator.model
        unit = np.broadcast_to(unit, len(space.parameters))
        n, shared = len(chromosomes), len(space.index)
        starts = space.starts_by_record(len(self.records))
        most = max(map(len, starts), default=0)
        along = np.zeros((n, shared + most, len(model.parameters)))
        along[:, :shared] = space.directions(chromosomes) * unit[:shared, None]
        moves = [np.zeros((n, shared + most, len(model.states))) for _ in self.records]
        for move, places in zip(moves, starts, strict=True):
            for i, (column, state) in enumerate(places):
                increments = chromosomes[:, column] if space.log[column] else 1.0
                move[:, shared + i, state] = increments * unit[column]
        parts = self.simulator.tangents(
            space.full(chromosomes), self.records, along, n_steps, self._starts(chromosomes),
            moves, self.scales,
        )  # fmt: skip
        self._counter[0] += n * (shared + most)
        of_records = [*zip(self.blocks, parts, strict=True)]
        return [
            Slopes(
                tuple(
                    SlopeBlock(rows, columns, part[k, ..., : len(columns)])
                    for (rows, columns), part in of_records
                ),
                len(space.parameters),
            )
            for k in range(n)
        ]

    @property
    def blocks(self) -> list[tuple[slice, IntArray]]:
        """Of each record the rows of its residuals, and the search coordinates that act on them."""
        shared, end, blocks = range(len(self.space.index)), 0, []
        starts = self.space.starts_by_record(len(self.records))
        for record, places in zip(self.records, starts, strict=True):
            columns = np.array([*shared, *(column for column, _ in places)], dtype=np.int64)
            blocks.append((slice(end, end := end + record.n_samples), columns))
        return blocks

    def with_sample(self, responses: Responses, residual: FloatArray) -> Responses:
        """Responses with one residual more, (n,), as if of the output that counts most."""
        output = int(np.argmax(self.weights))
        row = np.zeros((1, *responses.values.shape[1:]))
        row[0, output] = residual
        rms = responses.rms.copy()
        rms[:, output] = np.hypot(rms[:, output], residual / np.sqrt(self.counts[output]))
        values = np.concatenate([responses.values, row]) if responses.values.size else row[:0]
        return replace(responses, values=values, rms=rms)

    def shifted(self, responses: Responses, shift: FloatArray) -> Responses:
        """The same responses, their residuals more by (n_residuals, n_outputs)."""
        values = responses.values
        values += shift[..., None]
        with np.errstate(over="ignore", invalid="ignore"):  # where a simulation failed
            rms = self._roots(np.einsum("tin,tin->ni", values, values))
        return replace(responses, values=values, rms=np.where(np.isfinite(rms), rms, np.inf))

    def steps_needed(self, chromosomes: FloatArray) -> IntArray:
        """Integration steps per sample that each chromosome needs, (n, n_records)."""
        vectors = self.space.full(chromosomes)
        self._counter[0] += len(vectors)
        return self.simulator.steps_needed(vectors, self.records, self._starts(chromosomes))

    def error_of(self, rms: FloatArray) -> FloatArray:
        """The error E of outputs' errors r (n, n_outputs), (n,), infinite where one failed."""
        with np.errstate(over="ignore", invalid="ignore"):  # infinite times a weight of zero
            errors = rms @ self.weights
        return np.where(np.isfinite(errors), errors, np.inf)

    def smoothed_error_of(self, rms: FloatArray, floor: float) -> FloatArray:
        """The same of ``smoothed`` outputs' errors, (n,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.error_of(smoothed(rms, floor))

    def explains_little(self, rms: FloatArray) -> bool:
        """Whether errors (n_outputs,) are half of what each output deviates from its mean.

        Where a model explains so little minima are many and none is the plant's.
        """
        return self.unexplained(rms) > 1.0 - FITTED / 100.0

    def unexplained(self, rms: FloatArray) -> float:
        """Errors (n_outputs,) in parts of what the outputs deviate from their means, the least."""
        squares = np.zeros(len(self.weights))
        for record, scale in zip(self.records, self.scales, strict=True):
            seen = np.isfinite(record.outputs)
            outputs = np.where(seen, record.outputs, 0.0)
            away = outputs - outputs.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
            squares += np.sum(np.where(seen, away / scale, 0.0) ** 2, axis=0)
        counted = (self.weights > 0.0) & (squares > 0.0)
        return float(np.min(rms[counted] / self._roots(squares)[counted], initial=np.inf))

    @property
    def n_residuals(self) -> int:
        """Residuals of one chromosome, those of all outputs and of lost samples included."""
        return int(sum(record.outputs.size for record in self.records))

    def least_squares_weights(self, residual: FloatArray) -> FloatArray:
        """Weights (n_outputs,) of squares whose mean is least where the error is, by residuals."""
        counts, rms = np.maximum(self.counts, 1), self._roots(np.sum(residual**2, axis=0))
        floor = max(FLOORS[0] * float(self.weights @ rms) if self.smooth else 0.0, 1e-12)
        weights: FloatArray = self.weights * len(residual) / counts / np.maximum(rms, floor)
        return weights

    def in_units(self, residual: FloatArray) -> FloatArray:
        """Root mean squares, (n_outputs,), in the outputs' units of residuals without a scale."""
        lengths = [record.n_samples for record in self.records]
        scaled = residual * np.repeat(self.scales, lengths, axis=0)
        return self._roots(np.sum(scaled**2, axis=0))

    def _simulated(
        self, chromosomes: FloatArray, steps: IntArray, *, keep: bool = True
    ) -> Residuals:
        """Residuals at integration steps per sample, (n, n_records)."""
        vectors, starts = self.space.full(chromosomes), self._starts(chromosomes)
        return self.simulator.residuals(
            vectors, self.records, self.scales, steps, starts, keep=keep
        )

    def _with(self, **changes: Any) -> Self:
        variant = copy.copy(self)
        vars(variant).update(changes)
        return variant

    def _starts(self, chromosomes: FloatArray) -> list[FloatArray]:
        """Initial states of every chromosome for each record."""
        model = self.simulator.model
        declared = [record.initial_state(model) for record in self.records]
        return [self.space.starts(chromosomes, k, start) for k, start in enumerate(declared)]

    def _roots(self, sse: FloatArray) -> FloatArray:
        """Root mean squares of sums of squares, (n, n_outputs)."""
        roots: FloatArray = np.sqrt(sse / np.maximum(self.counts, 1))
        return roots


def _balanced(scales: list[FloatArray], counts: IntArray, balance: Balance) -> list[FloatArray]:
    """Divisors of the residuals under which the mean over all samples is the balanced one."""
    if balance == "samples":
        return scales
    if balance != "logs":
        raise ModelError(f"unknown balance {balance!r}; choose samples or logs")
    # A record's share of the samples over its share of the records that saw the output.
    share = counts * np.sum(counts > 0, axis=0) / np.maximum(counts.sum(axis=0), 1)
    factors = np.sqrt(np.where(share > 0.0, share, 1.0))
    return [scale * factor for scale, factor in zip(scales, factors, strict=True)]
