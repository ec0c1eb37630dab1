"""Do inputs answer what outputs err by? Then noise drives the plant, and fits by free runs are off.

Under feedback an input holds the outputs' noise of before. Where that is white no later output
errs with it, and a free run's fit is right; where it has a memory it is not (Forssell & Ljung,
"Closed-loop identification revisited", Automatica 35, 1999). Residuals that are weighed by their
colour are: what is new in each has not been answered yet.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtrc

from sysid.arrays import FloatArray
from sysid.judging.whitener import Whitener
from sysid.uncertainty.colour import colour, record_rows

_AT_REST = 0.5  # share of samples in which an input stands still that answers nothing
_SOON = 3  # samples within which a controller answers, the one of the error itself the first


def answer_probability(white: FloatArray, signal: FloatArray, lengths: Sequence[int]) -> float:
    """Probability that an input (n,) by chance goes so with outputs' errors just before it.

    white: (n, n_outputs), what is new in these errors. Of the input what is new counts as well, or
    chance would do more (Haugh, J. American Statistical Association 71, 1976).

    >>> e = np.random.default_rng(0).standard_normal((2, 1000))
    >>> bool(answer_probability(e[:1].T, e[1] - 0.3 * np.roll(e[0], 1), [1000]) < 1e-6)
    True
    """
    new = news(signal, lengths)
    if not new.any() or np.mean(np.diff(signal) == 0.0) > _AT_REST:
        return 1.0
    # An output that an input reaches at once, as its sensor or a late sample does, errs with what
    # is new of it where that is large; what a controller answers is in all that is new.
    small = np.where(np.abs(new) <= np.median(np.abs(new)), new, 0.0)
    statistic = np.zeros(white.shape[1])
    for lag in range(_SOON):
        answer = new if lag else small
        products, squares = np.zeros(white.shape[1]), np.zeros(white.shape[1])
        for rows in record_rows(lengths):
            late, errors = answer[rows][lag:], white[rows][: rows.stop - rows.start - lag]
            products += late @ errors
            squares += late**2 @ errors**2
        statistic += np.divide(products**2, squares, out=np.zeros_like(squares), where=squares > 0)
    chances = chdtrc(_SOON, statistic)
    return min(float(chances.min()) * len(chances), 1.0)


def news(signal: FloatArray, lengths: Sequence[int]) -> FloatArray:
    """What of an input (n,) was not to be foreseen from its samples before."""
    moved, seen = (signal - signal.mean())[:, None], np.ones((len(signal), 1), dtype=bool)
    if not moved.any():
        return np.zeros_like(signal)
    whitener = Whitener.by(colour(moved, seen, lengths), seen, lengths)
    return whitener.in_time(moved)[:, 0]


def answers(signal: FloatArray, lengths: Sequence[int], n_outputs: int) -> FloatArray:
    """Errors that an input (n,) would answer by its news, (n, n_outputs, k), by samples between."""
    new, columns = news(signal, lengths), np.zeros((len(signal), n_outputs, _SOON * n_outputs))
    for rows in record_rows(lengths):
        for lag in range(min(_SOON, rows.stop - rows.start)):
            for j in range(n_outputs):
                columns[rows][: rows.stop - rows.start - lag, j, _SOON * j + lag] = new[rows][lag:]
    return columns
