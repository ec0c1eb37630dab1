"""The torque that resists a model's shaft while it is driven at a speed: its hysteresis loops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from daq.figures.loops import Loop
from sysid.arrays import FloatArray
from sysid.problem.model import ProcessModel

_FREQUENCY = 5.0  # Hz, as fast as a hand moves
_PERIODS = 2  # the first of them to forget the start
_SAMPLES = 300  # of a period
_LEVELS = (0.0, 0.5, 1.0)  # of the largest brake current


@dataclass(frozen=True)
class Swing:
    """A sinusoidal speed of an amplitude [rad/s], and the largest brake current [A]."""

    speed: float
    current: float


def loops(model: ProcessModel, parameters: FloatArray, swing: Swing) -> list[Loop]:
    """One loop for each brake current; none of a model without such a brake and shaft.

    The speed is given and the motor's current zero, so that only the hysteresis moves. The
    resisting torque is the one that the load would have to apply to keep the speed's derivative
    zero, read from the model's own equation of the shaft.
    """
    needed = {"omega", "current_brake", "z"}
    if not needed <= set(model.state_names) or "torque" not in model.input_names:
        return []
    if not (swing.speed > 0.0 and swing.current > 0.0):
        return []
    shaft = _Driven(model, tuple(float(v) for v in parameters), swing.speed)
    try:
        return [shaft.loop(level * swing.current) for level in _LEVELS]
    except (ArithmeticError, ValueError):
        return []  # names alike, but no torque that turns the shaft


@dataclass(frozen=True)
class _Driven:
    """A shaft at a prescribed speed."""

    model: ProcessModel
    parameters: tuple[float, ...]
    amplitude: float

    def loop(self, current: float) -> Loop:
        """The last period, with the brake held at a current [A]."""
        from scipy.integrate import solve_ivp

        rate = 2.0 * np.pi * _FREQUENCY
        time = np.linspace(0.0, _PERIODS / _FREQUENCY, _PERIODS * _SAMPLES + 1)
        z = self.model.state_names.index("z")
        found = solve_ivp(
            lambda t, y: [self._slopes(self._state(t, float(y[0]), current))[z]],
            (0.0, float(time[-1])), [0.0], t_eval=time, method="LSODA", rtol=1e-6, atol=1e-9,
        )  # fmt: skip
        last = slice(-_SAMPLES - 1, None)
        deflection = found.y[0]
        torque = np.array([
            self._torque(self._state(t, float(y), current))
            for t, y in zip(time[last], deflection[last], strict=True)
        ])  # fmt: skip
        phase = rate * time[last]
        angle = -self.amplitude / rate * np.cos(phase)
        return Loop(f"brake {current:.2g} A", angle, self.amplitude * np.sin(phase), torque)

    def _state(self, t: float, z: float, current: float) -> tuple[float, ...]:
        rate = 2.0 * np.pi * _FREQUENCY
        given = {
            "omega": self.amplitude * float(np.sin(rate * t)),
            "theta": -self.amplitude / rate * float(np.cos(rate * t)),
            "z": z,
            "current_brake": current,
        }
        return tuple(given.get(name, 0.0) for name in self.model.state_names)

    def _slopes(self, x: tuple[float, ...], load: float = 0.0) -> tuple[float, ...]:
        u = tuple(load if name == "torque" else 0.0 for name in self.model.input_names)
        return self.model.derivative(x, u, self.parameters)

    def _torque(self, x: tuple[float, ...]) -> float:
        omega = self.model.state_names.index("omega")
        free, loaded = self._slopes(x)[omega], self._slopes(x, 1.0)[omega]
        return float(-free / (loaded - free))
