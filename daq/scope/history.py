"""A run's samples in bounded memory: the newest as they are, all of them as lows and highs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from daq.hal import FloatArray, IntArray

_RECENT = 65_536  # rows kept as they are
_BUCKETS = 65_536  # stretches of the whole run of which low and high are kept
_READ = 200_000  # rows read back from the file for one view

Reader = Callable[[int, int], FloatArray]


@dataclass(frozen=True)
class View:
    """A stretch of a run to be drawn: the lowest and the highest of every ``step`` rows.

    time: (m,), of the first of them [s]. low, high: (m, n_columns), one and the same where
    ``step`` is 1; no spike is lost. flags: (m,), those of all of them. end: row after the last.
    """

    time: FloatArray
    low: FloatArray
    high: FloatArray
    flags: IntArray
    step: int
    end: int


class History:
    """Rows of a log, to be looked at at any magnification.

    A stretch is drawn from the newest rows, kept whole; from lows and highs over ``bucket`` rows,
    which double when there are too many; or, magnified further, from the file itself. What is
    kept does not depend on how long the run is. The flags in the highs are those of all rows.

    columns: names, with ``t`` among them. read: rows of the file between two bytes.
    """

    def __init__(self, columns: tuple[str, ...], read: Reader) -> None:
        n = len(columns)
        self.n_rows = 0
        self.bucket = 1
        self._read = read
        self._time = columns.index("t")
        self._flags = columns.index("flags") if "flags" in columns else None
        self._recent = np.empty((2 * _RECENT, n))
        self._recent_end = 0
        self._n_buckets = 0
        self._buckets = np.empty((_BUCKETS, 2, n))  # the lowest and the highest of each
        self._starts = np.zeros(_BUCKETS, dtype=np.int64)
        self._pending = np.empty((0, n))  # rows of the bucket that is not full yet
        self._pending_starts = np.empty(0, dtype=np.int64)
        self._end_byte = 0
        self._lowest, self._highest = np.full(n, np.nan), np.full(n, np.nan)

    @property
    def span(self) -> tuple[float, float]:
        """Time of the first and of the last row [s]; zeros without any."""
        if not self.n_rows:
            return 0.0, 0.0
        first = self._buckets[0, 0] if self._n_buckets else self._pending[0]
        return float(first[self._time]), float(self._recent_rows()[-1, self._time])

    @property
    def dt(self) -> float:
        """Time between neighbouring rows, on average over the newest [s]."""
        time = self._recent_rows()[:, self._time]
        return float((time[-1] - time[0]) / (len(time) - 1)) if len(time) > 1 else 0.0

    @property
    def spread(self) -> FloatArray:
        """From the lowest to the highest value of each column so far, (n_columns,)."""
        spread: FloatArray = self._highest - self._lowest
        return spread

    @property
    def middle(self) -> FloatArray:
        """Between the lowest and the highest value of each column so far, (n_columns,)."""
        middle: FloatArray = 0.5 * (self._lowest + self._highest)
        return middle

    def add(self, values: FloatArray, starts: IntArray) -> None:
        """Take rows (n, n_columns) whose lines begin at ``starts`` (n + 1,)."""
        if not len(values):
            return
        self._add_recent(values)
        self._add_buckets(values, starts[:-1])
        self._lowest = np.fmin(self._lowest, np.fmin.reduce(values))
        self._highest = np.fmax(self._highest, np.fmax.reduce(values))
        self._end_byte = int(starts[-1])
        self.n_rows += len(values)

    def at(self, time: float) -> FloatArray | None:
        """The row nearest to a time [s], (n_columns,); None without any."""
        rows = self._recent_rows()
        if len(rows) and time < rows[0, self._time]:
            rows = self._from_file(*self._bucket_range(time, time))
        if not len(rows):
            return None
        times = rows[:, self._time]
        right = min(int(np.searchsorted(times, time)), len(times) - 1)
        left = max(right - 1, 0)
        nearest: FloatArray = rows[left if time - times[left] < times[right] - time else right]
        return nearest

    def view(self, start: float, end: float, points: int, to_the_end: bool = True) -> View:
        """Rows between two times [s], in ``points`` to twice as many stretches.

        to_the_end: draw the last rows too, where they fill no stretch; without it ``since`` can
        go on from where the view ends.
        """
        recent = self._recent_rows()
        if len(recent) == self.n_rows or start >= recent[0, self._time]:
            times = recent[:, self._time]
            first = max(int(np.searchsorted(times, start)) - 1, 0)
            rows = recent[first : int(np.searchsorted(times, end, side="right")) + 1]
            step, first = step_for(len(rows), points), self.n_rows - len(recent) + first
            return self._drawn(_extremes(rows), step, first, to_the_end)
        first, last = self._bucket_range(start, end)
        n_rows = (last - first) * self.bucket
        step = step_for(n_rows, points)
        if step < self.bucket and n_rows <= _READ:
            rows = self._from_file(first, last)
            step = step_for(len(rows), points)
            return self._drawn(_extremes(rows), step, first * self.bucket, to_the_end)
        buckets = self._buckets[first : min(last, self._n_buckets)]
        if to_the_end and last > self._n_buckets and len(self._pending):
            rest = self._united(_extremes(self._pending), len(self._pending))
            buckets = np.concatenate([buckets, rest])
        return self._drawn(buckets, step, first * self.bucket, to_the_end, self.bucket)

    def rows(self, start: float, end: float, most: int) -> FloatArray:
        """Neighbouring rows between two times [s], the newest ``most`` of them, (n, n_columns)."""
        rows, start = self._recent_rows(), max(start, end - most * self.dt)
        if len(rows) and end < rows[0, self._time]:
            rows = self._from_file(*self._bucket_range(start, end))
        times = rows[:, self._time]
        first, last = np.searchsorted(times, [start, end], side="left")
        shown: FloatArray = rows[max(first, last + 1 - most) : last + 1]
        return shown

    def since(self, row: int, step: int) -> View:
        """The full stretches of ``step`` rows from ``row`` on, or from the oldest row kept."""
        recent = self._recent_rows()
        kept = self.n_rows - len(recent)
        first = max(row, kept)
        return self._drawn(_extremes(recent[first - kept :]), step, first, to_the_end=False)

    def _recent_rows(self) -> FloatArray:
        first = max(self._recent_end - _RECENT, 0)
        return self._recent[first : self._recent_end]

    def _add_recent(self, values: FloatArray) -> None:
        values = values[-_RECENT:]
        if self._recent_end + len(values) > len(self._recent):
            kept = self._recent_rows()
            self._recent[: len(kept)] = kept.copy()
            self._recent_end = len(kept)
        self._recent[self._recent_end : self._recent_end + len(values)] = values
        self._recent_end += len(values)

    def _add_buckets(self, values: FloatArray, starts: IntArray) -> None:
        values = np.concatenate([self._pending, values])
        starts = np.concatenate([self._pending_starts, starts])
        done = 0
        while (full := (len(values) - done) // self.bucket) > 0:
            if self._n_buckets == _BUCKETS:
                self._merge()
                continue
            n = min(full, _BUCKETS - self._n_buckets)
            rows = slice(done, done + n * self.bucket)
            into = slice(self._n_buckets, self._n_buckets + n)
            self._buckets[into] = self._united(_extremes(values[rows]), self.bucket)
            self._starts[into] = starts[rows][:: self.bucket]
            self._n_buckets += n
            done = rows.stop
        self._pending, self._pending_starts = values[done:].copy(), starts[done:].copy()

    def _merge(self) -> None:
        """Buckets of twice the rows."""
        half = _BUCKETS // 2
        self._buckets[:half] = self._united(self._buckets, 2)
        self._starts[:half] = self._starts[0::2]
        self._n_buckets, self.bucket = half, 2 * self.bucket

    def _bucket_range(self, start: float, end: float) -> tuple[int, int]:
        """Buckets that hold the times, one more on each side; the last may be the pending rows."""
        times = self._buckets[: self._n_buckets, 0, self._time]
        first = max(int(np.searchsorted(times, start, side="right")) - 2, 0)
        last = int(np.searchsorted(times, end, side="right")) + 1
        return first, min(last, self._n_buckets + 1)

    def _from_file(self, first: int, last: int) -> FloatArray:
        end = int(self._starts[last]) if last < self._n_buckets else self._end_byte
        if first >= self._n_buckets:
            return self._pending
        return self._read(int(self._starts[first]), end)

    def _united(self, extremes: FloatArray, together: int) -> FloatArray:
        """Extremes (m, 2, n_columns) of stretches of so many rows or buckets."""
        parts = extremes.reshape(-1, together, *extremes.shape[1:])
        low, high = np.fmin.reduce(parts[:, :, 0], axis=1), np.fmax.reduce(parts[:, :, 1], axis=1)
        if self._flags is not None and together > 1:
            flags = self._flags_of(extremes).reshape(-1, together)
            high[:, self._flags] = np.bitwise_or.reduce(flags, axis=1)
        return np.stack([low, high], axis=1)

    def _flags_of(self, extremes: FloatArray) -> IntArray:
        if self._flags is None:
            return np.zeros(len(extremes), dtype=np.int64)
        # None where it is unreadable.
        return np.fmax(extremes[:, 1, self._flags], 0.0).astype(np.int64)

    def _drawn(
        self, extremes: FloatArray, step: int, first: int, to_the_end: bool, bucket: int = 1
    ) -> View:
        """Rows, or buckets of rows, from row ``first`` on, in stretches of ``step`` rows."""
        together = max(1, step // bucket)
        n = len(extremes) // together * together
        drawn, end = self._united(extremes[:n], together), first + n * bucket
        if to_the_end and n < len(extremes):
            drawn = np.concatenate([drawn, self._united(extremes[n:], len(extremes) - n)])
            end = first + len(extremes) * bucket
        low, high = drawn[:, 0], drawn[:, 1]
        end = min(end, self.n_rows)  # the last bucket may not be full
        return View(low[:, self._time], low, high, self._flags_of(drawn), together * bucket, end)


def _extremes(rows: FloatArray) -> FloatArray:
    """Rows (m, n_columns) as stretches of one, (m, 2, n_columns): lowest and highest are alike."""
    return np.broadcast_to(rows[:, np.newaxis], (len(rows), 2, rows.shape[1]))


def nothing(n_columns: int) -> View:
    """A view without samples."""
    none = np.empty((0, n_columns))
    return View(np.empty(0), none, none, np.empty(0, dtype=np.int64), 1, 0)


def step_for(rows: int, points: int) -> int:
    """Rows drawn together, a power of two; 1 where single samples fit."""
    if rows <= 2 * points:
        return 1
    return 1 << max(1, (rows // (2 * points)).bit_length())
