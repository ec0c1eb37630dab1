"""What designed experiments tell beside shipped and random ones of equal time and limits.

python -m benchmarks.design [--json] [--rigs 8] [--designs 50]
                            [--case motor|oscillator|actuator|phantoms]

``motor``: a DC motor with Coulomb friction, ``oscillator``: a mass on a Bouc-Wen spring; 2 s
designed from PRBS and multisines with free settings, as long as 20 s allow, against the best of 200
of the same drawn at random, repeated for as long.

``actuator``: the hybrid actuator with a mass wound up on its pulley; the whole plant is simulated
for torque and limits, its torque is the identification model's input. 8 runs of 1.25 s designed
from the model's nominal values, against 8 times the shipped PRBS, both judged at hidden parameters
drawn anew, a factor of 0.6 to 1.6 each.

``phantoms``: small designs for the actuator from values drawn anew, and how much of their
information lies along directions that the equations leave undetermined, in parts of the largest.

Figures are half widths of predicted 95 % intervals by the sensors' noise, the torque's included.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import null_space

from benchmarks._common import arguments, report
from daq.lookup.experiments import load_experiment
from protocols.prbs import lfsr_bits
from sim_rig.actuator import actuator
from sysid import (
    BatchSimulator,
    Dataset,
    Design,
    Excitation,
    Input,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    Setting,
    State,
    design,
    identifiability,
)
from sysid.arrays import FloatArray
from sysid.experiments import Prior
from sysid.experiments.criteria import Criterion
from sysid.experiments.information import Informant
from sysid.experiments.quantities import determined, relative_gradients

RATE = 800.0  # Hz
N = 1000  # samples of a run of the actuator
RUNS = 8
NOISE = {  # A, A, rad/s, N*m
    "current_motor": 0.005,
    "current_brake": 0.005,
    "omega": 0.1,
    "torque": 0.007,
}
LIMITS = {  # of the simulated rig, with a margin of a tenth
    "current_motor": (-2.4, 2.4),
    "current_brake": (-0.21, 0.21),
    "omega": (-150.0, 150.0),
    "torque": (-3.5, 3.5),
    "theta": (0.5 * math.pi, math.inf),  # what must stay wound up
}
MARGIN = 0.9
EFFORT = {"candidates": 400, "generations": 40, "offspring": 40}  # of a design of one input
WOUND = 10.0 * math.pi  # rad, five turns


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--rigs", type=int, default=8, help="hidden parameters drawn")
    parser.add_argument("--designs", type=int, default=50, help="of the case phantoms")
    further = ("actuator", "phantoms")
    parser.add_argument("--case", choices=(*CASES, *further), help="only this one")
    options = parser.parse_args()
    figures = {
        name: against_random(case()) for name, case in CASES.items() if options.case in (None, name)
    }
    if options.case in (None, "actuator"):
        figures["actuator"] = hybrid_actuator(options.rigs)
    if options.case in (None, "phantoms"):
        figures["phantoms"] = phantoms(options.designs)
    report(figures, options.json, show)


# Models of one input: a motor with Coulomb friction, an oscillator with hysteresis.


@dataclass(frozen=True)
class Case:
    """A model of one input with its limits and the noise of its outputs; runs of 1 s at a rate."""

    model: ProcessModel
    noise: Mapping[str, float]
    limits: Mapping[str, tuple[float, float]]
    rate: float


def motor() -> ProcessModel:
    def derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        i, omega = x
        R, L, J, B, K, dry = p
        friction = B * omega + dry * math.tanh(omega / 0.5)
        return ((u[0] - R * i - K * omega) / L, (K * i - friction) / J)

    values = {"R": 1.0, "L": 2e-3, "J": 5e-5, "B": 5e-5, "K": 0.05, "dry": 0.02}
    units = ("ohm", "H", "kg*m^2", "N*m*s/rad", "N*m/A", "N*m")
    return ProcessModel(
        name="motor with friction",
        states=(State("i", "A"), State("omega", "rad/s")),
        inputs=(Input("voltage", "V"),),
        outputs=(Output("i", "A"), Output("omega", "rad/s")),
        parameters=tuple(
            Parameter(name, unit, value, value / 2.0, value * 2.0, "log")
            for (name, value), unit in zip(values.items(), units, strict=True)
        ),
        derivative=derivative,
    )


def oscillator() -> ProcessModel:
    """Bouc-Wen's, with the values of the published benchmark (Noel and Schoukens, 2016)."""

    def derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        y, v, z = x
        mass, damping, stiffness, alpha, beta, gamma, delta = p
        force = alpha * v - beta * (gamma * abs(v) * z + delta * v * abs(z))
        return (v, (u[0] - damping * v - stiffness * y - z) / mass, force)

    values = {"mass": 2.0, "damping": 10.0, "stiffness": 5e4, "alpha": 5e4, "beta": 1e3}
    units = ("kg", "N*s/m", "N/m", "N/m", "1/m")
    positive = [
        Parameter(name, unit, value, value / 2.0, value * 2.0, "log")
        for (name, value), unit in zip(values.items(), units, strict=True)
    ]
    return ProcessModel(
        name="oscillator with hysteresis",
        states=(State("y", "m"), State("v", "m/s"), State("z", "N")),
        inputs=(Input("force", "N"),),
        outputs=(Output("y", "m"),),
        parameters=(
            *positive[:4],
            replace(positive[4], fixed=True),  # gamma and delta are known in parts of it
            Parameter("gamma", "1", 0.8, 0.4, 1.6, "log"),
            Parameter("delta", "1", -1.1, -2.2, -0.55, minimum=-10.0),
        ),
        derivative=derivative,
    )


CASES: dict[str, Callable[[], Case]] = {
    "motor": lambda: Case(
        motor(),
        {"i": 0.02, "omega": 0.5},
        {"voltage": (-5.0, 5.0), "i": (-3.0, 3.0), "omega": (-80.0, 80.0)},
        500.0,
    ),
    "oscillator": lambda: Case(
        oscillator(), {"y": 2e-5}, {"force": (-150.0, 150.0), "y": (-3e-3, 3e-3)}, 750.0
    ),
}


def against_random(case: Case, seed: int = 0) -> dict[str, Any]:
    """Half widths after 2 s designed, and after twice the best of 200 random runs of 1 s."""
    shared: dict[str, Any] = {"noise": case.noise, "limits": case.limits, "seed": seed}
    model, families = case.model, [prbs(case), multisine(case)]
    begin = time.perf_counter()
    best = design(model, families, runs=1, candidates=200, generations=0, **shared)
    between = time.perf_counter()
    designed = design(model, families, runs=2, **EFFORT, **shared)
    end = time.perf_counter()
    twice = design(
        model, families, runs=1, candidates=200, generations=0, before=best.information, **shared
    )
    return {
        "seconds": {"random": between - begin, "designed": end - between},
        "quantities": {
            q.name: {"random": once.after, "designed": q.after}
            for q, once in zip(designed.quantities, twice.quantities, strict=True)
        },
        "narrower": _ratio(
            [q.after for q in twice.quantities], [q.after for q in designed.quantities]
        ),
    }


def settings_of_case(case: Case, **further: Setting) -> dict[str, Setting]:
    """Settings of an excitation of a model's input, with those of its own."""
    (_, most), *_ = case.limits.values()
    level, seed = Setting(0.02 * most, most), Setting(1, 65535, whole=True)
    return {"amplitude": level, "offset": Setting(-0.4 * most, 0.4 * most), **further, "seed": seed}


def prbs(case: Case) -> Excitation:
    n = round(case.rate)

    def inputs(s: Mapping[str, float]) -> FloatArray:
        bits = levels(s["hold"], s["seed"], n, case.rate)
        return (s["offset"] + s["amplitude"] * bits)[:, None]

    settings = settings_of_case(case, hold=Setting(0.002, 0.5, log=True))
    return Excitation("prbs", settings, inputs, 1.0 / case.rate)


def multisine(case: Case) -> Excitation:
    n = round(case.rate)

    def inputs(s: Mapping[str, float]) -> FloatArray:
        lines = np.arange(1, 1 + round(s["highest"]))
        phases = np.random.default_rng(int(s["seed"])).uniform(0.0, 2.0 * np.pi, len(lines))
        wave = np.cos(2.0 * np.pi * lines * np.arange(n)[:, None] / n + phases).sum(axis=1)
        return (s["offset"] + s["amplitude"] * wave / np.abs(wave).max())[:, None]

    settings = settings_of_case(case, highest=Setting(1.0, 0.4 * case.rate, log=True))
    return Excitation("multisine", settings, inputs, 1.0 / case.rate)


def levels(hold: float, seed: float, n: int, rate: float) -> FloatArray:
    """A PRBS of -1 and 1, each bit held for the nearest whole number of samples."""
    samples = max(1, round(hold * rate))
    bits = lfsr_bits(int(seed), math.ceil(n / samples))
    return np.repeat(2.0 * bits - 1.0, samples)[:n]


# The hybrid actuator.


class WoundActuator:
    """The whole plant, its load wound up, for the torque and the limits of runs."""

    def __init__(self, model: ProcessModel) -> None:
        plant = actuator(load="pulley", limits=True, parameters="rig")
        values = dict(zip(plant.parameter_names, plant.nominal, strict=True))
        height = values["radius"] * (math.hypot(WOUND, 0.1) - 0.1)
        stretch = values["mass"] * 9.80665 / values["k_cable"]
        start = {"theta": WOUND, "height": height - stretch, "z": -1.0}
        self._model, self._simulator = model, BatchSimulator(plant.with_initial(start))
        self._places = [plant.parameter_names.index(name) for name in model.parameter_names]

    def records(
        self, inputs: FloatArray, dt: float, vectors: FloatArray
    ) -> Sequence[Dataset] | None:
        """As of ``Bench``; inputs: commands of motor and brake [V]."""
        plant = self._simulator.model
        values = np.tile(plant.nominal, (len(vectors), 1))
        values[:, self._places] = vectors
        blank = np.full((len(inputs), len(plant.outputs)), np.nan)
        outputs = self._simulator.trajectories(values, Dataset(inputs, blank, dt))
        signals = dict(zip(plant.output_names, np.moveaxis(outputs, 2, 0), strict=True))
        for name, (low, high) in LIMITS.items():
            ends = (low / MARGIN if low > 0.0 else low * MARGIN), high * MARGIN
            if not np.all((signals[name] >= ends[0]) & (signals[name] <= ends[1])):
                return None
        unseen = np.full((len(inputs), len(self._model.outputs)), np.nan)
        return [
            Dataset(np.column_stack([inputs, torque]), unseen, dt) for torque in signals["torque"]
        ]


def commands() -> Excitation:
    def inputs(s: Mapping[str, float]) -> FloatArray:
        motor = s["offset"] + s["amplitude"] * levels(s["hold"], s["seed"], N, RATE)
        brake = s["brake"] * 0.5 * (1.0 + levels(s["brake_hold"], s["brake_seed"], N, RATE))
        return np.column_stack([np.clip(motor, -5.0, 5.0), np.clip(brake, 0.0, 0.38)])

    settings = {
        "amplitude": Setting(0.1, 4.0),
        "offset": Setting(-0.5, 1.5),
        "hold": Setting(0.00125, 0.2, log=True),
        "seed": Setting(1, 65535, whole=True),
        "brake": Setting(0.0, 0.38),
        "brake_hold": Setting(0.00125, 0.4, log=True),
        "brake_seed": Setting(1, 65535, whole=True),
    }
    return Excitation("prbs", settings, inputs, 1.0 / RATE)


def hybrid_actuator(n_rigs: int, seed: int = 0) -> dict[str, Any]:
    model = actuator()
    bench, space = WoundActuator(model), SearchSpace.of(model)
    prior = Prior(model.nominal[list(space.index)], np.diag(np.full(len(space.index), 0.28**2)))
    begin = time.perf_counter()
    designed = design(
        model, [commands()], noise=NOISE, runs=RUNS, prior=prior, bench=bench, draws=2, seed=seed
    )
    seconds = time.perf_counter() - begin
    shipped = load_experiment("prbs.yaml").experiment.plan().commands
    rng = np.random.default_rng(seed)
    ratios, worst = [], []
    for _ in range(n_rigs):
        hidden = prior.values * rng.uniform(0.6, 1.6, len(prior.values))
        once = deviations(model, bench, space, prior, hidden, [shipped] * RUNS)
        now = deviations(model, bench, space, prior, hidden, [run.inputs for run in designed.runs])
        if once is None or now is None:
            ratios.append(math.nan)
            continue
        ratios.append(_ratio(once, now))
        worst.append(1.96 * float(now.max()))
    return {
        "seconds": seconds,
        "attempts": designed.attempts,
        "refused": designed.refused,
        "quantities": {q.name: {"before": q.before, "after": q.after} for q in designed.quantities},
        "narrower": ratios,
        "worst": worst,
        "runs": settings_of(designed),
    }


def deviations(
    model: ProcessModel,
    bench: WoundActuator,
    space: SearchSpace,
    prior: Prior,
    hidden: FloatArray,
    runs: Sequence[FloatArray],
) -> FloatArray | None:
    """Predicted relative deviations of all that can be told at a hidden rig; None: a limit."""
    noise = (
        np.array([NOISE.get(s.name, 0.0) for s in side]) for side in (model.outputs, model.inputs)
    )
    informant = Informant(BatchSimulator(model), space, *noise)
    total = np.zeros((len(hidden), len(hidden)))
    for inputs in runs:
        records = bench.records(inputs, 1.0 / RATE, space.full(hidden[None]))
        if records is None:
            return None
        total += informant.information(records[0], hidden[None])[0]
    quantities = determined(identifiability(model, sensors=False), space)
    gradients = relative_gradients(quantities, space, hidden[None])
    judged = Criterion("A", prior.information(), gradients)
    return judged.deviations(total[None, None])[0, 0]


def phantoms(n_designs: int) -> dict[str, Any]:
    """Information along what nothing tells, of small designs, in parts of the largest.

    The directions are those that leave every combination that experiments can tell as it is.
    """
    model = actuator()
    bench, space = WoundActuator(model), SearchSpace.of(model)
    quantities = determined(identifiability(model, sensors=False), space)
    nominal, gains, refused = model.nominal[list(space.index)], [], 0
    for seed in range(n_designs):
        rng = np.random.default_rng(seed)
        drawn = (nominal * rng.uniform(0.6, 1.6, len(nominal)) for _ in range(1000))
        values = next(v for v in drawn if space.feasible(v))
        prior = Prior(values, np.diag(np.full(len(nominal), 0.1**2)))
        designed = design(
            model, [commands()], noise=NOISE, runs=2, prior=prior, bench=bench, seed=seed,
            draws=2, candidates=16, generations=3, offspring=8,
        )  # fmt: skip
        null = null_space(relative_gradients(quantities, space, values[None])[0])
        along = np.diag(null.T @ designed.information @ null)
        gains.append(float(np.abs(along).max() / np.abs(designed.information).max()))
        refused += designed.phantoms
    return {"directions": null.shape[1], "largest_gains": gains, "left_out": refused}


def settings_of(designed: Design) -> list[dict[str, float]]:
    return [dict(run.settings) for run in designed.runs]


def _ratio(before: Sequence[float] | FloatArray, after: Sequence[float] | FloatArray) -> float:
    """How much narrower, geometric mean."""
    return float(np.exp(np.mean(np.log(np.asarray(before) / np.asarray(after)))))


def show(figures: dict[str, Any]) -> None:
    for case in figures.keys() & CASES.keys():
        against = figures[case]
        print(f"\n{case}, 2 s: half widths of 95 % intervals, best random and designed")
        for name, widths in against["quantities"].items():
            print(f"  {name:9} {100 * widths['random']:8.3g} %  {100 * widths['designed']:8.3g} %")
        print(f"  narrower by {against['narrower']:.2f}, {against['seconds']}")
    if "actuator" in figures:
        result = figures["actuator"]
        print(f"\nActuator, 8 x 1.25 s: {result['seconds']:.1f} s, {result['refused']} refused")
        for name, widths in result["quantities"].items():
            print(f"  {name:20} {100 * widths['before']:8.3g} %  {100 * widths['after']:8.3g} %")
        print("  narrower than 8 x PRBS by", [round(r, 2) for r in result["narrower"]])
        print("  widest [%]", [round(100 * w, 2) for w in result["worst"]])

    if "phantoms" in figures:
        result = figures["phantoms"]
        gains = result["largest_gains"]
        print(f"\nPhantoms, {len(gains)} designs, {result['directions']} directions: at most")
        print(f"  {max(gains):.1e} of the largest information; {result['left_out']} runs left out")


if __name__ == "__main__":
    main()
