"""Profile likelihood: how much worse the best fit becomes as one parameter is moved."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.problem.model import ModelError
from sysid.problem.space import HeldSpace
from sysid.uncertainty.directions import directions
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.sensitivity import common_steps, coordinate_units, sensitivity

_STEPS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)  # standard deviations, outwards
_ITERATIONS = 20
# A parameter without a standard deviation is moved by parts of its range.
_BLIND_SHARE = 0.05


@dataclass(frozen=True)
class Profile:
    """The profile of one parameter.

    values: (n,), rising, the estimate among them. statistic: (n,), twice the loss of
    log-likelihood with all the others fitted anew; 3.84 is the 95 % level of chi-squared with one
    degree of freedom. low, high: where it crosses that level, None where it does not within the
    range.
    """

    name: str
    unit: str
    value: float
    values: FloatArray
    statistic: FloatArray
    low: float | None
    high: float | None


def profile(objective: Objective, chromosome: FloatArray, name: str) -> Profile:
    """Profile of a free parameter around an identified chromosome, (n_free,).

    The loss of fit is scaled so that its curvature is that of the covariance, in which the
    residuals' colour is counted (the adjusted likelihood of Pace, Salvan & Sartori, "Adjusting
    composite likelihood ratio statistics", Statistica Sinica 21, 2011). Raises ModelError for a
    name that is not free.
    """
    space = objective.space
    if name not in space.names:
        raise ModelError(
            f"parameter {name!r} is not free, so it has no profile; free are "
            + ", ".join(space.names)
        )
    tracer = _Tracer(objective, chromosome, space.names.index(name))
    below, above = tracer.side(-1.0), tracer.side(1.0)
    points = [*reversed(below), (tracer.centre, 0.0), *above]
    ends = [tracer.in_units(_crossing([(tracer.centre, 0.0), *side])) for side in (below, above)]
    parameter = space.parameters[tracer.place]
    values = [tracer.in_units(coordinate) for coordinate, _ in points]
    return Profile(
        name,
        parameter.unit,
        float(chromosome[tracer.place]),
        np.array(values, dtype=np.float64),
        np.array([statistic for _, statistic in points]),
        ends[0],
        ends[1],
    )


class _Tracer:
    """Moves one coordinate outwards and fits the others."""

    def __init__(self, objective: Objective, chromosome: FloatArray, place: int) -> None:
        self.objective, self.place = objective, place
        self.space = objective.space
        coded = self.space.encode(chromosome)
        self.start = coded
        self.centre = float(coded[place])
        self.unit, self.factor = self._scale(chromosome)
        self.error = self._error(chromosome)

    def side(self, sign: float) -> list[tuple[float, float]]:
        """Coordinates and statistics on one side, until well beyond the 95 % level."""
        lower, upper = self.space.coded_bounds
        end = float((lower if sign < 0.0 else upper)[self.place])
        at, points = self.start, []
        for step in _STEPS:
            coordinate = self.centre + sign * step * self.unit
            beyond = sign * (coordinate - end) >= 0.0
            coordinate = end if beyond else coordinate
            if coordinate == self.centre:
                break
            at, statistic = self._fitted(at, coordinate)
            points.append((coordinate, statistic))
            if beyond or statistic > 1.5 * Z95**2:
                break
        return points

    def in_units(self, coordinate: float | None) -> float | None:
        """The parameter's value at a coordinate."""
        if coordinate is None:
            return None
        coded = self.start.copy()
        coded[self.place] = coordinate
        return float(self.space.decode(coded)[self.place])

    def _scale(self, chromosome: FloatArray) -> tuple[float, float]:
        """A standard deviation in search coordinates, and the statistic per loss of error."""
        objective = self.objective
        steps = common_steps(objective, chromosome)
        found = sensitivity(objective, chromosome, steps)
        told = directions(objective, chromosome, steps, found, self.space.on_bound(chromosome))
        n = sum(found.lengths)
        blind = _BLIND_SHARE * float(self.space.width[self.place])
        variance = float(told.covariance[self.place, self.place])
        own = variance > 0.0 and np.sum(told.lost[:, self.place] ** 2) < 1e-3
        inflation = told.inflation(self.place if own else None)
        size = float(coordinate_units(objective, chromosome)[self.place])
        return (np.sqrt(variance) * size if own else blind), 2.0 * n / inflation

    def _fitted(self, at: FloatArray, coordinate: float) -> tuple[FloatArray, float]:
        held = HeldSpace.holding(self.space, self.place, coordinate)
        moved = at.copy()
        moved[self.place] = coordinate
        result = refine(self.objective.over(held), held.decode(moved), max_iterations=_ITERATIONS)
        statistic = max(0.0, self.factor * (result.error - self.error))
        return held.encode(result.chromosome), statistic

    def _error(self, chromosome: FloatArray) -> float:
        steps = common_steps(self.objective, chromosome)
        found = self.objective.residuals(chromosome[None], steps, keep=False)
        return float(self.objective.error_of(found.rms)[0])


def _crossing(points: list[tuple[float, float]]) -> float | None:
    """Where the root of the statistic, nearly straight, passes the 95 % level."""
    for (a, low), (b, high) in itertools.pairwise(points):
        below, above = np.sqrt(low), np.sqrt(high)
        if below <= Z95 < above:
            return float(a + (b - a) * (Z95 - below) / (above - below))
    return None
