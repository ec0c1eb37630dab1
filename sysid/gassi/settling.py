"""The last step of an identification: which minimum, by which weights.

The mean of the outputs' RMSEs serves the search. Statistically it is not the figure to end with:
it lets an output that is noisy, or whose errors wander slowly, decide what another with small
white errors could tell better. The likelihood of independent normal errors whose variances are
unknown has its maximum where the product of the RMSEs is least (Ljung, "System Identification",
section 7.4, with a diagonal covariance): every output then weighs by the inverse of its own error.
Among minima the likelihood chooses once more, each output counted by as many independent samples
as the colour of its errors leaves; those that it cannot tell apart are rivals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.free_run import FINER, FINEST
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import Refinement, refine, refine_each
from sysid.gassi.lookalikes import lookalikes
from sysid.uncertainty.colour import colour, longest_memory
from sysid.uncertainty.sensitivity import (
    Sensitivity,
    common_steps,
    coordinate_units,
    sensitivity,
)

_ROUNDS = 6  # of weights and parameters in turn
_STEADY = 1e-3  # part by which weights may still change
# An output explained much better than the others keeps this share of the largest error, or the
# arithmetic of its last digits would decide.
_LEAST_SHARE = 1e-2
# Errors below this part of the simulation's accuracy are its own: there is no noise to weigh by.
_OWN = 0.1
_FINER, _FINEST = 1e-3, 1e-9
# Colour does not make an output's errors count as fewer independent samples than this.
_FEWEST = 30.0
# Twice the logarithm of a likelihood ratio above which one minimum is no rival to another: one
# in a hundred for the four parameters in which such minima typically differ.
_TOLD_APART = 13.3
_CONCEIVABLE = 40.0  # the same before a minimum has been refined to its end
_QUICKLY, _ROUGHLY = 15, 1e-4  # iterations and tolerance until then
_EXPLORED = 2  # minima whose lookalikes are descended from
# Minima are one when the way between them, were all linear, changed twice the log-likelihood by
# less than this.
_ONE = 16.0

Watch = Callable[[Refinement], None]


@dataclass(frozen=True)
class Settled:
    """Where an identification ends.

    objective: with the weights that were used in the end. chromosome: (n_free,). rivals: other
    chromosomes, far from it, that the data do not tell from it.
    """

    objective: Objective
    chromosome: FloatArray
    rivals: tuple[FloatArray, ...] = ()


def settle(
    objective: Objective, minima: Sequence[FloatArray], watch: Watch | None = None
) -> Settled:
    """The likeliest of some minima (n_free,) of the mean RMSE and of their lookalikes."""
    objective = _resolved(objective, minima[0])
    known = _Known(objective)
    for minimum in minima:
        known.add(_weighed(objective, minimum, watch))
    explored: list[_Settling] = []
    while len(explored) < _EXPLORED:
        best = known.ranked()[0]
        if any(best is one for one in explored):
            break  # nothing better was found around it
        explored.append(best)
        for found in refine_each(
            best.objective,
            lookalikes(best.objective, best.chromosome),
            max_iterations=_QUICKLY,
            tolerance=_ROUGHLY,
            enough=lambda chromosome: not known.new(chromosome),
        ):
            # By the best one's weights, until it turns out to matter.
            rough = _as_found(best.objective, found.chromosome, found.rms)
            if known.new(found.chromosome) and known.evidence(rough, best) < _CONCEIVABLE:
                known.add(_weighed(objective, found.chromosome, watch))
    best, *others = known.ranked()
    best = _exact(best)
    near = [one for one in others if known.evidence(one, best) < _TOLD_APART]
    return Settled(best.objective, best.chromosome, tuple(one.chromosome for one in near))


@dataclass(frozen=True)
class _Settling:
    """A minimum by the likelihood: chromosome (n_free,), the outputs' errors (n_outputs,)."""

    objective: Objective
    chromosome: FloatArray
    rms: FloatArray
    feasible: bool


class _Known:
    """The minima found so far."""

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        self._minima: list[_Settling] = []
        self._samples: FloatArray | None = None
        self._sensitivity: Sensitivity | None = None
        self._information: FloatArray | None = None

    def add(self, minimum: _Settling) -> None:
        """One more, unless it is known."""
        if self.new(minimum.chromosome):
            self._minima.append(minimum)

    def new(self, chromosome: FloatArray) -> bool:
        """Whether it is far from all others in directions that the data feel."""
        space = self._objective.space
        for known in self._minima:
            moved = space.encode(known.chromosome) - space.encode(chromosome)
            moved /= coordinate_units(self._objective, known.chromosome)
            if moved @ self._first_information() @ moved < _ONE:
                return False
        return True

    def ranked(self) -> list[_Settling]:
        """The likeliest first, feasible before infeasible."""
        first = self._minima[0]
        return sorted(self._minima, key=lambda one: (not one.feasible, self.evidence(one, first)))

    def evidence(self, one: _Settling, other: _Settling) -> float:
        """Twice the logarithm of the likelihood ratio by which the other is likelier."""
        samples = self._independent_samples()
        floor = _LEAST_SHARE * max(one.rms.max(), other.rms.max(), 1e-300)
        ratio = np.log(np.maximum(one.rms, floor) / np.maximum(other.rms, floor))
        return float(2.0 * np.sum(samples * ratio))

    def _independent_samples(self) -> FloatArray:
        """How many independent samples each output's errors amount to, (n_outputs,)."""
        if self._samples is None:
            found = self._first_sensitivity()
            noise = colour(found.residual, found.seen, found.lengths)
            memory = longest_memory(noise, np.mean(found.residual**2, axis=0))
            weights = self._objective.weights * len(self._objective.weights)
            self._samples = weights * np.maximum(self._objective.counts / memory, _FEWEST)
        return self._samples

    def _first_information(self) -> FloatArray:
        """What the data tell of the coordinates at the minimum that was known first."""
        if self._information is None:
            found = self._first_sensitivity()
            variance: FloatArray = np.mean(found.residual**2, axis=0)
            variance = np.maximum(variance, max(_LEAST_SHARE**2 * variance.max(), 1e-300))
            felt = (found.slopes / np.sqrt(variance)[:, None]).reshape(-1, found.slopes.shape[2])
            self._information = felt.T @ felt
        return self._information

    def _first_sensitivity(self) -> Sensitivity:
        """At the minimum that was known first."""
        if self._sensitivity is None:
            first = self._minima[0]
            steps = common_steps(first.objective, first.chromosome)
            self._sensitivity = sensitivity(first.objective, first.chromosome, steps)
        return self._sensitivity


def _resolved(objective: Objective, chromosome: FloatArray) -> Objective:
    """The objective with simulations as accurate as they are meant to be, at a chromosome.

    The steps are chosen by what each of them errs. Where little is damped, as in a pendulum that
    swings freely, such errors add up along the record; twice the steps show by how much.
    """
    accuracy = objective.simulator.accuracy
    while objective.simulator.accuracy >= FINEST:
        steps = objective.steps_needed(chromosome[None])[0]
        coarse = objective.residuals(chromosome[None], steps).values
        error = np.sqrt(
            np.mean((coarse - objective.residuals(chromosome[None], 2 * steps).values) ** 2, axis=0)
        )
        if not np.max(error) > accuracy:
            break
        objective = objective.finer(FINER * objective.simulator.accuracy)
    return objective


def _exact(minimum: _Settling) -> _Settling:
    """One whose errors are the simulation's own goes on with finer simulations."""
    accuracy = minimum.objective.simulator.accuracy
    if minimum.rms.max() > _OWN * accuracy:
        return minimum
    objective = minimum.objective.finer(max(_FINER * accuracy, _FINEST))
    found = refine(objective, minimum.chromosome)
    return _as_found(objective, found.chromosome, found.rms)


def _weighed(objective: Objective, chromosome: FloatArray, watch: Watch | None) -> _Settling:
    """Weights and parameters in turn, until the weights are those of the errors."""
    given = objective.weights
    rms = objective.rms(chromosome[None])[0]
    # A refinement may end where a simulation takes more steps than a chromosome is allowed.
    noisy = np.isfinite(rms).all() and given @ rms > _OWN * objective.simulator.accuracy
    for _ in range(_ROUNDS if noisy else 0):
        weights = given / np.maximum(rms, max(_LEAST_SHARE * rms.max(), 1e-300))
        weighed = objective.weighed(weights)
        steady = np.allclose(weighed.weights, objective.weights, rtol=_STEADY)
        objective = weighed
        found = refine(objective, chromosome, on_iteration=watch)
        chromosome, rms = found.chromosome, found.rms
        if steady:
            break
    return _as_found(objective, chromosome, rms)


def _as_found(objective: Objective, chromosome: FloatArray, rms: FloatArray) -> _Settling:
    finite = np.where(np.isfinite(rms), rms, np.finfo(np.float64).max)
    return _Settling(objective, chromosome, finite, objective.space.feasible(chromosome))
