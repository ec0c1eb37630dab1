"""Profile likelihood: how much worse the best fit becomes as one parameter is moved."""

import itertools
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.problem.model import ModelError
from sysid.uncertainty.directions import PART, directions
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.sensitivity import coordinate_units, sensitivity

_STEPS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)  # standard deviations, outwards
_ITERATIONS = 20
# A parameter without a standard deviation is moved by parts of its range.
_BLIND_SHARE = 0.05


@dataclass(frozen=True)
class Profile:
    """The profile of one parameter.

    values: (n,), rising, the estimate among them. statistic: (n,), twice the loss of
    log-likelihood with all other parameters fitted anew; 3.84 is the 95 % level of chi-squared
    with one degree of freedom. low, high: where it crosses that level, None where it does not
    within the range.
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
        free = ", ".join(space.names)
        raise ModelError(f"parameter {name!r} is not free, so it has no profile; free are {free}")
    place = space.names.index(name)
    tracer = _Tracer(objective, chromosome, place)
    centre = (tracer.centre, 0.0)
    below, above = [centre, *tracer.side(-1.0)], [centre, *tracer.side(1.0)]
    points = [*reversed(below), *above[1:]]
    values = np.array([tracer.value(coordinate) for coordinate, _ in points])
    statistic = np.array([statistic for _, statistic in points])
    unit, value = space.parameters[place].unit, float(chromosome[place])
    ends = tracer.crossing(below), tracer.crossing(above)
    return Profile(name, unit, value, values, statistic, *ends)


class _Tracer:
    """Moves a coordinate from ``centre`` by parts of its deviation ``unit`` and fits the others."""

    def __init__(self, objective: Objective, chromosome: FloatArray, place: int) -> None:
        self.objective, self.space, self.place = objective, objective.space, place
        self.start = self.space.encode(chromosome)
        self.centre = float(self.start[place])
        local = sensitivity(objective, chromosome)
        rms = objective.residuals(chromosome[None], local.steps, keep=False).rms
        self.error = float(objective.error_of(rms)[0])
        determined = directions(local)
        variance = float(determined.covariance[place, place])
        has_deviation = variance > 0.0 and determined.undetermined_share[place] < PART
        self.unit = _BLIND_SHARE * float(self.space.width[place])
        if has_deviation:
            self.unit = float(np.sqrt(variance) * coordinate_units(objective, chromosome)[place])
        inflation = determined.inflation(place if has_deviation else None)
        # Statistic per loss of error.
        self.factor = 2.0 * sum(local.lengths) / inflation

    def side(self, sign: float) -> list[tuple[float, float]]:
        """Coordinates and statistics on one side, outwards until well beyond the 95 % level."""
        lower, upper = self.space.coded_bounds
        end = float((lower if sign < 0.0 else upper)[self.place])
        at, points = self.start, []  # each fit starts from the one before
        for step in _STEPS:
            coordinate = self.centre + sign * step * self.unit
            beyond = sign * (coordinate - end) >= 0.0
            coordinate = end if beyond else coordinate
            if coordinate == self.centre:
                break
            held = self.space.holding(self.place, coordinate)
            at = at.copy()
            at[self.place] = coordinate
            best = refine(self.objective.over(held), held.decode(at), max_iterations=_ITERATIONS)
            at = held.encode(best.chromosome)
            statistic = max(0.0, self.factor * (best.error - self.error))
            points.append((coordinate, statistic))
            if beyond or statistic > 1.5 * Z95**2:
                break
        return points

    def value(self, coordinate: float) -> float:
        """The parameter's value at a coordinate."""
        coded = self.start.copy()
        coded[self.place] = coordinate
        return float(self.space.decode(coded)[self.place])

    def crossing(self, points: list[tuple[float, float]]) -> float | None:
        """Value at which the root of the statistic, nearly straight, passes the 95 % level."""
        for (a, low), (b, high) in itertools.pairwise(points):
            below, above = np.sqrt(low), np.sqrt(high)
            if below <= Z95 < above:
                return self.value(float(a + (b - a) * (Z95 - below) / (above - below)))
        return None
