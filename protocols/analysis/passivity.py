"""When a rendered wall is stable: the passivity bound, and the sampled loop's eigenvalues."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daq.findings import Series
from daq.hal import FloatArray
from protocols.control.speed_tracker import tracker_gains
from protocols.control.wall import Body

_STIFFEST = 1e4  # N*m/rad, beyond what any motor renders
_HALVINGS = 32
_DRAWN = 60  # dampings of a bound in a figure


def passive_stiffness(physical: float, damping: float, period: float) -> float:
    """Largest stiffness that (1.1), (1.2) call passive, b > K T / 2 + |B| [N*m/rad].

    Colgate & Schenkel, "Passivity of a class of sampled-data systems", 1997. physical: b, with
    what a brake adds [N*m*s/rad]; damping: B that is rendered; period: T [s]. Not positive where
    the damping alone is more than b.
    """
    return 2.0 * (physical - abs(damping)) / period


@dataclass(frozen=True)
class SampledWall:
    """A wall touched by a shaft: inertia [kg*m^2], damping [N*m*s/rad] and stiffness [N*m/rad] of
    all that is physical, hand included; rendered every ``period`` [s], ``ahead`` ticks late, with
    the speed tracked at a bandwidth [Hz].
    """

    inertia: float
    damping: float
    stiffness: float
    period: float
    ahead: int
    bandwidth: float

    def spectral_radius(self, stiffness: float, damping: float) -> float:
        """Size of the sampled loop's largest eigenvalue with this wall; below 1 it is stable.

        The shaft is discretised exactly between samples. States: angle and speed of the shaft,
        the tracker's, and the torques on their way.
        """
        n = 4 + self.ahead
        plant, push = self._shaft
        alpha, beta = tracker_gains(self.bandwidth, self.period)
        # The tracker as it stands after the sample k, from its state after k - 1 and theta_k.
        track = np.array(
            [[1.0 - alpha, (1.0 - alpha) * self.period], [-beta / self.period, 1.0 - beta]]
        )
        gain = np.array([alpha, beta / self.period])
        loop = np.zeros((n, n))
        loop[:2, :2] = plant
        loop[:2, -1] = push
        loop[2:4, 0], loop[2:4, 2:4] = gain, track
        loop[4] = -damping * loop[3]
        loop[4, 0] -= stiffness
        for late in range(1, self.ahead):
            loop[4 + late, 3 + late] = 1.0
        # The torque that acts from a sample on is the one computed ``ahead`` samples before.
        return float(np.abs(np.linalg.eigvals(loop)).max())

    def critical_stiffness(self, damping: float) -> float:
        """The stiffness at which a wall of this damping begins to ring [N*m/rad]; 0 if all do."""
        low, high = 0.0, _STIFFEST
        if self.spectral_radius(1e-9, damping) >= 1.0:
            return 0.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self.spectral_radius(middle, damping) < 1.0:
                low = middle
            else:
                high = middle
        return low

    @functools.cached_property
    def _shaft(self) -> tuple[FloatArray, FloatArray]:
        """Exact discretisation of J dω/dt = torque - b ω - k θ with the torque held."""
        from scipy.linalg import expm

        whole = np.zeros((3, 3))
        whole[0, 1] = 1.0
        whole[1] = np.array([-self.stiffness, -self.damping, 1.0]) / self.inertia
        step = expm(whole * self.period)
        return step[:2, :2], step[:2, 2]


@dataclass(frozen=True)
class WallTheory:
    """Stability and passivity of walls rendered to a body, by the brake's command [V].

    period [s], ahead and bandwidth [Hz] as of ``SampledWall``.
    """

    body: Body
    period: float
    ahead: int
    bandwidth: float

    def damping(self, brake: float) -> float:
        """b + b_passive of (1.2) [N*m*s/rad]."""
        return self.body.damping + self.body.brake_damping * abs(brake)

    def loop(self, brake: float, hand: bool) -> SampledWall:
        """The sampled loop around the shaft, with the hand or without."""
        body = self.body
        return SampledWall(
            body.inertia,
            self.damping(brake) + (body.hand_damping if hand else 0.0),
            body.hand_stiffness if hand else 0.0,
            self.period,
            self.ahead,
            self.bandwidth,
        )

    def passive_stiffness(self, brake: float, damping: float) -> float:
        """Largest passive stiffness of a wall of this damping [N*m/rad]."""
        return passive_stiffness(self.damping(brake), damping, self.period)

    def bounds(
        self, brake: float, dampings: Sequence[float], stiffest: float
    ) -> tuple[Series, Series, Series]:
        """Bounds of stability, handle held and free, and of passivity over the damping."""
        drawn = np.linspace(min(dampings), max(dampings), _DRAWN)

        def stable(label: str, hand: bool) -> Series:
            loop = self.loop(brake, hand)
            bound = np.array([loop.critical_stiffness(damping) for damping in drawn])
            return Series(label, drawn, np.where(bound <= stiffest, bound, math.nan))

        return (
            stable("stable, handle held", hand=True),
            stable("stable, handle free", hand=False),
            Series(
                "passive by (1.1)" if brake == 0.0 else "passive by (1.2)",
                np.array([0.0, self.damping(brake)]),
                np.array([self.passive_stiffness(brake, 0.0), 0.0]),
            ),
        )
