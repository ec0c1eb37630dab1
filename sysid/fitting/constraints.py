"""A model's constraints near a point, and the least costly moves within them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.problem.space import SearchSpace

_PERTURBATION = 1e-6
# A move ends this far inside, in parts of the constraint's slope: on it rounding would decide.
_MARGIN = 1e-6


@dataclass(frozen=True)
class Constraints:
    """Linearised constraints g <= 0: value g at a point, (n,), and slope by moves, (n, n_free)."""

    value: FloatArray
    slope: FloatArray

    @classmethod
    def at(cls, space: SearchSpace, coded: FloatArray, width: FloatArray) -> Constraints:
        """At search coordinates (n_free,), by central differences; moves in units of ``width``."""
        shift = _PERTURBATION * np.diag(width)
        points = space.decode(np.concatenate([coded[None], coded + shift, coded - shift]))
        values = space.constraint_values(points)
        n = len(coded)
        slope = (values[1 : n + 1] - values[n + 1 :]).T / (2.0 * _PERTURBATION)
        return cls(values[0], slope)

    def among(self, free: IntArray) -> Constraints:
        """Constraints that moves of the free parameters alone can reach."""
        slope = self.slope[:, free]
        reached = np.isfinite(slope).all(axis=1) & np.any(slope != 0.0, axis=1)
        return Constraints(self.value[reached], slope[reached])

    def nearest(self, move: FloatArray, inverse: FloatArray) -> FloatArray:
        """Minimum within the constraints of a quadratic whose free minimum is a move (n_free,).

        inverse: of the quadratic's Hessian, (n_free, n_free). Dual active-set method for few
        constraints (Nocedal & Wright, "Numerical optimization", section 16.5): the most violated
        constraint joins, those that would pull leave.
        """
        size = np.linalg.norm(self.slope, axis=1)
        limit = -self.value - _MARGIN * size
        active: list[int] = []
        moved = move
        for _ in range(3 * len(limit)):
            over = (self.slope @ moved - limit) / size
            over[active] = -np.inf
            worst = int(np.argmax(over))
            if over[worst] <= 0.0:
                break
            active.append(worst)
            while active:
                rows = self.slope[active]
                push = np.linalg.lstsq(
                    rows @ inverse @ rows.T, rows @ move - limit[active], rcond=1e-12
                )[0]
                if push.min() >= 0.0:
                    break
                active.pop(int(np.argmin(push)))
            moved = move - inverse @ self.slope[active].T @ push if active else move
        return moved
