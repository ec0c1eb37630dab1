"""Prediction-error minimisation of one output's equation.

Given C, the errors 1/C(q) (target - regressors @ theta) are linear in theta, so theta is
eliminated by least squares and the search is over the few coefficients of C only (variable
projection: Golub & Pereyra, Inverse Problems 19 (2003) R1-R26, with Kaufman's Jacobian).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.linear.polynomials import limit_noise, reflect_noise
from sysid.linear.regression import Equations, LeastSquares, least_squares
from sysid.linear.whitening import Whitener

# An iteration is not worth it when it promises to move the coefficients by less than this share
# of their standard errors.
_TOLERANCE = 1e-2
# Nor when it gains less than this in the logarithm of the likelihood.
_LEAST_GAIN = 1e-4
# A step this short that still does not help ends the search.
_MOST_DAMPING = 1e8
# Below this share of the signal a residual is rounding; there is no noise to model.
_ROUNDING = 1e-11


@dataclass(frozen=True)
class RowFit:
    """Estimate of one equation.

    theta: (p,) the linear coefficients; c: (nc,); errors: (n,) estimate of e; residual: (n,)
    what the sum of squares is taken of: the errors with the unknown past factored out (see
    ``Whitener``); sensitivity: (n, p + nc), minus its derivative by (theta, c), but for a
    rotation; log_det: what the unknown past takes from the likelihood.
    """

    theta: FloatArray
    c: FloatArray
    errors: FloatArray
    residual: FloatArray
    sensitivity: FloatArray
    log_det: float
    iterations: int
    converged: bool


class _Point:
    """The errors and their derivatives at one C, theta eliminated."""

    def __init__(self, rows: Equations, c: FloatArray) -> None:
        self.c = c
        self._whitener = Whitener(c, rows.position)
        self._filtered = self._whitener.inverse(np.column_stack((rows.regressors, rows.target)))
        columns = self._whitener.standardised(self._filtered)
        self.regressors = columns[:, :-1]
        self.linear: LeastSquares = least_squares(self.regressors, columns[:, -1])
        residual = self.linear.residual
        self.squares = float(residual @ residual)
        # What the likelihood's best value for a variance of e depends on.
        self.log_det = self._whitener.log_det
        self.loss = self.squares * np.exp(self.log_det / len(residual))

    def log_det_slope(self) -> FloatArray:
        """Derivative of ``log_det`` by C's coefficients, (nc,)."""
        return self._whitener.log_det_slope()

    def errors(self) -> tuple[FloatArray, FloatArray]:
        """Estimate of e, (n,), and minus its derivatives by C's coefficients, (n, nc).

        At fixed theta and past: from C(q) e = w, C(q) de/dc_l = -q^-l e (Ljung, section 10.3).
        """
        left = self._filtered[:, -1] - self._filtered[:, :-1] @ self.linear.solution
        errors, past = self._whitener.errors(left)
        return errors, self._whitener.standardised(self._whitener.inverse(past))


def fit_row(
    rows: Equations, nc: int, starts: list[FloatArray] | None = None, max_iterations: int = 50
) -> RowFit:
    """Maximise the Gaussian likelihood of one equation: white e of least variance.

    starts: coefficients of C to try first beside C = 1; the best becomes the start of a
    Levenberg-Marquardt search that keeps C's roots inside the unit circle.
    """
    point = _Point(rows, np.zeros(nc))
    negligible = (_ROUNDING * float(np.linalg.norm(rows.target))) ** 2
    if nc == 0 or point.loss <= negligible:
        return _result(point, 0, True)
    for start in starts or []:
        other = _Point(rows, reflect_noise(start))
        if other.loss < point.loss:
            point = other
    return _search(rows, point, max_iterations)


def _search(rows: Equations, point: _Point, max_iterations: int) -> RowFit:
    n, damping = len(rows.target), 1e-3
    curvature = _Curvature(point)
    for iteration in range(max_iterations):
        # What the undamped step promises; the loss rises by 1/n of itself one standard error off.
        if curvature.promise() <= 0.5 * _TOLERANCE**2 / n:
            return _result(point, iteration, True)
        trial = point
        while trial.loss >= point.loss:
            if damping > _MOST_DAMPING:
                # On the rim of the stable region no step helps: that is the minimum there.
                return _result(point, iteration, True)
            trial = _Point(rows, limit_noise(point.c + curvature.step(damping)))
            damping *= 10.0
        damping = max(damping / 100.0, 1e-9)
        gain = 0.5 * n * np.log(point.loss / trial.loss)
        if gain < _LEAST_GAIN:
            return _result(trial, iteration + 1, True)
        curvature.move(trial, trial.c - point.c)
        point = trial
    return _result(point, max_iterations, False)


class _Curvature:
    """Slope and second derivatives of log(loss) / 2 by C's coefficients.

    Gauss and Newton's part is exact; what it leaves out, which matters for roots near the unit
    circle, is learnt from how the slope changes. Dennis, Gay & Welsch, ACM Transactions on
    Mathematical Software 7 (1981) 348-368.
    """

    def __init__(self, point: _Point) -> None:
        self._downhill, self._known = _slopes(point)
        self._learnt = np.zeros_like(self._known)

    def promise(self) -> float:
        """How much of log(loss) / 2 an undamped Gauss-Newton step would gain."""
        return 0.5 * float(self._downhill @ np.linalg.lstsq(self._known, self._downhill)[0])

    def step(self, damping: float) -> FloatArray:
        """Levenberg-Marquardt step, (nc,)."""
        scale = np.diag(self._known) + 1e-12 * self._known.trace()
        damped = self._known + damping * np.diag(scale)
        whole = damped + self._learnt
        # Only downhill: where what was learnt spoils that, it is left out.
        matrix = whole if np.linalg.eigvalsh(whole)[0] > 0.0 else damped
        return np.asarray(np.linalg.solve(matrix, self._downhill), dtype=np.float64)

    def move(self, point: _Point, step: FloatArray) -> None:
        """Go to the next point and learn from the step to it."""
        downhill, known = _slopes(point)
        change = self._downhill - downhill
        self._downhill, self._known = downhill, known
        along = float(change @ step)
        if along <= 0.0:
            return
        wanted = change - known @ step
        have = float(step @ self._learnt @ step)
        if have != 0.0:
            self._learnt *= min(1.0, abs(float(step @ wanted)) / abs(have))
        miss = wanted - self._learnt @ step
        cross = np.outer(miss, change) / along
        self._learnt += cross + cross.T - (miss @ step) * np.outer(change, change) / along**2


def _slopes(point: _Point) -> tuple[FloatArray, FloatArray]:
    """Downhill direction of log(loss) / 2, (nc,), and Gauss-Newton's curvature, (nc, nc)."""
    J = point.linear.unexplained(point.errors()[1])
    volume = 0.5 * point.log_det_slope() / len(J)
    return J.T @ point.linear.residual / point.squares - volume, J.T @ J / point.squares


def _result(point: _Point, iterations: int, converged: bool) -> RowFit:
    errors, slopes = point.errors()
    return RowFit(
        point.linear.solution,
        point.c,
        errors,
        point.linear.residual,
        np.hstack((point.regressors, slopes)),
        point.log_det,
        iterations,
        converged,
    )
