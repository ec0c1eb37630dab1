"""Whether data that are mended are explained much better, by a search anew.

For what no small change of a channel leads to, so that slopes do not tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from sysid.arrays import FloatArray
from sysid.judging.alternatives import shared
from sysid.judging.evidence import independent_samples
from sysid.judging.findings import Move, moves_of
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError
from sysid.uncertainty import Uncertainty

if TYPE_CHECKING:
    from sysid.gassi import GASSI

_LESS = 0.5  # of the residuals' squares, that data the right way leave
_SURE = 1e-4  # probability by chance


@dataclass(frozen=True)
class Explained:
    """By how much better: share of the residuals' squares, probability by chance, and moves."""

    share: float
    p_value: float
    moves: tuple[Move, ...]


def explained_mended(
    estimator: GASSI,
    uncertainty: Uncertainty,
    left: Sequence[FloatArray],
    mended: Sequence[Dataset],
    as_logged: Callable[[FloatArray], FloatArray],
) -> Explained | None:
    """What a search on mended records explains; None where that is not much better.

    left: residuals (n, n_outputs) of the records as they were. as_logged: residuals of a mended
    record as those of what was logged.
    """
    from sysid.gassi import GASSI

    # Compared is what free runs leave of all outputs together, which that criterion makes least.
    settings = estimator.get_params(deep=False)
    settings |= {"criterion": "likelihood", "process_noise": None}
    try:
        fitted = GASSI(**settings).fit(list(mended))
        anew = [as_logged(record.outputs - fitted.predict(record)) for record in mended]
    except ModelError:
        return None
    rest = np.concatenate(anew)
    seen = np.isfinite(rest).all(axis=1) & np.isfinite(np.concatenate(left)).all(axis=1)
    before, after = (np.sum(np.concatenate(e)[seen] ** 2, axis=0) for e in (left, anew))
    if not seen.any() or not np.all(before > 0.0):
        return None
    share = float(np.exp(np.mean(np.log(np.maximum(after, 1e-300) / before))))
    samples = independent_samples([rest[seen]])
    p_value = float(chdtrc(1, max(-samples * len(before) * np.log(share), 0.0)))
    if share > _LESS or p_value > _SURE:
        return None
    estimates = list(shared(uncertainty, fitted.parameters_))
    moves = moves_of(estimates, [e.at(fitted.parameters_) - e.value for e in estimates])
    return Explained(1.0 - share, p_value, moves)
