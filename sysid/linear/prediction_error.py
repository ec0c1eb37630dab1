"""Prediction-error minimisation of one output's equation, X theta + C(q) e = y.

1/C(q) started at zero leaves r = e + K h of the noise, where h are the nc values of e before a
record, or within a gap: taken for zero, as is common, they bias a C that forgets slowly.
S = (I + K K')^-1/2 makes r white, S^2 r is the likeliest e, and its likelihood is largest where

    loss(theta, c) = |S C^-1 (y - X theta)|^2 det(I + K K')^(1/n)

is least (Box & Jenkins, Time Series Analysis, chapter 7). Least squares eliminate theta (variable
projection: Golub & Pereyra, Inverse Problems 19 (2003) R1-R26, with Kaufman's Jacobian J), so
that Levenberg and Marquardt's steps search the few coefficients of C only,

    (J'J + D + damping diag(J'J)) step = -slope,    C(q) de/dc_l = -q^-l e,

C's roots kept inside the unit circle. D, which matters for roots near the circle, is what J'J
leaves out, learnt from how the slope changes (Dennis, Gay & Welsch, ACM Transactions on
Mathematical Software 7 (1981) 348-368). Ljung, System Identification, chapters 7 and 10.
"""

from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy.linalg
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import lapack

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.linear.polynomials import Layout, filtered
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError

_TOLERANCE = 1e-2  # of a standard error: an iteration that promises less is not worth it
_LEAST_GAIN = 1e-4  # of log likelihood: an iteration that gains less is the last
_MOST_DAMPING = 1e8  # a step this short that does not help ends the search
_ROUNDING = 1e-11  # of the signal: below it there is no noise to model
_NOISE_RADIUS = 0.999  # a C that forgets more slowly needs thousands of samples to start

# Regressors and target (n, p + 1), and instants (n,): rows follow where they grow by one.
Equation = tuple[FloatArray, IntArray]


class Stack:
    """Records one below the other, each followed by a row of NaN.

    outputs: (n, q); signals: (n, q + m + 1), what A, B and the offset weigh: minus the outputs,
    inputs, 1. age: (n,), number of a row in its record, -1 between records.
    """

    def __init__(self, records: list[Dataset]) -> None:
        tables = [np.column_stack((r.outputs, -r.outputs, r.inputs)) for r in records]
        padded = [np.pad(table, ((0, 1), (0, 1)), constant_values=np.nan) for table in tables]
        table, q = np.vstack(padded), records[0].outputs.shape[1]
        table[:, -1] = 1.0
        self.outputs, self.signals = table[:, :q], table[:, q:]
        self.age = np.concatenate([np.append(np.arange(r.n_samples), -1) for r in records])

    def equations(self, layout: Layout, lag: int, A: FloatArray | None = None) -> list[Equation]:
        """Of all outputs, on rows with a past of ``lag`` ones; for a given A, of the rest."""
        target, free, equations = self.outputs, layout.free.copy(), []
        if A is not None:
            free[:, : len(A[0])] = False
            # The last row of the stack is lost, as are those before the first.
            lost = np.full((len(A) - 2, len(A[0])), np.nan)
            target = target + filtered(A[1:], np.roll(np.vstack((lost, target)), 1, axis=0))
        for row, signals in enumerate(free):
            columns, position = self.rows(signals[:-1], target[:, [row]], lag)
            if len(columns) <= signals.sum():
                raise ModelError(
                    f"output {row} has {len(columns)} rows with a complete past for "
                    f"{signals.sum()} coefficients: lower na, nb or nc, or give longer records "
                    "with fewer lost samples"
                )
            equations.append((columns, position))
        return equations

    def rows(self, free: BoolArray, target: FloatArray, lag: int) -> Equation:
        """Those with a past of ``lag`` ones and no lost sample; free: signals and lags to weigh."""
        rows, (signals, lags) = np.flatnonzero(self.age >= lag), np.nonzero(free)
        weighed = self.signals.T[signals[:, None], rows - lags[:, None]]
        columns = np.vstack((weighed, target[rows].T)).T
        complete = np.isfinite(columns).all(axis=1)
        return columns[complete], rows[complete]

    def first_guesses(self, layout: Layout, equations: list[Equation]) -> list[list[FloatArray]]:
        """Of each output's C, none where data are too few: Hannan & Rissanen, Biometrika 69 (1982).

        A long ARX model makes the noise visible, whose past then counts as more measured signals.
        """
        (q, m), n, nc = layout.nb.shape, int(np.sum(self.age >= 0)), int(layout.nc.max())
        # The noise's past must fit into the ARX order, and the ARX model into the data.
        length = min(max(layout.lag + nc, round(3.0 * np.log(max(n, 2)))), n // (4 * (q + m)))
        if nc == 0 or length < 1:
            return [[]] * q
        nk, guesses, noise = np.minimum(layout.nk, length), [], np.full_like(self.outputs, np.nan)
        long = Layout(q, m, na=length, nb=length + 1 - nk, nc=0, nk=nk, offset=layout.offset)
        columns, rows = self.rows(long.free[0, :-1], self.outputs, long.lag)
        p = columns.shape[1] - q
        if len(rows) >= 2 * p:
            noise[rows] = least_squares(columns, p)[1]
        for nc, e, (columns, rows) in zip(layout.nc, noise.T, equations, strict=True):
            seen, p, past = np.isfinite(e[rows]), columns.shape[1] - 1 + nc, np.zeros_like(e)
            past[rows[seen]] = e[rows[seen]]
            past = past[np.maximum(rows[seen, None] - np.arange(1, nc + 1), -1)]
            signals = np.column_stack((columns[seen, :-1], past, columns[seen, -1]))
            enough = nc and len(signals) > p
            guesses.append([least_squares(signals, p)[0][p - nc :, 0]] if enough else [])
        return guesses


def least_squares(columns: FloatArray, p: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit the first p columns of (n, p + k) to the others; of several solutions the shortest.

    Solution (p, k), residual (n, k) and orthonormal directions of the regressors (n, rank).
    """
    regressors, target = columns[:, :p], columns[:, p:]
    # scipy.linalg.qr takes twice as long, most of it to copy.
    room = 64 * columns.shape[1]
    factored, scales, *_ = lapack.dgeqrf(columns, lwork=room)
    factor = np.triu(factored[:p, :p])
    least = len(columns) * np.finfo(float).eps * np.linalg.norm(factor, axis=0)
    if np.all(np.abs(np.diag(factor)) > least):
        solution = scipy.linalg.solve_triangular(factor, factored[:p, p:], check_finite=False)
        Q, *_ = lapack.dorgqr(factored[:, : len(scales)], scales, lwork=room)
        basis = np.asarray(Q[:, :p], dtype=np.float64)
    else:  # they are dependent
        gain, basis, _ = influence(regressors)
        solution = gain @ target
    return solution, target - regressors @ solution, basis


def influence(sensitivity: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Of noise in n rows on parameters (p, n), the pseudo-inverse of their sensitivity (n, p).

    And orthonormal directions of the rows (n, rank); whether the data tell a parameter (p,).
    """
    lengths = np.linalg.norm(sensitivity, axis=0)
    lengths[lengths == 0.0] = 1.0
    U, s, V = np.linalg.svd(sensitivity / lengths, full_matrices=False)
    rank = int(np.sum(s > len(U) * np.finfo(float).eps * s.max(initial=0.0)))
    gain = ((V[:rank].T / s[:rank]) @ U[:, :rank].T) / lengths[:, None]
    return gain, U[:, :rank], np.linalg.norm(V[rank:], axis=0) < 1e-6


class EquationFit:
    """One equation at a given C(q), its other coefficients by least squares.

    c: (nc,), C's coefficients after the leading 1; theta: (p,); residual: (n,), S r; errors:
    (n,), the likeliest e; log_det: of I + K K'; iterations, converged: of the search.
    """

    iterations = 0
    converged = True

    def __init__(self, columns: FloatArray, position: IntArray, c: FloatArray) -> None:
        self.position, self.c = position, c
        n, nc = len(columns), len(c)
        self._bands = np.zeros((nc + 1, n), order="F")
        self._bands[0] = 1.0
        for lag in range(1, min(nc, n - 1) + 1):
            self._bands[lag, :-lag] = c[lag - 1] * (position[lag:] - position[:-lag] == lag)
        edges = [0, *(np.flatnonzero(np.diff(position) != 1) + 1).tolist(), n]
        self._runs = [slice(start, stop) for start, stop in pairwise(edges)]
        past = np.zeros((n, nc))
        for run in self._runs:
            past[run][:nc] = scipy.linalg.hankel(c)[: run.stop - run.start]
        self._K = self._inverse(past)
        # K V and s of each run's K'K = V diag(s^2 - 1) V'.
        eigen = [np.linalg.eigh(self._K[run].T @ self._K[run]) for run in self._runs]
        self._s = [np.sqrt(1.0 + np.maximum(values, 0.0)) for values, _ in eigen]
        self._KV = [self._K[run] @ V for run, (_, V) in zip(self._runs, eigen, strict=True)]
        self.log_det = 2.0 * float(np.log(self._s).sum())
        self._white = self._whitened(self._inverse(columns))
        solution, residual, self._basis = least_squares(self._white, columns.shape[1] - 1)
        self.theta, self.residual = solution[:, 0], residual[:, 0]
        self.errors = self._whitened(residual)[:, 0]
        self._squares = float(self.residual @ self.residual)
        self.loss = self._squares * np.exp(self.log_det / n)

    def _inverse(self, columns: FloatArray, trans: Literal["N", "T"] = "N") -> FloatArray:
        """1/C(q) of each column, (n, k), from zero at the start of each run; or its transpose."""
        inverse, _ = lapack.dtbtrs(self._bands, columns, uplo="L", trans=trans, diag="U")
        return np.asarray(inverse, dtype=np.float64)

    def _whitened(self, columns: FloatArray) -> FloatArray:
        """S of each column, (n, k)."""
        white = columns.copy(order="K")
        for run, K, s in zip(self._runs, self._KV, self._s, strict=True):
            white[run] -= K @ ((K.T @ columns[run]) / (s * (1.0 + s))[:, None])
        return white

    @cached_property
    def sensitivity(self) -> FloatArray:
        """Minus the derivatives of the residual by (theta, c), but for a rotation, (n, p + nc)."""
        past = [_earlier(self._K[run].T @ self.errors[run], self.errors[run]) for run in self._runs]
        return np.hstack((self._white[:, :-1], self._whitened(self._inverse(np.vstack(past)))))

    @cached_property
    def descent(self) -> tuple[FloatArray, FloatArray]:
        """Downhill direction of log(loss) / 2, (nc,), and Gauss and Newton's curvature (nc, nc)."""
        slopes = self.sensitivity[:, len(self.theta) :]
        J = slopes - self._basis @ (self._basis.T @ slopes)
        # log det (I + K K') changes by 2 tr(K' S^2 dK/dc_l), and K are the errors that unit
        # errors before the first row leave, so that dK/dc_l follows from the same recursion.
        weights = self._inverse(self._whitened(self._whitened(self._K)), "T")
        past = [_earlier(np.eye(len(self.c)), -self._K[run]) for run in self._runs]
        volume = np.einsum("tj,tjl->l", weights, np.concatenate(past)) / len(J)
        return J.T @ self.residual / self._squares - volume, J.T @ J / self._squares


def fit_equation(equation: Equation, nc: int, starts: list[FloatArray], limit: int) -> EquationFit:
    """Maximise the likelihood of an equation from C = 1 or ``starts``, in so many iterations."""
    n, fit = len(equation[0]), EquationFit(*equation, np.zeros(nc))
    if nc == 0 or fit.loss <= (_ROUNDING * np.linalg.norm(equation[0][:, -1])) ** 2:
        return fit
    fits = [EquationFit(*equation, _inside(start, mirrored=True)) for start in starts]
    fit = min([fit, *fits], key=lambda fit: fit.loss)
    learnt, damping = np.zeros((nc, nc)), 1e-3
    for iteration in range(1, limit + 1):
        downhill, curvature = fit.descent
        # What the undamped step promises; the loss rises by 1/n of itself one standard error off.
        if downhill @ np.linalg.lstsq(curvature, downhill)[0] <= _TOLERANCE**2 / n:
            return fit
        trial = fit
        while trial.loss >= fit.loss:
            if damping > _MOST_DAMPING:
                # On the rim of the stable region no step helps: that is the minimum there.
                return fit
            damped = curvature + damping * np.diag(np.diag(curvature) + 1e-12 * curvature.trace())
            # Only downhill: where what was learnt spoils that, it is left out.
            convex = np.linalg.eigvalsh(damped + learnt)[0] > 0.0
            step = np.linalg.solve(damped + learnt if convex else damped, downhill)
            trial = EquationFit(*equation, _inside(fit.c + step))
            damping *= 10.0
        damping = max(damping / 100.0, 1e-9)
        trial.iterations = iteration
        if 0.5 * n * np.log(fit.loss / trial.loss) < _LEAST_GAIN:
            return trial
        learnt = _secant(learnt, fit, trial)
        fit = trial
    fit.converged = False
    return fit


def _secant(learnt: FloatArray, fit: EquationFit, trial: EquationFit) -> FloatArray:
    """What the step from one fit to the next teaches of the curvature, (nc, nc)."""
    step, change = trial.c - fit.c, fit.descent[0] - trial.descent[0]
    along, wanted = float(change @ step), change - trial.descent[1] @ step
    if along <= 0.0:
        return learnt
    present = abs(float(step @ learnt @ step))
    learnt = learnt * min(1.0, abs(float(step @ wanted)) / present) if present else learnt
    miss = wanted - learnt @ step
    cross = np.outer(miss, change) / along
    return learnt + cross + cross.T - (miss @ step) * np.outer(change, change) / along**2


def _earlier(before: FloatArray, values: FloatArray) -> FloatArray:
    """Values 1, 2, ... rows earlier, (n, ..., nc); before: (nc, ...), those before the first."""
    joined = np.concatenate((before[::-1], values))
    return sliding_window_view(joined, len(before), axis=0)[: len(values), ..., ::-1]


def _inside(c: FloatArray, mirrored: bool = False) -> FloatArray:
    """C(q) with roots beyond ``_NOISE_RADIUS`` moved back to it, or ``mirrored`` at the circle."""
    roots = np.roots(np.concatenate(([1.0], c)))
    size = np.maximum(np.abs(roots), np.finfo(float).tiny)
    if np.all(size <= _NOISE_RADIUS):
        return c
    limit = np.minimum(1.0 / size, _NOISE_RADIUS) if mirrored else _NOISE_RADIUS
    moved = np.where(size > _NOISE_RADIUS, roots / size * limit, roots)
    return np.asarray(np.real(np.poly(moved))[1:], dtype=np.float64)
