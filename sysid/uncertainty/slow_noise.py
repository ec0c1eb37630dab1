"""Noise of which a slow part hides below a fast one, as a sensor's drift below its converter's.

White noise v and a process w of first order, e = v + w, have an autoregression that does not end,
of coefficients that are all small: one of few samples is blind to w, which decides how much the
mean of many errs. They are an ARMA(1, 1) (Granger & Morris, "Time series modelling and
interpretation", J. Royal Statistical Society A 139, 1976),

    e_t - c e_(t-1) = eps_t - h eps_(t-1),    0 < h < c < 1

of pole c, w's, and zero h. The Kalman filter makes eps of e, from a first sample on at which w is
as large as ever, and across samples that were lost: with P the variance of w before a sample, and
that of eps one after many,

    eps_t = (e_t - w_t) / sqrt(s_t)    w_(t+1) = c (w_t + P_t / s_t (e_t - w_t))
    s_t = P_t + h / c                  P_(t+1) = c^2 P_t (h / c) / s_t + (c - h) (1 - c h) / c

Of fast noise that is no white one, eps is what of it remains; an autoregression describes that.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import njit

from sysid.arrays import BoolArray, FloatArray, IntArray

_FASTEST = 0.5  # samples that the zero's response takes to decay, at least
_STEPS = (2.0, math.sqrt(2.0), 2.0**0.25)  # of time constants that are tried, ever finer
_PARAMETERS = 2


@dataclass(frozen=True)
class SlowNoise:
    """Pole and zero of an ARMA(1, 1)."""

    pole: float
    zero: float

    @property
    def amplification(self) -> float:
        """Spectrum at frequency zero in parts of what it is at high ones, nearly."""
        return ((1.0 - self.zero) / (1.0 - self.pole)) ** 2


@dataclass(frozen=True)
class SlowFilter:
    """The Kalman filter of an output's slow noise: gains, sizes: (n,), as P / s and sqrt(s)."""

    pole: float
    gains: FloatArray
    sizes: FloatArray

    @classmethod
    def of(cls, noise: SlowNoise, seen: BoolArray, begins: IntArray) -> Self:
        """seen: (n,), which samples were measured; begins: first rows of the records."""
        return cls(noise.pole, *_gains(noise.pole, noise.zero, seen, begins))

    def innovations(self, signals: FloatArray, rows: slice = slice(None)) -> FloatArray:
        """Signals (n, k) without what is foreseen of their slow part; rows: those of one record."""
        gains, sizes = self.gains[rows], self.sizes[rows]
        return _innovations(np.ascontiguousarray(signals), self.pole, gains, sizes)

    def back(self, signals: FloatArray, rows: slice = slice(None)) -> FloatArray:
        """The transpose of ``innovations``, of signals (n, k)."""
        gains, sizes = self.gains[rows], self.sizes[rows]
        return _back(np.ascontiguousarray(signals), self.pole, gains, sizes)

    def response(self, slopes: FloatArray, rows: slice) -> FloatArray:
        """The transpose of what makes noise of innovations, of slopes (n, k) of one record."""
        gains, sizes = self.gains[rows], self.sizes[rows]
        return _response(np.ascontiguousarray(slopes), self.pole, gains, sizes)


def slow_noise(
    residual: FloatArray, seen: BoolArray, lengths: Sequence[int], order: int
) -> SlowNoise | None:
    """The slow part of an output's residuals (n,); None where an autoregression tells as much.

    seen: (n,), which were measured. order: the highest of the autoregression of what is left. By
    Schwarz's criterion, with autoregressions by their correlations (Levinson).
    """
    begins = first_rows(lengths)
    signal = np.where(seen, residual, 0.0)
    if not signal.any():
        return None

    def criterion(pole_time: float, zero_time: float) -> float:
        pole, zero = math.exp(-1.0 / pole_time), math.exp(-1.0 / zero_time)
        gains, sizes = _gains(pole, zero, seen, begins)
        return _criterion(_filtered(signal, begins, pole, gains, sizes), sizes, begins, order)

    plain = _criterion(signal, np.ones(len(signal)), begins, order)
    longest, best = float(max(lengths)), (math.inf, 0.0, 0.0)
    times = _FASTEST * _STEPS[0] ** np.arange(math.log2(longest / _FASTEST) + 1.0)
    tried = [(a, b) for a in np.minimum(times, longest).tolist() for b in times.tolist()]
    for step in _STEPS:
        if best[1]:
            ways = (1.0 / step, 1.0, step)
            tried = [(best[1] * a, best[2] * b) for a in ways for b in ways if a != 1.0 or b != 1.0]
        pairs = [(a, b) for a, b in tried if _FASTEST <= b < a <= longest]
        best = min([best, *((criterion(a, b), a, b) for a, b in pairs)])
    if best[0] + _PARAMETERS * math.log(max(int(seen.sum()), 2)) >= plain:
        return None
    return SlowNoise(math.exp(-1.0 / best[1]), math.exp(-1.0 / best[2]))


def first_rows(lengths: Sequence[int]) -> IntArray:
    """Rows at which records of these lengths begin, one after another, and where the last ends."""
    rows: IntArray = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return rows


@njit(cache=True, nogil=True)
def _gains(
    pole: float, zero: float, seen: BoolArray, begins: IntArray
) -> tuple[FloatArray, FloatArray]:
    n, white = len(seen), zero / pole
    new = (pole - zero) * (1.0 - pole * zero) / pole
    gains, sizes = np.zeros(n), np.ones(n)
    for record in range(len(begins) - 1):
        variance = new / (1.0 - pole * pole)
        for t in range(begins[record], begins[record + 1]):
            left = variance
            if seen[t]:
                whole = variance + white
                gains[t], sizes[t] = variance / whole, math.sqrt(whole)
                left = variance * white / whole
            variance = pole * pole * left + new
    return gains, sizes


@njit(cache=True, nogil=True)
def _filtered(
    signal: FloatArray, begins: IntArray, pole: float, gains: FloatArray, sizes: FloatArray
) -> FloatArray:
    """Innovations (n,) of a signal of records that begin at those rows."""
    white = np.empty(len(signal))
    for record in range(len(begins) - 1):
        slow = 0.0
        for t in range(begins[record], begins[record + 1]):
            error = signal[t] - slow
            white[t] = error / sizes[t] if gains[t] > 0.0 else 0.0
            slow = pole * (slow + gains[t] * error)
    return white


@njit(cache=True, nogil=True)
def _innovations(
    signals: FloatArray, pole: float, gains: FloatArray, sizes: FloatArray
) -> FloatArray:
    n, count = signals.shape
    white, slow = np.zeros((n, count)), np.zeros(count)
    for t in range(n):
        for i in range(count):
            error = signals[t, i] - slow[i]
            if gains[t] > 0.0:
                white[t, i] = error / sizes[t]
            slow[i] = pole * (slow[i] + gains[t] * error)
    return white


@njit(cache=True, nogil=True)
def _back(signals: FloatArray, pole: float, gains: FloatArray, sizes: FloatArray) -> FloatArray:
    n, count = signals.shape
    back, after = np.zeros((n, count)), np.zeros(count)
    for t in range(n - 1, -1, -1):
        for i in range(count):
            direct = signals[t, i] / sizes[t] if gains[t] > 0.0 else 0.0
            back[t, i] = direct + pole * gains[t] * after[i]
            after[i] = pole * (1.0 - gains[t]) * after[i] - direct
    return back


@njit(cache=True, nogil=True)
def _response(slopes: FloatArray, pole: float, gains: FloatArray, sizes: FloatArray) -> FloatArray:
    n, count = slopes.shape
    response, after = np.zeros((n, count)), np.zeros(count)
    for t in range(n - 1, -1, -1):
        for i in range(count):
            if gains[t] > 0.0:
                response[t, i] = sizes[t] * (slopes[t, i] + pole * gains[t] * after[i])
            after[i] = slopes[t, i] + pole * after[i]
    return response


@njit(cache=True, nogil=True)
def _criterion(signal: FloatArray, sizes: FloatArray, begins: IntArray, order: int) -> float:
    """Schwarz's criterion of the best autoregression of a signal (n,), and the sizes' logarithms.

    By Durbin's recursion along the correlations.
    """
    n = len(signal)
    sums, logs = np.zeros(order + 1), 0.0
    for record in range(len(begins) - 1):
        for t in range(begins[record], begins[record + 1]):
            logs += 2.0 * math.log(sizes[t])
            for lag in range(min(order, t - begins[record]) + 1):
                sums[lag] += signal[t] * signal[t - lag]
    variance, least = sums[0] / n, math.inf
    coefficients, before = np.zeros(order + 1), np.zeros(order + 1)
    for k in range(order + 1):
        if k > 0:
            reflection = sums[k] / n
            for i in range(1, k):
                reflection -= before[i] * sums[k - i] / n
            reflection /= variance
            for i in range(1, k):
                coefficients[i] = before[i] - reflection * before[k - i]
            coefficients[k] = reflection
            before[:] = coefficients
            variance *= 1.0 - reflection * reflection
        if variance <= 0.0:
            return -math.inf
        least = min(least, n * math.log(variance) + k * math.log(n))
    return least + logs
