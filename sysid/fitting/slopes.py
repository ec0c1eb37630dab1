"""Slopes of residuals by search coordinates, where a start acts on the rows of its record alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray

_ROWS = 1024  # that are made orthogonal at once
_ROUNDING = 1e-15  # part of the largest eigenvalue, below which others are sums' rounding


@dataclass(frozen=True)
class SlopeBlock:
    """Slopes of some residuals: by other coordinates than ``columns`` they are zero.

    rows: of the residuals. columns: (k,). values: (n_rows, n_outputs, k).
    """

    rows: slice
    columns: IntArray
    values: FloatArray


@dataclass(frozen=True)
class Slopes:
    """Slopes J_j of outputs' residuals by n_free coordinates, in blocks of rows.

    >>> first = SlopeBlock(slice(0, 2), np.array([0, 1]), np.ones((2, 1, 2)))
    >>> second = SlopeBlock(slice(2, 3), np.array([0, 2]), np.full((1, 1, 2), 3.0))
    >>> slopes = Slopes((first, second), 3)
    >>> root, right = slopes.triangle(np.array([[1.0], [1.0], [2.0]]), np.ones(1))
    >>> (abs(root.T @ root)).round(9).tolist(), (root.T @ right).round(9).tolist()
    ([[11.0, 2.0, 9.0], [2.0, 2.0, 0.0], [9.0, 0.0, 9.0]], [8.0, 2.0, 6.0])
    """

    blocks: tuple[SlopeBlock, ...]
    n_free: int

    @classmethod
    def of(cls, values: FloatArray) -> Self:
        """Slopes (n_residuals, n_outputs, n_free) that may all be other than zero."""
        n_free = values.shape[2]
        return cls((SlopeBlock(slice(0, len(values)), np.arange(n_free), values),), n_free)

    @property
    def finite(self) -> BoolArray:
        """Of which coordinates all slopes are numbers, (n_free,)."""
        finite = np.ones(self.n_free, dtype=bool)
        for block in self.blocks:
            finite[block.columns] &= np.isfinite(block.values).all(axis=(0, 1))
        return finite

    @property
    def dense(self) -> FloatArray:
        """All of them, (n_residuals, n_outputs, n_free)."""
        last = self.blocks[-1]
        dense = np.zeros((last.rows.stop, last.values.shape[1], self.n_free))
        for block in self.blocks:
            dense[block.rows][..., block.columns] = block.values
        return dense

    def without(self, places: BoolArray) -> Slopes:
        """The same, with zeros by coordinates that are left out, (n_free,)."""
        blocks = []
        for block in self.blocks:
            kept = ~places[block.columns]
            blocks.append(SlopeBlock(block.rows, block.columns[kept], block.values[..., kept]))
        return Slopes(tuple(blocks), self.n_free)

    def triangle(self, residual: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
        """R and q of sum_j c_j |J_j d + e_j|^2 = |R d + q|^2 + what no step d changes.

        residual: e, (n_residuals, n_outputs); c: (n_outputs,). H = R'R would lose what is told by
        less than 1e-8 of the most. Slopes that are no numbers count as none.
        """
        n, parts = self.n_free, []
        for block in self.blocks:
            rows = _weighed(block.values, residual[block.rows], c)
            triangle = _factored(rows)
            wide = np.zeros((len(triangle), n + 1))
            wide[:, np.append(block.columns, n)] = triangle
            parts.append(wide)
        triangle = triangle_of(np.concatenate([*parts, np.zeros((n + 1, n + 1))]))
        return triangle[:n, :n], triangle[:n, n]

    def root(self, residual: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Other R and q of the same, from sums of products; takes a fifth of the time.

        What is told by less than 1e-8 of the most, column by column, is lost: enough for slopes by
        differences, which know no more.
        """
        hessian, slope = self._products(residual, c)
        if not np.isfinite(hessian).all():
            hessian, slope = self.without(~self.finite)._products(residual, c)
        size = np.sqrt(np.diag(hessian))
        size = np.where(size > 0.0, size, 1.0)
        values, axes = np.linalg.eigh(hessian / np.outer(size, size))
        roots = np.sqrt(np.where(values > _ROUNDING * values[-1], values, 0.0))
        back = np.divide(1.0, roots, out=np.zeros_like(roots), where=roots > 0.0)
        return (roots * axes).T * size, back * ((slope / size) @ axes)

    def _products(self, residual: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
        """sum_j c_j J_j'J_j, (n_free, n_free), and sum_j c_j J_j'e_j, (n_free,)."""
        hessian, slope = np.zeros((self.n_free, self.n_free)), np.zeros(self.n_free)
        with np.errstate(over="ignore", invalid="ignore"):
            for block in self.blocks:
                for j in np.flatnonzero(c > 0.0).tolist():
                    values = block.values[:, j]
                    across = c[j] * values.T
                    hessian[np.ix_(block.columns, block.columns)] += across @ values
                    slope[block.columns] += across @ residual[block.rows, j]
        return hessian, slope

    def along(self, steps: FloatArray, output: int) -> FloatArray:
        """Changes J_j d of an output's residuals by steps d, (n, n_free): (n, n_residuals)."""
        parts = [steps[:, block.columns] @ block.values[:, output].T for block in self.blocks]
        return np.concatenate(parts, axis=1)

    def pushes(self, errors: FloatArray, output: int) -> FloatArray:
        """J_j' e of an output's errors e, (n, n_residuals): (n, n_free)."""
        pushes = np.zeros((len(errors), self.n_free))
        for block in self.blocks:
            pushes[:, block.columns] += errors[:, block.rows] @ block.values[:, output]
        return pushes


def _weighed(values: FloatArray, residual: FloatArray, c: FloatArray) -> FloatArray:
    """Rows of slopes and residuals (n * n_counted, k + 1) times the root of c."""
    counted, k = np.flatnonzero(c > 0.0), values.shape[2]
    rows = np.empty((len(values), len(counted), k + 1))
    roots = np.sqrt(c[counted])[:, None]
    everything = len(counted) == len(c)
    np.multiply(values if everything else values[:, counted], roots, out=rows[..., :k])
    rows[..., k] = residual[:, counted] * roots[:, 0]
    if not np.isfinite(rows.sum()):  # a number that is none, or a sum too large for one
        rows[..., :k][~np.isfinite(rows[..., :k])] = 0.0
    return rows.reshape(-1, k + 1)


def _factored(rows: FloatArray) -> FloatArray:
    """A triangle, or fewer rows than it has, of rows (m, n): first of parts that a cache holds."""
    n = rows.shape[1]
    whole = len(rows) // _ROWS * _ROWS
    parts = triangle_of(rows[:whole].reshape(-1, _ROWS, n))
    return triangle_of(np.concatenate([parts.reshape(-1, n), rows[whole:]]))


def triangle_of(rows: FloatArray) -> FloatArray:
    """Triangles R of matrices A, (..., m, n), with R'R = A'A, (..., min(m, n), n)."""
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)


def joined(slopes: Slopes, row: FloatArray) -> Slopes:
    """Slopes with one residual more, whose slopes are (n_outputs, n_free)."""
    first = slopes.blocks[-1].rows.stop
    last = SlopeBlock(slice(first, first + 1), np.arange(slopes.n_free), row[None])
    return Slopes((*slopes.blocks, last), slopes.n_free)
