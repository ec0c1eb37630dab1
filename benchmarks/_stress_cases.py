"""Cases that try to fool the verdict: faults in data and in structure, and none at all.

A direct-current motor, simulated here by a Runge-Kutta scheme of its own, is identified from 1.5 s
under random levels and judged on as much again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.arrays import FloatArray

DT, SAMPLES, PARTS = 2e-3, 750, 8  # s, samples of a record, steps of a sample
FRICTION = 0.02  # N*m
TRUTH = {"R": 1.2, "L": 2e-3, "K": 0.1, "J": 1.5e-4, "B": 2e-4, "T_c": FRICTION}
NOISE = np.array([0.02, 0.3])  # A, rad/s

Signals = tuple[FloatArray, FloatArray]
Fault = Callable[[FloatArray, FloatArray, np.random.Generator], Signals]
Change = Callable[[FloatArray, np.random.Generator], FloatArray]
Friction = Callable[[float, float], float]
Validation = Literal["another", "copy", "repetition", "still"]


def _derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
    current, omega = x
    voltage, load = u
    R, L, K, J, B = p
    return ((voltage - R * current - K * omega) / L, (K * current - B * omega + load) / J)


def _range(name: str, unit: str, reach: float = 10.0) -> Parameter:
    value = TRUTH[name]
    return Parameter(name, unit, 2.0 * value, value / reach, reach * value, "log")


MODEL = ProcessModel(
    name="motor",
    states=(State("current", "A"), State("omega", "rad/s")),
    inputs=(Input("voltage", "V"), Input("load", "N*m")),
    outputs=(Output("current", "A"), Output("omega", "rad/s")),
    parameters=(
        _range("R", "ohm"),
        _range("L", "H"),
        _range("K", "N*m/A"),
        _range("J", "kg*m^2"),
        _range("B", "N*m*s/rad"),
    ),
    derivative=_derivative,
)


def _with_friction(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
    rates = _derivative(x, u, p[:5])
    return (rates[0], rates[1] - p[5] * math.tanh(x[1] / 0.2) / p[3])


WITH_FRICTION = replace(
    MODEL,
    name="motor with friction",
    parameters=(*MODEL.parameters, Parameter("T_c", "N*m", 0.01, 1e-3, 0.1, "log")),
    derivative=_with_friction,
)
WIDE = replace(
    WITH_FRICTION,
    name="motor with friction, wide ranges",
    parameters=tuple(_range(p.name, p.unit, 50.0) for p in WITH_FRICTION.parameters),
)


@dataclass(frozen=True)
class Plant:
    """The motor that is there: what differs from the model's.

    friction: (omega, theta) -> torque. drive: voltage at the winding from that commanded.
    heating: share by which the resistance rises until the end, along a straight line, or with the
    time constant ``warming`` [s]. constant, inductance: K and L by the current, in parts of the
    truth. disturbance: torque by time. compliance: share of J behind a shaft of 0.5 N*m/rad, none
    for a stiff one; backlash: its play [rad]. bristles: LuGre friction's stiffness [1/rad].
    governor: voltage that a controller takes back for every rad/s measured.
    """

    friction: Friction = lambda omega, theta: 0.0
    drive: Callable[[float], float] = lambda voltage: voltage
    heating: float = 0.0
    warming: float = 0.0
    constant: Callable[[float], float] = lambda current: 1.0
    inductance: Callable[[float], float] = lambda current: 1.0
    disturbance: Callable[[float], float] = lambda time: 0.0
    compliance: float = 0.0
    backlash: float = 0.0
    bristles: float = 0.0
    governor: float = 0.0

    def run(self, inputs: FloatArray, noise: FloatArray, truth: Mapping[str, float]) -> Signals:
        """Inputs as applied and outputs as measured at every sample, (n, 2) each."""
        x = np.zeros(6)
        h, applied, outputs = DT / PARTS, inputs.copy(), np.empty((len(inputs), 2))
        for k in range(len(inputs)):
            outputs[k] = x[:2] + noise[k]
            applied[k, 0] -= self.governor * outputs[k, 1]
            voltage, load = applied[k].tolist()
            for part in range(PARTS):
                f = partial(self._rates, truth, voltage, load, (k + part / PARTS) * DT)
                a = f(x)
                b = f(x + 0.5 * h * a)
                c = f(x + 0.5 * h * b)
                x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + f(x + h * c))
        return applied, outputs

    def _rates(
        self, p: Mapping[str, float], voltage: float, load: float, time: float, x: FloatArray
    ) -> FloatArray:
        current, omega, theta, behind, twist, bristle = x.tolist()
        K, R = p["K"] * self.constant(current), p["R"] * (1.0 + self._heated(time))
        torque = load - p["B"] * omega - self.friction(omega, theta) + self.disturbance(time)
        slip = omega - self.bristles * abs(omega) * bristle
        torque -= FRICTION * (self.bristles * bristle + 0.01 * slip) * (self.bristles > 0.0)
        shaft, behind_rate = 0.0, 0.0
        if self.compliance:
            half = 0.5 * self.backlash
            wound = twist - min(max(twist, -half), half)
            shaft = 2.0 * wound + 2e-4 * (omega - behind) * (wound != 0.0 or half == 0.0)
            behind_rate = shaft / (self.compliance * p["J"])
        return np.array(
            [
                (self.drive(voltage) - R * current - K * omega)
                / (p["L"] * self.inductance(current)),
                (K * current + torque - shaft) / ((1.0 - self.compliance) * p["J"]),
                omega,
                behind_rate,
                omega - behind,
                slip,
            ]
        )

    def _heated(self, time: float) -> float:
        """Share by which the resistance has risen."""
        if self.warming:
            return self.heating * (1.0 - math.exp(-time / self.warming))
        return self.heating * time / (SAMPLES * DT)


def excitation(rng: np.random.Generator) -> FloatArray:
    """Voltages [V] and loads [N*m] in random levels of 20 ms and more, (n, 2)."""
    columns = []
    for size, shortest in ((6.0, 10), (0.05, 25)):
        lengths = rng.integers(shortest, 4 * shortest, SAMPLES // shortest)
        levels = np.repeat(rng.uniform(-size, size, len(lengths)), lengths)
        columns.append(levels[:SAMPLES])
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Case:
    """The plant, what happens to its data, and the model that is fitted.

    fault: of a record, with ``only_later`` not of the first log and the validation. sensor: noise
    of unit variance, (n, 2). noise: its size in parts of NOISE; calibration: what is said of it, in
    parts of the truth, 0 where nothing is. load_noise: of the load, a measured input [N*m];
    told: whether that is said. motors: whether every seed has a motor of its own. words: one of
    which names what is wrong.
    """

    name: str
    kind: str
    plant: Plant = Plant()
    fault: Fault = lambda u, y, rng: (u, y)
    model: ProcessModel = MODEL
    sensor: Callable[[np.random.Generator], FloatArray] = lambda rng: rng.standard_normal(
        (SAMPLES, 2)
    )
    noise: float = 1.0
    calibration: float = 1.0
    load_noise: float = 0.0
    told: bool = True
    validation: Validation = "another"
    logs: int = 1
    only_later: bool = False
    motors: bool = False
    words: tuple[str, ...] = ()

    @property
    def sound(self) -> Plant:
        """The plant as the model has it."""
        return Plant(dry(FRICTION)) if self._rubs else Plant(governor=self.plant.governor)

    @property
    def _rubs(self) -> bool:
        return "T_c" in self.model.parameter_names

    def truth(self, seed: int) -> dict[str, float]:
        """Parameters of the motor that is there."""
        if not self.motors:
            return TRUTH
        factors = np.exp(np.random.default_rng([seed, 0]).uniform(-1.0, 1.0, len(TRUTH)))
        return {name: value * factors[i] for i, (name, value) in enumerate(TRUTH.items())}

    def records(self, seed: int) -> tuple[list[Dataset], Dataset]:
        """Training and validation."""
        training = [
            self._record(seed, 1 + 10 * k, f"training {k + 1}", not self.only_later or k > 0)
            for k in range(self.logs)
        ]
        if self.validation == "copy":
            return training, replace(training[0], name="validation")
        return training, self._record(seed, 2, "validation", not self.only_later)

    def _record(self, seed: int, place: int, name: str, faulty: bool = True) -> Dataset:
        rng = np.random.default_rng([seed, place])
        levels = np.random.default_rng([seed, 1]) if self.validation == "repetition" else rng
        inputs = excitation(levels) * (self.validation != "still" or place != 2)
        noise = self.noise * NOISE * self.sensor(rng)
        plant = self.plant
        if self.motors and self._rubs:
            plant = replace(plant, friction=dry(self.truth(seed)["T_c"]))
        applied, outputs = plant.run(inputs, noise, self.truth(seed))
        applied[:, 1] += self.load_noise * rng.standard_normal(SAMPLES)
        u, y = self.fault(applied, outputs, rng) if faulty else (applied, outputs)
        known = self.calibration * self.noise * NOISE
        of_load = np.array([0.0, self.load_noise * self.told])
        return Dataset(u, y, DT, name, output_noise=known, input_noise=of_load)


def each(side: int, column: int, change: Change) -> Fault:
    """A fault of one column of the inputs (0) or outputs (1)."""

    def fault(u: FloatArray, y: FloatArray, rng: np.random.Generator) -> Signals:
        table = (u, y)[side]
        table[:, column] = change(table[:, column], rng)
        return u, y

    return fault


def both(*faults: Fault) -> Fault:
    """Faults one after another."""

    def fault(u: FloatArray, y: FloatArray, rng: np.random.Generator) -> Signals:
        for each_fault in faults:
            u, y = each_fault(u, y, rng)
        return u, y

    return fault


def _averaged(s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The mean since the sample before, by the straight line between both."""
    mean: FloatArray = 0.5 * (s + np.append(s[:1], s[:-1]))
    return mean


def _late(samples: int) -> Change:
    return lambda s, rng: np.concatenate([np.full(samples, s[0]), s[:-samples]])


def _clipped(part: float) -> Change:
    return lambda s, rng: np.clip(s, -part * np.abs(s).max(), part * np.abs(s).max())


def _outliers(size: float, share: float = 0.01) -> Change:
    """size: in parts of the channel's peak."""

    def change(s: FloatArray, rng: np.random.Generator) -> FloatArray:
        at = rng.choice(len(s) - 1, int(share * len(s)), replace=False) + 1
        s[at] += size * np.abs(s).max() * rng.choice([-1.0, 1.0], len(at))
        return s

    return change


def _frozen(s: FloatArray, rng: np.random.Generator) -> FloatArray:
    s[300:400] = s[300]
    return s


def _ramp(size: float) -> Change:
    return lambda s, rng: s + size * np.linspace(0.0, 1.0, len(s))


def _scaled(factor: float) -> Change:
    return lambda s, rng: factor * s


def _moved(offset: float) -> Change:
    return lambda s, rng: s + offset


def _low_passed(samples: float) -> Change:
    """A first-order filter of so many samples' time constant."""

    def change(s: FloatArray, rng: np.random.Generator) -> FloatArray:
        pole, filtered = math.exp(-1.0 / samples), s.copy()
        for k in range(1, len(s)):
            filtered[k] = pole * filtered[k - 1] + (1.0 - pole) * s[k]
        return filtered

    return change


def _hum(size: float) -> Change:
    phases = 2.0 * math.pi * 50.0 * DT * np.arange(SAMPLES)
    return lambda s, rng: s + size * np.sin(phases + rng.uniform(0.0, 2.0 * math.pi))


def _jittered(samples: float) -> Change:
    """Sampled early or late by this deviation."""

    def change(s: FloatArray, rng: np.random.Generator) -> FloatArray:
        rows = np.arange(len(s))
        return np.interp(rows + samples * rng.standard_normal(len(s)), rows, s)

    return change


def _rows_dropped(u: FloatArray, y: FloatArray, rng: np.random.Generator) -> Signals:
    """Ten rows that nobody knows to be lost, in three places."""
    kept = np.ones(len(y), dtype=bool)
    for begin in (200, 400, 600):
        kept[begin : begin + 10] = False
    return u[kept], y[kept]


def _lost(u: FloatArray, y: FloatArray, rng: np.random.Generator) -> Signals:
    """Samples that are known to be lost."""
    y[1:][rng.uniform(size=y[1:].shape) < 0.05] = np.nan
    return u, y


def dry(
    level: float, standstill: float = 0.0, cycles: float = 0.0, backward: float = 1.0
) -> Friction:
    """Coulomb friction, more at standstill and along a turn; backward: in parts of forward."""

    def torque(omega: float, theta: float) -> float:
        size = level + standstill * math.exp(-((omega / 5.0) ** 2)) + cycles * math.cos(theta)
        return size * math.tanh(omega / 0.2) * (backward if omega < 0.0 else 1.0)

    return torque


VOLTAGE, LOAD, CURRENT, SPEED = (0, 0), (0, 1), (1, 0), (1, 1)


def _in_data(name: str, fault: Fault, *words: str, **options: Any) -> Case:
    """A fault in data whose noise nobody calibrated, as in a file of a user's own."""
    return Case(name, "data", fault=fault, words=words, **{"calibration": 0.0, **options})


def _in_structure(name: str, plant: Plant, *words: str, **options: Any) -> Case:
    return Case(name, "structure", plant, words=words, **{"calibration": 0.0, **options})


_IN_LATER_LOGS: dict[str, Any] = {"logs": 3, "only_later": True}
DATA = (
    _in_data("current clipped at 90 %", each(*CURRENT, _clipped(0.9)), "ends at", "saturates"),
    _in_data("current clipped at 60 %", each(*CURRENT, _clipped(0.6)), "ends at", "saturates"),
    _in_data("speed clipped at 80 %", each(*SPEED, _clipped(0.8)), "ends at", "saturates"),
    _in_data("1 % outliers in the current", each(*CURRENT, _outliers(1.0)), "alone"),
    _in_data("1 % outliers in the speed", each(*SPEED, _outliers(1.0)), "alone"),
    _in_data("current a sample late", each(*CURRENT, _late(1)), " late", " early"),
    _in_data("speed two samples late", each(*SPEED, _late(2)), " late", " early"),
    _in_data("voltage two samples late", each(*VOLTAGE, _late(2)), " late", " early"),
    _in_data("load ten samples late", each(*LOAD, _late(10)), " late", " early"),
    _in_data("current 1.3 times", each(*CURRENT, _scaled(1.3)), "times what"),
    _in_data("load half", each(*LOAD, _scaled(0.5)), "times what"),
    _in_data("sign of the current", each(*CURRENT, _scaled(-1.0)), "opposite sign"),
    _in_data("sign of the load", each(*LOAD, _scaled(-1.0)), "opposite sign"),
    _in_data("current 0.3 A off", each(*CURRENT, _moved(0.3)), " off"),
    _in_data("speed 5 rad/s off", each(*SPEED, _moved(5.0)), " off"),
    _in_data("load drifts", each(*LOAD, _ramp(0.05)), "drifts", " off"),
    _in_data("current drifts", each(*CURRENT, _ramp(0.5)), "drifts", " off"),
    _in_data("speed hangs", each(*SPEED, _frozen), "repeats"),
    _in_data("validation is the training log", lambda u, y, rng: (u, y), validation="copy"),
    _in_data("validation stands still", lambda u, y, rng: (u, y), validation="still"),
)
MORE_DATA = (
    _in_data("sign of the voltage", each(*VOLTAGE, _scaled(-1.0)), "opposite sign"),
    _in_data("sign of the speed", each(*SPEED, _scaled(-1.0)), "opposite sign"),
    _in_data("speed without direction", each(*SPEED, lambda s, rng: np.abs(s))),
    _in_data("voltage ten samples late", each(*VOLTAGE, _late(10)), " late", " early"),
    _in_data("speed ten samples late", each(*SPEED, _late(10)), " late", " early"),
    _in_data("speed through a filter", each(*SPEED, _low_passed(4.0)), "filter"),
    _in_data("current through a filter", each(*CURRENT, _low_passed(1.5)), "filter"),
    _in_data("current hums", each(*CURRENT, _hum(0.5))),
    _in_data(
        "sampling jitters", both(each(*CURRENT, _jittered(0.3)), each(*SPEED, _jittered(0.3)))
    ),
    _in_data("rows dropped", _rows_dropped),
    _in_data("small outliers", each(*SPEED, _outliers(0.05, 0.05)), "alone"),
    _in_data("current in coarse steps", each(*CURRENT, lambda s, rng: np.round(s)), "coarser"),
    _in_data(
        "current 1.3 times, speed late", both(each(*CURRENT, _scaled(1.3)), each(*SPEED, _late(2)))
    ),
    _in_data(
        "load half, current clipped", both(each(*LOAD, _scaled(0.5)), each(*CURRENT, _clipped(0.8)))
    ),
    _in_data(
        "offset and outliers", both(each(*SPEED, _moved(5.0)), each(*CURRENT, _outliers(1.0)))
    ),
    _in_data(
        "current 1.3 times in later logs",
        each(*CURRENT, _scaled(1.3)),
        "of training",
        **_IN_LATER_LOGS,
    ),
    _in_data(
        "sign of the load in later logs",
        each(*LOAD, _scaled(-1.0)),
        "of training",
        **_IN_LATER_LOGS,
    ),
    _in_data("speed late in later logs", each(*SPEED, _late(2)), "of training", **_IN_LATER_LOGS),
    _in_data(
        "current clipped in later logs",
        each(*CURRENT, _clipped(0.6)),
        "of training",
        **_IN_LATER_LOGS,
    ),
    _in_data("load off in later logs", each(*LOAD, _moved(0.02)), "of training", **_IN_LATER_LOGS),
    _in_data("speed as differences of positions", each(*SPEED, _averaged), "mean over"),
    _in_data("speed late, calibrated", each(*SPEED, _late(2)), " late", calibration=1.0),
    _in_data(
        "load half, noise understated", each(*LOAD, _scaled(0.5)), "times what", calibration=1 / 3
    ),
    _in_data(
        "load half, noise overstated", each(*LOAD, _scaled(0.5)), "times what", calibration=3.0
    ),
    _in_data("load half, its noise known", each(*LOAD, _scaled(0.5)), load_noise=5e-3),
    _in_data(
        "load's noise, not told",
        lambda u, y, rng: (u, y),
        "with noise of",
        load_noise=0.02,
        told=False,
    ),
)
STRUCTURE = (
    _in_structure("Coulomb friction", Plant(dry(FRICTION)), "sign of omega"),
    _in_structure("Stribeck friction", Plant(dry(0.01, 0.015)), " omega"),
    _in_structure("friction along a turn", Plant(dry(0.015, 0.0, 0.012)), " omega"),
    _in_structure("drag", Plant(lambda omega, theta: 1e-5 * omega * abs(omega)), "omega (square)"),
    _in_structure("amplifier saturates", Plant(drive=lambda v: min(max(v, -4.0), 4.0)), "saturat"),
    _in_structure("amplifier's dead zone", Plant(drive=lambda v: v - min(max(v, -0.8), 0.8))),
    _in_structure("winding warms up", Plant(heating=0.4), "R changes"),
    _in_structure("motor constant saturates", Plant(constant=lambda i: 1.0 / (1.0 + 0.04 * i * i))),
    _in_structure(
        "a load not measured", Plant(disturbance=lambda t: 0.03 * math.sin(9.0 * t)), "slow signal"
    ),
    _in_structure("a flexible shaft", Plant(compliance=0.5)),
)
MORE_STRUCTURE = (
    _in_structure("backlash", Plant(compliance=0.5, backlash=0.2)),
    _in_structure("LuGre friction", Plant(bristles=5.0), " omega"),
    _in_structure("stiff LuGre friction", Plant(bristles=100.0), " omega"),
    _in_structure("friction of one direction", Plant(dry(FRICTION, backward=0.5)), "omega"),
    _in_structure("cogging", Plant(lambda w, a: 0.02 * math.sin(4.0 * a)), "cogging"),
    _in_structure("little cogging", Plant(lambda w, a: 0.003 * math.sin(12.0 * a)), "cogging"),
    _in_structure("winding warms up fast", Plant(heating=0.4, warming=0.3), "R changes"),
    _in_structure("inductance saturates", Plant(inductance=lambda i: 1.0 / (1.0 + 0.1 * i * i))),
    _in_structure("brakes from the middle on", Plant(disturbance=lambda t: -0.02 * (t > 0.75))),
    _in_structure("wind", Plant(lambda w, a: 2e-7 * w**3), " omega"),
    _in_structure("Coulomb friction, calibrated", Plant(dry(FRICTION)), calibration=1.0),
    _in_structure("Coulomb friction, noise overstated", Plant(dry(FRICTION)), calibration=3.0),
    _in_structure("Coulomb friction, load's noise", Plant(dry(FRICTION)), load_noise=5e-3),
    _in_structure("Stribeck friction, load's noise", Plant(dry(0.01, 0.015)), load_noise=5e-3),
    _in_structure("Stribeck friction, much noise", Plant(dry(0.01, 0.015)), noise=5.0),
    _in_structure("drag, load's noise", Plant(lambda w, a: 1e-5 * w * abs(w)), load_noise=5e-3),
    _in_structure("little friction", Plant(dry(0.003)), " omega"),
    _in_structure("friction, three logs", Plant(dry(0.005)), " omega", logs=3),
    _in_structure("Coulomb friction, governed", Plant(dry(FRICTION), governor=0.1), " omega"),
    _in_structure("friction, validation repeats", Plant(dry(FRICTION)), validation="repetition"),
    _in_structure("Stribeck beside Coulomb", Plant(dry(0.02, 0.02)), model=WITH_FRICTION),
    _in_structure("motors' Coulomb friction", Plant(dry(FRICTION)), motors=True),
)


def _correct(name: str, **options: Any) -> Case:
    return Case(name, "correct", **options)


_RUBBING: dict[str, Any] = {"plant": Plant(dry(FRICTION)), "model": WITH_FRICTION}
CORRECT = (
    _correct("motor"),
    _correct("noise not known", calibration=0.0),
    _correct("much noise", noise=10.0),
    _correct("much noise, not known", noise=10.0, calibration=0.0),
    _correct("little noise", noise=0.1),
    _correct("little noise, not known", noise=0.1, calibration=0.0),
    _correct("next to no noise, not known", noise=1e-6, calibration=0.0),
    _correct("friction", **_RUBBING),
    _correct("friction, noise not known", calibration=0.0, **_RUBBING),
    _correct("friction, much noise", noise=5.0, **_RUBBING),
)


def _heavy(rng: np.random.Generator) -> FloatArray:
    """Student's noise with four degrees of freedom, of unit variance."""
    return rng.standard_t(4.0, (SAMPLES, 2)) / math.sqrt(2.0)


def _slow(rng: np.random.Generator) -> FloatArray:
    """Noise with a memory of five samples, of unit variance."""
    white, pole = rng.standard_normal((SAMPLES, 2)), 0.8
    for k in range(1, SAMPLES):
        white[k] = pole * white[k - 1] + math.sqrt(1.0 - pole**2) * white[k]
    return white


def _even(rng: np.random.Generator) -> FloatArray:
    return rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), (SAMPLES, 2))


def _fading(rng: np.random.Generator) -> FloatArray:
    """Noise that becomes three times less along the record, of unit variance at its middle."""
    return rng.standard_normal((SAMPLES, 2)) * np.geomspace(1.7, 0.6, SAMPLES)[:, None]


MORE_CORRECT = (
    _correct("noise of heavy tails", sensor=_heavy, calibration=0.0),
    _correct("noise of heavy tails, calibrated", sensor=_heavy),
    _correct("noise with a memory", sensor=_slow, calibration=0.0),
    _correct("noise with a memory, calibrated", sensor=_slow),
    _correct("even noise", sensor=_even, calibration=0.0),
    _correct("noise that fades", sensor=_fading, calibration=0.0),
    _correct("samples lost", fault=_lost, calibration=0.0),
    _correct("fine steps", fault=each(*SPEED, lambda s, rng: np.round(s / 0.5) * 0.5)),
    _correct("three logs", logs=3, calibration=0.0),
    _correct("governed", plant=Plant(governor=0.1), calibration=0.0),
    _correct("noise overstated", calibration=3.0),
    _correct("validation repeats", validation="repetition", calibration=0.0),
    _correct("load's noise", load_noise=5e-3),
    _correct("load's noise, others not known", load_noise=5e-3, calibration=0.0),
    _correct("friction, load's noise", load_noise=5e-3, **_RUBBING),
    _correct("motors", motors=True, calibration=0.0),
    _correct("motors with friction", motors=True, calibration=0.0, **_RUBBING),
    _correct("motors with friction, calibrated", motors=True, **_RUBBING),
    _correct(
        "friction, wide ranges",
        plant=Plant(dry(FRICTION)),
        model=WIDE,
        motors=True,
        calibration=0.0,
    ),
)


def cases() -> list[Case]:
    """All of them."""
    return [*DATA, *MORE_DATA, *STRUCTURE, *MORE_STRUCTURE, *CORRECT, *MORE_CORRECT]
