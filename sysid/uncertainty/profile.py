"""Profile likelihood: how much worse the best fit becomes as one parameter is moved."""

from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.problem.model import ModelError
from sysid.uncertainty.covariance import covariance
from sysid.uncertainty.quantities import Coordinate
from sysid.uncertainty.sensitivity import sensitivity
from sysid.uncertainty.ties import ties
from sysid.uncertainty.tracer import Tracer, traced
from sysid.uncertainty.walk import Walk, ends_of


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
    local = sensitivity(objective, chromosome)
    tied = ties(local).directions
    tracer = Tracer(local, covariance(local, tied), np.eye(len(chromosome))[place],
                    Coordinate(space, place))  # fmt: skip
    sides = traced([(tracer, tracer.side(sign)) for sign in (-1.0, 1.0)])
    below, above = ([(tracer.centre, 0.0), *points] for points in sides)
    points = [*reversed(below), *above[1:]]
    values = np.array([tracer.quantity.value(coordinate) for coordinate, _ in points])
    statistic = np.array([statistic for _, statistic in points])
    unit, value = space.parameters[place].unit, float(chromosome[place])
    low, high = ends_of([Walk.begun(tracer, sign) for sign in (-1.0, 1.0)])
    return Profile(name, unit, value, values, statistic, low, high)
