"""The last step of an identification: which minimum, by which weights.

The mean of the outputs' RMSEs serves the search. Statistically it is not the figure to end with:
it lets an output that is noisy, or whose errors wander slowly, decide what another with small
white errors could tell better. The likelihood of independent normal errors whose variances are
unknown has its maximum where the product of the RMSEs is least (Ljung, "System Identification",
section 7.4, with a diagonal covariance): every output then weighs by the inverse of its own error.
Minima that the mean cannot tell apart, the likelihood often does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.model import FloatArray
from sysid.objective import Objective
from sysid.refinement import Refinement, refine

_ROUNDS = 6  # of weights and parameters in turn
_STEADY = 1e-3  # part by which weights may still change
# An output explained much better than the others keeps this share of the largest error, or the
# arithmetic of its last digits would decide.
_LEAST_SHARE = 1e-2
# Errors below this part of the simulation's accuracy are its own: there is no noise to weigh by.
_OWN = 0.1


@dataclass(frozen=True)
class Settled:
    """Where an identification ends.

    objective: with the weights that were used in the end. chromosome: (n_free,).
    loss: minus the mean log-likelihood of a sample up to a constant, the weighted mean of the
    logarithms of the outputs' RMSEs.
    """

    objective: Objective
    chromosome: FloatArray
    loss: float


def settle(
    objective: Objective,
    minima: Sequence[FloatArray],
    on_iteration: Callable[[Refinement], None] | None = None,
) -> Settled:
    """The likeliest of some minima (n_free,) of the mean RMSE, refined by the likelihood."""
    settled = [_settle(objective, minimum, on_iteration) for minimum in minima]
    return min(settled, key=lambda one: one.loss)


def _settle(
    objective: Objective,
    chromosome: FloatArray,
    on_iteration: Callable[[Refinement], None] | None,
) -> Settled:
    given = objective.weights
    rms = objective.rms(chromosome[None])[0]
    # A refinement may end where a simulation takes more steps than a chromosome is allowed.
    noisy = np.isfinite(rms).all() and given @ rms > _OWN * objective.simulator.accuracy
    for _ in range(_ROUNDS if noisy else 0):
        weights = given / np.maximum(rms, max(_LEAST_SHARE * rms.max(), 1e-300))
        weighed = objective.weighed(weights)
        steady = np.allclose(weighed.weights, objective.weights, rtol=_STEADY)
        objective = weighed
        chromosome = refine(objective, chromosome, on_iteration=on_iteration).chromosome
        rms = objective.rms(chromosome[None])[0]
        if steady:
            break
    floor = max(_LEAST_SHARE * rms.max(), 1e-300)
    return Settled(objective, chromosome, float(given @ np.log(np.maximum(rms, floor))))
