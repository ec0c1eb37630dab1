"""Regression of whitened residuals on columns, and tests of what else they may hold.

The covariance of a score is the largest of three, since a whitened residual is white in the mean
only: that of white residuals; their own, whatever their variance along the record and with what
colour is left (Newey & West, Econometrica 55, 1987); and that of the known noise of the inputs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import fdtrc

from sysid.arrays import FloatArray
from sysid.judging.whitener import Whitener
from sysid.uncertainty.colour import record_rows

_NEW = 1e-2  # share of a suspect that no change of the parameters makes, below which it is theirs
_ROUNDING = 1e-9  # the same, which rounding makes
_LAGS = 20  # of what colour whitening may leave


@dataclass(frozen=True)
class Regressed:
    """A suspect's test: log of its probability, its amplitudes, and what becomes of the rest.

    coefficients: of the regression's columns beside the suspect; move: what they were moved by.
    """

    log_p: float
    amplitudes: FloatArray
    coefficients: FloatArray
    move: FloatArray
    share: float


class Regression:
    """Residuals on columns, whitened; free (p,) says how firmly each column stands at zero."""

    def __init__(
        self,
        whitening: Whitener,
        columns: FloatArray,
        free: FloatArray,
        residual: FloatArray,
        noises: Sequence[tuple[slice, FloatArray]],
    ) -> None:
        self.whitening = whitening
        white, target = whitening(columns), whitening(residual[..., None])
        free = np.where(white.any(axis=0), free, 1.0)  # what no row shows stands at zero
        self._n = len(target)
        self._left = self._n - white.shape[1] - whitening.model.coefficients.size
        self._basis = _Basis(
            white, free, [whitening.rows_of(r) for r in record_rows(whitening.lengths)]
        )
        within, beyond = self._basis.split(target)
        self.coefficients, self._residual = self._basis.solved(within[:, 0]), beyond[:, 0]
        self._noises = noises
        self.squares = float(self._residual[: self._n] @ self._residual[: self._n])

    def least(self, changes: FloatArray, one_sided: bool) -> float:
        """What the logarithm of a suspect's probability is at least, by its test.

        That of white residuals, which needs no row of what the regression's columns leave.
        """
        columns, size = self._scaled(changes)
        if not columns.size:
            return math.inf
        if one_sided and len(size) > 1:
            return -math.inf
        rows = _span(columns)
        within = self._basis.within(columns[rows], rows)
        squares, axes = np.linalg.eigh(columns[rows].T @ columns[rows] - within.T @ within)
        new = squares > _NEW**2
        score = (axes[:, new].T @ (columns[rows].T @ self._residual[rows])) / np.sqrt(squares[new])
        if not new.any() or (one_sided and axes[0, 0] * score[0] <= 0.0):
            return math.inf
        return self._log_p(float(score @ score), int(new.sum()))

    def deviation(self, changes: FloatArray) -> float:
        """Standard deviation of a suspect's only amplitude, infinite where parameters do the same.

        changes: (n_residuals, n_outputs, 1).
        """
        columns, size = self._scaled(changes)
        if not columns.size:
            return math.inf
        new = float(np.linalg.norm(self._basis.split(columns)[1]))
        variance = self.squares / max(self._left, 1)
        return math.sqrt(variance) / (new * float(size[0])) if new > _ROUNDING else math.inf

    def _scaled(self, changes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened columns of unit length, those without any left out, and all their lengths."""
        white = self.whitening(changes)
        size = np.linalg.norm(white, axis=0)
        return white[:, size > 0.0] / size[size > 0.0], size

    def test(self, changes: FloatArray, one_sided: bool) -> Regressed | None:
        """The test of a suspect's changes; None where the parameters do all that it does.

        one_sided: whether only amplitudes above zero are looked for; their statistic has as many
        degrees of freedom as amplitudes turned out to be (Susko, "Likelihood ratio tests with
        boundary constraints using data-dependent degrees of freedom", Biometrika 100, 2013).
        """
        columns, size = self._scaled(changes)
        if not columns.size:
            return None
        within, beyond = self._basis.split(columns)
        squares, axes = np.linalg.eigh(beyond.T @ beyond)
        new = squares > _NEW**2
        if not new.any():
            return None
        if one_sided:
            from scipy.optimize import nnls  # slow, and seldom needed

            amplitudes = nnls(beyond, self._residual)[0]
            length = float(np.linalg.norm(beyond @ amplitudes))
            if length == 0.0:
                return None
            turn, freedom = (amplitudes / length)[:, None], int(np.count_nonzero(amplitudes))
        else:
            turn, freedom = axes[:, new] / np.sqrt(squares[new]), int(new.sum())
            amplitudes = turn @ (turn.T @ (beyond.T @ self._residual))
        left = beyond @ turn
        score = left.T @ self._residual
        move = -self._basis.solved(within @ amplitudes)
        whole = np.zeros(len(size))
        whole[size > 0.0] = amplitudes / size[size > 0.0]
        return Regressed(
            self._log_p(*self._statistic(left, score, freedom)),
            whole,
            self.coefficients + move,
            move,
            min(float(score @ score) / max(self.squares, 1e-300), 1.0),
        )

    def _log_p(self, statistic: float, freedom: int, draws: float = math.inf) -> float:
        """Logarithm of a statistic's probability by chance, of residuals whose variance is theirs.

        Of a short record that is hardly known: Fisher's distribution, not the chi-square's. Nor is
        what draws, perhaps few, tell: Hotelling's ("The generalization of Student's ratio", Annals
        of Mathematical Statistics 2, 1931).
        """
        left = max(self._left - freedom, 1)
        chance = float(fdtrc(freedom, left, statistic / freedom * left / self._n))
        if draws < math.inf:
            left = max(draws + 1.0 - freedom, 1.0)
            chance = max(chance, float(fdtrc(freedom, left, statistic / freedom * left / draws)))
        return math.log(chance) if chance > 0.0 else -math.inf

    def _statistic(
        self, left: FloatArray, score: FloatArray, freedom: int
    ) -> tuple[float, int, float]:
        """The score's square in units of its covariance, in every direction the larger of three.

        With its degrees of freedom, and how many draws tell the covariance.
        """
        rest = self._residual - left @ score
        terms = (left * rest[:, None])[: self._n]
        terms = terms.reshape(-1, self.whitening.n_outputs, len(score)).sum(axis=1)
        seen, white = _long_run_covariance(terms - terms.mean(axis=0)), np.eye(len(score))
        by_residuals = _square(_larger(seen, white), score)
        if not self._noises:
            return by_residuals, freedom, math.inf
        pushes = self._pushes(left[: self._n])
        by_noise = sum((each @ each.T for each in pushes), np.zeros_like(white))
        statistic = _square(_larger(_larger(seen, by_noise), white), score)
        # Variances of independent records add up (Satterthwaite, Biometrics 2, 1946).
        squares = np.array([np.sum(each**2) for each in pushes])
        counts = np.array([each.shape[1] for each in pushes])
        more = 1.0 - statistic / max(by_residuals, 1e-300)
        spread = float(np.sum(squares**2 / counts)) * more
        return statistic, freedom, float(squares.sum()) ** 2 / spread if spread > 0.0 else math.inf

    def _pushes(self, left: FloatArray) -> list[FloatArray]:
        """Changes of the score by draws of the inputs' noise, (k, n_draws) of each record."""
        pushes = []
        for rows, noise in self._noises:
            back = self.whitening.back(rows, left)
            pushes.append(back.T @ noise.reshape(len(back), -1))
        return pushes


class _Basis:
    """Orthonormal basis of whitened columns (n_rows, p) and what is known of each beforehand.

    free: (p,), as of ``Regression``; below the rows of the columns stands one for each of them.
    Columns that are in one record alone are factored there, the common ones by what those leave of
    them (Frisch & Waugh, Econometrica 1, 1933): that takes no longer a record the more there are.
    records: rows of each.
    """

    def __init__(self, white: FloatArray, free: FloatArray, records: Sequence[slice]) -> None:
        self._n, self._records = len(white), records
        felt = np.array([white[rows].any(axis=0) for rows in records])
        alone = felt.sum(axis=0) == 1
        self._places = [np.flatnonzero(alone & in_record) for in_record in felt]
        self._common = np.flatnonzero(~alone)
        common = np.vstack([white, np.diag(free)])[:, self._common]
        self._bases, self._triangles, self._parts = [], [], []
        for rows, places in zip(records, self._places, strict=True):
            basis, triangle = np.linalg.qr(np.vstack([white[rows, places], np.diag(free[places])]))
            count = rows.stop - rows.start
            part = basis[:count].T @ common[rows]
            common[rows] -= basis[:count] @ part
            common[self._n + places] -= basis[count:] @ part
            self._bases.append((basis[:count], basis[count:]))
            self._triangles.append(triangle)
            self._parts.append(part)
        self._common_basis, self._common_triangle = np.linalg.qr(common)

    def within(self, white: FloatArray, rows: slice) -> FloatArray:
        """Scalar products with the basis, (p, k), of columns that are zero outside some rows."""
        within = np.zeros((len(self._common_basis) - self._n, white.shape[1]))
        within[self._common] = self._common_basis[rows].T @ white
        for record, places, (basis, _) in zip(
            self._records, self._places, self._bases, strict=True
        ):
            first, end = max(record.start, rows.start), min(record.stop, rows.stop)
            if first < end and len(places):
                part = white[first - rows.start : end - rows.start]
                within[places] = basis[first - record.start : end - record.start].T @ part
        return within

    def split(self, white: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scalar products of whitened columns with the basis, and what it leaves of them.

        The latter with rows for what is known beforehand.
        """
        rows = _span(white)
        within = self.within(white[rows], rows)
        beyond: FloatArray = -(self._common_basis @ within[self._common])
        for record, places, (basis, below) in zip(
            self._records, self._places, self._bases, strict=True
        ):
            beyond[record] -= basis @ within[places]
            beyond[self._n + places] -= below @ within[places]
        beyond[rows] += white[rows]
        return within, beyond

    def solved(self, within: FloatArray) -> FloatArray:
        """Coefficients (p,) of the columns from scalar products (p,) with the basis."""
        solution = np.zeros_like(within)
        common = solve_triangular(self._common_triangle, within[self._common])
        solution[self._common] = common
        for places, triangle, part in zip(self._places, self._triangles, self._parts, strict=True):
            solution[places] = solve_triangular(triangle, within[places] - part @ common)
        return solution


def _span(white: FloatArray) -> slice:
    """Rows from the first to the last in which columns are not zero."""
    rows = np.flatnonzero(white.any(axis=1))
    return slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0, 0)


def _larger(first: FloatArray, second: FloatArray) -> FloatArray:
    """A covariance as large in every direction as the larger of two."""
    values, vectors = np.linalg.eigh(first)
    floor = 1e-9 * max(float(values[-1]), float(np.trace(second)))
    root = vectors * np.sqrt(np.maximum(values, floor))
    back = np.linalg.inv(root)
    ratio, axes = np.linalg.eigh(back @ second @ back.T)
    whole = root @ axes
    larger: FloatArray = (whole * np.maximum(ratio, 1.0)) @ whole.T
    return larger


def _square(covariance: FloatArray, score: FloatArray) -> float:
    """Square of a score (k,) in units of its covariance (k, k)."""
    return float(score @ np.linalg.solve(covariance, score))


def _long_run_covariance(terms: FloatArray) -> FloatArray:
    """Covariance of the sum of correlated terms (n, k) of mean zero, with Bartlett's weights."""
    total: FloatArray = terms.T @ terms
    for lag in range(1, min(_LAGS, len(terms) // 4)):
        product = terms[lag:].T @ terms[:-lag]
        total = total + (1.0 - lag / _LAGS) * (product + product.T)
    # The weights keep it from being negative but for rounding.
    return total
