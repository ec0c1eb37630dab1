"""What no sensor shows: the state of the brake's hysteresis, and how the shaft moves.

The hysteresis forgets where it began once the shaft has turned by its yield travel, so an observer
that integrates its equation over the encoder's angle needs no correction. Speed, acceleration and
the hand's torque h are those of a steady-state Kalman filter whose model is Newton's second law,
with the torques N of motor, brake and friction as its input:

    theta' = omega,  omega' = (N + h + d) / J,  h' = -B omega' + w

B is the hand's damping, w what else changes its torque, and d what the model of the shaft lacks; w
and d are random walks. Without B and d, h itself is one. It measures the angle and, where it is
to, the torque sensor, which has h but for the noise. N is that of the currents in the sample, so it
is right whatever became of the commands.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from haptics import laws
from sysid.arrays import FloatArray

_HAND_WALK = 2e-3  # N*m in a sample, of a hand whose damping is modelled: what is not smooth in it


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations: of the angle [rad], of the torque sensor [N*m] (infinite: not used)."""

    angle: float
    torque: float = math.inf


@dataclass(frozen=True)
class Hand:
    """The filter's hand, by changes from sample to sample.

    walk: of its torque [N*m]; damping [N*m*s/rad], zero for a torque that is a random walk; rate:
    of the w that drives it [N*m/s]; disturbance: of the shaft's d [N*m].
    """

    walk: float = _HAND_WALK
    damping: float = 0.0
    rate: float = 0.0
    disturbance: float = 0.0


@dataclass(frozen=True)
class ShaftFilter:
    """x+ = A x + b N, then x + L (y - C x) with y of angle and torque sensor.

    x: angle, speed, h, and of a hand with damping w and d. A: (n, n), b: (n,), gain L: (n, 2).
    """

    A: FloatArray
    b: FloatArray
    gain: FloatArray

    @classmethod
    def of(cls, inertia: float, time: float, noise: SensorNoise, hand: Hand) -> "ShaftFilter":
        """The steady-state filter of a shaft; time: of a sample [s]."""
        n = 5 if hand.damping > 0.0 else 3
        rates = np.zeros((6, 6))  # of theta, omega, h, w, d, and N behind them
        rates[0, 1] = 1.0
        rates[1, [2, 4, 5]] = 1.0 / inertia
        rates[2] = -hand.damping * rates[1]
        rates[2, 3] = 1.0
        step = expm(rates * time)
        A, b = step[:n, :n], step[:n, 5]
        Q = np.diag([0.0, 0.0, hand.walk, hand.rate, hand.disturbance][:n]) ** 2
        C = np.eye(n)[[0, 2] if math.isfinite(noise.torque) else [0]]
        R = np.diag([noise.angle, noise.torque][: len(C)]) ** 2
        P = solve_discrete_are(A.T, C.T, Q, R)
        gain = np.zeros((n, 2))
        gain[:, : len(C)] = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        return cls(A, b, gain)

    def predicted(self, x: FloatArray, driving: float) -> FloatArray:
        """The state a sample later."""
        later: FloatArray = self.A @ x + self.b * driving
        return later

    def corrected(self, x: FloatArray, theta: float, torque: float) -> FloatArray:
        """A predicted state by what was measured."""
        better: FloatArray = x + self.gain @ (theta - x[0], torque - x[2])
        return better

    def placed(self, constants: list[float]) -> list[float]:
        """Constants of a law with these in their places; a smaller filter's others are zero."""
        n, size, placed = len(self.b), laws.FILTER_ORDER, list(constants)
        A, b, gain = np.zeros((size, size)), np.zeros(size), np.zeros((size, 2))
        A[:n, :n], b[:n], gain[:n] = self.A, self.b, self.gain
        for place, values in ((laws.FILTER_A, A), (laws.FILTER_B, b), (laws.FILTER_L, gain)):
            placed[place : place + values.size] = values.ravel().tolist()
        return placed
