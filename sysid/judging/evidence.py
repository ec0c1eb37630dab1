"""How much coloured residuals tell: ratios of losses, and independent samples."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray


@dataclass(frozen=True)
class Ratio:
    """A ratio of two means with its 95 % interval; p_value: of one this far from 1 by chance."""

    value: float
    low: float
    high: float
    p_value: float


def ratio_of_means(losses: Sequence[FloatArray], references: Sequence[FloatArray]) -> Ratio:
    """Mean of losses in parts of the mean of reference losses, over the same samples in time.

    losses, references: not negative, of each record by itself, (n_rows,). Diebold & Mariano
    ("Comparing predictive accuracy", J. Business & Economic Statistics 13, 1995), who look at the
    mean difference of the losses, on a logarithmic scale: the interval of a ratio stays positive,
    and a much larger loss is not hidden by its own spread. The standard error allows for
    correlation in time by Bartlett weights, their bandwidth by the autoregressive rule of Andrews
    ("Heteroskedasticity and autocorrelation consistent covariance matrix estimation",
    Econometrica 59, 1991); Student's t has as many degrees of freedom as the records have
    stretches of the bandwidth's length.
    """
    from scipy.special import stdtr, stdtrit

    tops, bottoms = np.concatenate(losses), np.concatenate(references)
    top, bottom = float(tops.mean()), float(bottoms.mean())
    if top == bottom == 0.0 or np.array_equal(tops, bottoms):
        return Ratio(1.0, 1.0, 1.0, 1.0)
    if top == 0.0 or bottom == 0.0:
        ratio = 0.0 if top == 0.0 else np.inf
        return Ratio(ratio, ratio, ratio, 0.0)
    error, freedom = _standard_error(
        [a / top - b / bottom for a, b in zip(losses, references, strict=True)]
    )
    log = float(np.log(top / bottom))
    half = float(stdtrit(freedom, 0.975)) * error
    p_value = 2.0 * float(stdtr(freedom, -abs(log) / error)) if error > 0.0 else 0.0
    low, value, high = np.exp(np.array([log - half, log, log + half])).tolist()
    return Ratio(value, low, high, p_value)


def _standard_error(series: Sequence[FloatArray]) -> tuple[float, float]:
    """Standard error of the mean of correlated series around zero, and its degrees of freedom."""
    n = sum(map(len, series))
    variance = _covariance(series, 0, n)
    if variance == 0.0:
        return 0.0, float(n)
    rho = float(np.clip(_covariance(series, 1, n) / variance, -0.99, 0.99))
    width = min(1.1447 * (4.0 * rho**2 / (1.0 - rho**2) ** 2 * n) ** (1.0 / 3.0), n / 4.0)
    for lag in range(1, int(width) + 1):
        variance += 2.0 * (1.0 - lag / (width + 1.0)) * _covariance(series, lag, n)
    return float(np.sqrt(max(variance, 0.0) / n)), max(n / (width + 1.0) - 1.0, 1.0)


def independent_samples(residuals: Sequence[FloatArray]) -> float:
    """How many independent samples have a covariance as uncertain as that of these, at most n.

    residuals: of each record, (n_rows, n_outputs). n q / (sum over all lags of |R_k|^2), with R_k
    the autocorrelation matrices of the whitened residuals: the variance of the covariance of
    coloured Gaussian noise (Bartlett, "An introduction to stochastic processes", 1955). The sum
    ends where the correlations cannot be told from those of noise.
    """
    n = sum(map(len, residuals))
    joined = np.concatenate(residuals)
    values, vectors = np.linalg.eigh(joined.T @ joined / max(n, 1))
    kept = values > 1e-12 * values.max(initial=0.0)
    if not kept.any():
        return float(n)
    whiten = vectors[:, kept] / np.sqrt(values[kept])
    white = [part @ whiten for part in residuals]
    q = int(kept.sum())
    chance = q * q / n  # what the squares of a white series sum to
    total = float(q)
    for lag in range(1, n // 2):
        # Two at a time: an oscillation passes through zero.
        pair = sum(_squares(white, k, n) for k in (2 * lag - 1, 2 * lag))
        if pair < 4.0 * chance:
            break
        total += 2.0 * (pair - 2.0 * chance)
    return n * q / total


def independent_of_each(residual: FloatArray) -> FloatArray:
    """As of ``independent_samples``, of each output's residuals (n_samples, n_outputs) alone.

    NaN where a sample was lost.
    """
    return np.array([independent_samples([e[np.isfinite(e), None]]) for e in residual.T])


def _squares(series: Sequence[FloatArray], lag: int, n: int) -> float:
    products = [part[lag:].T @ part[: len(part) - lag] for part in series if len(part) > lag]
    return float(np.sum((np.sum(products, axis=0) / n) ** 2)) if products else 0.0


def _covariance(series: Sequence[FloatArray], lag: int, n: int) -> float:
    return float(sum(part[lag:] @ part[: max(len(part) - lag, 0)] for part in series) / n)
