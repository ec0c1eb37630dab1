"""When an encoder measured the speed that a log shows.

A counter that times its edges tells the speed as one count over the time between the last two of
them: a mean over an interval that has ended before the sample. Log and calibration tell where it
lies,

- its length T from the speed, count / |omega|, or, where the shaft has turned round and the speed
  is zero, from the edges at its ends;
- its end from the sample in which the count has changed, to within a sample time, and closer as it
  began where the interval before it ended. With several edges in a sample the last is half an
  interval old on average.

Samples within an interval that is longer than a sample are given its mean, which the device could
not know before it was over; what it showed instead is that of the interval before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from daq.hal import FloatArray, IntArray

SPEED = "omega"  # the column that a counter's rate makes

_OFF_COUNT = 0.05  # counts that a printed angle may be off a whole one
_OFF_TICK = 0.02  # samples that printed speeds may put an edge off
_CREDIBLE = 0.85, 1.2  # change of the speed within an interval that its neighbour can tell
_FEWEST, _SHARE = 3, 0.8  # of the intervals that can be checked, those that must agree
# Samples of a mean of zero for which it does not matter when exactly its edges were.
_REST = 20.0
_MANY = 20  # intervals that contradict what somebody says


@dataclass(frozen=True)
class MeanSpeeds:
    """Speeds as means over known times.

    values: (n,) [rad/s], NaN for samples between edges of which none was timed, and where the
    shaft turned round amid several edges of a sample, or time and again. windows: (n, 2),
    begin and end of what each is the mean over [s], from its sample on. jitter: (n,), standard
    deviations of when they were [s].
    """

    values: FloatArray
    windows: FloatArray
    jitter: FloatArray


@dataclass(frozen=True)
class _Intervals:
    """The last interval between edges at each change of the count, times in ticks."""

    rows: IntArray  # of the log, where the count has changed
    speed: FloatArray
    begin: FloatArray
    end: FloatArray
    slack: FloatArray  # by which it may lie earlier or later
    checked: int  # those whose length and edges can be compared
    agreeing: int  # of them

    @classmethod
    def of(cls, tick: IntArray, counts: FloatArray, rates: FloatArray) -> _Intervals:
        """rates: in counts per tick."""
        rows = np.flatnonzero(np.diff(counts, prepend=np.nan))
        latest = tick[rows].astype(np.float64)  # the last edge was no later than this
        earliest = np.append(latest[0] - 1.0, tick[rows[1:] - 1])
        rate = rates[rows]
        with np.errstate(divide="ignore"):
            length = 1.0 / np.abs(rate)
        # The shaft stands anywhere between two edges; how long ago it passed the last depends on
        # its speed at the sample, which has changed since the interval.
        change = np.diff(rate, prepend=rate[0]) / np.diff(latest, prepend=latest[0] - 1.0)
        with np.errstate(invalid="ignore"):
            growth = np.nan_to_num(1.0 + np.sign(rate) * change * length**2, nan=1.0)
        growth = np.clip(growth, *_CREDIBLE)
        slack = 0.5 * np.minimum(latest - earliest, length / growth)
        end = latest - slack
        # An interval begins with the edge that ended the one before; the first row is no edge.
        timed = np.flatnonzero(np.isfinite(length) & (length > 1.0 + _OFF_TICK))
        timed = timed[timed > 1]
        moved = np.diff(counts[rows], prepend=np.nan)
        timed = timed[_follow(moved, rate, timed)]
        # Nor may the speed have gone at once since then, as where the shaft turned over and back.
        kept = np.sign(rates[rows[timed] - 1]) == np.sign(rate[timed - 1])
        timed = timed[kept | (length[timed] >= _REST)]
        low = np.maximum(earliest[timed], earliest[timed - 1] + length[timed])
        high = np.minimum(latest[timed], latest[timed - 1] + length[timed])
        agreeing = low <= high + _OFF_TICK
        end[timed[agreeing]] = 0.5 * (low + high)[agreeing]
        slack[timed[agreeing]] = 0.5 * np.maximum(high - low, 0.0)[agreeing]
        begin = np.where(rate == 0.0, np.append(earliest[0], end[:-1]), end - length)
        # A turn shows as a speed of zero, back over the edge before. Amid several edges nothing
        # tells when that was; nor, where the count goes on, how often the shaft has turned.
        back = (np.abs(moved) == 1.0) & (np.diff(moved, prepend=np.nan) == 2.0 * moved)
        # Of one turn after the other nothing tells how fast the shaft passed the edges.
        turns = rate == 0.0
        lasting = ~repeated(turns) | (end - begin >= _REST)
        measured = back & (_faster(rate) < 1.0) & lasting
        rate = np.where(turns & ~measured, np.nan, rate)
        return cls(rows, rate, begin, end, slack, len(timed), int(agreeing.sum()))

    def show_edges(self, stated: bool) -> bool:
        """Whether edges made the speeds; stated: somebody says so, and is believed if need be."""
        if stated and self.checked < _MANY:
            return True
        return self.agreeing >= max(_FEWEST, _SHARE * self.checked)


def _follow(moved: FloatArray, rate: FloatArray, rows: IntArray) -> npt.NDArray[np.bool_]:
    """Whether the last edge of the row before each was passed in the same direction.

    Else the shaft has turned round since, over an edge that the count does not show. moved, rate:
    (n,) of all rows, in counts; a rate of zero says that the last edge was a turn.
    """
    turn = np.where(np.abs(moved) == 1.0, moved, np.nan)
    direction = np.sign(np.where(rate == 0.0, turn, rate))
    follows: npt.NDArray[np.bool_] = direction[rows - 1] == np.sign(rate[rows])
    return follows


def repeated(turns: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Of turns of a shaft, (n,), those that have another next to them."""
    again: npt.NDArray[np.bool_] = turns & (
        np.append(False, turns[:-1]) | np.append(turns[1:], False)
    )
    return again


def _faster(rate: FloatArray) -> FloatArray:
    """The faster of the speeds before and after each, (n,), without its sign."""
    size: FloatArray = np.pad(np.abs(rate), 1)
    faster: FloatArray = np.maximum(size[:-2], size[2:])
    return faster


def mean_speeds(
    tick: IntArray,
    theta: FloatArray,
    omega: FloatArray,
    dt: float,
    count: float,
    by_edges: bool = False,
) -> MeanSpeeds | None:
    """What an encoder's speeds are the means of; None where its edges did not make them.

    tick, theta [rad], omega [rad/s]: (n,), of a log's rows. count: angle of a count [rad].
    by_edges: edges are known to have made them; else slow motion must show it.
    """
    counts = np.rint(theta / count)
    if np.abs(theta / count - counts).max() > _OFF_COUNT:
        return None
    intervals = _Intervals.of(tick, counts, omega * (dt / count))
    if not intervals.show_edges(by_edges):
        return None
    rates, begin, end, slack = _at_rows(intervals, tick)
    windows = np.stack([begin - tick, end - tick], axis=1) * dt
    return MeanSpeeds(rates * (count / dt), windows, slack * (dt / np.sqrt(3.0)))


def _at_rows(intervals: _Intervals, tick: IntArray) -> tuple[FloatArray, ...]:
    """Mean rate, begin, end and slack of the interval that each row tells of, (n,) each."""
    n = len(tick)
    before = np.searchsorted(intervals.rows, np.arange(n), side="right") - 1
    after = np.minimum(before + 1, len(intervals.rows) - 1)
    length = intervals.end - intervals.begin
    within = (after > before) & (length[after] > 1.0)
    interval = np.where(within, after, before)
    rate, begin, end = intervals.speed[interval], intervals.begin[interval], intervals.end[interval]
    # Longer ago than the interval took, the shaft has slowed down since.
    silent = ~within & (tick - intervals.end[before] > length[before])
    silent &= tick != tick[intervals.rows[before]]
    last = before == len(intervals.rows) - 1
    rate[silent] = np.where(last, 0.0, np.nan)[silent]
    begin[silent] = np.where(last, intervals.end[before], tick)[silent]
    end[silent] = np.where(last, float(tick[-1]), tick)[silent]
    # Rows that tell of the same interval have the same error, and all together count as one.
    _, place, repeated = np.unique(interval, return_inverse=True, return_counts=True)
    return rate, begin, end, intervals.slack[interval] * np.sqrt(repeated[place])
