"""Profile likelihood: how much worse the best fit becomes as one parameter is moved."""

import itertools
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.problem.model import ModelError
from sysid.uncertainty.covariance import Covariance, covariance
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.quantities import Coordinate, Profiled
from sysid.uncertainty.sensitivity import Sensitivity, sensitivity
from sysid.uncertainty.ties import ties

_STEPS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)  # standard deviations, outwards
_ITERATIONS = 20
# A parameter without a standard deviation is moved by parts of its range.
_BLIND_SHARE = 0.05
_RESOLUTION = 0.02  # of the statistic, to which refits go
_REFITS, _NEAR = 10, 0.1  # of one end, until the root of the statistic is so near its level
_LEAP = 8.0  # times the distance, that the next point may be away at most
_TETHER = 200.0  # loss of likelihood by a quantity that is a standard deviation off its place
_BEYOND = 3.0  # widths of a range to which its open end is searched


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
    centre = (tracer.centre, 0.0)
    below, above = [centre, *tracer.side(-1.0)], [centre, *tracer.side(1.0)]
    points = [*reversed(below), *above[1:]]
    values = np.array([tracer.quantity.value(coordinate) for coordinate, _ in points])
    statistic = np.array([statistic for _, statistic in points])
    unit, value = space.parameters[place].unit, float(chromosome[place])
    low, high = (tracer.crossing(side) for side in (below, above))
    return Profile(name, unit, value, values, statistic, low, high)


class Tracer:
    """Moves a quantity from ``centre``, where it stands, and fits all parameters to each place.

    gradient: (n_free,), its changes with the search coordinates. failed: whether simulations end
    a side.
    """

    def __init__(
        self,
        local: Sensitivity,
        covariance: Covariance,
        gradient: FloatArray,
        quantity: Profiled,
    ) -> None:
        objective, self.quantity = local.criterion, quantity
        self.objective = objective
        self.start = objective.space.encode(local.chromosome)
        self.centre = quantity.at(self.start)
        self.error = self._error(local.chromosome)
        deviation = covariance.deviation(gradient)
        self.unit = deviation if np.isfinite(deviation) else _BLIND_SHARE * quantity.width
        # Statistic per loss of error.
        samples = sum(record.n_samples for record in objective.records)
        self.factor = 2.0 * samples / covariance.inflation(gradient)
        output = int(np.argmax(objective.weights))
        rms = np.sqrt(np.sum(local.residual[:, output] ** 2) / objective.counts[output])
        scale = objective.counts[output] * rms / (objective.weights[output] * self.factor)
        # Next to zero a logarithm's deviation is no measure.
        near = min(self.unit, _BLIND_SHARE * quantity.width)
        self.stiffness = float(np.sqrt(2.0 * _TETHER * scale) / near)
        self.failed = False

    def side(self, sign: float) -> list[tuple[float, float]]:
        """Coordinates and statistics on one side, outwards until well beyond the 95 % level."""
        end, at, points = self._end(sign), self.start, []  # each fit starts from the one before
        for step in _STEPS:
            coordinate = self.centre + sign * step * self.unit
            beyond = sign * (coordinate - end) >= 0.0
            coordinate = end if beyond else coordinate
            if coordinate == self.centre:
                break
            statistic, at = self._fit(coordinate, at)
            points.append((coordinate, statistic))
            if beyond or statistic > 1.5 * Z95**2:
                break
        return points

    def bound(self, sign: float) -> float | None:
        """Value on one side at which the statistic passes the 95 % level, None for nowhere."""
        end = self._end(sign)
        if sign * (end - self.centre) <= 0.0:
            return None
        inside, at = (self.centre, 0.0), self.start
        outside: tuple[float, float] | None = None
        step = Z95 * self.unit
        for _ in range(_REFITS):
            if outside is None:
                coordinate = self.centre + sign * min(step, abs(end - self.centre))
            else:
                share = (Z95 - inside[1]) / (outside[1] - inside[1])
                share = float(np.clip(share, 0.1, 0.9)) if np.isfinite(outside[1]) else 0.5
                coordinate = inside[0] + share * (outside[0] - inside[0])
            statistic, fitted = self._fit(coordinate, at)
            point = coordinate, float(np.sqrt(statistic))
            if statistic > Z95**2:
                outside = point
            else:
                inside, at = point, fitted
                if coordinate == end:
                    return None
                # The root of the statistic is nearly straight, if it is felt at all.
                step *= float(np.clip(1.2 * Z95 / max(point[1], 1e-3), 1.5, _LEAP))
            if outside is not None and abs(point[1] - Z95) < _NEAR:
                break
        if outside is None:
            return None
        if not np.isfinite(outside[1]):
            self.failed = True
            return self.quantity.value(inside[0])
        return self.crossing([(x, root**2) for x, root in (inside, outside)])

    def crossing(self, points: list[tuple[float, float]]) -> float | None:
        """Value at which the root of the statistic, nearly straight, passes the 95 % level."""
        for (a, low), (b, high) in itertools.pairwise(points):
            below, above = np.sqrt(low), np.sqrt(high)
            if below <= Z95 < above:
                return self.quantity.value(a + (b - a) * (Z95 - below) / (above - below))
        return None

    def _end(self, sign: float) -> float:
        """The end of the range on one side, or where the search for one ends."""
        farthest = self.centre + sign * _BEYOND * self.quantity.width
        return sign * min(sign * self.quantity.ends[0 if sign < 0.0 else 1], sign * farthest)

    def _fit(self, coordinate: float, at: FloatArray) -> tuple[float, FloatArray]:
        """Statistic and search coordinates (n_free,) of the best fit at a value, from others."""
        loss = 1.0 / (self.factor * max(self.error, 1e-300))  # share of the error
        constrained, start = self.quantity.constrained(
            self.objective, coordinate, at, self.stiffness
        )
        best = refine(
            constrained,
            start,
            max_iterations=_ITERATIONS,
            tolerance=float(np.clip(_RESOLUTION * loss, 1e-7, 1e-3)),
        )
        statistic = max(0.0, self.factor * (self._error(best.chromosome) - self.error))
        return statistic, self.objective.space.encode(best.chromosome)

    def _error(self, chromosome: FloatArray) -> float:
        return float(self.objective.evaluate(chromosome[None])[0][0])
