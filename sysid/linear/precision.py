"""How precise the coefficients are: noise covariance, parameter covariance, likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.linear.prediction_error import RowFit
from sysid.linear.regression import influence


class Precision:
    """Second-order statistics of the equations' fits.

    The outputs' equations are estimated apart, but their errors at one instant may be
    correlated. Ljung, System Identification, sections 9.2 and 9.3.
    """

    def __init__(self, positions: Sequence[IntArray], fits: Sequence[RowFit]) -> None:
        self._positions = positions
        self._fits = fits
        self._influence = [influence(fit.sensitivity) for fit in fits]
        self.shared: IntArray = reduce(
            lambda a, b: np.intersect1d(a, b, assume_unique=True), positions
        )
        self.noise = self._noise()

    def _noise(self) -> FloatArray:
        """Covariance of e, (q, q); each error counts for its degrees of freedom."""
        q = len(self._fits)
        noise = np.zeros((q, q))
        for i in range(q):
            for j in range(i + 1):
                ours, theirs = self._common(i, j)
                used = (self._influence[i].rank + self._influence[j].rank) / 2.0
                product = self._fits[i].residual[ours] @ self._fits[j].residual[theirs]
                noise[i, j] = noise[j, i] = product / max(len(ours) - used, 1.0)
        return noise

    def covariance(self) -> FloatArray:
        """Of all coefficients, (p, p). Infinite where the data do not determine one."""
        outputs = range(len(self._fits))
        result: FloatArray = np.block([[self._block(i, j) for j in outputs] for i in outputs])
        undetermined = np.concatenate([~found.determined for found in self._influence])
        result[undetermined] = np.nan
        result[:, undetermined] = np.nan
        result[undetermined, undetermined] = np.inf
        return result

    def log_likelihood(self) -> float:
        """Gaussian, at the instants that all outputs are known for."""
        n, q = len(self.shared), len(self._fits)
        if n == 0:
            return np.nan
        errors = np.column_stack(
            [
                fit.residual[np.isin(position, self.shared)]
                for fit, position in zip(self._fits, self._positions, strict=True)
            ]
        )
        sign, logdet = np.linalg.slogdet(errors.T @ errors / n)
        if sign <= 0:
            return np.inf
        unknown_past = sum(fit.log_det for fit in self._fits)
        return float(-0.5 * (n * (q * np.log(2.0 * np.pi) + logdet + q) + unknown_past))

    def _common(self, i: int, j: int) -> tuple[IntArray, IntArray]:
        _, ours, theirs = np.intersect1d(
            self._positions[i], self._positions[j], assume_unique=True, return_indices=True
        )
        return ours, theirs

    def _block(self, i: int, j: int) -> FloatArray:
        ours, theirs = self._common(i, j)
        one, other = self._influence[i].gain[:, ours], self._influence[j].gain[:, theirs]
        block: FloatArray = self.noise[i, j] * one @ other.T
        return block
