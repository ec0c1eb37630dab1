"""From coloured to white: the inverse of a moving average, with its unknown past."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.linalg import lapack

from sysid.arrays import FloatArray, IntArray


class Whitener:
    """Turns noise C(q) e into errors of equal variance, uncorrelated with each other.

    1/C(q) started at zero leaves r = e + K h, where h are the values of e at the nc instants
    before the first, as large as any other. Their covariance I + K K' is factored out: what
    results has the sum of squares of the likeliest e and h together, and the Gaussian likelihood
    is exact. The first row of a record, or after a gap, has a past of its own. Box & Jenkins, Time
    Series Analysis, chapter 7.

    c: (nc,), the coefficients of C after the leading 1; position: (n,), instants. log_det: of
    I + K K'.
    """

    def __init__(self, c: FloatArray, position: IntArray) -> None:
        n, nc = len(position), len(c)
        self._bands = np.zeros((nc + 1, n), order="F")
        self._bands[0] = 1.0
        for lag in range(1, min(nc, n - 1) + 1):
            unbroken = position[lag:] - position[:-lag] == lag
            self._bands[lag, :-lag] = np.where(unbroken, c[lag - 1], 0.0)
        starts = [0, *(np.flatnonzero(np.diff(position) != 1) + 1).tolist()]
        self._runs = [slice(a, b) for a, b in zip(starts, [*starts[1:], n], strict=True)]
        past = np.zeros((n, nc))
        for run in self._runs:
            for row in range(min(nc, run.stop - run.start)):
                past[run.start + row, : nc - row] = c[row:]
        self._K = self.inverse(past)
        grams = [self._K[run].T @ self._K[run] for run in self._runs]
        self._estimate = [np.linalg.inv(np.eye(nc) + gram) for gram in grams]
        self._root = [_root(gram) for gram in grams]
        self.log_det = float(sum(np.linalg.slogdet(np.eye(nc) + gram)[1] for gram in grams))

    def inverse(self, columns: FloatArray) -> FloatArray:
        """1/C(q) of each column, from zero at the start of each run; (n, k)."""
        return self._solve(columns, "N")

    def _solve(self, columns: FloatArray, trans: Literal["N", "T"]) -> FloatArray:
        result: FloatArray = lapack.dtbtrs(
            self._bands, np.asfortranarray(columns), uplo="L", trans=trans, diag="U"
        )[0]
        return result

    def standardised(self, columns: FloatArray) -> FloatArray:
        """The same with the unknown past factored out, so that r becomes white; (n, k)."""
        result = np.empty_like(columns)
        for run, root in zip(self._runs, self._root, strict=True):
            K, x = self._K[run], columns[run]
            result[run] = x - K @ (root @ (K.T @ x))
        return result

    def errors(self, r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The likeliest e, (n,), and its own past, (n, nc): e(t-1), e(t-2), ... in each row."""
        e, past = np.empty_like(r), np.empty_like(self._K)
        for run, estimate in zip(self._runs, self._estimate, strict=True):
            K = self._K[run]
            before = estimate @ (K.T @ r[run])
            e[run] = r[run] - K @ before
            for lag in range(1, len(before) + 1):
                past[run, lag - 1] = _earlier(before, e[run], lag)
        return e, past

    def log_det_slope(self) -> FloatArray:
        """Derivative of ``log_det`` by C's coefficients, (nc,).

        It is 2 tr((I + K'K)^-1 K' dK/dc_l), and K are the errors that unit errors before the
        first row leave, so that it follows from the same recursion.
        """
        nc = self._K.shape[1]
        weights = np.empty_like(self._K)
        for run, estimate in zip(self._runs, self._estimate, strict=True):
            weights[run] = self._K[run] @ estimate
        weights = self._solve(weights, "T")
        slope = np.zeros(nc)
        for run in self._runs:
            for lag in range(1, nc + 1):
                past = _earlier(np.eye(nc), -self._K[run], lag)
                slope[lag - 1] += 2.0 * np.sum(weights[run] * past)
        return slope


def _earlier(before: FloatArray, values: FloatArray, lag: int) -> FloatArray:
    """Values ``lag`` rows earlier; before: (nc, ...), those 1, 2, ... rows before the first."""
    return np.concatenate((before[:lag][::-1], values))[: len(values)]


def _root(gram: FloatArray) -> FloatArray:
    """S of (I + K K')^-1/2 = I - K S K', from K'K."""
    values, vectors = np.linalg.eigh(gram)
    size = np.sqrt(1.0 + np.maximum(values, 0.0))
    root: FloatArray = (vectors / (size * (1.0 + size))) @ vectors.T
    return root
