"""One output's equation as a regression, over records and gaps; least squares on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.linear.orders import Orders, Term
from sysid.problem.data import Dataset


@dataclass(frozen=True)
class Equations:
    """Rows of target = regressors @ theta + noise that all data are known for.

    target: (n,); regressors: (n, p); position: (n,) instants, counted through all records with
    a gap between them: rows follow each other in time where it grows by one.
    """

    target: FloatArray
    regressors: FloatArray
    position: IntArray

    def take(self, rows: BoolArray) -> Equations:
        """The equations of some rows only."""
        return Equations(self.target[rows], self.regressors[rows], self.position[rows])


def equations(records: Sequence[Dataset], orders: Orders, row: int, lag: int) -> Equations:
    """The equation of output ``row`` at every instant with a complete past of ``lag`` rows.

    None reaches across the boundary of a record, and those with a lost sample are left out.
    """
    terms = orders.linear_terms(row)
    blocks, targets, positions = [], [], []
    start = 0
    for record in records:
        n = record.n_samples
        if n > lag:
            blocks.append(_regressors(record, terms, lag))
            targets.append(record.outputs[lag:, row])
            positions.append(start + np.arange(lag, n))
        start += n + 1
    if not blocks:
        return Equations(np.zeros(0), np.zeros((0, len(terms))), np.zeros(0, dtype=np.int64))
    found = Equations(np.concatenate(targets), np.vstack(blocks), np.concatenate(positions))
    return found.take(np.isfinite(found.target) & np.isfinite(found.regressors).all(axis=1))


def _regressors(record: Dataset, terms: Sequence[Term], lag: int) -> FloatArray:
    n = record.n_samples
    matrix = np.empty((n - lag, len(terms)), order="F")
    for column, term in enumerate(terms):
        rows = slice(lag - term.lag, n - term.lag)
        if term.polynomial == "a":
            matrix[:, column] = -record.outputs[rows, term.column]
        elif term.polynomial == "b":
            matrix[:, column] = record.inputs[rows, term.column]
        else:
            matrix[:, column] = 1.0
    return matrix


def delayed(values: FloatArray, position: IntArray, lag: int) -> FloatArray:
    """Values ``lag`` instants earlier, zero where a gap or a boundary lies between; (n,)."""
    result = np.zeros_like(values)
    if lag < len(values):
        unbroken = position[lag:] - position[: len(position) - lag] == lag
        result[lag:] = np.where(unbroken, values[: len(values) - lag], 0.0)
    return result


@dataclass(frozen=True)
class LeastSquares:
    """Solution (p,) and residual (n,) of one target, or (p, k) and (n, k) of several.

    columns: (n, rank) independent directions of the regressors; factor: (rank, rank), upper
    triangular with factor.T @ factor = columns.T @ columns.
    """

    solution: FloatArray
    residual: FloatArray
    columns: FloatArray
    factor: FloatArray

    def unexplained(self, values: FloatArray) -> FloatArray:
        """What is left of other columns (n, k) when the regressors are fitted to them too."""
        inner = scipy.linalg.solve_triangular(self.factor, self.columns.T @ values, trans=1)
        result: FloatArray = values - self.columns @ scipy.linalg.solve_triangular(
            self.factor, inner
        )
        return result


def least_squares(regressors: FloatArray, target: FloatArray) -> LeastSquares:
    """Minimise |target - regressors @ theta|; of several solutions the shortest in scaled units.

    QR on columns scaled to length one; singular value decomposition where they are dependent.
    Ljung, System Identification, section 10.1.
    """
    p = regressors.shape[1]
    scale = _lengths(regressors)
    columns = regressors / scale
    R: FloatArray = np.asarray(np.linalg.qr(np.column_stack((columns, target)), mode="r"))
    factor, pivots = R[:p, :p], np.abs(np.diag(R[:p, :p]))
    tolerance = max(regressors.shape) * np.finfo(float).eps
    if p == 0 or (len(R) >= p and pivots.min() > tolerance * pivots.max()):
        solution = scipy.linalg.solve_triangular(factor, R[:p, p:])
    else:
        columns, s, V = np.linalg.svd(columns, full_matrices=False)
        rank = int(np.sum(s > tolerance * s[0]))
        columns, factor = columns[:, :rank], np.eye(rank)
        solution = (V[:rank].T / s[:rank]) @ (columns.T @ target.reshape(len(target), -1))
    solution = (solution.T / scale).T.reshape((p, *target.shape[1:]))
    return LeastSquares(solution, target - regressors @ solution, columns, factor)


@dataclass(frozen=True)
class Influence:
    """How the parameters follow the noise.

    gain: (p, n), change of each parameter per noise; determined: (p,), whether the data tell a
    parameter at all; rank: how many combinations of parameters they tell.
    """

    gain: FloatArray
    determined: BoolArray
    rank: int


def influence(sensitivity: FloatArray) -> Influence:
    """Of noise in each row on parameters of a given sensitivity, (n, p)."""
    scale = _lengths(sensitivity)
    U, s, V = np.linalg.svd(sensitivity / scale, full_matrices=False)
    rank = int(np.sum(s > max(sensitivity.shape) * np.finfo(float).eps * s[0])) if len(s) else 0
    gain = ((V[:rank].T / s[:rank]) @ U[:, :rank].T) / scale[:, None]
    return Influence(gain, np.linalg.norm(V[rank:], axis=0) < 1e-6, rank)


def _lengths(columns: FloatArray) -> FloatArray:
    length = np.linalg.norm(columns, axis=0)
    return np.where(length > 0.0, length, 1.0)
