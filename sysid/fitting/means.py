"""Means over windows as a filter takes them in: each once, in the sample in which it ends."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.problem.data import Dataset

_SAME = 1e-6  # samples by which windows of one mean differ for the arithmetic's sake
_INSIDE = 1e-3  # samples behind the end of a sample where a window that is cut begins
# Overlap [samples] that comes of ends which are known so well only, and the share of long windows
# that may overlap more.
_OVERLAP, _FEW = 1.0, 0.05
# Of the mean square of the slopes around, which that beside a mean is taken for at least: where it
# seems to rest, between two turns, it does not. Means on each side that are around it.
_AROUND, _NEAR = 0.05, 3
_NO_PART = 1e-3  # of a colour, that is none
_WIDE = 10  # the same of those by which a run is judged

Run = Callable[[Dataset], FloatArray]  # outputs (n_samples, n_outputs) of a record's inputs


def each_mean_once(record: Dataset) -> Dataset:
    """The record with every mean once, where its window ends, and NaN in the rows between.

    Rows that tell of the same window, perhaps before it has ended, repeat its mean. Their jitter
    is such that all of them count as one; that of the one is less by the root of their number.
    An output whose windows overlap stays as it is, and so does the first row, where states start.
    Errors of when a mean was go on through rows without one.

    >>> ends = np.array([0, 3, 3, 3, 4])
    >>> windows = np.stack([[0, 0, 0, 0, 3], ends], axis=1) - np.arange(5)[:, None]
    >>> record = Dataset(np.ones(5), [0, 2, 2, 2, 7], 1.0, windows=windows[:, None])
    >>> once = each_mean_once(record)
    >>> once.outputs[:, 0], once.windows[3, 0]
    (array([ 0., nan, nan,  2.,  7.]), array([-3.,  0.]))
    """
    if not record.windows.size:
        return record
    outputs, windows = record.outputs.copy(), record.windows.astype(np.float64)
    jitter, colour = record.jitter.astype(np.float64), record.jitter_colour.astype(np.float64)
    for j in np.flatnonzero(record.windows.any(axis=(0, 2))).tolist():
        rows, firsts, spans = _distinct(record, j)
        if not len(rows):
            continue
        counts = np.diff(np.append(firsts, len(rows)))
        ends = np.ceil(spans[firsts, 1] - _SAME).astype(np.int64)
        within = (spans[firsts, 0] > -_SAME) & (ends > 0) & (ends < record.n_samples)
        # Of two that end in a sample the later one.
        within &= np.append(np.diff(ends) > 0, True)
        all_of = firsts
        firsts, counts, ends = firsts[within], counts[within], ends[within]
        begins = _apart(spans[firsts, 0], ends)
        if begins is None:
            continue
        moved = np.stack([begins, spans[firsts, 1]], axis=1) - ends[:, None]
        values, jitters = outputs[rows[firsts], j], jitter[rows[firsts], j] / np.sqrt(counts)
        parts = _going_on(colour[rows[all_of], j], within)
        outputs[1:, j], windows[1:, j], jitter[1:, j], colour[1:, j] = np.nan, 0.0, 0.0, 1.0
        outputs[ends, j], windows[ends, j], jitter[ends, j] = values, moved * record.dt, jitters
        colour[ends, j] = parts
    return replace(record, outputs=outputs, windows=windows, jitter=jitter, jitter_colour=colour)


def _going_on(colours: FloatArray, kept: BoolArray) -> FloatArray:
    """Of colours from each window to the next, (n,), those from each that is kept to the next."""
    passed = np.cumsum(np.log(np.maximum(colours, _NO_PART)))[kept]
    going_on: FloatArray = np.exp(np.minimum(np.diff(passed, prepend=np.inf), 0.0))
    return going_on


def _apart(begins: FloatArray, ends: IntArray) -> FloatArray | None:
    """Begins of windows none of which begins in a sample before one in which another ends.

    begins: (n,) in samples; ends: (n,), samples in which they end. Those within a sample are let
    alone. None where too many overlap too far.
    """
    begins = begins.copy()
    long = np.flatnonzero(begins < ends - 1.0 - _SAME)
    earliest = np.append(-np.inf, ends[long[:-1]] - 1.0 + _INSIDE)
    overlap = earliest - begins[long]
    if len(long) and np.mean(overlap > _OVERLAP) > _FEW:
        return None
    begins[long] = np.maximum(begins[long], earliest)
    return begins


@dataclass(frozen=True)
class Scatter:
    """What the jitter of windows does to their means, (n_samples, n_outputs) each.

    variance: of it. shift: what a mean that is a deviation of its jitter later is more, as far as
    it changes alike on both sides; its square is a part of the variance. Zero where rows repeat a
    mean.
    """

    variance: FloatArray
    shift: FloatArray


def scatter(record: Dataset, run: Run | None = None) -> Scatter:
    """What the jitter of the windows makes of their means.

    By how fast an output changes to the means before and behind each, as measured, without what
    the jitter itself does to that. Not by the slope from one neighbour to the other, which is none
    where a speed has its peak. run: of a model, to tell how an output bends in between. What noise
    of the inputs and wrong parameters make of it changes slowly, and shows in what was measured.

    >>> windows = np.tile([-1.0, 0.0], (4, 1, 1))
    >>> ramp = Dataset(np.ones(4), [1, 3, 5, 7], 1.0, windows=windows, jitter=np.full((4, 1), 0.1))
    >>> np.sqrt(scatter(ramp).variance)[:, 0].round(3)
    array([0.198, 0.198, 0.198, 0.198])
    >>> turned = scatter(replace(ramp, outputs=np.array([[1], [3], [1], [-1]])))
    >>> np.sqrt(turned.variance)[:, 0].round(3), turned.shift[:, 0].round(3)
    (array([0.198, 0.198, 0.198, 0.198]), array([ 0.198,  0.   , -0.198, -0.198]))
    """
    variances, shifts = np.zeros(record.outputs.shape), np.zeros(record.outputs.shape)
    if not (record.windows.size and record.jitter.any()):
        return Scatter(variances, shifts)
    of_run = None if run is None else _of_run(record, run)
    for j in np.flatnonzero(record.windows.any(axis=(0, 2))).tolist():
        rows, firsts, spans = _distinct(record, j)
        if len(firsts) < 2:
            continue
        jitter, counts = record.jitter[rows, j], np.diff(np.append(firsts, len(rows)))
        apart = np.maximum(record.dt * np.diff(spans[firsts].mean(axis=1)), _SAME * record.dt)
        in_time = jitter[firsts] ** 2 / counts
        excess = 1.0 + (in_time[1:] + in_time[:-1]) / apart**2
        distinct, measured = rows[firsts], record.outputs[rows[firsts], j]
        plain = np.diff(measured) / apart
        level = np.zeros(len(distinct))
        sides = _sides(level, plain)
        if of_run is not None:
            means, slopes = (table[distinct, j] for table in of_run)
            beside = np.diff(measured - means) / apart
            straighter = _bend(beside) < _bend(plain)
            sides = np.where(straighter, _sides(slopes, beside), sides)
        squares = np.mean(sides**2 / _sides(level, excess), axis=0)
        squares = np.maximum(squares, _AROUND * _around(squares, _NEAR))
        place = np.searchsorted(firsts, np.arange(len(rows)), side="right") - 1
        variances[rows, j] = squares[place] * jitter**2
        most = np.sqrt(squares)
        rates = np.where(counts == 1, np.clip(sides.mean(axis=0), -most, most), 0.0)
        shifts[distinct, j] = rates * jitter[firsts]
    return Scatter(variances, shifts)


def _of_run(record: Dataset, run: Run) -> tuple[FloatArray, FloatArray]:
    """Means of a run, and how fast they change as windows move, (n_samples, n_outputs) each."""
    jitter = record.jitter[..., None]
    early, late = (
        run(replace(record, windows=record.windows + moved)) for moved in (-jitter, jitter)
    )
    slopes = np.zeros(early.shape)
    np.divide(late - early, 2.0 * record.jitter, out=slopes, where=record.jitter > 0.0)
    return run(record), slopes


def _sides(slopes: FloatArray, chords: FloatArray) -> FloatArray:
    """Slopes to both sides, (2, n): of a run, (n,), and of what is beside it.

    chords: (n - 1,), of that from each to the next.
    """
    before, behind = slopes[1:] + chords, slopes[:-1] + chords
    return np.array([np.append(behind[0], before), np.append(behind, before[-1])])


def _bend(chords: FloatArray) -> FloatArray:
    """Mean square around each, (n,), of how chords (n - 1,) change to the next."""
    bends = np.pad(np.diff(chords) ** 2, 1, mode="edge") if len(chords) > 1 else np.zeros(2)
    return _around(bends, _WIDE)


def _around(values: FloatArray, reach: int) -> FloatArray:
    """Means of each, (n,), and so many on each side."""
    width = 2 * reach + 1
    means: FloatArray = np.convolve(
        np.pad(values, reach, mode="edge"), np.full(width, 1.0 / width), "valid"
    )
    return means


def _distinct(record: Dataset, output: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows of an output that were measured, and which of them begin another window.

    And begin and end of each row's window in samples, (n_rows, 2).
    """
    rows = np.flatnonzero(np.isfinite(record.outputs[:, output]))
    spans = record.windows[rows, output] / record.dt + rows[:, None]
    changes = np.abs(np.diff(spans, axis=0)) > _SAME
    return rows, np.flatnonzero(np.append(len(rows) > 0, changes.any(axis=1))), spans
