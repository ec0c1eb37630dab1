"""Whether ``rig check`` tells the experiments that trip from those that do not.

python -m benchmarks.evidence [--json] [--experiments 12] [--draws 1000] [--fresh 100] [--seed 0]
                              [--kept FILE.jsonl]

Experiments are drawn: a rig as ``benchmarks.torque`` draws it, known to 1 to 5 %; controller and
sample rate, half of the controllers mistuned behind the back of ``rig tune``; protocol, largest
torque (0.05 to 0.6 N*m) and highest frequency of the reference, limits of speed and torque, 15 to
100 rad/s and 0.4 to 3.5 N*m. Each is checked on ``draws`` plausible actuators and hands, until one
fails; then it is tried on ``fresh`` others of the same uncertainty, by the same simulation, until
one fails. Let through: how many of the fresh trials trip or do not come to rest. Refused: in how
many experiments one of the fresh ones does. ``--kept``: a file of a row an experiment, from which
a run that was ended goes on.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import protocols
from benchmarks._common import arguments, report
from benchmarks.torque import drawn_plant
from benchmarks.walls import COUNT, UNCERTAIN
from daq import tune
from daq.errors import ConfigError
from daq.experiment import TripLimits
from daq.lookup.controllers import TunedController, load_controller
from daq.lookup.experiments import load_experiment
from haptics.evidence import Outcomes, Scene, family_margins, run_trials
from haptics.experiment import TorqueExperiment
from sim_rig.actuator import actuator

KINDS = ("static", "feedforward", "lqg", "feedforward", "lqg", "hinf")
PROTOCOLS = ("torque_tracking", "torque_tracking", "transparency")
TORQUES, SPEEDS, TORQUE_LIMITS = (0.05, 0.6), (15.0, 100.0), (0.4, 3.5)
UNCERTAINTY = (0.01, 0.05)
RATES = (400.0, 800.0, 800.0, 1600.0)  # Hz
HIGHEST = (10.0, 30.0)  # Hz, of the reference
MISTUNED: dict[str, tuple[dict[str, Any], ...]] = {
    "static": ({"motor_current": 4.0},),
    "feedforward": (
        {"inertia_share": 0.999},
        {"acceleration_filter": 300.0},
        {"hand_walk": 0.3},
        {"hand_walk": 0.3, "acceleration_filter": 300.0},
    ),
    "lqg": (
        {"effort": 1e-3},
        {"hand_damping": 0.15},
        {"yield_share": 1.0, "hand_rate": 5.0},
        {"torque_noise": 1e-3},
    ),
    "hinf": ({"yield_share": 1.0, "gains": []}, {"hand_damping": 0.15, "gains": []}),
}


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--experiments", type=int, default=12)
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--fresh", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kept", type=Path)
    options = parser.parse_args()
    kept: Path | None = options.kept
    lines = kept.read_text().splitlines() if kept is not None and kept.exists() else []
    rows = {row["seed"]: row for row in map(json.loads, lines)}
    seeds = range(options.seed, options.seed + options.experiments)
    for seed in seeds:
        if seed not in rows:
            rows[seed] = measure(seed, options)
            if kept is not None:
                with kept.open("a") as file:
                    file.write(f"{json.dumps(rows[seed])}\n")
    report({"experiments": [rows[seed] for seed in seeds]}, options.json, show)


def measure(seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """One drawn experiment: whether a check refuses it, and what becomes of it."""
    rng = np.random.default_rng(seed)
    kind, rate = str(rng.choice(KINDS)), float(rng.choice(RATES))
    mistuned = MISTUNED[kind][rng.integers(len(MISTUNED[kind]))] if rng.random() < 0.5 else {}
    torque, speed, most, uncertainty, highest = (
        math.exp(rng.uniform(math.log(low), math.log(high)))
        for low, high in (TORQUES, SPEEDS, TORQUE_LIMITS, UNCERTAINTY, HIGHEST)
    )
    protocol = str(rng.choice(PROTOCOLS))
    row = {
        "seed": seed, "controller": kind, "rate": rate, "mistuned": mistuned, "protocol": protocol,
        "torque": torque, "speed": speed, "torque_limit": most,
    }  # fmt: skip
    try:
        tuned = _controller(rng, {"controller": kind, "sample_rate": rate}, mistuned, uncertainty)
    except ConfigError as error:
        return {**row, "untuned": str(error)}
    limits = TripLimits(2.4, 0.21, speed, most, (-5.0, 5.0), (0.0, 0.38), COUNT)
    changes: dict[str, Any] = {"seed": seed, "duration": 2.5, "torque": torque}
    changes |= {"band": [0.1, highest]}
    scenes = _scenes(tuned, protocol, changes if protocol == "torque_tracking" else {})
    checked = _failing(tuned, scenes, limits, options.draws, 0)
    fresh = _failing(tuned, scenes, limits, options.fresh, seed + 1)
    disk = min(member.margins.disk for member in family_margins(tuned))
    return {**row, "refused": checked[1] > 0, "checked": checked, "fresh": fresh, "disk": disk}


def _failing(
    tuned: TunedController, scenes: list[Scene], limits: TripLimits, trials: int, seed: int
) -> tuple[int, int]:
    """Trials until some fail, and how many do."""

    def failed(outcomes: Outcomes) -> bool:
        return bool(outcomes.failures())

    program = tuned.control.program(tuned.model, tuned.parameters)
    outcomes = run_trials(tuned, program, scenes, limits, trials, seed, enough=failed)
    return len(outcomes.results), sum(outcomes.failures().values())


def _controller(
    rng: np.random.Generator, settings: dict[str, Any], mistuned: dict[str, Any], uncertainty: float
) -> TunedController:
    """A controller tuned to a drawn rig, then with settings that nobody tuned."""
    model = actuator(parameters="rig")
    values = dict(zip(model.parameter_names, model.nominal.tolist(), strict=True))
    drawn = drawn_plant(rng, False)["parameters"]
    values |= {name: value for name, value in drawn.items() if name in values}
    factor = np.diag([uncertainty * values[name] for name in UNCERTAIN]).tolist()
    covariance = {"parameters": list(UNCERTAIN), "factor": factor}
    content = {"model": "actuator", "parameters": values, "covariance": covariance}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "parameters.yaml").write_text(yaml.safe_dump(content))
        (folder / "settings.yaml").write_text(yaml.safe_dump(settings))
        path = folder / "controller.yaml"
        tune(folder / "settings.yaml", folder / "parameters.yaml", draws=40).save(path)
        made = yaml.safe_load(path.read_text())
        made["settings"] |= mistuned
        path.write_text(yaml.safe_dump(made))
        return load_controller(str(path), folder)


def _scenes(tuned: TunedController, protocol: str, changes: dict[str, Any]) -> list[Scene]:
    """What trials of a shipped experiment with this controller ask."""
    content = yaml.safe_load((Path(protocols.__file__).parent / f"{protocol}.yaml").read_text())
    content |= {"torque_controller": str(tuned.path), "sample_rate": tuned.control.sample_rate}
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "experiment.yaml"
        file.write_text(yaml.safe_dump(content | changes))
        experiment = load_experiment(str(file)).experiment
    if not isinstance(experiment, TorqueExperiment):
        raise TypeError(f"{protocol} is no experiment with a torque controller")
    return experiment.scenes()


def show(figures: dict[str, Any]) -> None:
    rows = [row for row in figures["experiments"] if "refused" in row]
    print("failed of trials until then: checked, fresh; least disk margin")
    for row in rows:
        (checked, failed), (fresh, fresh_failed) = row["checked"], row["fresh"]
        print(
            f"{row['seed']:>6} {row['controller']:>12} {row['rate']:>5.0f} Hz {row['torque']:>6.3f}"
            f" N*m {row['speed']:>6.1f} rad/s {row['torque_limit']:>5.2f} N*m {failed:>3}/{checked}"
            f" {fresh_failed:>3}/{fresh} {row['disk']:>5.2f} {row['protocol']}"
            f" {row['mistuned'] or ''}"
        )
    print(f"{len(figures['experiments']) - len(rows)} cannot be tuned")
    through = [row for row in rows if not row["refused"]]
    trials, failures = (sum(row["fresh"][k] for row in through) for k in (0, 1))
    bad = sum(row["fresh"][1] > 0 for row in through)
    print(f"{len(through)} let through: {bad} with failures, {failures} of {trials} fresh trials")
    refused = [row for row in rows if row["refused"]]
    true = sum(row["fresh"][1] > 0 for row in refused)
    print(f"{len(refused)} refused: {true} fail on a fresh rig")


if __name__ == "__main__":
    main()
