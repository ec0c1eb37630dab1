"""Errors of a run made independent, each of variance one.

Noise of a measured input moves states, which remember it, so that the outputs' errors are coloured:
V = R + G G'. A Kalman filter along the run that is right (``linear_response``) foretells each error
by those before it. What it does not foretell is white, and divided by its deviation e' V^-1 e is a
sum of squares. A speed whose torque is measured is foretold from sample to sample: its free run
wanders by more than what a small part of the model does, its changes do not.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import njit

from sysid.arrays import FloatArray
from sysid.engine.intervals import Intervals, IntervalSlopes
from sysid.engine.linear_response import feedthrough, output_slopes

_LEAST = 1e-12  # variance of an error; a smaller one is that of rounding


@dataclass(frozen=True, eq=False)
class Whitener:
    """A linear filter of a run's errors.

    Of m deviations, those of the states first, behind them the inputs' noise: rows, gains:
    (n_samples, n_outputs, m), onward: (n_samples, m, m), to the next sample. deviations:
    (n_samples, n_outputs), of what is not foretold; infinite where an output does not count.
    """

    rows: FloatArray
    gains: FloatArray
    onward: FloatArray
    deviations: FloatArray

    @classmethod
    def along(
        cls,
        intervals: Intervals,
        states: FloatArray,
        variances: FloatArray,
        input_noise: FloatArray,
    ) -> Self:
        """The filter along a run's states, (n_samples, n_states).

        variances: (n_samples, n_outputs), of the outputs' own noise, infinite for one that does
        not count. input_noise: (n_inputs,), standard deviations of what inputs have.
        """
        model, inputs, vector = intervals.model, intervals.inputs, intervals.vector
        noisy = np.flatnonzero(input_noise)
        n, n_states = states.shape
        m = n_states + len(noisy)
        rows, onward = np.zeros((n, variances.shape[1], m)), np.zeros((n, m, m))
        rows[..., :n_states] = output_slopes(model, states, inputs, vector)
        rows[..., n_states:] = feedthrough(model, states, inputs, vector)[..., noisy]
        slopes, ends = IntervalSlopes(intervals, states), np.zeros((n, len(noisy), m))
        onward[:-1, :n_states, :n_states] = slopes.by_states
        for k, j in enumerate(noisy.tolist()):
            begin, end = slopes.by_input(j)
            onward[:-1, n_states + k, :n_states] = begin
            ends[1:, k, :n_states] = end
            ends[:, k, n_states + k] = 1.0
        scatter = ends * input_noise[noisy, None]
        gains, left = _foretold(rows, onward, scatter, np.maximum(variances, _LEAST))
        return cls(rows, gains, onward, np.sqrt(left))

    @property
    def finite(self) -> bool:
        """Whether the run that it goes along stays finite."""
        return bool(np.isfinite(self.gains).all() and np.isfinite(self.onward).all())

    def of(self, columns: FloatArray) -> FloatArray:
        """What is not foretold of errors, (n_samples * n_outputs, n), in its deviations."""
        n, q = self.deviations.shape
        counted = np.isfinite(self.deviations)[..., None]
        errors = np.where(counted, columns.reshape(n, q, -1), 0.0)
        left = _filtered(self.rows, self.gains, self.onward, errors)
        whitened: FloatArray = (left / self.deviations[..., None]).reshape(columns.shape)
        return whitened


@njit(cache=True, nogil=True)
def _foretold(
    rows: FloatArray, onward: FloatArray, scatter: FloatArray, variances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gains (n_samples, n_outputs, m), and variances of what is not foretold.

    scatter: (n_samples, n_noises, m), what deviations of one of the inputs' noise at a sample do
    until then.
    """
    n, q, m = rows.shape
    n_noises = scatter.shape[1]
    gains, left = np.zeros((n, q, m)), np.empty((n, q))
    P, moved, shared = np.zeros((m, m)), np.empty((m, m)), np.empty(m)
    for k in range(n):
        for i in range(n_noises):
            for a in range(m):
                for b in range(m):
                    P[a, b] += scatter[k, i, a] * scatter[k, i, b]
        for j in range(q):
            left[k, j] = variances[k, j]
            for a in range(m):
                shared[a] = 0.0
                for b in range(m):
                    shared[a] += P[a, b] * rows[k, j, b]
                left[k, j] += rows[k, j, a] * shared[a]
            for a in range(m):
                gains[k, j, a] = shared[a] / left[k, j]
            for a in range(m):
                for b in range(m):
                    P[a, b] -= gains[k, j, a] * shared[b]
        for a in range(m):
            for b in range(m):
                moved[a, b] = 0.0
                for c in range(m):
                    moved[a, b] += onward[k, c, a] * P[c, b]
        for a in range(m):
            for b in range(m):
                P[a, b] = 0.0
                for c in range(m):
                    P[a, b] += moved[a, c] * onward[k, c, b]
    return gains, left


@njit(cache=True, nogil=True)
def _filtered(
    rows: FloatArray, gains: FloatArray, onward: FloatArray, errors: FloatArray
) -> FloatArray:
    """Of errors (n_samples, n_outputs, n) what is not foretold by those before."""
    n, q, m = rows.shape
    n_columns = errors.shape[2]
    left = np.empty(errors.shape)
    d, moved = np.zeros((m, n_columns)), np.empty((m, n_columns))
    for k in range(n):
        for j in range(q):
            for c in range(n_columns):
                left[k, j, c] = errors[k, j, c]
            for a in range(m):
                if rows[k, j, a] != 0.0:
                    for c in range(n_columns):
                        left[k, j, c] -= rows[k, j, a] * d[a, c]
            for a in range(m):
                if gains[k, j, a] != 0.0:
                    for c in range(n_columns):
                        d[a, c] += gains[k, j, a] * left[k, j, c]
        for a in range(m):
            for c in range(n_columns):
                moved[a, c] = 0.0
        for b in range(m):
            for a in range(m):
                if onward[k, b, a] != 0.0:
                    for c in range(n_columns):
                        moved[a, c] += onward[k, b, a] * d[b, c]
        d, moved = moved, d
    return left
