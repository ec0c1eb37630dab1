"""Samples that stand in two records: a copy proves nothing, and counts twice."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sysid.arrays import FloatArray
from sysid.problem.channels import noise, resolution
from sysid.problem.data import Dataset

UIntArray = npt.NDArray[np.uint64]

_RARE = 4  # times that a row may stand in a record and still be told from others


def shared_samples(records: Sequence[Dataset]) -> FloatArray:
    """Share of a record's rows, where it moves, that stand in another, (n_records, n_records).

    Entry [i, j] is the share of record i that stands in record j. Rows are compared by their
    content, all inputs and outputs, bit for bit, and count where the row that follows is the same
    in both. Rows that are common, as those at rest are, say nothing. A record whose outputs differ
    by less than noise from another's, or from a part of it, is a copy with other digits. NaN of a
    record with itself.

    >>> rows = np.random.default_rng(0).standard_normal((400, 2))
    >>> whole = Dataset(rows[:, :1], rows[:, 1:], dt=0.01)
    >>> shared_samples([whole.part(100, 200, "cut"), whole])[0, 1].item()
    1.0
    """
    shares = np.full((len(records), len(records)), np.nan)
    contents = [_contents(record) for record in records]
    for j, source in enumerate(contents):
        distinct, first, counts = np.unique(source, return_index=True, return_counts=True)
        for i, rows in enumerate(contents):
            if i == j:
                continue
            place = np.minimum(np.searchsorted(distinct, rows), len(distinct) - 1)
            same = (distinct[place] == rows) & (counts[place] <= _RARE)
            followed = same[:-1] & same[1:] & (np.diff(first[place]) == 1)
            moving = rows[1:] != rows[:-1]
            shares[i, j] = (followed & moving).sum() / max(moving.sum(), 1)
            if shares[i, j] < 1.0:
                shares[i, j] = max(shares[i, j], _rewritten(records[i], records[j]))
    return shares


def _rewritten(record: Dataset, source: Dataset) -> float:
    """Share of a record that is in another, or all of that, written with other digits."""
    if record.outputs.shape[1] != source.outputs.shape[1]:
        return 0.0
    short, long = record, source
    if record.n_samples > source.n_samples:
        short, long = source, record
    measured = [np.isfinite(each.outputs).any(axis=0) for each in (short, long)]
    if not (measured[0] & measured[1]).any():
        return 0.0
    j = int(np.argmax(measured[0] & measured[1]))
    place = _place(short.outputs[:, j], long.outputs[:, j])
    part = long.outputs[place : place + short.n_samples]
    return short.n_samples / record.n_samples if _same(short.outputs, part) else 0.0


def _place(part: FloatArray, whole: FloatArray) -> int:
    """Where in a channel (n,) a shorter one (m,) is most like it, by the squares of differences."""
    a, b = (np.where(np.isfinite(y), y, np.nanmean(y)) - np.nanmean(whole) for y in (part, whole))
    squares = np.concatenate([[0.0], np.cumsum(b**2)])
    size = 1 << (len(a) + len(b)).bit_length()  # scipy.signal, which has it, takes a second to load
    products = np.fft.irfft(np.fft.rfft(b, size) * np.fft.rfft(a[::-1], size), size)
    products = products[len(a) - 1 : len(b)]
    return int(np.argmin(squares[len(a) :] - squares[: -len(a)] - 2.0 * products))


def _same(outputs: FloatArray, originals: FloatArray) -> bool:
    """Whether outputs of as many rows are one, written with other digits.

    They are nearer than noise lets two records be, or than half a unit of the last digit.
    """
    moves = False
    for y, original in zip(outputs.T, originals.T, strict=True):
        both = np.isfinite(y) & np.isfinite(original)
        if not both.any():
            continue
        difference = np.abs(y - original)[both].max(initial=0.0)
        if difference > 0.1 * np.nanstd(original):
            return False
        digit = max(resolution(y), resolution(original))
        if difference > max(0.51 * digit, noise(original)):
            return False
        moves |= digit > 0.0
    return moves


def _contents(record: Dataset) -> UIntArray:
    """A number for each row, (n,), alike where its inputs and outputs are."""
    rows = np.column_stack([record.inputs, record.outputs])
    # Zeros of either sign are alike, and so are lost samples.
    words = np.ascontiguousarray(np.where(np.isnan(rows), np.nan, rows + 0.0)).view(np.uint64)
    odd = np.random.default_rng(0).integers(0, 2**63, words.shape[1], dtype=np.uint64) * 2 + 1
    keys: UIntArray = ((words ^ (words >> np.uint64(32))) * odd).sum(axis=1)
    return keys
