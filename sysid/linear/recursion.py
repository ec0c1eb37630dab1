"""Running A(q) y = w + C(q) e through time: free run, innovations, k-step prediction.

The recursions are triangular banded systems of equations, solved by LAPACK's forward
substitution: the same operations as a loop over time, at the speed of compiled code.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas

from sysid.arrays import FloatArray

# Rows solved at a time; bounds the memory of the band matrix.
_BLOCK = 4096


def filtered(P: FloatArray, x: FloatArray, past: FloatArray) -> FloatArray:
    """P(q) x, (n, rows). x: (n, columns); past: the rows before it, at least P's lags."""
    joined = np.concatenate((past, x))
    n, start = len(x), len(past)
    total = np.zeros((n, P.shape[1]))
    for lag, matrix in enumerate(P):
        total += joined[start - lag : start - lag + n] @ matrix.T
    return total


def free_run(A: FloatArray, w: FloatArray, past: FloatArray) -> FloatArray:
    """Y of A(q) y = w, (n, q). past: (>= n_lags, q) outputs before the first row."""
    unknown = np.full(w.shape, np.nan)
    no_noise = np.ones((1, A.shape[1]))
    return innovations(A, no_noise, w, unknown, past, np.zeros_like(past))[0]


def innovations(
    A: FloatArray,
    C: FloatArray,
    w: FloatArray,
    y: FloatArray,
    past_y: FloatArray,
    past_e: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Outputs with lost samples predicted, and one-step prediction errors, each (n, q).

    A: (na + 1, q, q); C: (nc + 1, q), the diagonal of C(q); w: (n, q), inputs' share and
    offset; y: (n, q), NaN where lost. There the error is zero and the output its prediction.
    past_y, past_e: rows before the first, as many as the polynomials have lags or more.
    """
    out, errors = np.empty_like(y), np.empty_like(y)
    for start in range(0, len(y), _BLOCK):
        rows = slice(start, start + _BLOCK)
        # What an unstable model overflows to shows in the result.
        with np.errstate(all="ignore"):
            out[rows], errors[rows] = _block(A, C, w[rows], y[rows], past_y, past_e)
        past_y = np.concatenate((past_y, out[rows]))[-len(past_y) :]
        past_e = np.concatenate((past_e, errors[rows]))[-len(past_e) :]
    return out, errors


def _block(
    A: FloatArray,
    C: FloatArray,
    w: FloatArray,
    y: FloatArray,
    past_y: FloatArray,
    past_e: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    # Unknown is the output where it was lost (its error is zero), else minus the error.
    lost = np.isnan(y)
    measured = np.where(lost, 0.0, y)
    noise = np.stack([np.diag(row) for row in C])
    nothing = np.zeros_like(y)
    right = w - filtered(A, measured, past_y) + filtered(noise, nothing, past_e)
    bands = np.where(lost.reshape(1, -1), _bands(A, noise, len(y)), _bands(noise, A, len(y)))
    solution = blas.dtbsv(
        len(bands) - 1, np.asfortranarray(bands), right.ravel(), lower=1, diag=1
    ).reshape(y.shape)
    return np.where(lost, solution, measured), np.where(lost, 0.0, -solution)


def _bands(P: FloatArray, other: FloatArray, n: int) -> FloatArray:
    """P(q) over n rows as a lower band matrix with room for the other polynomial's lags."""
    q = P.shape[1]
    column = np.zeros((max(len(P), len(other)) * q, q))
    for lag, matrix in enumerate(P):
        for j in range(q):
            # Rows above the diagonal belong to P_0, the identity, and are zero.
            first = lag * q - j
            column[max(first, 0) : first + q, j] = matrix[max(-first, 0) :, j]
    return np.tile(column, n)


def ahead(
    A: FloatArray, C: FloatArray, w: FloatArray, y: FloatArray, e: FloatArray, k: int, pad: int
) -> FloatArray:
    """Predictions of rows pad.. from the data up to k rows before each, (n - pad, q).

    y, e: (n, q) outputs and innovations of ``innovations``, the first ``pad`` rows what is
    assumed before the record. Ljung, System Identification, section 3.2.
    """
    n = len(y) - pad
    steps: list[FloatArray] = []
    for step in range(1, k + 1):
        prediction = w[pad:].copy()
        for lag in range(1, len(A)):
            # Outputs younger than ``step`` rows are predictions themselves.
            source = steps[-lag] if lag < step else y
            prediction -= source[pad - lag : pad - lag + n] @ A[lag].T
        for lag in range(step, len(C)):
            prediction += C[lag] * e[pad - lag : pad - lag + n]
        steps.append(np.concatenate((y[:pad], prediction)))
        del steps[: -len(A)]
    return steps[-1][pad:]
