"""Combinations of parts, points of their models, and trajectories by SciPy."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from sim_rig.actuator import actuator
from tests.sysid.support import outputs_of

HYSTERESES = (
    ("bouc-wen", 1.0),
    ("bouc-wen", 2.0),
    ("bouc-wen", 1.5),
    ("dahl", 1.0),
    ("lugre", 1.0),
)
LOADS = ("measured", "free", "locked", "pulley", "hand", "pulley+hand")


@dataclass(frozen=True)
class Parts:
    """What an actuator is put together from."""

    driver_motor: str = "closed"
    driver_brake: str = "closed"
    hysteresis: str = "bouc-wen"
    exponent: float = 1.0
    smooth: bool = False
    friction: str = "none"
    load: str = "measured"
    sensor: str = "load"
    limits: bool = False
    order_motor: int = 1
    order_brake: int = 1
    output_resistance_motor: bool = False
    output_resistance_brake: bool = False

    def build(self, **settings):
        return _build(self, tuple(sorted(settings.items())))

    def __str__(self):
        exponent = f"^{self.exponent:g}" if self.hysteresis == "bouc-wen" else ""
        motor = f"{self.driver_motor}{self.order_motor}{'R' * self.output_resistance_motor}"
        brake = f"{self.driver_brake}{self.order_brake}{'R' * self.output_resistance_brake}"
        return (
            f"{motor}-{brake}-{'smooth-' * self.smooth}{self.hysteresis}"
            f"{exponent}-{self.friction}-{self.load}-{self.sensor}{'-limits' * self.limits}"
        )


@functools.cache
def _build(parts, settings):
    return actuator(**asdict(parts), **dict(settings))


AMPLIFIER = ("order_motor", "order_brake", "output_resistance_motor", "output_resistance_brake")
AMPLIFIERS = tuple(itertools.product((1, 2, 3), (1, 2, 3), (False, True), (False, True)))


def combinations(**kept):
    """Every combination of parts that goes together, some of the choices kept.

    Each once with plain amplifiers, and once with those of one of the kinds that there are, in
    turn: of all with all there would be a hundred thousand.
    """
    choices = {
        "driver_motor": ("closed", "open"),
        "driver_brake": ("closed", "open"),
        "hysteresis": HYSTERESES,
        "smooth": (False, True),
        "friction": ("none", "stribeck", "cyclic"),
        "load": LOADS,
        "sensor": ("load", "between"),
        "limits": (False, True),
    } | {name: (value,) for name, value in kept.items()}
    kinds = itertools.cycle(AMPLIFIERS[1:])
    for values in itertools.product(*choices.values()):
        chosen = dict(zip(choices, values, strict=True))
        chosen["hysteresis"], chosen["exponent"] = chosen["hysteresis"]
        if (chosen["load"], chosen["sensor"]) != ("measured", "between"):
            yield Parts(**chosen)
            yield Parts(**chosen, **dict(zip(AMPLIFIER, next(kinds), strict=True)))


ALL = tuple(combinations())

# Plants of simulated rigs besides the default one: few, as each takes seconds to compile.
PLANTS = {
    "unloaded": {"load": "free", "sensor": "between"},
    "free": {
        "load": "free", "friction": "stribeck", "sensor": "between", "hysteresis": "dahl",
        "driver_motor": "open", "driver_brake": "open",
    },
    "locked": {"load": "locked", "friction": "cyclic", "hysteresis": "lugre"},
    "hand": {"load": "hand", "sensor": "between", "smooth": True, "driver_brake": "open"},
    "pulley": {
        "load": "pulley", "friction": "cyclic", "sensor": "between", "exponent": 2.0,
        "parameter_set": "C", "parameters": {"cycles": 3.0},
    },
}  # fmt: skip


class Point(NamedTuple):
    """States, inputs and parameters by name."""

    x: dict
    u: dict
    q: dict

    def of(self, model):
        """The same as tuples in the model's order."""
        return (
            tuple(self.x[name] for name in model.state_names),
            tuple(self.u[name] for name in model.input_names),
            tuple(self.q[name] for name in model.parameter_names),
        )


def random_point(model, rng):
    """A point on a random side of every kink, and never at one; rng: random.Random.

    Kinks are zero speed, current and hysteresis variable, the amplifiers' limits, and where the
    cable or the stop begins or ceases to press.
    """

    def side(low, high):
        return rng.choice((-1.0, 1.0)) * rng.uniform(low, high)

    def either(inside, outside):
        return side(*(inside if rng.random() < 0.7 else outside))

    q = {}
    for parameter in model.parameters:
        q[parameter.name] = parameter.nominal * math.exp(rng.uniform(-0.7, 0.7))
    q["K_v2i"], q["n_c"] = 0.5, rng.choice((-1.0, 2.0, -3.5))
    if "F_s" in q:
        q["F_s"], q["B_f"] = q["F_c"] * rng.uniform(1.1, 2.0), rng.uniform(0.0, 1e-3)
    if "cycles" in q:
        q["F_cos"], q["F_sin"] = (q["F_c"] * rng.uniform(-0.6, 0.6) for _ in range(2))
        q["cycles"] = float(rng.randint(1, 5))
    slide = 1.0 / q["zeta"] if "zeta" in q else 1.0
    x = {
        "voltage_motor": either((0.1, 20.0), (26.0, 60.0)),
        "voltage_brake": either((0.1, 20.0), (26.0, 60.0)),
        **{name: side(0.1, 60.0) for name in model.state_names if name[-2:] in ("_2", "_3")},
        "current_motor": either((0.05, 2.3), (2.7, 5.0)),
        "current_brake": either((0.01, 0.5), (2.7, 3.0)),
        "omega": either((0.02, 0.3), (1.0, 30.0)),
        "z": side(0.05, 1.2) * slide,
        "theta": side(0.02, 30.0),
    }
    if "radius" in q:
        lever = q["radius"] * x["theta"] / math.hypot(x["theta"], 0.1)
        rate = either((0.0, 0.8 / q["d_cable"]), (1.3 / q["d_cable"], 2.0 / q["d_cable"]))
        x["speed"] = lever * x["omega"] - rate
        if abs(1.0 + q["d_cable"] * x["speed"]) < 0.05:
            x["speed"] += 0.5
        path = q["radius"] * (math.hypot(x["theta"], 0.1) - 0.1)
        x["height"] = path - side(1e-4, 5e-3)
        # The stop is the cable's length: beyond it, or not.
        q["length"] = max(x["height"] - side(1e-4, 5e-3), 0.0)
        if abs(x["height"] - q["length"]) < 1e-5:
            q["length"] = 0.5
    u = {
        "applied_voltage_motor": either((0.05, 4.5), (5.5, 10.0)),
        "applied_voltage_brake": either((0.05, 0.4), (5.5, 10.0)),
        "torque": side(0.01, 1.0),
        "hand_grip": rng.choice((0.0, 0.5, 1.0)),
        "hand_theta": x["theta"] + side(0.0, 1.0),
        "hand_omega": side(0.0, 10.0),
    }
    return Point(x, u, q)


def as_dicts(model, x, u, p):
    """A point by names."""
    return Point(
        dict(zip(model.state_names, x, strict=True)),
        dict(zip(model.input_names, u, strict=True)),
        dict(zip(model.parameter_names, p, strict=True)),
    )


class Trajectory:
    """States over time, by name; ``end`` is the last of them, ``extra`` the added integrals."""

    def __init__(self, model, inputs, p, solution):
        self.model, self.inputs, self.p = model, inputs, p
        self.t, self.y = solution.t, solution.y

    def __getitem__(self, name):
        return self.y[self.model.state_names.index(name)]

    @property
    def extra(self):
        return self.y[len(self.model.states) :]

    def output(self, name, row=-1):
        """An output at one of the instants."""
        x = tuple(self.y[: len(self.model.states), row])
        values = outputs_of(self.model, x, self.inputs(self.t[row]), self.p)
        return values[self.model.output_names.index(name)]


def follow(
    model, inputs, duration, changes=None, start=None, powers=None, rtol=1e-7, atol=1e-9,
    max_step=5e-3, method="LSODA", times=None,
):  # fmt: skip
    """The model's motion under inputs(t), with integrals of powers(t, x) beside it.

    changes: parameters by name. start: initial states by name, others as declared.
    """
    p = tuple(model.vector(changes or {}))
    n = len(model.states)
    x0 = np.array([(start or {}).get(s.name, s.initial) for s in model.states])
    extra = [] if powers is None else powers(0.0, x0)

    def rhs(t, x):
        slopes = model.derivative(tuple(x[:n]), inputs(t), p)
        return [*slopes, *powers(t, x[:n])] if powers else slopes

    solution = solve_ivp(
        rhs, (0.0, duration), np.append(x0, np.zeros(len(extra))), method=method, rtol=rtol,
        atol=atol, max_step=max_step, t_eval=times,
    )  # fmt: skip
    assert solution.success, solution.message
    return Trajectory(model, inputs, p, solution)


def constant(model, **values):
    """Inputs that stay as they are, the others zero."""
    assert set(values) <= set(model.input_names)
    u = tuple(float(values.get(name, 0.0)) for name in model.input_names)
    return lambda t: u
