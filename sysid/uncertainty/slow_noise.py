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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import njit

from sysid.arrays import BoolArray, FloatArray, IntArray

_FASTEST = 0.5  # samples that the zero's response takes to decay, at least
_STEPS = (4.0, 2.0, math.sqrt(2.0), 2.0**0.25)  # of time constants that are tried, ever finer
PARAMETERS = 2  # that a slow part counts for
_REFITS = 10  # until noise and what a fit by its colour leaves agree
_ALIKE = 1.0  # of a criterion, that tells a memory from a longer one: a deviation
_ROUNDING = 1e-9  # singular value in parts of the largest
_SETTLED = 1e-14  # part of a variance that it changes from sample to sample, below which it rests


@dataclass(frozen=True)
class SlowNoise:
    """Pole and zero of an ARMA(1, 1)."""

    pole: float
    zero: float

    @property
    def amplification(self) -> float:
        """Spectrum at frequency zero in parts of what it is at high ones, nearly."""
        return ((1.0 - self.zero) / (1.0 - self.pole)) ** 2


@dataclass(frozen=True, eq=False)
class Hidden:
    """A slow part, and what a fit would leave of the residuals, (n,), if there were none."""

    noise: SlowNoise
    without: FloatArray


@dataclass(frozen=True)
class SlowFilter:
    """The Kalman filter of an output's slow noise, of records that begin at rows ``begins``.

    gains, sizes: (n,), as P / s and sqrt(s); no gain where a sample was lost.
    """

    pole: float
    begins: IntArray
    gains: FloatArray
    sizes: FloatArray

    @classmethod
    def of(cls, noise: SlowNoise, seen: BoolArray, lengths: Sequence[int]) -> Self:
        """seen: (n,), which samples were measured."""
        begins = _first_rows(lengths)
        return cls(noise.pole, begins, *_gains(noise.pole, noise.zero, seen, begins))

    def innovations(self, signals: FloatArray, rows: slice | None = None) -> FloatArray:
        """Signals (n, k) without what is foreseen of their slow part; rows: of one record."""
        begins = self.begins if rows is None else _first_rows([len(signals)])
        signals = np.ascontiguousarray(signals)
        return _innovations(signals, begins, self.pole, *self._of(rows))

    def back(self, signals: FloatArray, rows: slice) -> FloatArray:
        """The transpose of ``innovations``, of signals (n, k) of one record."""
        return _back(np.ascontiguousarray(signals), self.pole, *self._of(rows))

    def response(self, slopes: FloatArray, rows: slice) -> FloatArray:
        """The transpose of what makes noise of innovations, of slopes (n, k) of one record."""
        return _response(np.ascontiguousarray(slopes), self.pole, *self._of(rows))

    def _of(self, rows: slice | None) -> tuple[FloatArray, FloatArray]:
        return (self.gains, self.sizes) if rows is None else (self.gains[rows], self.sizes[rows])


def regression_table(
    residual: FloatArray, seen: BoolArray, slopes: FloatArray | None
) -> FloatArray:
    """An orthonormal basis of slopes (n, p), if any, and behind it residuals (n,): (n, k + 1).

    Zero where a sample was not seen, (n,).
    """
    signal = np.where(seen, residual, 0.0)[:, None]
    if slopes is None:
        return signal
    columns = np.column_stack([slopes, np.ones(len(slopes))])
    basis, sizes, _ = np.linalg.svd(np.where(seen[:, None], columns, 0.0), full_matrices=False)
    return np.hstack([basis[:, sizes > _ROUNDING * sizes.max(initial=0.0)], signal])


def remainder(table: FloatArray) -> tuple[FloatArray, float]:
    """What columns (n, k + 1) leave of the last of them, and the logarithm of their volume."""
    columns, signal = table[:, :-1], table[:, -1]
    if not columns.size:
        return signal, 0.0
    left = signal - columns @ _amplitudes(table)
    return left, float(np.linalg.slogdet(columns.T @ columns)[1])


def _amplitudes(table: FloatArray) -> FloatArray:
    """By which the last of columns (n, k + 1) is nearest to the sum of the others, (k,)."""
    columns = table[:, :-1]
    gram, within = columns.T @ columns, columns.T @ table[:, -1]
    return np.asarray(np.linalg.lstsq(gram, within, rcond=None)[0], dtype=np.float64)


def slow_noise(
    table: FloatArray, seen: BoolArray, lengths: Sequence[int], order: int
) -> Hidden | None:
    """The slow part of an output's residuals; None where an autoregression tells as much.

    table: (n, k + 1), as of ``regression_table``. order: the highest of the autoregression of what
    is left. By Schwarz's criterion of the likelihood of what no fit can take out (restricted
    maximum likelihood; Patterson & Thompson, "Recovery of inter-block information when block sizes
    are unequal", Biometrika 58, 1971): where slopes are slow, a fit has taken most of a slow noise.
    It is sought with autoregressions by their correlations, quickly; of memories that these hardly
    tell apart the longest is taken.
    """
    if not table[:, -1].any():
        return None
    begins, freedom = _first_rows(lengths), table.shape[1] - 1

    def filtered(pole_time: float, zero_time: float) -> tuple[FloatArray, FloatArray]:
        pole, zero = math.exp(-1.0 / pole_time), math.exp(-1.0 / zero_time)
        gains, sizes = _gains(pole, zero, seen, begins)
        return _innovations(table, begins, pole, gains, sizes), sizes

    def criterion(pole_time: float, zero_time: float) -> float:
        columns, sizes = filtered(pole_time, zero_time)
        left, volume = remainder(columns)
        return _criterion(left, sizes, begins, order, freedom) + volume

    plain, without = _restricted(table, np.ones(len(table)), begins, order)
    _, pole_time, zero_time = _lowest(criterion, float(max(lengths)), plain)
    if not pole_time:
        return None
    best, _ = _restricted(*filtered(pole_time, zero_time), begins, order)
    if best + PARAMETERS * math.log(max(int(seen.sum()), 2)) >= plain:
        return None
    return Hidden(SlowNoise(math.exp(-1.0 / pole_time), math.exp(-1.0 / zero_time)), without)


def _restricted(
    table: FloatArray, sizes: FloatArray, begins: IntArray, order: int
) -> tuple[float, FloatArray]:
    """Schwarz's criterion of the best autoregression of what columns (n, k + 1) leave of the last.

    And what they leave, (n,). They take out of it what a fit would whose errors are whitened by
    that autoregression: of slow noise a fit by squares leaves less than there was, and that is less
    slow. sizes: (n,), that columns are in.
    """
    n, freedom = len(table), table.shape[1] - 1
    table, lowest = np.ascontiguousarray(table), math.inf
    left = remainder(table)[0]
    for _ in range(_REFITS):
        turns = _turns(left, begins, order)
        whitened, divided = _whitened(table, turns, begins)
        rest, volume = remainder(whitened)
        variance = float(rest @ rest) / n
        if variance <= 0.0:
            return -math.inf, left
        deviance = (n - freedom) * math.log(variance) + divided + volume
        criterion = deviance + len(turns) * math.log(n)
        if criterion > lowest - _ALIKE:
            break
        lowest, left = criterion, table[:, -1] - table[:, :-1] @ _amplitudes(whitened)
    return lowest + 2.0 * float(np.sum(np.log(sizes))), left


_Criterion = Callable[[float, float], float]
_Minimum = tuple[float, float, float]  # of a criterion, and the times of pole and zero there


def _lowest(criterion: _Criterion, longest: float, plain: float) -> _Minimum:
    """The minimum, on a grid that becomes finer, or the longest memory up to that about as good.

    plain: the criterion without a slow part, from where on the coarsest grid will do.
    """
    times = _FASTEST * _STEPS[0] ** np.arange(math.log(longest / _FASTEST, _STEPS[0]) + 1.0)
    places = [(a, b) for a in np.minimum(times, longest).tolist() for b in times.tolist()]
    best = _best_of(criterion, places, longest)
    if best[0] >= plain:
        return best
    for step in _STEPS[1:]:
        ways = (1.0 / step, 1.0, step)
        beside = [(best[1] * a, best[2] * b) for a in ways for b in ways if a != 1.0 or b != 1.0]
        best = min(best, _best_of(criterion, beside, longest))
    lowest, (finer, finest) = best[0], _STEPS[-2:]
    while best[1] < longest:
        longer = min(finer * best[1], longest)
        beside = [(longer, best[2] * way) for way in (1.0 / finest, 1.0, finest)]
        alike = _best_of(criterion, beside, longest)
        if alike[0] > lowest + _ALIKE:
            break
        best = alike
    return best


def _best_of(
    criterion: _Criterion, places: Sequence[tuple[float, float]], longest: float
) -> _Minimum:
    allowed = [(a, b) for a, b in places if _FASTEST <= b < a <= longest]
    return min(((criterion(a, b), a, b) for a, b in allowed), default=(math.inf, 0.0, 0.0))


def _first_rows(lengths: Sequence[int]) -> IntArray:
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
        variance, before, gain, size, left = new / (1.0 - pole * pole), 0.0, 0.0, 1.0, 0.0
        for t in range(begins[record], begins[record + 1]):
            if not seen[t]:
                variance = pole * pole * variance + new
                continue
            if abs(variance - before) > _SETTLED * variance:
                whole = variance + white
                gain, size, left = variance / whole, math.sqrt(whole), variance * white / whole
            gains[t], sizes[t] = gain, size
            before, variance = variance, pole * pole * left + new
    return gains, sizes


@njit(cache=True, nogil=True)
def _innovations(
    signals: FloatArray, begins: IntArray, pole: float, gains: FloatArray, sizes: FloatArray
) -> FloatArray:
    """Innovations (n, k) of signals of records that begin at those rows."""
    n, count = signals.shape
    white, slow = np.zeros((n, count)), np.zeros(count)
    for record in range(len(begins) - 1):
        slow[:] = 0.0
        for t in range(begins[record], begins[record + 1]):
            for i in range(count):
                error = signals[t, i] - slow[i]
                white[t, i] = error / sizes[t] if gains[t] > 0.0 else 0.0
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
def _criterion(
    signal: FloatArray, sizes: FloatArray, begins: IntArray, order: int, freedom: int
) -> float:
    """Schwarz's criterion of the best autoregression of a signal (n,), and the sizes' logarithms.

    By Durbin's recursion along the correlations.
    """
    n = len(signal)
    sums, logs = _products(signal, begins, order), 0.0
    for size in sizes:
        if size != 1.0:
            logs += 2.0 * math.log(size)
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
        least = min(least, (n - freedom) * math.log(variance) + k * math.log(n))
    return least + logs


@njit(cache=True, nogil=True, fastmath=True)
def _products(signal: FloatArray, begins: IntArray, order: int) -> FloatArray:
    """Sums of products of samples so many apart, (order + 1,), in whatever order vectors take."""
    sums = np.zeros(order + 1)
    for lag in range(order + 1):
        for record in range(len(begins) - 1):
            total = 0.0
            for t in range(begins[record] + lag, begins[record + 1]):
                total += signal[t] * signal[t - lag]
            sums[lag] += total
    return sums


@njit(cache=True, nogil=True)
def _turns(signal: FloatArray, begins: IntArray, order: int) -> FloatArray:
    """Reflection coefficients of the autoregression of a signal (n,) that Schwarz prefers.

    By Burg's recursion, which takes nothing for zero beyond the ends: of a slow signal that is a
    step. See Kay, "Modern Spectral Estimation", 1988.
    """
    n, ahead, behind = len(signal), signal.copy(), signal.copy()
    turns, best = np.zeros(order), 0
    variance = np.sum(signal * signal) / n
    least = n * math.log(max(variance, 1e-300))
    for k in range(order):
        product, squares = 0.0, 0.0
        for record in range(len(begins) - 1):
            for t in range(begins[record] + k + 1, begins[record + 1]):
                product += ahead[t] * behind[t - 1]
                squares += ahead[t] ** 2 + behind[t - 1] ** 2
        turn = 2.0 * product / squares if squares > 0.0 else 0.0
        for record in range(len(begins) - 1):
            for t in range(begins[record + 1] - 1, begins[record] + k, -1):
                forward = ahead[t]
                ahead[t] -= turn * behind[t - 1]
                behind[t] = behind[t - 1] - turn * forward
        turns[k] = turn
        variance *= max(1.0 - turn * turn, 1e-15)
        criterion = n * math.log(max(variance, 1e-300)) + (k + 1) * math.log(n)
        if criterion < least:
            best, least = k + 1, criterion
    return turns[:best]


@njit(cache=True, nogil=True)
def _whitened(signals: FloatArray, turns: FloatArray, begins: IntArray) -> tuple[FloatArray, float]:
    """Signals (n, k) whitened from a first sample on, and minus twice the logarithm of its volume.

    By a lattice of these reflection coefficients; the first samples of a record, which are foreseen
    from few, are divided by how much more they vary than the others.
    """
    n, count = signals.shape
    order, white, logs = len(turns), np.zeros((n, count)), 0.0
    behind, before = np.zeros((order + 1, count)), np.zeros((order + 1, count))
    for record in range(len(begins) - 1):
        for t in range(begins[record], begins[record + 1]):
            deep, scale = min(t - begins[record], order), 1.0
            for k in range(deep, order):
                scale /= max(1.0 - turns[k] ** 2, 1e-15)
            if deep < order:
                logs += math.log(scale)
            for i in range(count):
                forward = signals[t, i]
                behind[0, i] = forward
                for k in range(deep):
                    behind[k + 1, i] = before[k, i] - turns[k] * forward
                    forward -= turns[k] * before[k, i]
                white[t, i] = forward / math.sqrt(scale)
            behind, before = before, behind
    return white, logs
