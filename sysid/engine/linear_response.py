"""How outputs answer what is added to a model's equations and outputs, in proportion.

Along a free run, or the run of an extended Kalman filter (``filter_kernel``), states deviate
linearly from what they were: with the rows C of the outputs, taken in one after the other with
gains G, and the Jacobian F of the simulated step,

    e = C d + o      d -= G e      d_(k+1) = F d_k + a_k

where o is added to the outputs and a_k is the response of the states to what is added to their
rates and to the inputs. A free run has no gains. That a filter's gains answer as well is left out:
their change multiplies innovations, which are zero in the mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit

from sysid.arrays import FloatArray
from sysid.engine.filter_kernel import FilterKernel
from sysid.engine.intervals import Intervals, IntervalSlopes
from sysid.engine.trace import values_along
from sysid.problem.model import ModelError, ProcessModel

_STEP = 1e-6  # for slopes of outputs, in parts of the largest value
_LEAST = 1e-6  # value that counts as that where there is none
_FINER = 8  # times the integration steps, for a run that stands for an exact one


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """The linear response along a run of n_samples.

    Of m deviations, those of the states first: rows, gains: (n_samples, n_outputs, m); onward:
    (n_samples, m, m), to those that the next sample begins with by each of these. kept: (n_samples,
    n_outputs), factors of the outputs' changes. states: (n_samples, n_states), foreseen from all
    samples before. slopes: of the states over what acts between the samples.
    """

    rows: FloatArray
    gains: FloatArray
    onward: FloatArray
    kept: FloatArray
    states: FloatArray
    slopes: IntervalSlopes

    def of(
        self,
        rates: FloatArray | None = None,
        inputs: FloatArray | None = None,
        outputs: FloatArray | None = None,
        start: FloatArray | None = None,
        vector: FloatArray | None = None,
        held: FloatArray | None = None,
        before: FloatArray | None = None,
        jumps: tuple[FloatArray, FloatArray] | None = None,
    ) -> FloatArray:
        """Changes of the outputs, or of what is kept of the innovations, (n_samples, n_outputs).

        By what is added to rates, (n_samples, n_states), straight from sample to sample, or by each
        of several of these, (n_samples, n_states, k), alone: (n_samples, n_outputs, k); to inputs,
        (n_samples, n_inputs), and to outputs, (n_samples, n_outputs); start: (n_states,), by where
        the states begin elsewhere; vector: (n_parameters,), by what is added to the equations'
        parameters; held: (n_samples, n_inputs), by what is added to inputs from each sample to the
        next; before: of the rates' shape, what they are just before each sample, where they jump as
        inputs do that are held; jumps: (n_samples, n_states) each, of the states just before and
        just after each sample. Behind the model's states and outputs stand integrals of those that
        are averaged, which may be left out.
        """
        several = () if rates is None else rates.shape[2:]
        count = math.prod(several)
        n, q, m = self.rows.shape
        pushes, first = np.zeros((n, m, count)), np.zeros((m, count))
        if rates is not None or inputs is not None:
            causes = self.slopes.intervals.causes(inputs, rates, before)
            _push(pushes, self.slopes.by_causes, causes.reshape(*causes.shape[:2], count))
        if held is not None:
            _push(pushes, self.slopes.by_causes, self.slopes.intervals.held(held)[..., None])
        if vector is not None:
            _push(pushes, self.slopes.by_parameters, np.tile(vector, (n - 1, 1))[..., None])
        if start is not None:
            first[: len(start), 0] = start
        if jumps is not None:
            ahead, after = jumps
            size = after.shape[1]
            pushes[:-1, :size, 0] += ahead[1:]
            pushes[..., 0] += np.einsum("kba,kb->ka", self.onward[:, :size], after)
        added = np.zeros((n, q, count))
        if outputs is not None:
            added[:, : outputs.shape[1], 0] = outputs
        changes = changes_along(self.rows, self.gains, self.onward, pushes, added, first)
        changes *= self.kept[..., None]
        return changes if several else changes[..., 0]


@njit(cache=True, nogil=True)
def _push(pushes: FloatArray, slopes: FloatArray, causes: FloatArray) -> None:
    """Add to pushes (n_samples, m, k) what causes (n_samples - 1, n_causes, k) do by slopes."""
    n, n_causes, n_states = slopes.shape
    for t in range(n):
        for i in range(n_causes):
            for c in range(causes.shape[2]):
                cause = causes[t, i, c]
                if cause != 0.0:
                    for a in range(n_states):
                        pushes[t, a, c] += slopes[t, i, a] * cause


@njit(cache=True, nogil=True)
def changes_along(
    rows: FloatArray,
    gains: FloatArray,
    onward: FloatArray,
    pushes: FloatArray,
    added: FloatArray,
    first: FloatArray,
) -> FloatArray:
    """Changes (n_samples, n_outputs, k) by deviations that begin at ``first``, (m, k).

    rows, gains, onward: as of ``LinearResponse``; pushes: (n_samples, m, k), added: (n_samples,
    n_outputs, k). Copied in loops: assignments of whole arrays take the compiler three seconds.
    """
    n, q, m = rows.shape
    changes = np.empty(added.shape)
    d, moved = np.empty(m), np.empty(m)
    for c in range(added.shape[2]):
        for a in range(m):
            d[a] = first[a, c]
        for k in range(n):
            for j in range(q):
                e = added[k, j, c]
                for a in range(m):
                    e += rows[k, j, a] * d[a]
                for a in range(m):
                    d[a] -= gains[k, j, a] * e
                changes[k, j, c] = e
            for a in range(m):
                moved[a] = pushes[k, a, c]
            for b in range(m):
                for a in range(m):
                    moved[a] += onward[k, b, a] * d[b]
            for a in range(m):
                d[a] = moved[a]
    return changes


def free_response(
    model: ProcessModel,
    vector: FloatArray,
    inputs: FloatArray,
    dt: float,
    n_steps: int,
    start: FloatArray,
) -> LinearResponse:
    """The response along a free run under parameters (n_parameters,) from a start, (n_states,).

    inputs: (n_samples, n_inputs), dt apart. n_steps: of the integration in an interval, for what
    answers; the run itself takes more. Raises ModelError where it does not stay finite.
    """
    states = Intervals(model, vector, inputs, dt, _FINER * n_steps).run(start)
    if not np.all(np.isfinite(states)):
        raise ModelError(f"model {model.name}: its run does not stay finite")
    slopes = IntervalSlopes(Intervals(model, vector, inputs, dt, n_steps), states)
    rows = output_slopes(model, states, inputs, vector)
    onward, kept = _onward(slopes, states.shape[1]), np.ones(rows.shape[:2])
    return LinearResponse(rows, np.zeros(rows.shape), onward, kept, states, slopes)


def filter_response(
    kernel: FilterKernel,
    averaged: Sequence[int],
    slopes: IntervalSlopes,
    before: FloatArray,
    mean: FloatArray,
    weights: FloatArray,
    variances: FloatArray,
    shift: FloatArray,
    lasting: FloatArray,
    noise: FloatArray,
    colour: FloatArray,
    corrects: bool,
) -> LinearResponse:
    """The response along a run of a filter.

    averaged: places of the outputs whose integrals are the model's last states. slopes: of the
    intervals, from states as corrected. before: (n_samples, work_rows), the kernel's work area
    before each sample's outputs. mean: (n_samples, n_outputs, 2, 4), weights of means and of sums,
    weights: (n_samples, n_outputs), variances, shift, lasting: of that shape, as the kernel had
    them; noise: (n_outputs,), variances. colour: (n_noises,).
    """
    intervals, n_states = slopes.intervals, slopes.states.shape[1]
    model, inputs, vector = intervals.model, intervals.inputs, intervals.vector
    deviations = _Deviations(kernel, n_states, averaged)
    states, noisy = before[:, :n_states], kernel.variation.noisy
    n, q, m = len(before), kernel.n_measured, deviations.size
    of_outputs = np.zeros((n, q, m))
    of_outputs[..., :n_states] = output_slopes(model, states, inputs, vector)[:, :q]
    of_outputs[..., deviations.noises] = feedthrough(model, states, inputs, vector)[:, :q, noisy]
    covariance = deviations.covariance(before)
    rows, gains, kept = np.empty((n, q, m)), np.empty((n, q, m)), np.empty((n, q))
    seen = (weights > 0.0) * float(corrects)
    for j in range(q):
        rows[:, j] = deviations.row(j, of_outputs, mean[:, j, 0])
        if j in deviations.late:
            rows[:, j, deviations.late[j]] = shift[:, j]
        shared = np.einsum("kab,kb->ka", covariance, rows[:, j])
        variance = np.einsum("ka,ka->k", rows[:, j], shared) + variances[:, j]
        gains[:, j] = shared * (seen[:, j] / variance)[:, None]
        covariance -= gains[:, j, :, None] * shared[:, None]
        kept[:, j] = weights[:, j] * np.sqrt(noise[j] / variance)
    taken = np.tile(np.eye(m), (n, 1, 1))  # what is kept for the next sample
    for j in averaged:
        taken[:, deviations.integral[j]] = 0.0
        taken[:, deviations.lag[j]] = of_outputs[:, j]
        taken[:, deviations.summed[j]] = deviations.row(j, of_outputs, mean[:, j, 1])
    onward = _onward(slopes, m)
    for k, place in enumerate(deviations.noises):
        begin, end = slopes.by_input(noisy[k])
        onward[:-1, place, :n_states] = begin + colour[k] * end
        onward[:, place, place] = colour[k]
    for j, place in deviations.late.items():
        onward[:-1, place, place] = lasting[1:, j]
    foreseen = states[:, : n_states - len(averaged)]
    return LinearResponse(rows, gains, taken.swapaxes(1, 2) @ onward, kept, foreseen, slopes)


def _onward(slopes: IntervalSlopes, m: int) -> FloatArray:
    """Deviations with which the next sample begins, by those of this, (n_samples, m, m).

    Those behind the states stay as they are; nothing follows the last sample.
    """
    n, n_states = slopes.states.shape
    onward = np.tile(np.eye(m), (n, 1, 1))
    onward[:-1, :n_states, :n_states] = slopes.by_states
    return onward


class _Deviations:
    """Places of a filter's deviations: states, noises, averaged outputs before, sums, timing."""

    def __init__(self, kernel: FilterKernel, n_states: int, averaged: Sequence[int]) -> None:
        self._kernel = kernel
        count, first = len(averaged), n_states + kernel.n_noises
        self.noises = list(range(n_states, first))
        self.integral = {j: n_states - count + i for i, j in enumerate(averaged)}
        self.lag = {j: first + i for i, j in enumerate(averaged)}
        self.summed = {j: first + count + i for i, j in enumerate(averaged)}
        self.late = {j: first + 2 * count + i for i, j in enumerate(kernel.late)}
        self.size = first + 2 * count + len(self.late)
        behind = [self.lag[j] for j in kernel.lag] + [self.summed[j] for j in kernel.summed]
        self._of_kernel = [*kernel.reached, *self.noises, *behind, *self.late.values()]

    def covariance(self, before: FloatArray) -> FloatArray:
        """Covariance before each sample's outputs, (n_samples, m, m)."""
        whole = np.zeros((len(before), self.size, self.size))
        for i, (a, b) in enumerate(self._kernel.pairs):
            row, column = self._of_kernel[a], self._of_kernel[b]
            whole[:, row, column] = whole[:, column, row] = before[:, self._kernel.covariance + i]
        return whole

    def row(self, j: int, of_outputs: FloatArray, mean: FloatArray) -> FloatArray:
        """Row of output j, or of the sum of an averaged one, (n_samples, m), by weights (., 4).

        Of the output at the sample before, at this one, of the integral between and of the sum so
        far.
        """
        if j not in self.lag:
            return of_outputs[:, j].copy()
        row: FloatArray = mean[:, [1]] * of_outputs[:, j]
        for place, weight in (
            (self.lag[j], mean[:, 0]),
            (self.integral[j], mean[:, 2]),
            (self.summed[j], mean[:, 3]),
        ):
            row[:, place] += weight
        return row


def output_slopes(
    model: ProcessModel, states: FloatArray, inputs: FloatArray, vector: FloatArray
) -> FloatArray:
    """Slopes of a model's outputs over its states, (n_samples, n_outputs, n_states)."""
    if model.output is None:
        picked = np.eye(states.shape[1])[list(model.output_states or ())]
        return np.tile(picked, (len(states), 1, 1))
    return _slopes_over(states, lambda x: observed(model, x, inputs, vector))


def feedthrough(
    model: ProcessModel, states: FloatArray, inputs: FloatArray, vector: FloatArray
) -> FloatArray:
    """Slopes of a model's outputs over its inputs, (n_samples, n_outputs, n_inputs)."""
    if model.output is None or not model.inputs:
        return np.zeros((len(states), len(model.outputs), inputs.shape[1]))
    return _slopes_over(inputs, lambda u: observed(model, states, u, vector))


def observed(
    model: ProcessModel, states: FloatArray, inputs: FloatArray, vector: FloatArray
) -> FloatArray:
    """A model's outputs of states, (n_samples, n_outputs)."""
    if model.output is None:
        return states[:, list(model.output_states or ())]
    return values_along(model.output, len(model.outputs), states, inputs, vector)


def _slopes_over(table: FloatArray, values: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Slopes of values (n_samples, n) over each column of a table, (n_samples, n, n_columns)."""
    steps = _STEP * np.maximum(np.abs(table).max(axis=0), _LEAST)
    slopes = []
    for unit, size in zip(np.eye(table.shape[1]), steps.tolist(), strict=True):
        along = partial(_moved, values, table, unit)
        slopes.append(slope_of(along, size))
    return np.stack(slopes, axis=2)


def _moved(
    values: Callable[[FloatArray], FloatArray], table: FloatArray, along: FloatArray, step: float
) -> FloatArray:
    return values(table + step * along)


def slope_of(values: Callable[[float], FloatArray], step: float) -> FloatArray:
    """Slope at zero of what follows a move, by central differences.

    >>> slope_of(lambda move: np.array([2.0 * move, move**2]), 0.5).tolist()
    [2.0, 0.0]
    """
    slope: FloatArray = (values(step) - values(-step)) / (2.0 * step)
    return slope
