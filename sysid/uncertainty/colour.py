"""Covariance of a score whose residuals are coloured.

The residuals are described by a vector autoregression, whose order the Schwarz criterion
chooses. The sum over time of S_t' e_t, with e = H eps for the autoregression's response H and
white eps, has the covariance (H' S)' cov(eps) (H' S); H' is the same recursion run backwards in
time, so that nothing of the size of the record squared is ever formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from sysid.model import FloatArray

_LARGEST_ORDER = 12


@dataclass(frozen=True)
class Autoregression:
    """e_t = sum_k A_k e_(t-k) + eps_t; coefficients: (order, q, q), noise: (q, q)."""

    coefficients: FloatArray
    noise: FloatArray


def colour(residual: FloatArray, lengths: Sequence[int]) -> Autoregression:
    """Autoregression of residuals (n, q) of records of the given lengths, by least squares."""
    q = residual.shape[1]
    largest = max(0, min(_LARGEST_ORDER, min(lengths) // (4 * q) - 1))
    y, past = _regression(residual, lengths, largest)
    best, lowest = _fit(y, past[:, :0], q), np.inf
    for order in range(largest + 1):
        fitted = _fit(y, past[:, : order * q], q)
        # A tiny part of its own: an output that never errs has no logarithm.
        sign, size = np.linalg.slogdet(fitted.noise + 1e-300 * np.eye(q))
        criterion = len(y) * size + np.log(max(len(y), 2)) * order * q * q
        if sign > 0 and criterion < lowest:
            best, lowest = fitted, criterion
    return best


def score_covariance(
    slopes: FloatArray, lengths: Sequence[int], model: Autoregression
) -> FloatArray:
    """Covariance of sum_t slopes_t' e_t, (p, p).

    slopes: (n, q, p), of records of the given lengths one after another.
    """
    p = slopes.shape[2]
    total = np.zeros((p, p))
    start = 0
    for length in lengths:
        part = _response(slopes[start : start + length], model)
        start += length
        total += np.einsum("tip,ij,tjr->pr", part, model.noise, part, optimize=True)
    return total


def _response(slopes: FloatArray, model: Autoregression) -> FloatArray:
    """H' S: solves s_t = slopes_t + sum_k A_k' s_(t+k) from the end backwards."""
    n, q, p = slopes.shape
    order = len(model.coefficients)
    if order == 0:
        return slopes
    # Time reversed the recursion is a banded lower triangular system with unit diagonal.
    bands = np.zeros(((order + 1) * q, n * q), order="F")
    bands[0] = 1.0
    for k, matrix in enumerate(model.coefficients, start=1):
        for row in range(q):
            for column in range(q):
                # Unknown (t, column) in equation (t + k, row).
                bands[k * q + row - column, column : (n - k) * q : q] = -matrix[column, row]
    right = np.asfortranarray(slopes[::-1].reshape(n * q, p))
    solved = lapack.dtbtrs(bands, right, uplo="L", trans="N", diag="U")[0]
    response: FloatArray = solved.reshape(n, q, p)[::-1]
    return response


def _regression(
    residual: FloatArray, lengths: Sequence[int], order: int
) -> tuple[FloatArray, FloatArray]:
    """Residuals behind the first ``order`` of each record, and their pasts, nearest first."""
    targets, pasts = [], []
    start = 0
    for length in lengths:
        part = residual[start : start + length]
        start += length
        targets.append(part[order:])
        past = [part[order - k : length - k] for k in range(1, order + 1)]
        pasts.append(np.hstack(past) if past else np.zeros((length - order, 0)))
    return np.vstack(targets), np.vstack(pasts)


def _fit(y: FloatArray, past: FloatArray, q: int) -> Autoregression:
    order = past.shape[1] // q
    solution = np.asarray(np.linalg.lstsq(past, y, rcond=None)[0], dtype=np.float64)
    e = y - past @ solution
    noise = e.T @ e / max(len(y) - order * q, 1)
    return Autoregression(np.moveaxis(solution.reshape(order, q, q), 1, 2), noise)
