"""Errors of a run made independent, each of variance one.

Noise of a measured input moves states, which remember it, so that the outputs' errors are coloured:
V = R + G G'. A Kalman filter along the run that is right (``linear_response``) foretells each error
by those before it. What it does not foretell is white, and divided by its deviation e' V^-1 e is a
sum of squares. A speed whose torque is measured is foretold from sample to sample: its free run
wanders by more than what a small part of the model does, its changes do not.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from sysid.arrays import FloatArray
from sysid.engine.intervals import Intervals, IntervalSlopes
from sysid.engine.linear_response import changes_along, feedthrough, output_slopes

SingleArray = NDArray[np.float32]

_NEAR = 16  # samples whose errors are alike
_LOOSE = 1.5  # times what is foretold, by which samples may err
_BY_CHANCE = 1.5  # times the variance that is foretold, which chance alone may make of draws
_LEAST = 1e-12  # variance of an error; a smaller one is that of rounding


@dataclass(frozen=True, eq=False)
class ErrorFilter:
    """A linear filter of a run's errors.

    As of ``LinearResponse``, whose deviations are those of the states, behind them the inputs'
    noise: rows, gains: (n_samples, n_outputs, m), onward: (n_samples, m, m); single precision, for
    a search keeps many. kept: (n_samples, n_outputs), one over the deviation of what is not
    foretold, zero for an output that does not count. loose: share of the samples of the worst
    output that err by more than is foretold.
    """

    rows: SingleArray
    gains: SingleArray
    onward: SingleArray
    kept: FloatArray
    loose: float = 0.0

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
        slopes, scatter = IntervalSlopes(intervals, states), np.zeros((n, len(noisy), m))
        onward[:-1, :n_states, :n_states] = slopes.by_states
        for k, j in enumerate(noisy.tolist()):
            onward[:-1, n_states + k, :n_states], scatter[1:, k, :n_states] = slopes.by_input(j)
            scatter[:, k, n_states + k] = 1.0
        scatter *= input_noise[noisy, None]
        gains, left = _foretold(rows, onward, scatter, np.maximum(variances, _LEAST))
        single = [each.astype(np.float32) for each in (rows, gains, onward)]
        return cls(single[0], single[1], single[2], 1.0 / np.sqrt(left))

    @classmethod
    def white(cls, variances: FloatArray) -> Self:
        """Of errors that are independent as they are: no input is noisy.

        variances: as of ``along``, (n_samples, n_outputs).
        """
        n, q = variances.shape
        nothing, onward = np.zeros((n, q, 0), np.float32), np.zeros((n, 0, 0), np.float32)
        return cls(nothing, nothing, onward, 1.0 / np.sqrt(np.maximum(variances, _LEAST)))

    @property
    def finite(self) -> bool:
        """Whether the run that it goes along stays finite."""
        return all(bool(np.isfinite(p).all()) for p in (self.gains, self.onward, self.kept))

    def loosened(self, errors: FloatArray) -> Self:
        """The same with larger deviations where errors of runs that are right need them.

        errors: (n_samples * n_outputs, n_draws). Where states bend within what noise moves them,
        as those of a shaft that comes to rest, errors are not in proportion to the noise.
        """
        squares = np.mean(self.of(errors) ** 2, axis=1).reshape(self.kept.shape)
        squares = uniform_filter1d(squares, _NEAR, axis=0, mode="nearest")
        larger = np.sqrt(np.where(squares > _BY_CHANCE, squares, 1.0))
        loose = float(np.mean(larger > _LOOSE, axis=0).max())
        return replace(self, kept=self.kept / larger, loose=loose)

    def of(self, columns: FloatArray) -> FloatArray:
        """What is not foretold of errors, (n_samples * n_outputs, n), in its deviations."""
        (n, q), m = self.kept.shape, self.rows.shape[2]
        errors = np.where(self.kept[..., None] > 0.0, columns.reshape(n, q, -1), 0.0)
        if not m:
            return np.asarray((errors * self.kept[..., None]).reshape(columns.shape))
        rows, gains, onward = (p.astype(np.float64) for p in (self.rows, self.gains, self.onward))
        count = errors.shape[2]
        nothing, first = np.zeros((n, m, count)), np.zeros((m, count))
        left = changes_along(rows, gains, onward, nothing, np.ascontiguousarray(errors), first)
        whitened: FloatArray = (left * self.kept[..., None]).reshape(columns.shape)
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
    gains, left = np.zeros((n, q, m)), variances.copy()
    P, work = np.zeros((m, m)), np.empty((m, m))
    for k in range(n):
        for i in range(scatter.shape[1]):
            _add_square(P, scatter[k, i], 1.0)
        for j in range(q):
            shared = gains[k, j]
            _multiply(P, rows[k, j], shared)
            for a in range(m):
                left[k, j] += rows[k, j, a] * shared[a]
            _add_square(P, shared, -1.0 / left[k, j])
            for a in range(m):
                shared[a] /= left[k, j]
        for a in range(m):
            _multiply(P, onward[k, :, a], work[a])
        for a in range(m):
            _multiply(work, onward[k, :, a], P[a])
    return gains, left


@njit(cache=True, nogil=True)
def _add_square(matrix: FloatArray, row: FloatArray, factor: float) -> None:
    """Add factor row row' to a matrix."""
    for a in range(len(row)):
        for b in range(len(row)):
            matrix[a, b] += factor * row[a] * row[b]


@njit(cache=True, nogil=True)
def _multiply(matrix: FloatArray, row: FloatArray, product: FloatArray) -> None:
    """Matrix times row."""
    for a in range(len(row)):
        product[a] = 0.0
        for b in range(len(row)):
            product[a] += matrix[a, b] * row[b]
