"""Residuals and changes of the outputs, whitened by the residuals' autoregression."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit

from sysid.arrays import BoolArray, FloatArray
from sysid.uncertainty.colour import Autoregression, colour, fast_colour, record_rows
from sysid.uncertainty.sensitivity import Sensitivity
from sysid.uncertainty.slow_noise import SlowFilter

_OF_A_LINE = 2  # parameters


@dataclass(frozen=True)
class Whitener:
    """Takes the residuals' colour out of columns (n_residuals, n_outputs, k): (n_rows, k).

    kept: rows whose past the autoregression knows. decorrelate: (n_outputs, n_outputs). filters: of
    the outputs whose noise has a slow part, by their places.
    """

    model: Autoregression
    lengths: tuple[int, ...]
    kept: BoolArray
    decorrelate: FloatArray
    filters: Mapping[int, SlowFilter] = field(default_factory=dict)

    @classmethod
    def of(cls, local: Sensitivity, residual: FloatArray, slow: bool = True) -> Self:
        """By residuals (n_residuals, n_outputs); of outputs that do not count none are left.

        slow: whether their noise may have a slow part.
        """
        counted = local.objective.weights > 0.0
        measured = counted & local.seen
        residual = np.where(measured, residual, 0.0)
        if local.corrects:
            return cls._of_innovations(local, residual)
        model = colour_about_line(residual, local.seen, measured, local.lengths, slow)
        return cls.by(model, local.seen, local.lengths)

    @classmethod
    def by(cls, model: Autoregression, seen: BoolArray, lengths: Sequence[int]) -> Self:
        """By a colour; seen: (n_residuals, n_outputs), which samples were measured."""
        values, vectors = np.linalg.eigh(model.noise)
        floor = 1e-12 * max(float(values[-1]), 1e-300)
        roots = np.where(values > floor, 1.0 / np.sqrt(np.maximum(values, floor)), 0.0)
        whole = np.all(seen | ~seen.any(axis=0), axis=1)
        kept, order = whole.copy(), len(model.coefficients)
        for rows in record_rows(lengths):
            for k in range(1, order + 1):
                kept[rows][k:] &= whole[rows][:-k]
            kept[rows][:order] = False
        filters = model.filters(seen, lengths)
        return cls(model, tuple(lengths), kept, (vectors * roots) @ vectors.T, filters)

    @classmethod
    def _of_innovations(cls, local: Sensitivity, residual: FloatArray) -> Self:
        """By innovations, which are white, and of each output independent of the others'.

        An output that is seldom measured takes no row from the others.
        """
        q = residual.shape[1]
        squares = np.sum(residual**2, axis=0) / np.maximum(local.seen.sum(axis=0), 1)
        sizes = np.where(squares > 0.0, 1.0 / np.sqrt(np.maximum(squares, 1e-300)), 0.0)
        model = Autoregression(np.zeros((0, q, q)), np.diag(squares))
        return cls(model, local.lengths, np.ones(len(residual), dtype=bool), np.diag(sizes))

    @cached_property
    def n_outputs(self) -> int:
        """Columns of the residuals."""
        return len(self.decorrelate)

    @cached_property
    def _filter(self) -> FloatArray:
        """What makes a sample of it and those before, the oldest first, (q, (order + 1) q)."""
        parts = [-matrix for matrix in self.model.coefficients[::-1]]
        whole: FloatArray = self.decorrelate @ np.hstack([*parts, np.eye(self.n_outputs)])
        return whole

    def __call__(self, columns: FloatArray) -> FloatArray:
        """The whitened columns, rows of outputs one after another."""
        whole = np.zeros((self.n_outputs * int(self.kept.sum()), columns.shape[2]))
        for rows, places in self._records:
            if columns[rows].any():
                whole[places] = self.of_record(rows, columns[rows])
        return whole

    def in_time(self, residual: FloatArray) -> FloatArray:
        """Whitened residuals, (n_residuals, n_outputs) both, 0 where these have no whole past."""
        white = np.zeros_like(residual)
        white[self.kept] = self(residual[..., None]).reshape(-1, self.n_outputs)
        return white

    @cached_property
    def _records(self) -> list[tuple[slice, slice]]:
        """Each record's rows of the residuals and of the whitened columns."""
        return [(rows, self.rows_of(rows)) for rows in record_rows(self.lengths)]

    def of_record(self, rows: slice, columns: FloatArray) -> FloatArray:
        """Those of one record, (n_samples, n_outputs, k), by its rows of the residuals."""
        _, q, k = columns.shape
        felt = columns.any(axis=(0, 1))
        whole = np.zeros((q * int(self.kept[rows].sum()), k))
        order = len(self.model.coefficients)
        fast = np.array(columns[..., felt], order="C")
        for j, kalman in self.filters.items():
            fast[:, j] = kalman.innovations(fast[:, j], rows)
        white: FloatArray = _filtered(self._filter, fast)[self.kept[rows][order:]]
        whole[:, felt] = white.reshape(len(whole), int(felt.sum()))
        return whole

    def back(self, rows: slice, white: FloatArray) -> FloatArray:
        """Of columns' products with whitened ones (n_rows, k) what these are with any, of a record.

        Its transpose: (n_samples * n_outputs, k), by the record's rows of the residuals.
        """
        q, order = self.n_outputs, len(self.model.coefficients)
        kept = self.kept[rows]
        whole = np.zeros((len(kept), white.shape[1], q))
        whole[kept] = white[self.rows_of(rows)].reshape(-1, q, white.shape[1]).swapaxes(1, 2)
        pieces = whole[order:] @ self._filter  # (n_samples - order, k, (order + 1) q)
        back = np.zeros_like(whole)
        for lag in range(order + 1):
            back[lag : lag + len(pieces)] += pieces[..., lag * q : (lag + 1) * q]
        for j, kalman in self.filters.items():
            back[..., j] = kalman.back(back[..., j], rows)
        flat: FloatArray = back.swapaxes(1, 2).reshape(len(kept) * q, -1)
        return flat

    def rows_of(self, rows: slice) -> slice:
        """Rows of the whitened columns of one record, by its rows of the residuals."""
        first = int(self.kept[: rows.start].sum())
        count = int(self.kept[rows].sum())
        return slice(self.n_outputs * first, self.n_outputs * (first + count))


@njit(cache=True, nogil=True)
def _filtered(weights: FloatArray, columns: FloatArray) -> FloatArray:
    """Columns (n, q, k) of which each sample is made of it and those before, (n - order, q, k).

    weights: (q, (order + 1) q), the oldest first.
    """
    n, q, count = columns.shape
    size = weights.shape[1]
    flat = columns.reshape(n * q, count)
    white = np.zeros((max(n - size // q + 1, 0), q, count))
    for t in range(len(white)):
        for j in range(q):
            for i in range(size):
                for c in range(count):
                    white[t, j, c] += weights[j, i] * flat[t * q + i, c]
    return white


def colour_about_line(
    residual: FloatArray,
    seen: BoolArray,
    measured: BoolArray,
    lengths: tuple[int, ...],
    slow: bool = True,
) -> Autoregression:
    """Colour of residuals (n, q) about offset and drift, of outputs that these tell more of.

    They are no colour: an autoregression would take them for a memory without end, and whitening
    would erase them. Of noise as slow as a record they are part; Schwarz's criterion decides. Each
    record has a line of its own: what is off in one of several is no slow noise of all. slow:
    whether noise may have a slow part.
    """
    line = np.zeros_like(residual)
    for rows in record_rows(lengths):
        for j in np.flatnonzero(measured[rows].any(axis=0)):
            at = rows.start + np.flatnonzero(measured[rows, j])
            time = at - at.mean()
            slope = (time @ residual[at, j]) / max(float(time @ time), 1.0)
            line[at, j] = residual[at, j].mean() + slope * time
    columns = range(residual.shape[1])
    straight = [
        _is_straight(residual[:, [j]], line[:, [j]], seen[:, [j]], lengths, slow) for j in columns
    ]
    whole = colour if slow else fast_colour
    return whole(residual - np.where(straight, line, 0.0), seen, lengths)


def _is_straight(
    residual: FloatArray,
    line: FloatArray,
    seen: BoolArray,
    lengths: tuple[int, ...],
    slow: bool,
) -> bool:
    """Whether lines through an output's residuals, (n, 1), are more than slow noise makes of it."""
    lines = _OF_A_LINE * len(lengths) * math.log(max(len(residual), 2))
    # Beside slow noise a line is worth no more than it is without, and that is sooner asked.
    return bool(line.any()) and all(
        of(residual - line, seen, lengths).criterion + lines < of(residual, seen, lengths).criterion
        for of in (fast_colour, *([colour] if slow else []))
    )
