"""How much the estimates of single logs differ, where that is more than their noise lets them.

Of a model that is not quite right every log wants parameters of its own, and no colour of the
residuals tells by how much. The spread of what each log pulls the estimate by does (variances by
clusters; Bell & McCaffrey, "Bias reduction in standard errors for linear regression with
multi-stage samples", Survey Methodology 28, 2002). It counts where Cochran's test finds the logs to
disagree ("The combination of estimates from different experiments", Biometrics 10, 1954). Less
than that, and what too few logs inform, is widened by what all quantities show together (Birge,
"The calculation of errors by the method of least squares", Physical Review 40, 1932). A single log
is cut into parts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from sysid.arrays import FloatArray
from sysid.fitting.free_run import noiseless
from sysid.uncertainty.colour import record_rows
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.sensitivity import Sensitivity

_PARTS = 8  # of a single log
# Of a correct model's logs, and of its logs' parts, that the test calls at odds.
_CHANCE, _CHANCE_OF_PARTS = 0.01, 1e-4
# Share of what all logs tell of a direction above which the rest tell nothing of it.
_ALONE = 0.98
_FEWEST = 3.0  # logs, of like information, whose spread says something
# Of a correct model's logs, that are widened a little, for all of a modest spread is not found.
_MODEST = 0.1
_APART = 0.01  # of quantities that differ no more than all do, those whose own spread counts


@dataclass(frozen=True)
class LogSpread:
    """What each log moves the estimate of all by.

    influence: (n_logs, n_free), in search coordinates, such that its squares sum to the variance
    on average if logs differ by noise alone. information: (n_logs, n_free, n_free),
    parts of the covariance that each log's share of the curvature stands for. ratio: the spread's
    variance in parts of what noise makes, of so many degrees of freedom. at_odds: whether it is
    more than chance.
    """

    influence: FloatArray
    information: FloatArray
    ratio: float
    freedom: float
    at_odds: bool

    @property
    def disagreement(self) -> float:
        """Variance in parts of what noise makes, 1 where it is no more than chance."""
        return self.ratio if self.at_odds else 1.0

    def deviation(self, gradient: FloatArray, noise: float) -> float:
        """Standard deviation of what changes so (n_free,) with the coordinates.

        noise: that by the noise. The normal distribution's 95 % interval of the result is Student's
        of the spread. Of what too few logs inform, whose spread says little, it is that by noise
        widened as much as those of all quantities together, unless its own spread is apart.
        """
        together = noise * max(1.0, float(np.sqrt(self.ratio)))
        if not self.at_odds:
            return together
        together *= _student(self.freedom)
        moves = self.influence @ gradient
        n = len(moves)
        variance = float((n - 1) / n * np.sum((moves - moves.mean()) ** 2))
        shares = np.einsum("p,kpr,r->k", gradient, self.information, gradient)
        freedom = _freedom(shares / shares.sum())
        single = float(np.sqrt(variance)) * _student(freedom)
        if np.sum(shares) ** 2 > _FEWEST * np.sum(shares**2):
            return max(noise, single)
        apart = special.fdtrc(freedom, self.freedom, variance / (self.ratio * noise**2))
        return max(together, single if apart < _APART else float(np.sqrt(variance)))


def spread(
    sensitivity: Sensitivity, weighted: FloatArray, back: FloatArray, score: FloatArray
) -> LogSpread | None:
    """The spread between logs where it may be more than chance, or parts of one where it is.

    weighted: (n_residuals, n_outputs, n_free), slopes times weights. back: (n_free, rank), in
    whose directions the curvature is one. score: (n_free, n_free), its covariance by noise. None
    where the residuals are the simulation's: they are no noise that logs could differ by.
    """
    errors = np.sqrt(np.mean(sensitivity.residual**2, axis=0))
    if noiseless(sensitivity.objective, sensitivity.chromosome, errors):
        return None
    logs = len(sensitivity.lengths) > 1
    lengths = sensitivity.lengths if logs else _parts(sensitivity.lengths[0])
    rank = back.shape[1]
    if rank == 0 or len(lengths) < 2:
        return None
    noise, axes = np.linalg.eigh(back.T @ score @ back)
    back = back @ axes
    moves, leverages = np.empty((len(lengths), rank)), np.empty((len(lengths), rank, rank))
    for k, rows in enumerate(record_rows(lengths)):
        part = weighted[rows]
        push = np.einsum("tip,ti->p", part, sensitivity.residual[rows])
        leverages[k] = back.T @ np.einsum("tip,tir->pr", part, sensitivity.slopes[rows],
                                          optimize=True) @ back  # fmt: skip
        moves[k] = _moved(leverages[k], back.T @ push)
    freedom = np.array([_freedom(shares) for shares in np.diagonal(leverages, axis1=1, axis2=2).T])
    ratios = np.sum(moves**2, axis=0) / np.maximum(noise, 1e-12 * noise[-1])
    chance = float(special.chdtrc(freedom.sum(), freedom @ ratios))
    at_odds = chance <= (_CHANCE if logs else _CHANCE_OF_PARTS)
    if not at_odds and (not logs or chance > _MODEST):
        return None
    information = np.einsum("pi,kij,rj->kpr", back, leverages, back, optimize=True)
    ratio, total = float(freedom @ ratios / freedom.sum()), float(freedom.sum())
    return LogSpread(moves @ back.T, information, ratio, total, at_odds)


def _moved(leverage: FloatArray, push: FloatArray) -> FloatArray:
    """Move of the estimate by a log, of its leverage (rank, rank) and its score (rank,).

    The squares, summed over the logs, have the estimate's variance as their mean (Bell &
    McCaffrey's correction by the root of what is left without the log). By what leaving the log out
    would move, as the jackknife has it, a quantity that one log tells nearly alone would err a
    hundred times as much as it does.
    """
    share, axes = linalg.eigh(leverage)
    left = np.where(share < _ALONE, np.sqrt(np.abs(1.0 - share)), np.inf)
    moved: FloatArray = axes @ ((axes.T @ push) / left)
    return moved


def _freedom(shares: FloatArray) -> float:
    """Degrees of freedom of a spread of logs with these shares of the information."""
    return max(1.0 / float(np.sum(shares**2)) - 1.0, 1.0)


def _student(freedom: float) -> float:
    """Student's 95 % interval in parts of the normal distribution's."""
    return float(special.stdtrit(freedom, 0.975)) / Z95


def _parts(length: int) -> list[int]:
    """Lengths of the parts that a log is cut into."""
    ends = np.linspace(0, length, min(_PARTS, length) + 1).astype(int)
    return [int(n) for n in np.diff(ends)]
