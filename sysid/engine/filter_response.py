"""How a filter's innovations answer what is added to its equations and outputs, in proportion.

Along the run of an extended Kalman filter (``filter_kernel``) its estimate d deviates linearly from
what it was: with the rows C of the outputs, taken in one after the other with gains G, and the
Jacobian F of the simulated step,

    e = C d + o      d -= G e      d_(k+1) = F d_k + a_k

where o is added to the outputs and a_k is the response of the states to what is added to their
rates. That gains answer as well is left out: their change multiplies innovations, which are zero in
the mean. Without gains it is the response of a free run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from sysid.arrays import FloatArray
from sysid.engine.filter_kernel import FilterKernel
from sysid.engine.trace import evaluated
from sysid.problem.model import ProcessModel

_STEP = 1e-6  # for slopes of outputs, in parts of the largest value of a state


@dataclass(frozen=True)
class FilterResponse:
    """The linear response along a filter's run of n_samples.

    Of m deviations, which stand as in the filter's covariance: rows, gains: (n_samples, n_outputs,
    m). onward: (n_samples, m, m), to the deviations that the next sample begins with. level, slope:
    (n_samples, m, n_states), their response to a rate of each state that is one throughout the
    interval, and to one that rises from zero to one; by_parameters: (n_samples, m, n_parameters),
    to a parameter that is one more. kept: (n_samples, n_outputs), factors of the
    innovations. states: (n_samples, n_states), foreseen from all samples before.
    """

    rows: FloatArray
    gains: FloatArray
    onward: FloatArray
    level: FloatArray
    slope: FloatArray
    by_parameters: FloatArray
    kept: FloatArray
    states: FloatArray
    reached: tuple[int, ...]

    def of(
        self,
        rates: FloatArray | None = None,
        held: FloatArray | None = None,
        outputs: FloatArray | None = None,
        start: FloatArray | None = None,
        vector: FloatArray | None = None,
    ) -> FloatArray:
        """Changes of what is kept of the innovations, (n_samples, n_outputs).

        By what is added to rates, (n_samples, n_states), straight from sample to sample or held,
        and to outputs, (n_samples, n_outputs); start: (n_states,), by where the states begin
        elsewhere; vector: (n_parameters,), by what is added to the equations' parameters.
        """
        n, m = self.onward.shape[:2]
        pushes = np.zeros((n, m))
        if rates is not None:
            rises = np.diff(rates, axis=0)
            pushes[:-1] = np.einsum("kas,ks->ka", self.level[:-1], rates[:-1])
            pushes[:-1] += np.einsum("kas,ks->ka", self.slope[:-1], rises)
        if held is not None:
            pushes[:-1] += np.einsum("kas,ks->ka", self.level[:-1], held[:-1])
        if vector is not None:
            pushes += self.by_parameters @ vector
        first = np.zeros(m)
        if start is not None:
            states = [(a, i) for a, i in enumerate(self.reached) if i < len(start)]
            for a, i in states:
                first[a] = start[i]
        added = np.zeros(self.kept.shape) if outputs is None else np.ascontiguousarray(outputs)
        innovations: FloatArray = _innovations(
            self.rows, self.gains, self.onward, pushes, added, first
        )
        return innovations * self.kept


@njit(cache=True, nogil=True)
def _innovations(
    rows: FloatArray,
    gains: FloatArray,
    onward: FloatArray,
    pushes: FloatArray,
    added: FloatArray,
    first: FloatArray,
) -> FloatArray:
    """Innovations (n_samples, n_outputs) of deviations that begin at ``first``, (m,)."""
    n, q, m = rows.shape
    innovations = np.empty((n, q))
    d, moved = first.copy(), np.empty(m)
    for k in range(n):
        for j in range(q):
            e = added[k, j]
            for a in range(m):
                e += rows[k, j, a] * d[a]
            for a in range(m):
                d[a] -= gains[k, j, a] * e
            innovations[k, j] = e
        for a in range(m):
            total = pushes[k, a]
            for b in range(m):
                total += onward[k, a, b] * d[b]
            moved[a] = total
        d[:] = moved
    return innovations


def filter_response(
    model: ProcessModel,
    kernel: FilterKernel,
    before: FloatArray,
    behind: FloatArray,
    mean: FloatArray,
    weights: FloatArray,
    variances: FloatArray,
    noise: FloatArray,
    colour: FloatArray,
    corrects: bool,
    inputs: FloatArray,
    vector: FloatArray,
) -> FilterResponse:
    """The response along a run of a filter with every state driven, and all parameters moved.

    before, behind: (n_samples, work_rows), its work area before each sample's outputs and behind
    the interval that follows. mean, weights, variances: as the kernel had them; noise:
    (n_outputs,), variances. colour: (n_noises,). inputs: (n_samples, n_inputs); vector:
    (n_parameters,).
    """
    of_outputs = _slopes(model, kernel, before, inputs, vector)
    covariance = _covariance(kernel, before)
    n, q, m = of_outputs.shape
    rows, gains, kept = np.empty((n, q, m)), np.empty((n, q, m)), np.empty((n, q))
    seen = (weights > 0.0) * float(corrects)
    for j in range(q):
        rows[:, j] = _row(kernel, j, of_outputs, mean[:, j, 0])
        shared = np.einsum("kab,kb->ka", covariance, rows[:, j])
        variance = np.einsum("ka,ka->k", rows[:, j], shared) + variances[:, j]
        gains[:, j] = shared * (seen[:, j] / variance)[:, None]
        covariance -= gains[:, j, :, None] * shared[:, None]
        kept[:, j] = weights[:, j] * np.sqrt(noise[j] / variance)
    taken = np.tile(np.eye(m), (n, 1, 1))  # what is kept for the next sample
    taken[:, list(kernel.integral.values())] = 0.0
    for j, place in kernel.lag.items():
        taken[:, place] = of_outputs[:, j]
    for j, place in kernel.summed.items():
        taken[:, place] = _row(kernel, j, of_outputs, mean[:, j, 1])
    onward = _onward(kernel, behind, colour) @ taken
    level, slope, by_parameters = (
        _to(kernel, behind, kind) for kind in ("level", "slope", "parameter")
    )
    states = before[:, : level.shape[2]]
    return FilterResponse(
        rows, gains, onward, level, slope, by_parameters, kept, states, kernel.reached
    )


def _slopes(
    model: ProcessModel,
    kernel: FilterKernel,
    before: FloatArray,
    inputs: FloatArray,
    vector: FloatArray,
) -> FloatArray:
    """Slopes of the outputs at their instants, (n_samples, n_outputs, m)."""
    entries = kernel.variation.gains
    slopes = np.zeros((len(before), kernel.n_measured, len(kernel.places)))
    states = before[:, : kernel.variation.n_states]
    for k in sorted({k for _, k in entries}):
        if model.output is None:
            values = np.tile([float(i == k) for i in model.output_states or ()], (len(before), 1))
        else:
            noisy = k - kernel.variation.n_states
            side, at = (0, k) if noisy < 0 else (1, kernel.variation.noisy[noisy])
            values = _along(model.output, states, inputs, vector, side, at)
        place = kernel.place_of(k)
        for j in (j for j, of in entries if of == k and j < kernel.n_measured):
            slopes[:, j, place] = values[:, j]
    return slopes


def _along(
    function: Any, states: FloatArray, inputs: FloatArray, vector: FloatArray, side: int, place: int
) -> FloatArray:
    """Slopes of a model's function over a state (side 0) or an input (side 1), by its place."""

    def moved(step: float) -> FloatArray:
        sides = [states.copy(), inputs.copy()]
        sides[side][:, place] += step
        return evaluated(function, *sides, vector[None])

    largest = float(np.abs((states, inputs)[side][:, place]).max())
    return slope_of(moved, _STEP * max(largest, _STEP))


def slope_of(values: Callable[[float], FloatArray], step: float) -> FloatArray:
    """Slope at zero of what follows a move, by central differences.

    >>> slope_of(lambda move: np.array([2.0 * move, move**2]), 0.5).tolist()
    [2.0, 0.0]
    """
    slope: FloatArray = (values(step) - values(-step)) / (2.0 * step)
    return slope


def _row(kernel: FilterKernel, j: int, of_outputs: FloatArray, mean: FloatArray) -> FloatArray:
    """Row of output j, or of the sum of an averaged one, (n_samples, m), by weights (n_samples, 4).

    Of the output at the sample before, at this one, of the integral between and of the sum so far.
    """
    if j not in kernel.lag:
        return of_outputs[:, j].copy()
    row: FloatArray = mean[:, [1]] * of_outputs[:, j]
    for place, weight in (
        (kernel.lag[j], mean[:, 0]),
        (kernel.integral[j], mean[:, 2]),
        (kernel.summed[j], mean[:, 3]),
    ):
        row[:, place] += weight
    return row


def _covariance(kernel: FilterKernel, before: FloatArray) -> FloatArray:
    """Covariance before each sample's outputs, (n_samples, m, m)."""
    m = len(kernel.places)
    whole = np.zeros((len(before), m, m))
    for i, (a, b) in enumerate(kernel.pairs):
        whole[:, a, b] = whole[:, b, a] = before[:, kernel.covariance + i]
    return whole


def _onward(kernel: FilterKernel, behind: FloatArray, colour: FloatArray) -> FloatArray:
    """Deviations with which the next sample begins, by those kept of this, (n_samples, m, m)."""
    m, n = len(kernel.places), len(kernel.reached)
    onward = np.zeros((len(behind), m, m))
    for (kind, k), column in kernel.variation.columns.items():
        for state, row in column.items():
            a = kernel.reached.index(state)
            if kind == "state":
                onward[:, a, kernel.reached.index(k)] += behind[:, row]
            elif kind == "begin":
                onward[:, a, n + k] += behind[:, row]
            elif kind == "end":
                onward[:, a, n + k] += colour[k] * behind[:, row]
    for place in range(n, m):
        onward[:, place, place] = colour[place - n] if place < kernel.size else 1.0
    return onward


def _to(kernel: FilterKernel, behind: FloatArray, kind: str) -> FloatArray:
    """Response (n_samples, m, n) at an interval's end to all causes of a kind."""
    columns = {k: column for (of, k), column in kernel.variation.columns.items() if of == kind}
    response = np.zeros((len(behind), len(kernel.places), len(columns)))
    for k, column in columns.items():
        for state, row in column.items():
            response[:, kernel.reached.index(state), k] = behind[:, row]
    return response
