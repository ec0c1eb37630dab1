"""What no sensor shows: the state of the brake's hysteresis, and how the shaft moves.

The hysteresis forgets where it began once the shaft has turned by its yield travel, so an observer
that integrates its equation over the encoder's angle needs no correction. Speed, acceleration and
the hand's torque are those of a steady-state Kalman filter whose model is Newton's second law, with
the torques of motor, brake and friction as its input and the hand's torque as a random walk:

    theta' = omega,  omega' = (N + h) / J,  h' = white noise

It measures the angle and, where it is to, the torque sensor, which has h but for the noise. N is
that of the currents in the sample, so it is right whatever became of the commands.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from haptics.dynamics import ActuatorDynamics
from sysid.arrays import FloatArray


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations: of the angle [rad], of the torque sensor [N*m] (infinite: not used)."""

    angle: float
    torque: float


@dataclass
class Motion:
    """Angle [rad] and speed [rad/s] of the shaft, the hand's torque on it [N*m], hysteresis."""

    theta: float
    omega: float
    hand: float
    z: float


class ShaftObserver:
    """Steady-state Kalman filter of the shaft, and the hysteresis along its angle.

    walk: change of the hand's torque from sample to sample [N*m]. time: of a sample [s].
    """

    def __init__(
        self, dynamics: ActuatorDynamics, time: float, noise: SensorNoise, walk: float
    ) -> None:
        self._dynamics, self._time = dynamics, time
        self.gain = kalman_gain(dynamics.inertia, time, noise, walk)
        self._rows = self.gain.tolist()
        self.motion = Motion(0.0, 0.0, 0.0, 0.0)
        self.known: float = 0.0  # torque of motor, brake and friction over the last sample [N*m]
        self._started = False

    @property
    def acceleration(self) -> float:
        """Of the shaft, now [rad/s^2]."""
        return (self.known + self.motion.hand) / self._dynamics.inertia

    def update(self, theta: float, torque: float, i_m: float, i_b: float) -> Motion:
        """The motion at a sample of angle, torque sensor and currents."""
        dynamics, T, motion = self._dynamics, self._time, self.motion
        if not self._started:
            self._started = True
            motion.theta, motion.hand = theta, 0.0
            return motion
        self.known = dynamics.motor_constant * i_m + dynamics.rest(
            i_b, motion.omega, motion.z, motion.theta
        )
        rate = self.acceleration
        guess = motion.theta + T * (motion.omega + 0.5 * T * rate)
        omega, hand = motion.omega + T * rate, motion.hand
        missed, felt = theta - guess, torque - hand
        corrections = [row[0] * missed + row[1] * felt for row in self._rows]
        turned = guess + corrections[0]
        z = dynamics.turned(motion.z, turned - motion.theta, T)
        self.motion = Motion(turned, omega + corrections[1], hand + corrections[2], z)
        return self.motion

    def coast(self) -> None:
        """Over a sample that did not arrive."""
        self.motion = self.ahead(self._time)

    def ahead(self, time: float) -> Motion:
        """The motion so much later [s], at the present acceleration."""
        motion, rate = self.motion, self.acceleration
        angle = time * (motion.omega + 0.5 * time * rate)
        z = self._dynamics.turned(motion.z, angle, time)
        return Motion(motion.theta + angle, motion.omega + time * rate, motion.hand, z)


def kalman_gain(inertia: float, time: float, noise: SensorNoise, walk: float) -> FloatArray:
    """Gain of angle and torque sensor on angle, speed and the hand's torque, (3, 2)."""
    a = time / inertia
    A = np.array([[1.0, time, 0.5 * time * a], [0.0, 1.0, a], [0.0, 0.0, 1.0]])
    Q = np.diag([0.0, 0.0, walk**2])
    sees_torque = math.isfinite(noise.torque)
    C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])[: 2 if sees_torque else 1]
    R = np.diag([noise.angle, noise.torque][: len(C)]) ** 2
    P = solve_discrete_are(A.T, C.T, Q, R)
    gain = np.zeros((3, 2))
    gain[:, : len(C)] = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    return gain
