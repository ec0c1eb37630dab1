"""Prediction-error minimisation of one output's equation.

Given C, the prediction errors 1/C(q) (target - regressors @ theta) are linear in theta, so theta
is eliminated by least squares and the search is over the few coefficients of C only (variable
projection: Golub & Pereyra, Inverse Problems 19 (2003) R1-R26, with Kaufman's Jacobian).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.linear.polynomials import reflect_noise
from sysid.linear.regression import Equations, LeastSquares, least_squares
from sysid.linear.whitening import Whitener
from sysid.model import FloatArray

# An iteration is not worth it when it promises to move the coefficients by less than this share
# of their standard errors.
_TOLERANCE = 1e-3
# Below this share of the signal a residual is rounding; there is no noise to model.
_ROUNDING = 1e-11


@dataclass(frozen=True)
class RowFit:
    """Estimate of one equation.

    theta: (p,) the linear coefficients; c: (nc,); errors: (n,) estimate of e; residual: (n,)
    what the sum of squares is taken of: the errors with the unknown past factored out (see
    ``Whitener``); sensitivity: (n, p + nc), minus its derivative by (theta, c), but for a
    rotation.
    """

    theta: FloatArray
    c: FloatArray
    errors: FloatArray
    residual: FloatArray
    sensitivity: FloatArray
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
        self.loss = float(self.linear.residual @ self.linear.residual)

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
    """Minimise the sum of squared errors e of one equation, those before it included.

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
    damping = 1e-3
    # The loss rises by this share of itself one standard error off the minimum.
    significant = 1.0 / len(rows.target)
    for iteration in range(max_iterations):
        J = point.linear.unexplained(point.errors()[1])
        gradient, H = J.T @ point.linear.residual, J.T @ J
        # What the undamped step promises.
        promise = float(gradient @ np.linalg.lstsq(H, gradient)[0])
        if promise <= _TOLERANCE**2 * significant * point.loss:
            return _result(point, iteration, True)
        while True:
            step = np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-12 * H.trace()), gradient)
            trial = _Point(rows, reflect_noise(point.c + step))
            if trial.loss < point.loss:
                damping = max(damping / 10.0, 1e-9)
                break
            damping *= 10.0
            if damping > 1e9:
                # On the rim of the stable region no step helps: that is the constrained minimum.
                return _result(point, iteration, True)
        point = trial
    return _result(point, max_iterations, False)


def _result(point: _Point, iterations: int, converged: bool) -> RowFit:
    errors, slopes = point.errors()
    return RowFit(
        point.linear.solution,
        point.c,
        errors,
        point.linear.residual,
        np.hstack((point.regressors, slopes)),
        iterations,
        converged,
    )
