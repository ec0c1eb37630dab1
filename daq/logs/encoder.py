"""When an encoder measured the speed that a log shows.

A counter that times its edges tells the speed as one count over the time between the last two of
them, a mean over an interval that has ended before the sample; or, with a capture unit that keeps
the last alone, as the counts of a sample over the time between its last edge and that of the sample
before. Which it is shows where the speed changes. Log and calibration tell where the interval lies,

- its length T from the speed, one count or those of the sample over |omega|, or, where the shaft
  has turned round and the speed is zero, from the edges at its ends;
- its end, the last edge, from the sample in which the count has changed, no more than T before its
  end. Of several edges in a sample the one before the last came in it, too.

From the last edge of one sample to that of the next it takes an interval that the log shows, or
several: those it does not show are as long as those beside them, or in between. So what is known of
one edge narrows where all of a chain of them were. Of what is left the middle is likelier.

Samples within an interval that is longer than a sample are given its mean, which the device could
not know before it was over; what it showed instead is that of the interval before.

A speed is never more than one count over the time since the last edge: where no edge comes for long
it is a bound. In samples without an edge it tells when the last one was. In the sample of the edge
itself it may be one wherever the shaft slows down and the edge may have come as long ago; the part
a T^2 / count of such speeds is bounds (a deceleration, edges at any phase), means over times T that
end between T before the sample and the sample. Before a turn they are means of nothing. With the
counts of a sample there are no bounds but in samples without an edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from daq.hal import BoolArray, FloatArray, IntArray

SPEED = "omega"  # the column that a counter's rate makes

_OFF_COUNT = 0.05  # counts that a printed angle may be off a whole one
_OFF_TICK = 0.02  # samples that printed speeds may put an edge off
_LOST = 0.5  # part of the speed that is lost in an interval before a turn, which tells no mean
_LOWER = 1.0 - 1e-6  # parts of a speed below which another is lower
_GROWTH = 0.5  # of the speed within an interval, at most, that the next one can tell
_SURE = 0.3  # part of its speed lost in an interval, up to which those beside it tell of it
# Of how far intervals next to each other are apart, by which one in between may be beyond them.
_BETWEEN = 0.1
_BESIDE = 0.05  # of a sample, from an edge that a bound would tell to where it is
_PASSES = 4  # from bounds of edges to which speeds are no bounds, and back
# Square of how far bounds of an edge are apart, over the variance of where it is: 12, were all
# places alike. Of what several bounds leave the middle is likelier.
_NARROWED = 14.0
# Correlation of when two edges were with no slack in between, and by what slack squared, over the
# product of how far their bounds are apart, makes it less; correlations that are none.
_FIRM, _LOOSER, _NO_PART = 0.95, 4.5, 1e-3
_TINY = 1e-9  # counts a sample, of a shaft that stands
# Square counts a sample that changes of the speed make of a kind of means; the part that may miss.
_CLEAR, _ALIKE = 10.0, 0.3
_FEWEST, _SHARE = 3, 0.8  # of the intervals that can be checked, those that must agree
# Samples of a mean of zero for which it does not matter when exactly its edges were, nor that none
# has come yet.
_REST = 20.0
_MANY = 20  # intervals that contradict what somebody says


@dataclass(frozen=True)
class MeanSpeeds:
    """Speeds as means over known times.

    values: (n,) [rad/s], NaN for samples between edges of which none was timed, and where the
    shaft turned round amid several edges of a sample, or time and again. windows: (n, 2),
    begin and end of what each is the mean over [s], from its sample on. jitter: (n,), standard
    deviations of when they were [s]; colour: (n,), the part of the mean before in these errors,
    correlations of 0 to 1.
    """

    values: FloatArray
    windows: FloatArray
    jitter: FloatArray
    colour: FloatArray


@dataclass(frozen=True)
class _Changes:
    """Samples in which the count has changed, (n,) each, times in ticks and rates in counts a tick.

    latest: time of the sample, the last edge was no later. gap: since the sample before. moved:
    counts, NaN in the first. length: of the interval, infinite for a turn. next_rate, pause: the
    rate at the sample behind and the time until it. whole: intervals are of all counts of a sample.
    """

    rows: IntArray  # of the log
    latest: FloatArray
    gap: FloatArray
    moved: FloatArray
    rate: FloatArray
    length: FloatArray
    next_rate: FloatArray
    pause: FloatArray
    whole: bool

    @classmethod
    def of(cls, tick: IntArray, counts: FloatArray, rates: FloatArray, whole: bool) -> _Changes:
        """rates: in counts per tick."""
        rows = np.flatnonzero(np.diff(counts, prepend=np.nan))
        behind = np.minimum(rows + 1, len(tick) - 1)
        rate, latest = rates[rows], tick[rows].astype(np.float64)
        moved = np.diff(counts[rows], prepend=np.nan)
        with np.errstate(divide="ignore"):
            length = (np.abs(moved) if whole else 1.0) / np.abs(rate)
        gap = np.append(1.0, latest[1:] - tick[rows[1:] - 1])
        pause = np.maximum(tick[behind] - latest, 1.0)
        return cls(rows, latest, gap, moved, rate, length, rates[behind], pause, whole)

    @property
    def follows(self) -> BoolArray:
        """Whether the edge before each was passed in the same direction.

        Else the shaft has turned round since, over an edge that the count does not show. A rate of
        zero says that the edge was a turn.
        """
        turn = np.where(np.abs(self.moved) == 1.0, self.moved, np.nan)
        direction = np.sign(np.where(self.rate == 0.0, turn, self.rate))
        return np.append(False, direction[:-1] == np.sign(self.rate[1:]))

    def waits(self) -> tuple[FloatArray, FloatArray]:
        """How long the last edge was ago, at least and at most, (n,) each."""
        if self.whole:  # the next edge would have come since
            slower = np.minimum(np.abs(self.rate), self.next_rate * np.sign(self.rate))
            return np.zeros(len(self.rows)), np.minimum(self.gap, 1.0 / np.maximum(slower, _TINY))
        # Speeding up, the shaft has passed it no longer ago than it would take for the next by now.
        gain = (self.next_rate - self.rate) * np.sign(self.rate) / (self.pause + self.length)
        with np.errstate(invalid="ignore"):
            gain = np.clip(np.nan_to_num(gain * self.length**2), 0.0, _GROWTH)
        gain[self.slowing > 0.0] = 0.0  # where the speed shown may be a bound
        most = np.minimum(self.gap, self.length / (1.0 + gain))
        # The edge before came in the sample as well, or not, unless the shaft has turned twice.
        within, before = np.abs(self.moved) > 1.0, (np.abs(self.moved) == 1.0) & self.follows
        rest, at_most = self.gap - self.length, self.gap - self.shortest()
        most = np.where(within & (at_most > 0.0), np.minimum(most, at_most), most)
        return np.where(before & (rest > 0.0) & (rest < most), rest, 0.0), most

    def shortest(self) -> FloatArray:
        """How long each interval was at least, (n,), if the speed that was shown may be a bound."""
        with np.errstate(invalid="ignore"):
            bounded = np.minimum(self._earlier, self.length) * (1.0 - self.slowing)
        return np.where(self.slowing > 0.0, bounded, self.length)

    def between_edges(self, means: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Bounds, (n,) each, of the time from the last edge of the change before to the last one.

        Intervals that the log does not show are as long as those beside them, or in between.
        means: (n,), which of the speeds are no bounds, whatever the others are.
        """
        more, shortest = np.abs(self.moved) - 1.0, np.where(means, self.length, self.shortest())
        with np.errstate(invalid="ignore"):
            beyond = _BETWEEN * self._uneven()
            least = more * (np.minimum(_shifted(shortest), shortest) - beyond) + shortest
            most = more * (np.maximum(self._earlier, self.length) + beyond) + self.length
        shown = (more == 0.0) | self.whole | (self.length > 1.0 + _OFF_TICK)
        return np.where(shown, shortest, least), np.where(shown, self.length, most)

    @property
    def _earlier(self) -> FloatArray:
        return _shifted(self.length)

    def _uneven(self) -> FloatArray:
        """How far intervals next to each other are apart at most, around each and the one before.

        (n,), as long as the interval itself where a turn is among them.
        """
        apart = np.pad(np.abs(np.diff(self.length, prepend=np.nan)), 1, constant_values=np.nan)
        most = np.fmax(np.fmax(apart[:-2], apart[1:-1]), apart[2:])
        return np.where(np.isfinite(most), most, self.length)

    @cached_property
    def slowing(self) -> FloatArray:
        """Part of its speed, 0 to 1, that the shaft loses in each interval, (n,).

        By what came before and by what follows: a speed that is a bound may be less than both.
        """
        before, since = np.append(0.0, self.rate[:-1]), np.diff(self.latest, prepend=0.0)
        gone = (before - self.rate) * np.sign(self.rate) / np.maximum(since, self.length)
        coming = (self.rate - self.next_rate) * np.sign(self.rate) / self.pause
        with np.errstate(invalid="ignore"):
            loss = np.nan_to_num(np.maximum(coming, gone) * self.length**2)
        return np.clip(loss, 0.0, 1.0)


def _shifted(lengths: FloatArray) -> FloatArray:
    """Of each change the length of the change before, (n,)."""
    return np.append(np.inf, lengths[:-1])


@dataclass(frozen=True)
class _Intervals:
    """The last interval between edges at each change of the count, times in ticks."""

    rows: IntArray  # of the log, where the count has changed
    speed: FloatArray
    begin: FloatArray
    end: FloatArray
    deviation: FloatArray  # by which it may lie earlier or later
    colour: FloatArray  # part of the deviation of the one before in it
    checked: int  # those whose length and edges can be compared
    agreeing: int  # of them

    @classmethod
    def of(cls, tick: IntArray, counts: FloatArray, rates: FloatArray, whole: bool) -> _Intervals:
        """rates: in counts per tick."""
        changes = _Changes.of(tick, counts, rates, whole)
        rate, length, latest = changes.rate, changes.length, changes.latest
        soonest, longest = changes.waits()
        wait = _waits_by_silence(tick, rates, changes, longest)
        heard = np.isfinite(wait)
        low, high = (latest - np.where(heard, wait, waited) for waited in (longest, soonest))
        # An interval begins with the edge that ended the one before; the first row is no edge.
        linked = np.isfinite(length) & changes.follows
        linked[:2] = False
        # Nor may the speed have gone at once since then, as where the shaft turned over and back.
        kept = np.sign(rates[changes.rows - 1]) == np.sign(np.append(0.0, rate[:-1]))
        linked &= kept | (length >= _REST)
        timed = linked & ((length > 1.0 + _OFF_TICK) | changes.whole)
        lost = changes.slowing
        linked &= timed | (lost < _SURE)
        bounds = low, high
        for _ in range(_PASSES):
            means = timed | (lost == 0.0) | (latest - low < length - _OFF_TICK)
            least, most = changes.between_edges(means)
            low, high, fits = _linked(*bounds, least, most, linked)
        agreeing = fits & timed
        # A speed may be a bound where the last edge may be as long ago as it says.
        within = (length <= changes.gap) & (not changes.whole)
        bound = within & (latest - low >= length - _BESIDE)
        turning = within & (np.sign(changes.next_rate) != np.sign(rate)) & (lost > _LOST)
        if changes.whole:  # perhaps within the sample, over an edge and back
            turning = np.append(changes.moved[1:] * changes.moved[:-1] < 0.0, True)
        end, deviation = _mixed(low, high, latest, length, np.where(bound, lost, 0.0))
        edges = np.append(latest[0] - 1.0, 0.5 * (low + high)[:-1])
        # Either end of a turn moves its mean by half of what both together do.
        of_turns = 0.5 * np.hypot(deviation, np.append(0.0, deviation[:-1]))
        deviation = np.where(rate == 0.0, of_turns, deviation)
        begin = np.where(rate == 0.0, edges, end - length)
        # A turn shows as a speed of zero, back over the edge before. Amid several edges nothing
        # tells when that was; nor, where the count goes on, how often the shaft has turned.
        moved = changes.moved
        back = (np.abs(moved) == 1.0) & (np.diff(moved, prepend=np.nan) == 2.0 * moved)
        # Of one turn after the other nothing tells how fast the shaft passed the edges.
        turns = rate == 0.0
        lasting = ~repeated(turns) | (end - begin >= _REST)
        measured = back & (_faster(rate) < 1.0) & lasting
        speed = np.where((bound & heard) | turning | (turns & ~measured), np.nan, rate)
        slack = np.subtract(most, least, out=np.full(len(rate), np.inf), where=fits)
        colour = _colour(high - low, slack, np.isfinite(speed))
        counted = int(timed.sum()), int(agreeing.sum())
        return cls(changes.rows, speed, begin, end, deviation, colour, *counted)

    def show_edges(self, stated: bool) -> bool:
        """Whether edges made the speeds; stated: somebody says so, and is believed if need be."""
        if stated and self.checked < _MANY:
            return True
        return self.agreeing >= max(_FEWEST, _SHARE * self.checked)


def _are_of_whole_samples(tick: IntArray, counts: FloatArray, rates: FloatArray) -> bool:
    """Whether speeds are means of all counts of a sample, and not of the last.

    A mean over a sample is behind one over its last interval, by half a sample less half of the
    interval: so do rates differ from the counts of the sample as the speed changes. Where it swings
    within a few samples chords do not tell how it changes, and this is no more than likely.
    """
    lone = (np.diff(tick)[:-1] == 1) & (np.diff(tick)[1:] == 1)
    moved, rate = np.diff(counts)[:-1], rates[1:-1]
    same = (np.sign(rates[:-2]) == np.sign(rate)) & (np.sign(rates[2:]) == np.sign(rate))
    rows = np.flatnonzero(lone & same & (np.abs(moved) > 1.0) & (rate != 0.0))
    change = 0.5 * (rates[2:] - rates[:-2])[rows]
    length = 1.0 / np.abs(rate[rows])
    of_last, apart = change * (0.5 - length), change * 0.5 * (length - 1.0)
    beside = (rate - moved)[rows] - of_last
    square = float(apart @ apart)
    return abs(float(beside @ apart) - square) < _ALIKE * square and square > _CLEAR


def _waits_by_silence(
    tick: IntArray, rates: FloatArray, changes: _Changes, most: FloatArray
) -> FloatArray:
    """How long each last edge was ago by the bounds shown until the next one, (n,); NaN for most.

    most: how long it can have been ago. A device whose speeds are no such bounds tells nothing.
    """
    place = np.searchsorted(changes.rows, np.arange(len(tick)), side="right") - 1
    size, shown = np.abs(rates), changes.rate[place]
    silent = (place >= 0) & (np.sign(rates) == np.sign(shown)) & (size > 0.0)
    silent = np.flatnonzero(silent & (size < _LOWER * np.abs(shown)))
    silent = silent[tick[silent] > changes.latest[place[silent]]]
    edges, firsts = np.unique(place[silent], return_index=True)
    silent = silent[firsts]
    wait = 1.0 / size[silent] - (tick[silent] - changes.latest[edges])
    possible = (wait > -_OFF_TICK) & (wait < most[edges] + _OFF_TICK)
    waits = np.full(len(most), np.nan)
    if possible.sum() >= max(1.0, _SHARE * len(edges)):
        waits[edges[possible]] = np.clip(wait, 0.0, most[edges])[possible]
    return waits


def _linked(
    low: FloatArray, high: FloatArray, least: FloatArray, most: FloatArray, linked: BoolArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Bounds of last edges, (n,) each, that times between them narrow, and which of these fit.

    least, most: bounds of the time since the last edge before; linked: where they are known. They
    narrow those behind and those before them, along whole chains.
    """
    linked = linked & np.isfinite(most)
    least, most = np.where(linked, least, 0.0), np.where(linked, most, 0.0)
    begin, end = np.append(low[0], low[:-1]) + least, np.append(high[0], high[:-1]) + most
    fits = linked & (np.maximum(low, begin) <= np.minimum(high, end) + _OFF_TICK)
    chain = np.cumsum(~fits, dtype=np.int64)
    soonest, latest = (np.cumsum(np.where(fits, each, 0.0)) for each in (least, most))
    lowest = soonest + _largest(low - soonest, chain)
    highest = latest - _largest(latest - high, chain)
    lowest = latest + _largest((lowest - latest)[::-1], -chain[::-1])[::-1]
    highest = soonest - _largest((soonest - highest)[::-1], -chain[::-1])[::-1]
    agreed = lowest <= highest + _OFF_TICK
    middle, half = 0.5 * (lowest + highest), 0.5 * np.maximum(highest - lowest, 0.0)
    return np.where(agreed, middle - half, low), np.where(agreed, middle + half, high), fits


def _colour(width: FloatArray, slack: FloatArray, measured: BoolArray) -> FloatArray:
    """Correlations, (n,), of when each edge was with when the one of the mean before was.

    width: of their bounds, slack: of the time from the edge before, infinite where it is not known;
    measured: where there are means. Edges of no mean pass on what they have of the one before.
    """
    both = width * np.append(0.0, width[:-1])
    apart = both / _FIRM + _LOOSER * slack**2
    part = np.divide(both, apart, out=np.zeros(len(width)), where=both > 0.0)
    logarithms = np.cumsum(np.log(np.maximum(part, _NO_PART)))
    colour = np.zeros(len(width))
    colour[measured] = np.exp(np.diff(logarithms[measured], prepend=np.inf))
    return colour


def _largest(values: FloatArray, chain: IntArray) -> FloatArray:
    """The largest of each value and those before it in its chain, (n,); chain: rising numbers."""
    apart = (1.0 + np.ptp(values)) * chain
    largest: FloatArray = np.maximum.accumulate(values + apart) - apart
    return largest


def _mixed(
    low: FloatArray, high: FloatArray, latest: FloatArray, length: FloatArray, share: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and deviation, (n,) each, of the ends of means of which a share are bounds.

    Means over intervals end between low and high, bounds as if they did in the length before the
    sample, share times as densely; (n,) each.
    """
    width, mixed = high - low, share > 0.0
    length, apart = (
        np.where(mixed, x, 0.0) for x in (length, latest - 0.5 * (length + low + high))
    )
    part = np.divide(share * length, share * length + width, out=np.zeros(len(width)), where=mixed)
    variance = (1.0 - part) * width**2 / _NARROWED + part * length**2 / 12.0
    variance += part * (1.0 - part) * apart**2
    return 0.5 * (low + high) + part * apart, np.sqrt(variance)


def repeated(turns: BoolArray) -> BoolArray:
    """Of turns of a shaft, (n,), those that have another next to them."""
    again: BoolArray = turns & (np.append(False, turns[:-1]) | np.append(turns[1:], False))
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
    intervals = _shown_by(tick, counts, omega * (dt / count), by_edges)
    if intervals is None:
        return None
    rates, begin, end, deviation, colour = _at_rows(intervals, tick)
    windows = np.stack([begin - tick, end - tick], axis=1) * dt
    return MeanSpeeds(rates * (count / dt), windows, deviation * dt, colour)


def _shown_by(
    tick: IntArray, counts: FloatArray, rates: FloatArray, stated: bool
) -> _Intervals | None:
    """The intervals that made the speeds, of all counts of a sample only where edges agree."""
    for whole in (True, False):
        if whole and not _are_of_whole_samples(tick, counts, rates):
            continue
        intervals = _Intervals.of(tick, counts, rates, whole)
        if intervals.show_edges(stated):
            return intervals
    return None


def _at_rows(intervals: _Intervals, tick: IntArray) -> tuple[FloatArray, ...]:
    """Mean rate, begin, end, deviation and colour of the interval of each row, (n,) each."""
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
    last = (before == len(intervals.rows) - 1) & (tick[-1] - intervals.end[before] >= _REST)
    rate[silent] = np.where(last, 0.0, np.nan)[silent]
    begin[silent] = np.where(last, intervals.end[before], tick)[silent]
    end[silent] = np.where(last, float(tick[-1]), tick)[silent]
    # Rows that tell of the same interval have the same error, and all together count as one.
    _, place, repeated = np.unique(interval, return_inverse=True, return_counts=True)
    deviation = intervals.deviation[interval] * np.sqrt(repeated[place])
    return rate, begin, end, deviation, intervals.colour[interval]
