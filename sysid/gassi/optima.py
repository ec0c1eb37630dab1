"""Minima of an objective, compared by the likelihood that each has by its own weights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.descent import Point, Restriction
from sysid.fitting.innovations import Innovations
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import begin, refine_each
from sysid.uncertainty.colour import colour, longest_memory
from sysid.uncertainty.sensitivity import Sensitivity, sensitivity
from sysid.uncertainty.ties import Shown, ties

# While minima are sought an output explained much better than the others counts for this share of
# the largest error: by less their valleys are too narrow to be gone along from afar.
LEAST_SHARE = 1e-2
# Deviance above which one minimum is no rival to another: one in a hundred for the four
# parameters in which such minima typically differ.
TOLD_APART = 13.3
QUICKLY, ROUGHLY = 15, 1e-4  # iterations and tolerance until a minimum is refined to its end
TINY = 1e-300
# Colour does not make an output's errors count as fewer independent samples than this.
_FEWEST = 30.0
_WAY = np.array([0.25, 0.5, 0.75])  # parts of the way between two minima that are tried
_SLACK = 1e-10  # of the most that is told, which is told of every coordinate
# Minima are one when the way between them, were all linear, changed twice the log-likelihood by
# less than this.
_ONE = 16.0


@dataclass(frozen=True)
class Optimum:
    """A minimum by its own weights: chromosome (n_free,), the outputs' errors (n_outputs,)."""

    objective: Objective
    chromosome: FloatArray
    rms: FloatArray
    feasible: bool

    @classmethod
    def of(cls, objective: Objective, chromosome: FloatArray, rms: FloatArray) -> Self:
        """With errors that are finite where a simulation failed, too."""
        finite = np.where(np.isfinite(rms), rms, np.finfo(np.float64).max)
        return cls(objective, chromosome, finite, objective.space.feasible(chromosome))

    def by(self, objective: Objective) -> Self:
        """With the errors that another objective gives it."""
        rms = objective.rms(self.chromosome[None])[0]
        return self.of(self.objective, self.chromosome, rms)


def to_compare(objective: Objective) -> Objective:
    """By which minima far from one another are compared.

    All by the same means, whether or not what looks like one of them has asked for exact ones:
    each would be likelier or less by several than by those of parabolas.
    """
    return objective.uneased.exact_means if isinstance(objective, Innovations) else objective


def bounded(rms: FloatArray, least: float) -> FloatArray:
    """Errors (n_outputs,), none less than a share of the largest."""
    errors: FloatArray = np.maximum(rms, max(least * rms.max(), TINY))
    return errors


def chromosomes_of(optima: Sequence[Optimum]) -> tuple[FloatArray, ...]:
    """Where minima are, (n_free,) each."""
    return tuple(optimum.chromosome for optimum in optima)


class Optima:
    """Minima far from each other, compared by what the data tell at the first.

    scale: errors of the outputs (n_outputs,) that are alike to start from. least: share of the
    largest error that every one counts for.
    """

    def __init__(
        self, objective: Objective, scale: FloatArray | float = 1.0, least: float = LEAST_SHARE
    ) -> None:
        self._objective, self._scale, self._least = objective, np.maximum(scale, TINY), least
        self._optima: list[Optimum] = []

    @classmethod
    def around(cls, first: Optimum, objective: Objective, too_well: FloatArray) -> Self:
        """One refitted for noisy inputs; too_well: (n_outputs,), by which errors count for less."""
        first = first.by(to_compare(first.objective))
        optima = cls(objective, first.rms * too_well)
        optima.add(first)
        return optima

    def add(self, optimum: Optimum) -> None:
        """Add a minimum if it is a new one."""
        if self.new(optimum.chromosome):
            self._optima.append(optimum)

    def new(self, chromosome: FloatArray, others: Sequence[FloatArray] = ()) -> bool:
        """Whether a chromosome is far from all minima, and others, where the data feel it.

        Along ties it is no other minimum, however far.
        """
        minima = [*chromosomes_of(self._optima), *others]
        if not minima:
            return True
        at, *ends = map(self._shown.coordinates, [chromosome, *minima])
        moves = np.array(ends) - at
        return not np.any(np.sum((moves @ self._information) * moves, axis=1) < _ONE)

    def refit(self, optimum: Optimum, refitted: Optimum | None) -> None:
        """Put one fitted by its own noise, if it could be, in the place of a minimum."""
        if refitted is not None:
            place = [kept is optimum for kept in self._optima].index(True)
            self._optima[place] = refitted.by(to_compare(optimum.objective))

    def ranked(self) -> list[Optimum]:
        """The likeliest first, feasible before infeasible."""
        first = self._optima[0]
        return sorted(self._optima, key=lambda o: (not o.feasible, self.deviance(o, first)))

    def deviance(self, optimum: Optimum, reference: Optimum) -> float:
        """Twice the logarithm of the likelihood ratio of the reference and the optimum."""
        return self._deviance(optimum.rms, reference.rms)

    def error_at(self, objective: Objective, optimum: Optimum, deviance: float) -> float:
        """Error, by an objective, of a minimum that is less likely than one by so much, and more.

        Were all outputs to err more alike, by twice as much.
        """
        error = float(objective.error_of(optimum.rms[None])[0])
        return error * math.exp(deviance / float(np.sum(self._independent_samples)))

    def _deviance(self, rms: FloatArray, reference: FloatArray) -> float:
        sizes = np.log(np.maximum([rms, reference], TINY)) - np.log(self._scale)
        sizes = np.maximum(sizes, sizes.max() + np.log(self._least))
        return float(2.0 * np.sum(self._independent_samples * (sizes[0] - sizes[1])))

    def connected(self, optimum: Optimum, rivals: Sequence[Optimum]) -> list[bool]:
        """Whether ways lead from one to others on which the data rule nothing out.

        The coordinate that differs by most deviations, so none that is only felt with others, is
        moved in steps, all others are fitted to each.
        """
        objective, coded = optimum.objective, self._objective.space.encode
        here = optimum.by(objective)
        start, ends = coded(optimum.chromosome), [coded(rival.chromosome) for rival in rivals]
        places = [int(np.argmax(np.abs(end - start) / self._deviations)) for end in ends]
        at, passable = [start] * len(ends), [True] * len(ends)
        for part in _WAY:
            descents = {}
            for k in np.flatnonzero(passable).tolist():
                place, way = places[k], ends[k] - at[k]
                coordinate = start[place] + part * (ends[k] - start)[place]
                left = way[place]  # nothing, of two that rounding alone sets apart
                begun = at[k] + ((coordinate - at[k][place]) / left if left else 0.0) * way
                held = Restriction(held=(place, float(coordinate)))
                descents[k] = begin(
                    objective, objective.space.decode(begun), tolerance=ROUGHLY, restriction=held
                )
            fits = refine_each(
                objective,
                list(descents.values()),
                max_iterations=QUICKLY,
                enough=lambda point: self._alike(point, here),
            )
            for k, fit in zip(descents, fits, strict=True):
                reached = Optimum.of(objective, fit.chromosome, fit.rms)
                passable[k] = self.deviance(reached, here) < TOLD_APART
                at[k] = coded(fit.chromosome)
        return passable

    def _alike(self, point: Point, optimum: Optimum) -> bool:
        """Whether the data do not tell a point that was simulated from an optimum."""
        rms = point.accurate_rms
        return rms is not None and self._deviance(rms, optimum.rms) < TOLD_APART

    @cached_property
    def _independent_samples(self) -> FloatArray:
        """Independent samples that each output's errors amount to, (n_outputs,)."""
        first = self._sensitivity
        noise = colour(first.residual, first.seen, first.lengths)
        memory = longest_memory(noise, np.mean(first.residual**2, axis=0))
        weights = self._objective.weights * len(self._objective.weights)
        samples: FloatArray = weights * np.maximum(self._objective.counts / memory, _FEWEST)
        return samples

    @cached_property
    def _information(self) -> FloatArray:
        """Fisher information of the coordinates, (n_free, n_free), were errors white."""
        first = self._sensitivity
        rms: FloatArray = np.sqrt(np.mean(first.residual**2, axis=0)) / self._scale
        rms = self._scale * bounded(rms, self._least)
        slopes = (first.slopes / rms[:, None]).reshape(-1, first.slopes.shape[2])
        information: FloatArray = slopes.T @ slopes
        return information

    @cached_property
    def _deviations(self) -> FloatArray:
        """Deviations of the coordinates, (n_free,), were errors white, but for a common factor."""
        width = self._objective.space.width
        information = self._information * np.outer(width, width)
        most = max(float(np.diag(information).max()), TINY)
        inverse = np.linalg.inv(information / most + _SLACK * np.eye(len(width)))
        deviations: FloatArray = np.sqrt(np.maximum(np.diag(inverse), 1.0)) * width
        return deviations

    @cached_property
    def _shown(self) -> Shown:
        first = self._sensitivity
        return Shown(ties(first), self._objective.space, first.chromosome)

    @cached_property
    def _sensitivity(self) -> Sensitivity:
        return sensitivity(self._optima[0].objective, self._optima[0].chromosome)
