"""Is the verdict fooled? Faults in data and structure that must not be called good, and none.

python -m benchmarks.stress [--json] [--seeds 20] [--correct 100] [--only NAME]

A direct-current motor, simulated here by a Runge-Kutta scheme of its own, is identified from 1.5 s
under random levels and judged on as much again. Of twenty cases the data are faulty, of ten the
motor has what the model lacks, ten are correct. A faulty case is passed where the verdict is not
good, or says what it is, or where every interval holds the truth all the same; a correct one where
the verdict is good.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks._common import arguments, report
from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.arrays import FloatArray
from sysid.gassi import GASSI
from sysid.judging.assessment import Verdict
from sysid.judging.examination import verdict_of

DT, SAMPLES, PARTS = 2e-3, 750, 8  # s, samples of a record, steps of a sample
TRUTH = {"R": 1.2, "L": 2e-3, "K": 0.1, "J": 1.5e-4, "B": 2e-4}
NOISE = np.array([0.02, 0.3])  # A, rad/s

Signals = tuple[FloatArray, FloatArray]
Friction = Callable[[float, float], float]


def _derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
    current, omega = x
    voltage, load = u
    R, L, K, J, B = p
    return ((voltage - R * current - K * omega) / L, (K * current - B * omega + load) / J)


def _range(name: str, unit: str) -> Parameter:
    value = TRUTH[name]
    return Parameter(name, unit, 2.0 * value, 0.1 * value, 10.0 * value, "log")


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
FRICTION = 0.02  # N*m


@dataclass(frozen=True)
class Plant:
    """The motor that is there: what differs from the model's.

    friction: (omega, theta) -> torque. drive: voltage at the winding from that commanded.
    heating: share by which the resistance rises until the end. constant: K by the current.
    inertia: share of J behind a shaft of this stiffness [N*m/rad], none for a stiff one.
    """

    friction: Friction = lambda omega, theta: 0.0
    drive: Callable[[float], float] = lambda voltage: voltage
    heating: float = 0.0
    constant: Callable[[float], float] = lambda current: TRUTH["K"]
    disturbance: Callable[[float], float] = lambda time: 0.0
    compliance: float = 0.0

    def run(self, inputs: FloatArray) -> FloatArray:
        """Current and speed at every sample, (n, 2)."""
        x = np.zeros(6)
        h, outputs = DT / PARTS, np.empty((len(inputs), 2))
        for k, (voltage, load) in enumerate(inputs.tolist()):
            outputs[k] = x[0], x[1]
            for part in range(PARTS):
                f = partial(self._rates, voltage, load, (k + part / PARTS) * DT)
                a = f(x)
                b = f(x + 0.5 * h * a)
                c = f(x + 0.5 * h * b)
                x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + f(x + h * c))
        return outputs

    def _rates(self, voltage: float, load: float, time: float, x: FloatArray) -> FloatArray:
        current, omega, theta, behind, twist, _ = x.tolist()
        R = TRUTH["R"] * (1.0 + self.heating * time / (SAMPLES * DT))
        K, J = self.constant(current), TRUTH["J"]
        torque = load - TRUTH["B"] * omega - self.friction(omega, theta) + self.disturbance(time)
        shaft = 0.0
        if self.compliance:
            J *= 0.5
            shaft = twist / self.compliance + 2e-4 * (omega - behind)
        return np.array(
            [
                (self.drive(voltage) - R * current - K * omega) / TRUTH["L"],
                (K * current + torque - shaft) / J,
                omega,
                shaft / J if self.compliance else 0.0,
                omega - behind if self.compliance else 0.0,
                0.0,
            ]
        )


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
    """A case: the plant, what happens to its data, and the model that is fitted.

    fault: of each record, (inputs, outputs) -> the same with the fault. copied: whether the
    validation is the training log. still: whether it does not move. named: a word that names it.
    """

    name: str
    kind: str
    plant: Plant = Plant()
    fault: Callable[[FloatArray, FloatArray], Signals] = lambda u, y: (u, y)
    model: ProcessModel = MODEL
    noise: float = 1.0
    known_noise: bool = True
    copied: bool = False
    still: bool = False

    def records(self, seed: int) -> tuple[Dataset, Dataset]:
        """Training and validation."""
        training = self._record(np.random.default_rng([seed, 1]), "training")
        if self.copied:
            return training, replace(training, name="validation")
        return training, self._record(np.random.default_rng([seed, 2]), "validation", self.still)

    def _record(self, rng: np.random.Generator, name: str, still: bool = False) -> Dataset:
        inputs = excitation(rng) * (0.0 if still else 1.0)
        outputs = self.plant.run(inputs)
        outputs = outputs + self.noise * NOISE * rng.standard_normal(outputs.shape)
        u, y = self.fault(inputs.copy(), outputs.copy())
        known = self.noise * NOISE if self.known_noise else np.zeros(2)
        return Dataset(u, y, DT, name, output_noise=known)


def _each(side: int, column: int, change: Callable[[FloatArray], FloatArray]) -> Any:
    """A fault of one column of the inputs (0) or outputs (1)."""

    def fault(u: FloatArray, y: FloatArray) -> Signals:
        table = (u, y)[side]
        table[:, column] = change(table[:, column])
        return u, y

    return fault


def _late(samples: int) -> Callable[[FloatArray], FloatArray]:
    return lambda s: np.concatenate([np.full(samples, s[0]), s[:-samples]])


def _clipped(part: float) -> Callable[[FloatArray], FloatArray]:
    return lambda s: np.clip(s, -part * np.abs(s).max(), part * np.abs(s).max())


def _outliers(size: float) -> Callable[[FloatArray], FloatArray]:
    def change(s: FloatArray) -> FloatArray:
        rng = np.random.default_rng(len(s))
        at = rng.choice(len(s) - 1, len(s) // 100, replace=False) + 1
        s[at] += size * np.abs(s).max() * rng.choice([-1.0, 1.0], len(at))
        return s

    return change


def _frozen(s: FloatArray) -> FloatArray:
    s[300:400] = s[300]
    return s


def _ramp(size: float) -> Callable[[FloatArray], FloatArray]:
    return lambda s: s + size * np.linspace(0.0, 1.0, len(s))


def _dry(level: float, standstill: float = 0.0, cycles: float = 0.0) -> Friction:
    def torque(omega: float, theta: float) -> float:
        size = level + standstill * math.exp(-((omega / 5.0) ** 2)) + cycles * math.cos(theta)
        return size * math.tanh(omega / 0.2)

    return torque


VOLTAGE, LOAD, CURRENT, SPEED = (0, 0), (0, 1), (1, 0), (1, 1)
DATA: Mapping[str, Callable[[FloatArray, FloatArray], Signals]] = {
    "current clipped at 90 %": _each(*CURRENT, _clipped(0.9)),
    "current clipped at 60 %": _each(*CURRENT, _clipped(0.6)),
    "speed clipped at 80 %": _each(*SPEED, _clipped(0.8)),
    "1 % outliers in the current": _each(*CURRENT, _outliers(1.0)),
    "1 % outliers in the speed": _each(*SPEED, _outliers(1.0)),
    "current a sample late": _each(*CURRENT, _late(1)),
    "speed two samples late": _each(*SPEED, _late(2)),
    "voltage two samples late": _each(*VOLTAGE, _late(2)),
    "load ten samples late": _each(*LOAD, _late(10)),
    "current 1.3 times": _each(*CURRENT, lambda s: 1.3 * s),
    "load half": _each(*LOAD, lambda s: 0.5 * s),
    "sign of the current": _each(*CURRENT, lambda s: -s),
    "sign of the load": _each(*LOAD, lambda s: -s),
    "current 0.3 A off": _each(*CURRENT, lambda s: s + 0.3),
    "speed 5 rad/s off": _each(*SPEED, lambda s: s + 5.0),
    "load drifts": _each(*LOAD, _ramp(0.05)),
    "current drifts": _each(*CURRENT, _ramp(0.5)),
    "speed hangs": _each(*SPEED, _frozen),
}
STRUCTURE = {
    "Coulomb friction": Plant(_dry(FRICTION)),
    "Stribeck friction": Plant(_dry(0.01, 0.015)),
    "friction along a turn": Plant(_dry(0.015, 0.0, 0.012)),
    "drag": Plant(lambda omega, theta: 1e-5 * omega * abs(omega)),
    "amplifier saturates": Plant(drive=lambda v: min(max(v, -4.0), 4.0)),
    "amplifier's dead zone": Plant(drive=lambda v: v - min(max(v, -0.8), 0.8)),
    "winding warms up": Plant(heating=0.4),
    "motor constant saturates": Plant(constant=lambda i: 0.1 / (1.0 + 0.04 * i * i)),
    "a load not measured": Plant(disturbance=lambda t: 0.03 * math.sin(9.0 * t)),
    "a flexible shaft": Plant(compliance=0.5),
}


def cases() -> list[Case]:
    """All forty."""
    unknown = {"known_noise": False}  # as in a file of a user's own: the harder case
    data = [Case(name, "data", fault=fault, **unknown) for name, fault in DATA.items()]
    data += [
        Case("validation is the training log", "data", copied=True, **unknown),
        Case("validation stands still", "data", still=True, **unknown),
    ]
    structure = [
        Case(name, "structure", plant=plant, **unknown) for name, plant in STRUCTURE.items()
    ]
    friction = {"plant": Plant(_dry(FRICTION)), "model": WITH_FRICTION}
    correct = [
        Case("motor", "correct"),
        Case("noise not known", "correct", known_noise=False),
        Case("much noise", "correct", noise=10.0),
        Case("much noise, not known", "correct", noise=10.0, known_noise=False),
        Case("little noise", "correct", noise=0.1),
        Case("little noise, not known", "correct", noise=0.1, known_noise=False),
        Case("next to no noise, not known", "correct", noise=1e-6, known_noise=False),
        Case("friction", "correct", **friction),
        Case("friction, noise not known", "correct", known_noise=False, **friction),
        Case("friction, much noise", "correct", noise=5.0, **friction),
    ]
    return [*data, *structure, *correct]


@dataclass(frozen=True)
class Outcome:
    """What became of a case: its verdict, and whether an interval excludes the truth."""

    verdict: Verdict
    moved: tuple[str, ...]

    def passed(self, kind: str) -> bool:
        """Whether the verdict was not fooled."""
        good = self.verdict.trust == "good"
        named = any(note.startswith("There, but") for note in self.verdict.notes)
        return good if kind == "correct" else not good or named or not self.moved


def tried(case: Case, seed: int) -> Outcome:
    """Fit and judge a case."""
    training, validation = case.records(seed)
    estimator = GASSI(case.model, population=60, generations=12, random_state=seed).fit(training)
    truth = {**TRUTH, "T_c": FRICTION}
    estimates = estimator.uncertainty(training).determined()
    moved = tuple(e.name for e in estimates if e.excludes(truth))
    return Outcome(verdict_of(estimator, [training], [validation]), moved)


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=20, help="of each faulty case")
    parser.add_argument("--correct", type=int, default=100, help="seeds of each correct case")
    parser.add_argument("--only", default="", help="cases whose name holds this text")
    options = parser.parse_args()
    rows = []
    for case in cases():
        if options.only in case.name or options.only == case.kind:
            count = options.correct if case.kind == "correct" else options.seeds
            outcomes = [tried(case, seed) for seed in range(count)]
            rows.append(_row(case, outcomes))
    report({"cases": rows}, options.json, show)


def _row(case: Case, outcomes: list[Outcome]) -> dict[str, Any]:
    last = outcomes[-1].verdict
    return {
        "case": case.name,
        "kind": case.kind,
        "seeds": len(outcomes),
        "passed": sum(outcome.passed(case.kind) for outcome in outcomes),
        "good": sum(outcome.verdict.trust == "good" for outcome in outcomes),
        "moved": sum(bool(outcome.moved) for outcome in outcomes),
        "says": [*last.predicted.reasons, *last.parameters.reasons],
    }


def show(figures: dict[str, Any]) -> None:
    head = f"{'case':32}{'kind':12}{'seeds':>6}{'passed':>8}{'good':>6}{'moved':>7}"
    print(f"\n{head}")
    for row in figures["cases"]:
        counts = f"{row['seeds']:6}{row['passed']:8}{row['good']:6}{row['moved']:7}"
        print(f"{row['case']:32}{row['kind']:12}{counts}  {row['says'][-1][:90]}")
    kinds = dict.fromkeys(row["kind"] for row in figures["cases"])
    for kind in kinds:
        rows = [row for row in figures["cases"] if row["kind"] == kind]
        passed, seeds = (sum(row[key] for row in rows) for key in ("passed", "seeds"))
        print(f"{kind}: {passed} of {seeds} passed")


if __name__ == "__main__":
    main()
