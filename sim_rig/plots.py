"""What the actuator's model shows beside its outputs: torque over angle and speed.

The torque that resists the shaft is computed from the model's own equations, driven at a
sinusoidal speed with the brake's current held: its hysteresis loops.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid import Dataset, ProcessModel
from sysid.arrays import BoolArray, FloatArray
from sysid.problem.plots import Curve, Evidence, Plot, Quantity

_FREQUENCY = 5.0  # Hz, as fast as a hand moves
_PERIODS = 2  # the first of them to forget the start
_SAMPLES = 300  # of a period
_LEVELS = (0.0, 0.5, 1.0)  # of the largest brake current
_USUAL = 0.98  # quantile of a signal's magnitude that counts as its largest
_MOTION = ("omega", "current_brake")
_ABOUT = 0.25  # of the largest brake current, to either side of one
_AXES = (Quantity("angle", "rad"), Quantity("speed", "rad/s"))
_TORQUE = Quantity("torque", "N*m")


def plots(model: ProcessModel, evidence: Evidence) -> Iterator[Plot]:
    """Hysteresis loops of the identified model, and the torque as it was measured."""
    loops, measured = _hysteresis_loops(model, evidence), _measured_torque(evidence.log)
    if loops:
        text = (
            "Torque that resists the shaft in the identified model, driven at a sinusoidal speed "
            "with the brake's current held: over the angle, and over the speed. Thin where the "
            "training logs have no such speed at that current: the model alone says so."
        )
        if len(evidence.draws) > 1:
            text += " Bands: 95 % by the parameters' uncertainty."
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
    measured = {name: outputs[:, model.output_names.index(name)] for name in _MOTION}
    shaft = _DrivenShaft(model, np.vstack([evidence.parameters, evidence.draws]), speed)
    try:
        loops = [shaft.loop(level * current) for level in _LEVELS]
    except (ArithmeticError, TypeError, ValueError):
        return ()  # names alike, but no torque that turns the shaft
    return tuple(
        replace(loop, beyond=np.abs(loop.values["speed"]) > _fastest(measured, level * current))
        for level, loop in zip(_LEVELS, loops, strict=True)
    )


def _fastest(measured: Mapping[str, FloatArray], current: float) -> float:
    """The largest speed at about that brake current; 0 where the logs have no such current."""
    brake, omega = np.abs(measured["current_brake"]), np.abs(measured["omega"])
    reach = _ABOUT * float(np.nanquantile(brake, _USUAL))
    there = omega[(np.abs(brake - current) < reach) & np.isfinite(omega)]
    return float(np.quantile(there, _USUAL)) if len(there) else 0.0


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
    """A shaft at a prescribed speed, without motor current.

    parameters: (1 + n_draws, n_parameters), of the model and as plausible.
    """

    model: ProcessModel
    parameters: FloatArray
    amplitude: float

    def loop(self, current: float) -> Curve:
        """The last period, with the brake held at a current [A]."""
        from scipy.integrate import solve_ivp

        time = np.linspace(0.0, _PERIODS / _FREQUENCY, _PERIODS * _SAMPLES + 1)
        # Each row of parameters has a deflection of its own: the Jacobian is diagonal.
        solution = solve_ivp(
            lambda t, y: self._slope("z", self._state(t, y[:, None], current))[:, 0],
            (0.0, float(time[-1])), np.zeros(len(self.parameters)), t_eval=time,
            method="LSODA", lband=0, uband=0, rtol=1e-4, atol=1e-7,
        )  # fmt: skip
        last = slice(-_SAMPLES - 1, None)
        torques = self._torque(self._state(time[last], solution.y[:, last], current))
        spread = 1.96 * np.std(torques[1:], axis=0) if len(torques) > 2 else None
        band = None if spread is None else (torques[0] - spread, torques[0] + spread)
        values = {**self._motion(time[last]), "torque": torques[0]}
        return Curve(f"brake {current:.2g} A", values, band)

    def _motion(self, t: Any) -> dict[str, Any]:
        """At times, each alone or (n_times,)."""
        rate = 2.0 * np.pi * _FREQUENCY
        angle = -self.amplitude / rate * np.cos(rate * t)
        return {"angle": angle, "speed": self.amplitude * np.sin(rate * t)}

    def _state(self, t: Any, z: FloatArray, current: float) -> dict[str, Any]:
        """The model's states by name at times t; z: of each row, (1 + n_draws, n_times)."""
        motion = self._motion(t)
        at_rest = dict.fromkeys(self.model.state_names, 0.0)
        moving = {"omega": motion["speed"], "theta": motion["angle"], "z": z}
        given = moving | {"current_brake": current}
        return at_rest | {name: given[name] for name in at_rest if name in given}

    def _slope(self, name: str, x: Mapping[str, Any], load: float = 0.0) -> FloatArray:
        """Derivative of a state by each row of parameters, (1 + n_draws, n_times)."""
        u = tuple(load if each == "torque" else 0.0 for each in self.model.input_names)
        p = self.parameters.T[:, :, None]
        place, shape = self.model.state_names.index(name), x["z"].shape
        try:
            slope = self.model.derivative(tuple(x.values()), u, tuple(p))[place]
        except (TypeError, ValueError):  # of functions of one number, as math.exp, min and max
            numbers = np.array([np.broadcast_to(v, shape) for v in (*x.values(), *p)])
            rows = [tuple(row) for row in numbers.reshape(len(numbers), -1).T.tolist()]
            slope = np.array(
                [self.model.derivative(row[: len(x)], u, row[len(x) :])[place] for row in rows]
            ).reshape(shape)
        return np.broadcast_to(slope, shape)

    def _torque(self, x: Mapping[str, Any]) -> FloatArray:
        """The torque that the load has to apply to keep the speed's derivative zero."""
        free, loaded = self._slope("omega", x), self._slope("omega", x, 1.0)
        change = loaded - free
        # Of draws whose friction outweighs any load the change is lost to rounding.
        return np.divide(-free, change, out=np.full_like(change, np.nan), where=change != 0.0)
