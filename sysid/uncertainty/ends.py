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

    free: the covariance with no parameter held. on_bound: (n_free,). changes: how
    far quantities, by name, are at search coordinates (n_free,) from the estimate; deviations:
    standard deviations of these.
    """

    local: Sensitivity
    free: Covariance
    on_bound: BoolArray
    changes: Callable[[FloatArray], Mapping[str, float]]
    deviations: Mapping[str, float]

    def harmless(self, places: Sequence[int], estimates: Sequence[Estimate]) -> list[int]:
        """Which of some parameters stand on ends beyond which all else would be estimated alike.

        Or be where its interval has no end. By the slopes, as where ties would lead inside again;
        or by a run beyond, as where a parameter does next to nothing at that end, and the slope
        over its logarithm would lead far. None where beyond all of these ends something would be
        another, though it is not beyond each.
        """
        places = [j for j in places if not self._ends_a_combination(j, estimates)]
        freed = [j for j in places if self._alike([j], [], estimates)]
        passed = [j for j in places if j not in freed and self._alike([], [j], estimates)]
        several = len(freed) + len(passed) > 1
        if several and not self._alike(freed, passed, estimates):
            return []
        return [*freed, *passed]

    def _ends_a_combination(self, j: int, estimates: Sequence[Estimate]) -> bool:
        name = self.local.objective.space.names[j]
        combined = [e for e in estimates if e.combination and name in e.combination.names]
        return any(estimate.why == "end" for estimate in combined)

    def opened(self, covariance: Covariance, estimates: Sequence[Estimate]) -> list[Estimate]:
        """Estimates, by a covariance, without the ends of profiles that ends of ranges have set."""
        changes = self.changes(self._by_slopes(covariance))
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
        minimum: FloatArray = self._coded + step
        return minimum

    def _with(self, held: BoolArray) -> Covariance:
        """The covariance with parameters held, (n_free,), which ends the ties that they are in."""
        ties = self.free.ties
        if len(ties):
            ties = null_space(ties[:, held].T).T @ ties
        return covariance(self.local, ties, held, self.free.simulated, self.free.score)

    def _moved(self, freed: Sequence[int], passed: Sequence[int]) -> FloatArray | None:
        """Search coordinates, (n_free,), of the minimum by slopes with some parameters freed.

        passed: those that are well beyond their ends. None where a simulation fails there.
        """
        around = self._around(freed) if freed else self._around_ends
        onward = self._by_slopes(around) if freed else self._coded
        if not passed:
            return onward
        local, there = self.local, self.local.chromosome.copy()
        for j in passed:
            there[j] = self._value_beyond(j)
        residual = local.share * local.objective.residuals(there[None], local.steps).values[..., 0]
        if not np.all(np.isfinite(residual)):
            return None
        weights = local.objective.least_squares_weights(local.residual)
        push = np.einsum("tip,i,ti->p", local.slopes, weights, residual - local.residual)
        beyond = local.objective.space.encode(there) - self._coded
        minimum: FloatArray = onward + beyond - around.curvature @ push
        return minimum

    def _around(self, freed: Sequence[int]) -> Covariance:
        """The covariance with what stands on ends held, but for some parameters."""
        held = self.on_bound.copy()
        held[freed] = False
        return self._with(held)

    @cached_property
    def _around_ends(self) -> Covariance:
        return self._around([])

    @cached_property
    def _coded(self) -> FloatArray:
        """Search coordinates of the estimate, (n_free,)."""
        return self.local.objective.space.encode(self.local.chromosome)

    def _value_beyond(self, j: int) -> float:
        """A value of parameter j well beyond the end on which it stands."""
        space, value = self.local.objective.space, float(self.local.chromosome[j])
        low = self._coded[j] - space.coded_lower[j] < 0.5 * space.width[j]
        beyond = value / _FACTOR if low else value * _FACTOR
        if not space.log[j]:
            beyond = value + float(-space.width[j] if low else space.width[j])
        parameter = space.parameters[j]
        return min(max(beyond, parameter.minimum), parameter.maximum)

    def _alike(
        self, freed: Sequence[int], passed: Sequence[int], estimates: Sequence[Estimate]
    ) -> bool:
        """Whether other quantities are as estimated beyond ends, or on a side without end.

        Beyond each of the ends half a deviation may come in.
        """
        point, names = self._moved(freed, passed), self.local.objective.space.names
        if point is None:
            return False
        moved = {names[j] for j in (*freed, *passed)}
        changes, unmoved = self.changes(point), _UNMOVED * len(moved)
        return all(
            abs(changes[estimate.name]) <= unmoved * self.deviations[estimate.name]
            or (changes[estimate.name] < 0.0 and estimate.low is None)
            or (changes[estimate.name] > 0.0 and estimate.high is None)
            for estimate in estimates
            if estimate.name in changes and estimate.name not in moved
        )
