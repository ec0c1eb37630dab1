"""Means over windows as a filter takes them in: each once, in the sample in which it ends."""

from dataclasses import replace

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.problem.data import Dataset

_SAME = 1e-6  # samples by which windows of one mean differ for the arithmetic's sake
_INSIDE = 1e-3  # samples behind the end of a sample where a window that is cut begins
# Overlap [samples] that comes of ends which are known so well only, and the share of long windows
# that may overlap more.
_OVERLAP, _FEW = 1.0, 0.05
# Of the mean square of the slopes around, which that beside a mean is taken for at least: where it
# seems to rest, between two turns, it does not.
_AROUND = 0.25


def each_mean_once(record: Dataset) -> Dataset:
    """The record with every mean once, where its window ends, and NaN in the rows between.

    Rows that tell of the same window, perhaps before it has ended, repeat its mean. Their jitter
    is such that all of them count as one; that of the one is less by the root of their number.
    An output whose windows overlap stays as it is, and so does the first row, where states start.

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
    jitter = record.jitter.astype(np.float64)
    for j in np.flatnonzero(record.windows.any(axis=(0, 2))).tolist():
        rows, firsts, spans = _distinct(record, j)
        if not len(rows):
            continue
        counts = np.diff(np.append(firsts, len(rows)))
        ends = np.ceil(spans[firsts, 1] - _SAME).astype(np.int64)
        within = (spans[firsts, 0] > -_SAME) & (ends > 0) & (ends < record.n_samples)
        # Of two that end in a sample the later one.
        within &= np.append(np.diff(ends) > 0, True)
        firsts, counts, ends = firsts[within], counts[within], ends[within]
        begins = _apart(spans[firsts, 0], ends)
        if begins is None:
            continue
        moved = np.stack([begins, spans[firsts, 1]], axis=1) - ends[:, None]
        values, jitters = outputs[rows[firsts], j], jitter[rows[firsts], j] / np.sqrt(counts)
        outputs[1:, j], windows[1:, j], jitter[1:, j] = np.nan, 0.0, 0.0
        outputs[ends, j], windows[ends, j], jitter[ends, j] = values, moved * record.dt, jitters
    return replace(record, outputs=outputs, windows=windows, jitter=jitter)


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


def scatter(record: Dataset) -> FloatArray:
    """Variances (n_samples, n_outputs) that the jitter of the windows makes of their means.

    By how fast an output changes to the means before and behind each, as measured, without what
    the jitter itself does to that: a free run changes by the noise of its inputs as well. Not by
    the slope from one neighbour to the other, which is none where a speed has its peak.

    >>> windows = np.tile([-1.0, 0.0], (4, 1, 1))
    >>> ramp = Dataset(np.ones(4), [1, 3, 5, 7], 1.0, windows=windows, jitter=np.full((4, 1), 0.1))
    >>> np.sqrt(scatter(ramp))[:, 0].round(3)
    array([0.198, 0.198, 0.198, 0.198])
    >>> np.sqrt(scatter(replace(ramp, outputs=np.array([[1], [3], [1], [-1]]))))[:, 0].round(3)
    array([0.198, 0.198, 0.198, 0.198])
    """
    variances = np.zeros(record.outputs.shape)
    if not (record.windows.size and record.jitter.any()):
        return variances
    for j in np.flatnonzero(record.windows.any(axis=(0, 2))).tolist():
        rows, firsts, spans = _distinct(record, j)
        if len(firsts) < 2:
            continue
        apart = np.maximum(record.dt * np.diff(spans[firsts].mean(axis=1)), _SAME * record.dt)
        jitter, counts = record.jitter[rows, j], np.diff(np.append(firsts, len(rows)))
        squares = jitter[firsts] ** 2 / counts
        changes = np.diff(record.outputs[rows[firsts], j]) ** 2
        slopes = changes / (apart**2 + squares[1:] + squares[:-1])
        slopes = np.maximum(mean_of_sides(slopes), _AROUND * _mean_around(slopes))
        place = np.searchsorted(firsts, np.arange(len(rows)), side="right") - 1
        variances[rows, j] = slopes[place] * jitter**2
    return variances


def _mean_around(between: FloatArray) -> FloatArray:
    """As ``mean_of_sides`` the mean of three on each side, (n - 1,) to (n,)."""
    padded = np.pad(between, 3, mode="edge")
    mean: FloatArray = np.convolve(padded, np.full(6, 1.0 / 6.0), "valid")
    return mean


def mean_of_sides(between: FloatArray) -> FloatArray:
    """Of what is between neighbours, (n - 1, ...), the mean of both sides of each, (n, ...).

    >>> mean_of_sides(np.array([4.0, 2.0]))
    array([4., 3., 2.])
    """
    mean: FloatArray = 0.5 * (
        np.concatenate([between[:1], between]) + np.concatenate([between, between[-1:]])
    )
    return mean


def _distinct(record: Dataset, output: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows of an output that were measured, and which of them begin another window.

    And begin and end of each row's window in samples, (n_rows, 2).
    """
    rows = np.flatnonzero(np.isfinite(record.outputs[:, output]))
    spans = record.windows[rows, output] / record.dt + rows[:, None]
    changes = np.abs(np.diff(spans, axis=0)) > _SAME
    return rows, np.flatnonzero(np.append(len(rows) > 0, changes.any(axis=1))), spans
