"""What the actuator's model shows beside its outputs: torque over angle and speed.

The torque that resists the shaft is computed from the model's own equations, driven at a
sinusoidal speed with the brake's current held: its hysteresis loops.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid import Dataset, ProcessModel
from sysid.arrays import BoolArray, FloatArray
from sysid.problem.plots import Curve, Evidence, Plot, Quantity

_FREQUENCY = 5.0  # Hz, as fast as a hand moves
_PERIODS = 2  # the first of them to forget the start
_SAMPLES = 300  # of a period
_LEVELS = (0.0, 0.5, 1.0)  # of the largest brake current
_USUAL = 0.98  # quantile of a signal's magnitude that counts as its largest
_AXES = (Quantity("angle", "rad"), Quantity("speed", "rad/s"))
_TORQUE = Quantity("torque", "N*m")


def plots(model: ProcessModel, evidence: Evidence) -> Iterator[Plot]:
    """Hysteresis loops of the identified model, and the torque as it was measured."""
    loops, measured = _hysteresis_loops(model, evidence), _measured_torque(evidence.log)
    if loops:
        text = (
            "Torque that resists the shaft in the identified model, driven at a sinusoidal speed "
            "with the brake's current held: over the angle, and over the speed."
        )
        yield Plot("hysteresis", "torque", text, _AXES, _TORQUE, loops)
    if measured:
        text = (
            "Torque at the sensor as measured in the training log, over the angle and over the "
            "speed."
        )
        yield Plot("torque-velocity", "torque", text, _AXES, _TORQUE, measured, points=True)


def operating_points(
    model: ProcessModel, records: Sequence[Dataset]
) -> dict[str, dict[str, float]]:
    """The shaft at rest, and at the root mean square of its measured speed."""
    if not ("omega" in model.state_names and "omega" in model.output_names):
        return {}
    outputs = np.concatenate([record.outputs for record in records])
    omega = outputs[:, model.output_names.index("omega")]
    speed = float(np.sqrt(np.nanmean(omega**2)))
    at_rest = {name: 0.0 for name in ("theta",) if name in model.state_names}
    return {
        "linear, ω = 0": {"omega": 0.0, **at_rest},
        f"linear, ω = {speed:.3g} rad/s": {"omega": speed, **at_rest},
    }


def _hysteresis_loops(model: ProcessModel, evidence: Evidence) -> tuple[Curve, ...]:
    """One loop for each brake current; none of a model without such a brake and shaft."""
    needed = {"omega", "current_brake", "z"}
    if not needed <= set(model.state_names) or "torque" not in model.input_names:
        return ()
    outputs = np.concatenate([record.outputs for record in evidence.records])

    def largest(name: str) -> float:
        if name not in model.output_names:
            return 0.0
        magnitude = np.abs(outputs[:, model.output_names.index(name)])
        return float(np.nanquantile(magnitude, _USUAL))

    speed, current = largest("omega"), largest("current_brake")
    if not (speed > 0.0 and current > 0.0):
        return ()
    shaft = _DrivenShaft(model, tuple(float(v) for v in evidence.parameters), speed)
    try:
        return tuple(shaft.loop(level * current) for level in _LEVELS)
    except (ArithmeticError, ValueError):
        return ()  # names alike, but no torque that turns the shaft


def _measured_torque(log: Mapping[str, FloatArray]) -> tuple[Curve, ...]:
    """Torque of a log over angle and speed, apart by whether the brake's current is high."""
    if not {"theta", "omega", "torque", "current_brake"} <= set(log):
        return ()
    current = log["current_brake"]
    middle = 0.5 * (float(np.nanmin(current)) + float(np.nanmax(current)))

    def part(word: str, rows: BoolArray) -> Curve:
        values = {"angle": log["theta"], "speed": log["omega"], "torque": log["torque"]}
        return Curve(f"brake {word} {middle:.2g} A", {name: v[rows] for name, v in values.items()})

    return part("below", current < middle), part("above", current >= middle)


@dataclass(frozen=True)
class _DrivenShaft:
    """A shaft at a prescribed speed, without motor current."""

    model: ProcessModel
    parameters: tuple[float, ...]
    amplitude: float

    def loop(self, current: float) -> Curve:
        """The last period, with the brake held at a current [A]."""
        from scipy.integrate import solve_ivp

        rate = 2.0 * np.pi * _FREQUENCY
        time = np.linspace(0.0, _PERIODS / _FREQUENCY, _PERIODS * _SAMPLES + 1)
        z = self.model.state_names.index("z")
        solution = solve_ivp(
            lambda t, y: [self._slopes(self._state(t, float(y[0]), current))[z]],
            (0.0, float(time[-1])), [0.0], t_eval=time, method="LSODA", rtol=1e-6, atol=1e-9,
        )  # fmt: skip
        last = slice(-_SAMPLES - 1, None)
        deflection = solution.y[0]
        torque = np.array([
            self._torque(self._state(t, float(y), current))
            for t, y in zip(time[last], deflection[last], strict=True)
        ])  # fmt: skip
        phase = rate * time[last]
        angle = -self.amplitude / rate * np.cos(phase)
        speed = self.amplitude * np.sin(phase)
        return Curve(f"brake {current:.2g} A", {"angle": angle, "speed": speed, "torque": torque})

    def _state(self, t: float, z: float, current: float) -> tuple[float, ...]:
        rate = 2.0 * np.pi * _FREQUENCY
        omega = self.amplitude * float(np.sin(rate * t))
        theta = -self.amplitude / rate * float(np.cos(rate * t))
        given = {"omega": omega, "theta": theta, "z": z, "current_brake": current}
        return tuple(given.get(name, 0.0) for name in self.model.state_names)

    def _slopes(self, x: tuple[float, ...], load: float = 0.0) -> tuple[float, ...]:
        u = tuple(load if name == "torque" else 0.0 for name in self.model.input_names)
        return self.model.derivative(x, u, self.parameters)

    def _torque(self, x: tuple[float, ...]) -> float:
        """The torque that the load has to apply to keep the speed's derivative zero."""
        omega = self.model.state_names.index("omega")
        free, loaded = self._slopes(x)[omega], self._slopes(x, 1.0)[omega]
        return float(-free / (loaded - free))
