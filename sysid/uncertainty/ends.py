"""Ends of ranges that decide nothing, though an estimate stands on them.

Of a friction that data hardly feel any small value explains them, and an estimate may stand on the
low end of its range by chance. That end decides nothing if all would be estimated alike beyond it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import null_space

from sysid.arrays import BoolArray, FloatArray
from sysid.uncertainty.covariance import Covariance, covariance
from sysid.uncertainty.estimate import Estimate
from sysid.uncertainty.sensitivity import Sensitivity

_FACTOR = 10.0  # of a parameter searched by its logarithm; another goes by the width of its range
_UNMOVED = 0.5  # deviations
_FARTHEST = 30.0  # ranges, beyond which there are no numbers


@dataclass(frozen=True)
class RangeEnds:
    """Ends of ranges on which an estimate stands.

    ties: (n, n_free), directions that leave the outputs alone. on_bound: (n_free,). changes: how
    far quantities, by name, are at search coordinates (n_free,) from the estimate; deviations:
    standard deviations of these.
    """

    local: Sensitivity
    ties: FloatArray
    on_bound: BoolArray
    changes: Callable[[FloatArray], Mapping[str, float]]
    deviations: Mapping[str, float]

    def decide_nothing(self, places: Sequence[int], estimates: Sequence[Estimate]) -> bool:
        """Whether beyond the ends of some parameters all else would be estimated alike.

        Or be where its interval has no end. By the slopes, as where ties would lead inside again;
        or by a run beyond, as where a parameter does next to nothing at that end, and the slope
        over its logarithm would lead far.
        """
        space, held = self.local.objective.space, self.on_bound.copy()
        names = {space.names[j] for j in places}
        combined = [e for e in estimates if e.combination and names & {*e.combination.names}]
        if any(estimate.why == "end" for estimate in combined):
            return False
        held[places] = False
        others = [estimate for estimate in estimates if estimate.name not in names]
        if self._alike(self._by_slopes(self._with(held)), others):
            return True
        beyond = self._beyond(places)
        return beyond is not None and self._alike(beyond, others)

    def opened(self, free: Covariance, estimates: Sequence[Estimate]) -> list[Estimate]:
        """Estimates without the ends of profiles that these ends of ranges have set.

        free: with no parameter held.
        """
        changes = self.changes(self._by_slopes(free))
        return [self._opened(estimate, changes.get(estimate.name, 0.0)) for estimate in estimates]

    def _opened(self, estimate: Estimate, change: float) -> Estimate:
        """An estimate that would be another by a change."""
        traced = estimate.std is None and not estimate.why
        if not traced or not abs(change) > _UNMOVED * self.deviations.get(estimate.name, np.inf):
            return estimate
        opened = replace(estimate, low=None) if change < 0.0 else replace(estimate, high=None)
        vague = opened.low is None and opened.high is None
        return replace(opened, why="vague") if vague else opened

    def _by_slopes(self, covariance: Covariance) -> FloatArray:
        """Where the minimum would be, (n_free,), by the slopes."""
        space = self.local.objective.space
        step = np.clip(covariance.newton_step, -_FARTHEST * space.width, _FARTHEST * space.width)
        minimum: FloatArray = space.encode(self.local.chromosome) + step
        return minimum

    def _with(self, held: BoolArray) -> Covariance:
        """The covariance with parameters held, (n_free,), which ends the ties that they are in."""
        ties = self.ties
        if len(ties):
            ties = null_space(ties[:, held].T).T @ ties
        return covariance(self.local, ties, held)

    @cached_property
    def _inverse(self) -> FloatArray:
        """Inverse curvature, (n_free, n_free), of all that stand on no end."""
        return self._with(self.on_bound).curvature

    def _beyond(self, places: Sequence[int]) -> FloatArray | None:
        """Search coordinates, (n_free,), of the minimum with parameters beyond their ends.

        Those that stand on no end follow by their slopes. None where a simulation fails beyond.
        """
        local, objective, there = self.local, self.local.objective, self.local.chromosome.copy()
        space = objective.space
        for j in places:
            there[j] = self._value_beyond(j)
        residual = local.share * objective.residuals(there[None], local.steps).values[..., 0]
        if not np.all(np.isfinite(residual)):
            return None
        weights = objective.least_squares_weights(local.residual)
        push = np.einsum("tip,i,ti->p", local.slopes, weights, residual - local.residual)
        minimum: FloatArray = space.encode(there) - self._inverse @ push
        return minimum

    def _value_beyond(self, j: int) -> float:
        """A value of parameter j well beyond the end on which it stands."""
        space, value = self.local.objective.space, float(self.local.chromosome[j])
        coded = float(space.encode(self.local.chromosome)[j])
        low = coded - space.coded_lower[j] < 0.5 * space.width[j]
        beyond = value / _FACTOR if low else value * _FACTOR
        if not space.log[j]:
            beyond = value + float(-space.width[j] if low else space.width[j])
        parameter = space.parameters[j]
        return min(max(beyond, parameter.minimum), parameter.maximum)

    def _alike(self, point: FloatArray, estimates: Sequence[Estimate]) -> bool:
        """Whether quantities at a point, (n_free,), are as estimated, or on a side without end."""
        changes = self.changes(point)
        return all(
            abs(changes[estimate.name]) <= _UNMOVED * self.deviations[estimate.name]
            or (changes[estimate.name] < 0.0 and estimate.low is None)
            or (changes[estimate.name] > 0.0 and estimate.high is None)
            for estimate in estimates
            if estimate.name in changes
        )
