"""From records and orders to coefficients and their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.arrays import FloatArray
from sysid.linear.noise_start import first_guesses
from sysid.linear.orders import Orders
from sysid.linear.polynomials import reflect_poles
from sysid.linear.precision import Precision
from sysid.linear.prediction_error import RowFit, fit_row
from sysid.linear.regression import Equations, equations
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError


@dataclass(frozen=True)
class Coefficients:
    """A (na + 1, q, q), B (lags + 1, q, m), C (nc + 1, q) and offset (q,); first index: lag."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    offset: FloatArray

    @classmethod
    def of(cls, orders: Orders, values: FloatArray, leading: float = 1.0) -> Coefficients:
        """Tables from a vector (p,); ``leading`` goes where A and C have their ones."""
        q, m = orders.n_outputs, orders.n_inputs
        found = cls(
            np.zeros((orders.output_lag + 1, q, q)),
            np.zeros((orders.input_lag + 1, q, m)),
            np.zeros((int(orders.nc.max(initial=0)) + 1, q)),
            np.zeros(q),
        )
        found.A[0] = leading * np.eye(q)
        found.C[0] = leading
        for (row, term), value in zip(orders.layout, values, strict=True):
            if term.polynomial == "a":
                found.A[term.lag, row, term.column] = value
            elif term.polynomial == "b":
                found.B[term.lag, row, term.column] = value
            elif term.polynomial == "c":
                found.C[term.lag, row] = value
            else:
                found.offset[row] = value
        return found


@dataclass(frozen=True)
class Estimate:
    """What ``identify`` found.

    theta: (p,) all coefficients, output after output; covariance: (p, p); errors: per output the
    estimate of e; loss: (q,) mean squares; noise_covariance: (q, q); log_likelihood: Gaussian,
    of the n_rows instants known for every output; reflected: whether poles were moved.
    """

    coefficients: Coefficients
    theta: FloatArray
    covariance: FloatArray
    errors: tuple[FloatArray, ...]
    loss: FloatArray
    noise_covariance: FloatArray
    log_likelihood: float
    n_rows: int
    reflected: bool
    iterations: tuple[int, ...]
    converged: bool


def identify(
    records: Sequence[Dataset], orders: Orders, *, lag: int, stable: bool, max_iterations: int
) -> Estimate:
    """Minimise each output's prediction errors over the coefficients of its equation.

    lag: rows left out at the start of each record, at least ``orders.lag``; stable: mirror
    unstable poles in the unit circle and estimate B, C and offset again. Raises ModelError when
    an output has too few rows for its coefficients.
    """
    rows = [equations(records, orders, i, lag) for i in range(orders.n_outputs)]
    for i, found in enumerate(rows):
        _enough(i, len(found.target), len(orders.terms(i)))
    guesses = first_guesses(records, orders, rows)
    fits = [
        fit_row(found, int(nc), guess, max_iterations)
        for found, nc, guess in zip(rows, orders.nc, guesses, strict=True)
    ]
    theta = np.concatenate([np.concatenate((fit.theta, fit.c)) for fit in fits])
    coefficients = Coefficients.of(orders, theta)
    moved = reflect_poles(coefficients.A) if stable else coefficients.A
    reflected = moved is not coefficients.A
    if reflected:
        refitted, fits = _refit(records, orders, lag, moved, fits, max_iterations)
        theta = _merged(orders, moved, fits)
        coefficients = replace(Coefficients.of(orders, theta), A=moved)
        rows = refitted
    precision = Precision([found.position for found in rows], fits)
    return Estimate(
        coefficients,
        theta,
        _spread(orders, precision.covariance(), reflected),
        tuple(fit.errors for fit in fits),
        np.array([np.mean(fit.residual**2) for fit in fits]),
        precision.noise,
        precision.log_likelihood(),
        len(precision.shared),
        reflected,
        tuple(fit.iterations for fit in fits),
        all(fit.converged for fit in fits),
    )


def _enough(row: int, n_rows: int, n_parameters: int) -> None:
    if n_rows <= n_parameters:
        raise ModelError(
            f"output {row} has {n_rows} rows with a complete past for {n_parameters} "
            "coefficients: lower na, nb or nc, or give longer records with fewer lost samples"
        )


def _refit(
    records: Sequence[Dataset],
    orders: Orders,
    lag: int,
    A: FloatArray,
    fits: Sequence[RowFit],
    max_iterations: int,
) -> tuple[list[Equations], list[RowFit]]:
    """B, offset and C for a given A. It may have lags that ``orders`` leaves out."""
    full = replace(orders, na=np.full_like(orders.na, len(A) - 1))
    rows, result = [], []
    for row, fit in enumerate(fits):
        found = equations(records, full, row, lag)
        known = int(full.na[row].sum())
        past = A[1:, row].T.ravel()
        rest = Equations(
            found.target - found.regressors[:, :known] @ past,
            found.regressors[:, known:],
            found.position,
        )
        rows.append(rest)
        result.append(fit_row(rest, len(fit.c), [fit.c], max_iterations))
    return rows, result


def _merged(orders: Orders, A: FloatArray, fits: Sequence[RowFit]) -> FloatArray:
    parts = []
    for row, fit in enumerate(fits):
        known = [A[t.lag, row, t.column] for t in orders.terms(row) if t.polynomial == "a"]
        parts.append(np.concatenate((known, fit.theta, fit.c)))
    return np.concatenate(parts)


def _spread(orders: Orders, covariance: FloatArray, reflected: bool) -> FloatArray:
    """The covariance of all coefficients; a moved A is no estimate and has none (NaN)."""
    if not reflected:
        return covariance
    estimated = np.array([term.polynomial != "a" for _, term in orders.layout])
    result = np.full((len(estimated), len(estimated)), np.nan)
    result[np.ix_(estimated, estimated)] = covariance
    return result
