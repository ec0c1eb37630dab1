"""Covariance of a score whose residuals are coloured.

The residuals are described by a vector autoregression, whose order the Schwarz criterion
chooses, and where the same criterion asks for it by a slow part of each output, below what so few
samples show (``slow_noise``). The sum over time of S_t' e_t, with e = H eps for the response H of
both and white eps, has the covariance (H' S)' cov(eps) (H' S); H' is the same recursion run
backwards in time, so that nothing of the size of the record squared is ever formed.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from sysid.arrays import BoolArray, FloatArray
from sysid.uncertainty.slow_noise import (
    PARAMETERS,
    SlowFilter,
    SlowNoise,
    regression_table,
    remainder,
    slow_noise,
)

_LARGEST_ORDER = 12
_BY_CHANCE = 4.0  # standard deviations of a correlation, to which it may come by chance
_ROUNDING = 1e-12  # part of the largest eigenvalue
SUCCESSIVE = 0.3  # correlation from which an innovation could be foreseen by the one before


@dataclass(frozen=True)
class Autoregression:
    """x_t = sum_k A_k x_(t-k) + eps_t; coefficients: (order, q, q), noise: (q, q).

    x: the residuals, of outputs with a slow part what a filter of that leaves of them. slow: that
    part of each output, or none; empty where no output has any. deviance: minus twice the logarithm
    of the likelihood but for what residuals of the same samples share; criterion: Schwarz's.
    """

    coefficients: FloatArray
    noise: FloatArray
    slow: tuple[SlowNoise | None, ...] = ()
    deviance: float = math.inf
    criterion: float = math.inf

    def filters(self, seen: BoolArray, lengths: Sequence[int]) -> dict[int, SlowFilter]:
        """Filters of the outputs with a slow part, by their places; seen: (n, q), as measured."""
        return {
            j: SlowFilter.of(noise, seen[:, j], lengths)
            for j, noise in enumerate(self.slow)
            if noise is not None
        }


def colour(
    residual: FloatArray,
    seen: BoolArray,
    lengths: Sequence[int],
    slopes: FloatArray | None = None,
) -> Autoregression:
    """Colour of residuals (n, q) of records of the given lengths.

    seen: (n, q), which samples were measured; only equations without a lost one count. slopes: (n,
    q, p), of the fit that has left them.
    """
    plain, whole, q = fast_colour(residual, seen, lengths), _whole(seen), residual.shape[1]
    order = _largest_order(whole, lengths, 1) if whole.any() else 0
    if not order:
        return plain
    parts = [None] * q if slopes is None else list(np.moveaxis(slopes, 1, 0))
    tables = list(map(regression_table, residual.T, seen.T, parts))
    hidden = [slow_noise(*pair, lengths, order) for pair in zip(tables, seen.T, strict=True)]
    if not any(hidden):
        return plain
    slow = tuple(None if each is None else each.noise for each in hidden)
    without, filtered, sizes = residual.copy(), residual.copy(), 0.0
    filters = replace(plain, slow=slow).filters(seen, lengths)
    for j, each in enumerate(hidden):
        if each is not None:
            without[:, j] = each.without
            filtered[:, j] = remainder(filters[j].innovations(tables[j]))[0]
            sizes += 2.0 * float(np.sum(np.log(filters[j].sizes)))
    beside = _autoregression(filtered, whole, lengths)
    criterion = beside.criterion + sizes + PARAMETERS * len(filters) * math.log(len(residual))
    # What looks like a slow part of an output by itself may be what the outputs' noises share.
    if _autoregression(without, whole, lengths).criterion <= criterion:
        return plain
    return replace(beside, slow=slow, deviance=beside.deviance + sizes, criterion=criterion)


def fast_colour(residual: FloatArray, seen: BoolArray, lengths: Sequence[int]) -> Autoregression:
    """As of ``colour``, of noise that has no slow part."""
    q, whole = residual.shape[1], _whole(seen)
    if whole.any():
        return _autoregression(residual, whole, lengths)
    # Outputs that are never measured together: of each its own variance.
    variance = np.sum(residual**2, axis=0) / np.maximum(seen.sum(axis=0), 1)
    return Autoregression(np.zeros((0, q, q)), np.diag(variance))


def _whole(seen: BoolArray) -> BoolArray:
    """Samples, (n,), at which no output is lost that is measured at all."""
    whole: BoolArray = np.all(seen[:, seen.any(axis=0)], axis=1)
    return whole


def _autoregression(
    residual: FloatArray, whole: BoolArray, lengths: Sequence[int]
) -> Autoregression:
    """That of residuals (n, q) by least squares; whole: (n,), rows of which nothing was lost."""
    q = residual.shape[1]
    largest = _largest_order(whole, lengths, q)
    y, past = _regression(residual, whole, lengths, largest)
    # Below the columns of an order's past stands what these leave of the residuals.
    triangle: FloatArray = np.asarray(np.linalg.qr(np.hstack([past, y]), mode="r"))
    left = triangle[:, largest * q :]
    best, lowest, deviance = 0, math.inf, math.inf
    for order in range(largest + 1):
        noise = _covariance(left[order * q :], len(y), order)
        # A tiny part of its own: an output that never errs has no logarithm.
        sign, size = np.linalg.slogdet(noise + 1e-300 * np.eye(q))
        criterion = float(len(y) * size + np.log(max(len(y), 2)) * order * q * q)
        if sign > 0 and criterion < lowest:
            best, lowest, deviance = order, criterion, float(len(y) * size)
    y, past = _regression(residual, whole, lengths, best)
    solution = np.asarray(np.linalg.lstsq(past, y, rcond=None)[0], dtype=np.float64)
    noise = _covariance(y - past @ solution, len(y), best)
    coefficients = np.moveaxis(solution.reshape(best, q, q), 1, 2)
    return Autoregression(_decaying(coefficients, len(y)), noise, (), deviance, lowest)


def record_rows(lengths: Iterable[int]) -> list[slice]:
    """Rows of each record, of records of these lengths one after another."""
    ends = [0, *itertools.accumulate(lengths)]
    return [slice(begin, end) for begin, end in itertools.pairwise(ends)]


def successive_correlation(
    residual: FloatArray, seen: BoolArray, lengths: Sequence[int]
) -> FloatArray:
    """Correlation of each residual with the one before, (q,), 0 where chance explains it.

    residual, seen: (n, q), of records of the given lengths; what was not measured is left out, so
    that a residual may come before the next by more than a sample.

    >>> wave = np.cos(0.1 * np.arange(1000.0))[:, None]
    >>> successive_correlation(wave, np.full((1000, 1), True), [1000]).round(3)
    array([0.993])
    """
    products, squares = np.zeros(residual.shape[1]), np.zeros(residual.shape[1])
    for rows in record_rows(lengths):
        for j, (errors, measured) in enumerate(zip(residual[rows].T, seen[rows].T, strict=True)):
            e = errors[measured]
            products[j] += e[1:] @ e[:-1]
            squares[j] += e @ e
    correlation = np.divide(products, squares, out=np.zeros_like(products), where=squares > 0.0)
    by_chance = _BY_CHANCE / np.sqrt(np.maximum(seen.sum(axis=0), 1))
    return np.where(np.abs(correlation) > by_chance, correlation, 0.0)


def score_covariance(
    slopes: FloatArray,
    seen: BoolArray,
    lengths: Sequence[int],
    model: Autoregression,
    residual: FloatArray | None = None,
) -> FloatArray:
    """Covariance (p, p) of sum_t slopes_t' e_t; slopes: (n, q, p), record after record.

    seen: (n, q), which samples were measured. residual: (n, q), whose innovations may vary more
    where slopes are large, as noise in proportion to a signal does; None of noise that is even.
    """
    p = slopes.shape[2]
    total, filters = np.zeros((p, p)), model.filters(seen, lengths)
    parts = []
    for rows in record_rows(lengths):
        part = slopes[rows].copy()
        for j, kalman in filters.items():
            part[:, j] = kalman.response(part[:, j], rows)
        part = _response(part, model)
        total += np.einsum("tip,ij,tjr->pr", part, model.noise, part, optimize=True)
        parts.append(part)
    if residual is None:
        return total
    white, usable = _innovations(residual, seen, lengths, model)
    return _uneven(total, np.concatenate(parts)[usable], white[usable], model.noise)


def _innovations(
    residual: FloatArray, seen: BoolArray, lengths: Sequence[int], model: Autoregression
) -> tuple[FloatArray, BoolArray]:
    """What is new in residuals, (n, q), and where it is known, (n,): after enough samples."""
    fast, order = residual.copy(), len(model.coefficients)
    for j, kalman in model.filters(seen, lengths).items():
        fast[:, j] = kalman.innovations(fast[:, [j]])[:, 0]
    white, usable = fast.copy(), _usable(_whole(seen), lengths, order)
    for k, matrix in enumerate(model.coefficients, start=1):
        white[k:] -= fast[:-k] @ matrix.T
    return white, usable


def _uneven(
    even: FloatArray, responses: FloatArray, white: FloatArray, noise: FloatArray
) -> FloatArray:
    """The covariance of a score, larger in directions in which its own terms scatter more.

    By more than chance, else the larger of both would be too large. even: (p, p), of noise (q, q)
    whatever the time. responses: (n, q, p), white: (n, q). See White, "A heteroskedasticity-
    consistent covariance matrix estimator", Econometrica 48, 1980.
    """
    sizes = np.sqrt(np.diag(even))
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    values, vectors = np.linalg.eigh(even / np.outer(sizes, sizes))
    felt = values > _ROUNDING * max(float(values[-1]), 1e-300)
    roots = vectors[:, felt] * np.sqrt(values[felt]) * sizes[:, None]
    back = vectors[:, felt] / np.sqrt(values[felt]) / sizes[:, None]
    terms = np.einsum("tip,ti->tp", responses, white) @ back
    by_noise = np.linalg.cholesky(noise + 1e-12 * np.trace(noise) * np.eye(len(noise)))
    stated = np.einsum("tip,ij->tjp", responses, by_noise) @ back
    axes = np.linalg.eigh(terms.T @ terms - np.einsum("tjp,tjr->pr", stated, stated))[1]
    squares, expected = (terms @ axes) ** 2, np.sum((stated @ axes) ** 2, axis=1)
    more = (squares - expected).sum(axis=0)
    chance = _BY_CHANCE * np.sqrt(np.sum((squares - expected) ** 2, axis=0))
    wider = (roots @ axes)[:, more > chance]
    uneven: FloatArray = even + (wider * more[more > chance]) @ wider.T
    return uneven


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


def _largest_order(whole: BoolArray, lengths: Sequence[int], q: int) -> int:
    """Highest order that the shortest record bears and that lost samples leave equations for."""
    order = max(0, min(_LARGEST_ORDER, min(lengths) // (4 * q) - 1))
    while order and 2 * _usable(whole, lengths, order).sum() < whole.sum():
        order -= 1
    return order


def _usable(whole: BoolArray, lengths: Sequence[int], order: int) -> BoolArray:
    """Samples that were measured, as were ``order`` before them in their record, (n,)."""
    before_first = np.repeat([rows.start - 1 for rows in record_rows(lengths)], lengths)
    places = np.arange(len(whole))
    lost = np.maximum.accumulate(np.where(whole, before_first, places))
    usable: BoolArray = places - lost > order
    return usable


def _regression(
    residual: FloatArray, whole: BoolArray, lengths: Sequence[int], order: int
) -> tuple[FloatArray, FloatArray]:
    """Residuals whose past of ``order`` samples is known, and that past, nearest first."""
    rows = np.flatnonzero(_usable(whole, lengths, order))
    past = residual[rows[:, None] - np.arange(1, order + 1)]
    return residual[rows], past.reshape(len(rows), -1)


def _decaying(coefficients: FloatArray, samples: int) -> FloatArray:
    """Coefficients whose response decays within so many samples: least squares may make it grow."""
    order, q, _ = coefficients.shape
    if order == 0:
        return coefficients
    companion = np.eye(order * q, k=-q)
    companion[:q] = np.moveaxis(coefficients, 0, 1).reshape(q, order * q)
    radius = np.abs(np.linalg.eigvals(companion)).max()
    slowest = np.exp(-1.0 / samples)
    if radius <= slowest:
        return coefficients
    # All roots move towards zero in the same proportion.
    shrunk: FloatArray = coefficients * (slowest / radius) ** np.arange(1, order + 1)[:, None, None]
    return shrunk


def _covariance(e: FloatArray, samples: int, order: int) -> FloatArray:
    """Of what an autoregression leaves of so many samples, or of rows of the same products."""
    covariance: FloatArray = e.T @ e / max(samples - order * e.shape[1], 1)
    return covariance


def longest_memory(model: Autoregression, variance: FloatArray) -> FloatArray:
    """By how much each residual's mean varies more than if it were white, at least 1, (q,).

    variance: (q,), of the residuals. The ratio of the spectrum at zero frequency to the variance:
    so many samples count as one.
    """
    q = len(model.noise)
    slow = [1.0 if noise is None else noise.amplification for noise in model.slow] or np.ones(q)
    try:
        gain = np.linalg.inv(np.eye(q) - model.coefficients.sum(axis=0))
    except np.linalg.LinAlgError:  # a pole at exactly one
        return np.full(q, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = slow * np.diag(gain @ model.noise @ gain.T) / variance
    return np.where(np.isfinite(ratio), np.maximum(ratio, 1.0), 1.0)
