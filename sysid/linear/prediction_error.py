"""Prediction-error minimisation of one output's equation, X theta + C(q) e = y.

1/C(q) started at zero leaves r = e + K h of the noise, where h are the values of e at the nc
instants before the first, as large as any others: taken for zero, as is common, they bias a C
that forgets slowly. S = (I + K K')^-1/2 makes r white, S^2 r is the likeliest e, and the
likelihood, for the best variance of the n values of e, is largest where

    loss(theta, c) = |S C^-1 (y - X theta)|^2 det(I + K K')^(1/n)

is least. The first row of a record, or after a gap, has a past of its own (Box & Jenkins, Time
Series Analysis, chapter 7). theta is eliminated by least squares, so that the search is over the
few coefficients of C only (variable projection: Golub & Pereyra, Inverse Problems 19 (2003)
R1-R26, with Kaufman's Jacobian J), by Levenberg and Marquardt's steps

    (J'J + D + damping diag(J'J)) step = -slope,    C(q) de/dc_l = -q^-l e,

C's roots kept inside the unit circle. D is what Gauss and Newton's J'J leaves out, which matters
for roots near the circle, learnt from how the slope changes (Dennis, Gay & Welsch, ACM
Transactions on Mathematical Software 7 (1981) 348-368). Ljung, System Identification, sections
7.2 to 7.4 and 10.1 to 10.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import lapack

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.linear.polynomials import Layout, filtered
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError

# An iteration is not worth it when it promises to move the coefficients by less than this share
# of their standard errors, or gains less than this in the logarithm of the likelihood.
_TOLERANCE, _LEAST_GAIN = 1e-2, 1e-4
# A step this short that does not help ends the search.
_MOST_DAMPING = 1e8
# Below this share of the signal a residual is rounding; there is no noise to model.
_ROUNDING = 1e-11
# A noise model that forgets more slowly than this needs thousands of samples to start.
_NOISE_RADIUS = 0.999


class Stack(NamedTuple):
    """Records one below the other, each followed by a row of NaN.

    outputs: (n, q); signals: (n, q + m + 1), what A, B and the offset weigh: minus the outputs,
    inputs, 1. age: (n,), number of a row in its record, -1 between records.
    """

    outputs: FloatArray
    signals: FloatArray
    age: IntArray

    @classmethod
    def of(cls, records: Sequence[Dataset]) -> Stack:
        """All rows of the records."""
        tables = [np.column_stack((r.outputs, -r.outputs, r.inputs)) for r in records]
        padded = [np.pad(table, ((0, 1), (0, 1)), constant_values=np.nan) for table in tables]
        table, q = np.vstack(padded), records[0].outputs.shape[1]
        table[:, -1] = 1.0
        age = [np.append(np.arange(record.n_samples), -1) for record in records]
        return cls(table[:, :q], table[:, q:], np.concatenate(age))

    def equations(
        self, free: BoolArray, target: FloatArray, lag: int
    ) -> tuple[FloatArray, IntArray]:
        """Regressors and target (n, p + k), and the row of the stack (n,), of each equation.

        There is one at each instant with a past of ``lag`` rows in its record and no lost sample.
        free: (q + m + 1, n_lags + 1), signals and lags to weigh; target: (n, k) over the stack.
        """
        weighed, rows = np.argwhere(free), np.flatnonzero(self.age >= lag)
        columns = np.empty((len(rows), len(weighed) + target.shape[1]), order="F")
        for i, (signal, delay) in enumerate(weighed):
            columns[:, i] = self.signals[rows - delay, signal]
        columns[:, len(weighed) :] = target[rows]
        complete = np.isfinite(columns).all(axis=1)
        return columns[complete], rows[complete]


def least_squares(columns: FloatArray, p: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit the first p columns of (n, p + k) to the others; of several solutions the shortest.

    Solution (p, k), residual (n, k) and orthonormal directions of the regressors (n, rank). QR
    factorisation; singular values, in scaled units, where the regressors are dependent.
    """
    regressors, target = columns[:, :p], columns[:, p:]
    Q, R = scipy.linalg.qr(columns, mode="economic", check_finite=False)
    basis, factor = Q[:, :p], R[:p, :p]
    least = len(columns) * np.finfo(float).eps * np.linalg.norm(factor, axis=0)
    if np.all(np.abs(np.diag(factor)) > least):
        solution = scipy.linalg.solve_triangular(factor, R[:p, p:])
    else:
        gain, basis, _ = influence(regressors)
        solution = gain @ target
    return solution, target - regressors @ solution, basis


def influence(sensitivity: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """How parameters follow noise in n rows, from how the rows follow the parameters, (n, p).

    Change of each parameter per noise (p, n), the pseudo-inverse; orthonormal combinations of the
    rows (n, rank) that move any; whether the data tell a parameter at all (p,).
    """
    lengths = np.linalg.norm(sensitivity, axis=0)
    lengths[lengths == 0.0] = 1.0
    U, s, V = np.linalg.svd(sensitivity / lengths, full_matrices=False)
    rank = int(np.sum(s > len(U) * np.finfo(float).eps * s.max(initial=0.0)))
    gain = ((V[:rank].T / s[:rank]) @ U[:, :rank].T) / lengths[:, None]
    return gain, U[:, :rank], np.linalg.norm(V[rank:], axis=0) < 1e-6


class EquationFit:
    """One equation at a given C(q), its other coefficients by least squares.

    columns: (n, p + 1), X and y; position: (n,), instants; c: (nc,), C's coefficients after the
    leading 1. theta: (p,); residual: (n,), S r; errors: (n,), the likeliest e; log_det: of
    I + K K'; iterations, converged: of the search that ended here.
    """

    iterations = 0
    converged = True

    def __init__(self, columns: FloatArray, position: IntArray, c: FloatArray) -> None:
        self.columns, self.position, self.c = columns, position, c
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
        right = np.asfortranarray(columns)
        inverse: FloatArray = lapack.dtbtrs(self._bands, right, uplo="L", trans=trans, diag="U")[0]
        return inverse

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


def fit_equation(
    white: EquationFit, starts: Sequence[FloatArray], max_iterations: int
) -> EquationFit:
    """Maximise the Gaussian likelihood of an equation: white e of least variance.

    white: the fit for C = 1; starts: coefficients of C to try beside it.
    """
    n, nc, columns, position = len(white.errors), len(white.c), white.columns, white.position
    if nc == 0 or white.loss <= (_ROUNDING * np.linalg.norm(columns[:, -1])) ** 2:
        return white
    fits = [EquationFit(columns, position, _inside(start, mirrored=True)) for start in starts]
    fit = min([white, *fits], key=lambda fit: fit.loss)
    learnt, damping = np.zeros((nc, nc)), 1e-3
    for iteration in range(1, max_iterations + 1):
        downhill, curvature = fit.descent
        # What the undamped step promises; the loss rises by 1/n of itself one standard error off.
        promise = 0.5 * float(downhill @ np.linalg.lstsq(curvature, downhill)[0])
        if promise <= 0.5 * _TOLERANCE**2 / n:
            return fit
        trial = fit
        while trial.loss >= fit.loss:
            if damping > _MOST_DAMPING:
                # On the rim of the stable region no step helps: that is the minimum there.
                return fit
            step = _step(downhill, curvature, learnt, damping)
            trial = EquationFit(columns, position, _inside(fit.c + step))
            damping *= 10.0
        damping = max(damping / 100.0, 1e-9)
        trial.iterations = iteration
        if 0.5 * n * np.log(fit.loss / trial.loss) < _LEAST_GAIN:
            return trial
        learnt = _secant(learnt, fit, trial)
        fit = trial
    fit.converged = False
    return fit


def _step(
    downhill: FloatArray, curvature: FloatArray, learnt: FloatArray, damping: float
) -> FloatArray:
    scale = np.diag(curvature) + 1e-12 * curvature.trace()
    damped = curvature + damping * np.diag(scale)
    # Only downhill: where what was learnt spoils that, it is left out.
    convex = np.linalg.eigvalsh(damped + learnt)[0] > 0.0
    return np.linalg.solve(damped + learnt if convex else damped, downhill)


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


def fit_equations(
    stack: Stack,
    layout: Layout,
    lag: int,
    max_iterations: int,
    A: FloatArray | None = None,
    previous: Sequence[EquationFit] = (),
) -> list[EquationFit]:
    """Fits of all outputs' equations; for a given A, of B, offset and C, from previous fits on.

    lag: rows left out at the start of each record, if more than have no complete past. Raises
    ModelError when an output has too few rows for its coefficients.
    """
    target, free, fits, lag = stack.outputs, layout.free.copy(), [], max(lag, layout.lag)
    noise = np.full_like(target, np.nan) if previous else _visible_noise(stack, layout)
    if A is not None:
        free[:, : len(previous)] = False
        # The last row of the stack is lost, and so is that before the first.
        past = np.roll(target, 1, axis=0)
        target = target + filtered(A[1:], past, np.full_like(A[:, 0], np.nan))
    for row, nc in enumerate(layout.nc):
        columns, position = stack.equations(free[row, :-1], target[:, [row]], lag)
        if len(columns) <= free[row].sum():
            raise ModelError(
                f"output {row} has {len(columns)} rows with a complete past for {free[row].sum()} "
                "coefficients: lower na, nb or nc, or give longer records with fewer lost samples"
            )
        starts = [fit.c for fit in previous[row : row + 1]]
        starts += _first_guesses(columns, noise[position[:, None] - np.arange(nc + 1), row])
        white = EquationFit(columns, position, np.zeros(nc))
        fits.append(fit_equation(white, starts, max_iterations))
    return fits


def _visible_noise(stack: Stack, layout: Layout) -> FloatArray:
    """Residuals of a long ARX model of all outputs, (n, q) over the stack; NaN where unknown.

    The past of the noise that it makes visible then counts as more measured signals: the method
    of Hannan & Rissanen, Biometrika 69 (1982) 81-94.
    """
    (q, m), n, nc = layout.nb.shape, int(np.sum(stack.age >= 0)), int(layout.nc.max())
    noise = np.full_like(stack.outputs, np.nan)
    # The noise's past must fit into the ARX order, and the ARX model into the data.
    length = min(max(layout.lag + nc, round(3.0 * np.log(max(n, 2)))), n // (4 * (q + m)))
    if nc == 0 or length < nc:
        return noise
    nk = np.minimum(layout.nk, length)
    long = Layout(q, m, na=length, nb=length + 1 - nk, nc=0, nk=nk, offset=layout.offset)
    columns, position = stack.equations(long.free[0, :-1], stack.outputs, long.lag)
    p = columns.shape[1] - q
    if len(position) >= 2 * p:
        noise[position] = least_squares(columns, p)[1]
    return noise


def _first_guesses(columns: FloatArray, noise: FloatArray) -> list[FloatArray]:
    """Start of C (nc,) from the visible noise of each row and its past (n, nc + 1), or none."""
    seen, p = np.isfinite(noise[:, 0]), columns.shape[1] + noise.shape[1] - 2
    long = np.column_stack((columns[:, :-1], np.nan_to_num(noise[:, 1:]), columns[:, -1]))[seen]
    return [least_squares(long, p)[0][columns.shape[1] - 1 :, 0]] if len(long) > p else []


def _earlier(before: FloatArray, values: FloatArray) -> FloatArray:
    """Values 1, 2, ... rows earlier, (n, ..., nc); before: (nc, ...), those before the first."""
    joined = np.concatenate((before[::-1], values))
    return sliding_window_view(joined, len(before), axis=0)[: len(values), ..., ::-1]


def _inside(c: FloatArray, mirrored: bool = False) -> FloatArray:
    """C(q) with roots beyond ``_NOISE_RADIUS`` moved back to it along their direction.

    mirrored: roots outside the unit circle become their mirror images, which leaves the spectrum
    of the noise as it is. The predictor is stable only with C's roots inside.
    """
    roots = np.roots(np.concatenate(([1.0], c)))
    size = np.maximum(np.abs(roots), np.finfo(float).tiny)
    if np.all(size <= _NOISE_RADIUS):
        return c
    limit = np.minimum(1.0 / size, _NOISE_RADIUS) if mirrored else _NOISE_RADIUS
    moved = np.where(size > _NOISE_RADIUS, roots / size * limit, roots)
    coefficients: FloatArray = np.real(np.poly(moved))[1:]
    return coefficients
