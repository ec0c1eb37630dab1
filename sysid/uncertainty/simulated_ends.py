"""Do simulations agree with slopes at the ends of an interval?

Slopes at the estimate tell how far a quantity may be from it, and how all else follows on the way
d to an end. Two things are asked of simulations there:

1. Residuals are to have changed about as slopes foretell, and their squares to have grown so.
2. In a narrow valley that bends, the straight way ends high up its wall, however right the interval
   is. From the errors e there, a step b = -(H + mu I)^-1 sum_j w_j J_j' e_j that leaves the
   quantity where it is leads back, by the slopes J at the estimate, and so the next. What is lost
   at the bottom is no less than what the profile loses there, and is to be about its level. mu
   keeps b from going along the valley, in which all else stays where d led.

That takes one simulation of each end at a time, all side by side; a profile takes many fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.uncertainty.covariance import Covariance
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.sensitivity import Sensitivity
from sysid.uncertainty.tracer import Tracer

_SIDES = (-1.0, 1.0)
_AT_ONCE = 15  # ends that are simulated side by side
_UNLIKE = 5.0  # times what slopes foretell, in squares, from where they are no guide
# The root of what the squares grow by, in parts of what slopes foretell, where they are a guide.
_NEAR = 0.8, 1.25
_RESTORING = 1e-7  # mu in parts of the largest curvature, both in parts of the ranges
_STEPS = 8  # back into a valley
_SETTLED = 0.01  # of the root of the statistic, below which a step back does not matter any more
# The root of the statistic in parts of that of its level, where an interval ends as it should.
_LEAST, _MOST = 0.93, 1.2
_NOWHERE = 1e-6  # of the way to an end


@dataclass(frozen=True)
class _End:
    """Search coordinates (n_free,) of an end of an interval, of which of them, and what is there.

    edge: where the interval ends. root: of the statistic, in parts of what it is to be where the
    quantity is, since combinations are not quite where their slopes lead.
    """

    place: int
    point: FloatArray
    edge: float = np.nan
    root: float = np.inf
    settled: bool = False


@dataclass(frozen=True)
class SimulatedEnds:
    """Ends of intervals by slopes. on_bound: (n_free,), coordinates on an end of their range."""

    local: Sensitivity
    covariance: Covariance
    on_bound: BoolArray

    def as_foretold(self, tracers: Sequence[Tracer]) -> list[bool]:
        """Whether residuals and their squares change about as foretold, or that cannot be told.

        It is not where slopes are not of the criterion, nor beyond the ranges, nor where something
        on an end of its range would follow.
        """
        if self.local.criterion is not self.local.objective:
            return [True] * len(tracers)
        ends = [
            _End(i, point)
            for i, tracer in enumerate(tracers)
            if not np.any(self._along(tracer)[self.on_bound])
            for point in self._ends(tracer)
            if self._is_inside(point)
        ]
        alike = [True] * len(tracers)
        for k in range(0, len(ends), _AT_ONCE):
            batch = ends[k : k + _AT_ONCE]
            shares = zip(*self._shares([end.point for end in batch]), strict=True)
            for end, (changed, grown) in zip(batch, shares, strict=True):
                alike[end.place] &= 1.0 / _UNLIKE < changed < _UNLIKE
                alike[end.place] &= _NEAR[0] ** 2 < grown < _NEAR[1] ** 2
        return alike

    def at_the_level(self, intervals: Sequence[tuple[Tracer, tuple[float, float]]]) -> list[bool]:
        """Whether the profile, led to as by chords, is about at its level at both ends.

        intervals: of tracers' quantities. Coordinates on an end of their range stay there.
        """
        tracers, bounds = (
            [tracer for tracer, _ in intervals],
            self.local.objective.space.coded_bounds,
        )
        ends = [
            _End(i, np.clip(point, *bounds), edge)
            for i, (tracer, interval) in enumerate(intervals)
            for point, edge in zip(self._ends(tracer), interval, strict=True)
        ]
        alike = [True] * len(intervals)
        for _ in range(1 + _STEPS):
            live = [i for i, end in enumerate(ends) if alike[end.place] and not end.settled]
            for k in range(0, len(live), _AT_ONCE):
                batch = live[k : k + _AT_ONCE]
                for i, end in zip(batch, self._led_back(tracers, batch, ends), strict=True):
                    ends[i] = end
                    alike[end.place] &= end.root >= _LEAST and np.isfinite(end.root)
        for end in ends:
            alike[end.place] &= end.root <= _MOST
        return alike

    def _led_back(
        self, tracers: Sequence[Tracer], batch: Sequence[int], ends: Sequence[_End]
    ) -> list[_End]:
        """Some of the ends with what is there, and one step further where that has changed."""
        points = np.stack([ends[i].point for i in batch])
        criterion, space = self.local.criterion, self.local.objective.space
        responses = criterion.residuals(space.decode(points), self.local.steps)
        losses = criterion.error_of(responses.rms) - self.local.error_by(tuple(self.local.steps))
        onward = []
        for i, loss, values in zip(batch, losses, np.moveaxis(responses.values, 2, 0), strict=True):
            end, tracer = ends[i], tracers[ends[i].place]
            root = float(np.sqrt(tracer.statistic(float(loss)))) / Z95 / self._share(tracer, end)
            settled = bool(abs(end.root - root) <= _SETTLED * root)
            point = end.point
            if np.isfinite(root) and not settled:
                point = np.clip(point + self._step_back(tracer, values), *space.coded_bounds)
            onward.append(replace(end, point=point, root=root, settled=settled))
        return onward

    def _step_back(self, tracer: Tracer, errors: FloatArray) -> FloatArray:
        """b of a tracer's quantity, (n_free,), by errors (n_residuals, n_outputs)."""
        width = self.local.objective.space.width
        inverse, gradient = self._inverse, tracer.gradient * width * ~self.on_bound
        push = np.einsum("tip,ti->p", self._weighted, errors) * width
        step, across = -inverse @ push, inverse @ gradient
        kept: FloatArray = step - across * (gradient @ step) / (gradient @ across)
        return kept * width

    def _share(self, tracer: Tracer, end: _End) -> float:
        """How far the quantity is on its way to where the interval ends."""
        quantity = tracer.quantity
        value, there = quantity.value(tracer.centre), quantity.value(quantity.at(end.point))
        way = end.edge - value
        return max((there - value) / way, _NOWHERE) if way else _NOWHERE

    @cached_property
    def _weighted(self) -> FloatArray:
        """Slopes by their outputs' weights; none of what stays on an end of its range."""
        return self.local.slopes * self._weight[:, None] * ~self.on_bound

    @cached_property
    def _weight(self) -> FloatArray:
        """Of the squares of each output's residuals, (n_outputs,)."""
        return self.local.objective.least_squares_weights(self.local.residual)

    @cached_property
    def _at(self) -> FloatArray:
        """The estimate's search coordinates, (n_free,)."""
        return self.local.objective.space.encode(self.local.chromosome)

    @cached_property
    def _inverse(self) -> FloatArray:
        """(H + mu I)^-1 in parts of the ranges, (n_free, n_free)."""
        width = self.local.objective.space.width
        n_free = len(width)
        across = self._weighted.reshape(-1, n_free).T
        hessian = across @ self.local.slopes.reshape(-1, n_free) * ~self.on_bound
        hessian *= np.outer(width, width)
        mu = _RESTORING * float(np.diag(hessian).max())
        inverse: FloatArray = np.linalg.inv(hessian + mu * np.eye(n_free)).astype(np.float64)
        return inverse

    def _along(self, tracer: Tracer) -> FloatArray:
        along: FloatArray = self.covariance.curvature @ tracer.gradient
        return along

    def _ends(self, tracer: Tracer) -> list[FloatArray]:
        """Search coordinates (n_free,) of both ends, what is on an end of its range left there."""
        along, gradient = self._along(tracer) * ~self.on_bound, tracer.gradient
        moved, deviation = float(gradient @ along), self.covariance.deviation(gradient)
        far = Z95 * deviation / moved if moved > 0.0 else np.nan  # all of it is on such an end
        return [self._at + sign * far * along for sign in _SIDES]

    def _is_inside(self, point: FloatArray) -> bool:
        lower, upper = self.local.objective.space.coded_bounds
        return bool(np.all((point >= lower) & (point <= upper)))

    def _shares(self, points: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """What slopes foretell of residuals, and what simulations make of it, (n,) each.

        In parts of it: sums of squares of their changes, and by how much the sum of their squares
        is more than at the minimum that slopes foretell.
        """
        local, space = self.local, self.local.objective.space
        rows = space.decode(np.stack([self._at, *points]))
        values = local.objective.residuals(rows, local.steps).values
        weight = self._weight[:, None]
        steps = np.stack(points, axis=1) - self._at[:, None]
        foretold = local.slopes @ steps
        with np.errstate(all="ignore"):  # where a simulation failed
            size = np.sum(weight * foretold**2, axis=(0, 1))
            changes = values[..., 1:] - values[..., :1]
            changed = np.sum(weight * changes**2, axis=(0, 1)) / size
            slope = 2.0 * np.sum(weight * values[..., :1] * foretold, axis=(0, 1))
            squares = np.sum(weight * values**2, axis=(0, 1))
            grown = (squares[1:] - squares[0] - slope) / size
        return changed, grown
