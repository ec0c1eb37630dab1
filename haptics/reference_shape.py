"""What a hand makes of a reference, taken off the reference beforehand.

The loop of ``haptics.lqg`` is designed for one hand and stable in many. In a soft hand the torque
that is felt overshoots the reference towards 10 Hz, in a stiff one it falls short: by how much is
linear in the hand's mobility y, the design's damping by the hand's, to a few parts in a hundred. So
the loop is asked for

    r + (a_0 + a_1 y) D r + (b_0 + b_1 y) D^2 r,

D the change in a sample, smoothed. ``ReferenceShape.of`` has the numbers that leave least of the
error in hands of the whole range. The law tells y by the reference's slope r', with which the
hand's own motion has nothing to do: with B the design's damping and averages over ``hand_memory``,

    y = (<B omega' r'> + doubt^2) / (<-h' r'> + doubt^2).

Without a slope y is one. All this is outside of the loop: right or wrong, it makes no hand
unstable.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from daq.torque import LawProgram
from haptics import laws
from haptics.dynamics import ActuatorDynamics
from haptics.linear_loop import LinearLaw, felt_responses
from sysid import ProcessModel
from sysid.arrays import FloatArray

_HIGHEST = 11.0  # Hz
_FREQUENCIES = 22
_SMOOTHING = 30.0  # Hz
_HANDS = 5


@dataclass(frozen=True)
class ReferenceShape:
    """a_0, a_1, b_0, b_1: (4,). smoothing: of D, the part of a change that comes in a sample."""

    numbers: FloatArray
    smoothing: float

    @classmethod
    def of(
        cls, program: LawProgram, model: ProcessModel, hand: tuple[float, float], reach: float
    ) -> "ReferenceShape":
        """That of a law without any, in hands of 1 / ``reach`` to ``reach`` times a hand.

        hand: stiffness [N*m/rad] and damping [N*m*s/rad]. The shaft slides, by the motor alone.
        """
        constants = list(program.constants)
        constants[laws.PREFERENCE] = laws.BY_MOTOR
        law = LinearLaw.of(replace(program, constants=tuple(constants)), model, "sliding forwards")
        time, ahead = constants[laws.TIME], int(constants[laws.AHEAD])
        dynamics = ActuatorDynamics(model, np.array(program.parameters))
        smoothing = 1.0 - math.exp(-2.0 * math.pi * _SMOOTHING * time)
        f = np.linspace(0.5, _HIGHEST, _FREQUENCIES)
        z = np.exp(2j * np.pi * f * time)
        change = 1.0 - 1.0 / z
        smooth = smoothing / (1.0 - (1.0 - smoothing) / z)
        rows, missing = [], []
        for scale in np.geomspace(1.0 / reach, reach, _HANDS).tolist():
            stiffness, damping = hand[0] * scale, hand[1] * scale
            T = felt_responses(law, dynamics, (stiffness, damping), z, time, ahead)
            slope, bend = T * smooth * change, T * smooth * change**2
            rows.append(np.stack([slope, slope / scale, bend, bend / scale], axis=1))
            missing.append(1.0 - T)
        A, b = np.concatenate(rows), np.concatenate(missing)
        real, right = (np.concatenate([part.real, part.imag]) for part in (A, b))
        return cls(np.linalg.lstsq(real, right, rcond=None)[0], smoothing)

    def placed(self, constants: tuple[float, ...]) -> tuple[float, ...]:
        """Constants of a law with these in their places."""
        placed = list(constants)
        placed[laws.SHAPE_SLOPE : laws.SHAPE_SLOPE + 4] = self.numbers.tolist()
        placed[laws.SHAPE_SMOOTHING] = self.smoothing
        return tuple(placed)
