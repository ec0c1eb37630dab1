"""The stretch of a record that is worth a closer look, where the whole is too dense to read."""

from collections.abc import Sequence

import numpy as np

from daq.hal import FloatArray

_LEGIBLE = 40  # swings that a panel as wide as a column shows apart
_SHOWN = 16  # swings of the closer look
_FEWEST = 20  # samples of it
_SWING = 0.5  # standard deviations to either side of the mean that a swing passes
_NOISE = 1.0  # variance of a signal's steps in parts of its own above which it is noise (which: 2)


def busiest_stretch(signals: Sequence[FloatArray]) -> slice | None:
    """Samples in which signals move most, a few swings of the fastest; None where all is legible.

    signals: each (n_samples,), NaN where nothing was measured.
    """
    n = len(signals[0])
    most = max(map(_swings, signals))
    if most <= _LEGIBLE:
        return None
    length = max(_FEWEST, round(n * _SHOWN / most))
    if 2 * length > n:
        return None
    motion = np.sum([_motion(values, length) for values in signals], axis=0)
    start = int(np.argmax(motion))
    return slice(start, start + length)


def _swings(values: FloatArray) -> int:
    """How often a signal goes from one side of its mean to the other; 0 for one that is noise."""
    present = values[np.isfinite(values)]
    if len(present) < 2:
        return 0
    centred, deviation = present - present.mean(), float(present.std())
    if not np.diff(present).var() < _NOISE * deviation**2:
        return 0
    sides = centred[np.abs(centred) > _SWING * deviation] > 0.0
    return int(np.count_nonzero(sides[1:] != sides[:-1]))


def _motion(values: FloatArray, length: int) -> FloatArray:
    """Variance within each window of so many samples, in parts of the signal's own."""
    present = np.isfinite(values)
    if not present.any():
        return np.zeros(len(values) - length + 1)
    centred = np.where(present, values - np.mean(values[present]), 0.0)

    def sums(terms: FloatArray) -> FloatArray:
        total = np.concatenate([[0.0], np.cumsum(terms)])
        return np.asarray(total[length:] - total[:-length])

    count = np.maximum(sums(present.astype(np.float64)), 1.0)
    variance = sums(centred**2) / count - (sums(centred) / count) ** 2
    whole = float(np.mean(centred[present] ** 2))
    return np.asarray(variance / whole) if whole > 0.0 else np.zeros_like(variance)
