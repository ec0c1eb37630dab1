"""Whether ``rig check`` tells the experiments that trip from those that do not.

python -m benchmarks.evidence [--json] [--experiments 12] [--draws 300] [--fresh 100] [--seed 0]

Experiments are drawn: the controller, the largest torque (0.05 to 0.6 N*m) of a reference from
0.1 to 10 Hz, and the limits of speed and torque, 10 to 100 rad/s and 0.3 to 3.5 N*m. Each is
checked on ``draws`` plausible actuators and hands; then it is tried on ``fresh`` others of the same
uncertainty (3 % of the parameters), by the same simulation. Let through: how many of the fresh
trials trip or do not come to rest. Refused: in how many experiments any of the fresh ones does, and
the median part of them.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import protocols
from benchmarks._common import arguments, report
from benchmarks.walls import COUNT, controller
from daq.experiment import TripLimits
from daq.lookup.controllers import TunedController
from daq.lookup.experiments import load_experiment
from haptics.evidence import run_trials
from haptics.experiment import TorqueExperiment

KINDS = ("static", "feedforward", "lqg")
TORQUES, SPEEDS, TORQUE_LIMITS = (0.05, 0.6), (10.0, 100.0), (0.3, 3.5)
RATE = 800.0  # Hz


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--experiments", type=int, default=12)
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--fresh", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    controllers = [controller(RATE, {"controller": kind}) for kind in KINDS]
    rows = [
        measure(controllers[k % len(KINDS)], options.draws, options.fresh, rng)
        for k in range(options.experiments)
    ]
    report({"experiments": rows}, options.json, show)


def measure(
    tuned: TunedController, draws: int, fresh: int, rng: np.random.Generator
) -> dict[str, Any]:
    """One drawn experiment: whether a check refuses it, and what becomes of it."""
    torque, speed, most = (
        math.exp(rng.uniform(math.log(low), math.log(high)))
        for low, high in (TORQUES, SPEEDS, TORQUE_LIMITS)
    )
    limits = TripLimits(2.4, 0.21, speed, most, (-5.0, 5.0), (0.0, 0.38), COUNT)
    scenes = _tracking(tuned, torque, int(rng.integers(1, 1000))).scenes()
    program = tuned.control.program(tuned.model, tuned.parameters)
    checked, tried = (
        run_trials(tuned, program, scenes, limits, n, seed)
        for n, seed in ((draws, 0), (fresh, int(rng.integers(1, 1000))))
    )
    failed = [int(each.tripped.sum() + each.restless.sum()) for each in (checked, tried)]
    return {
        "controller": tuned.control.controller,
        "torque": torque,
        "speed": speed,
        "torque_limit": most,
        "refused": failed[0] > 0,
        "part": failed[0] / draws,
        "fresh": fresh,
        "fresh_failed": failed[1],
    }


def _tracking(tuned: TunedController, torque: float, seed: int) -> TorqueExperiment:
    """``torque_tracking`` of a controller."""
    content = yaml.safe_load((Path(protocols.__file__).parent / "torque_tracking.yaml").read_text())
    content |= {"torque_controller": str(tuned.path), "torque": torque, "seed": seed}
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "experiment.yaml"
        file.write_text(yaml.safe_dump(content))
        experiment = load_experiment(str(file)).experiment
    if not isinstance(experiment, TorqueExperiment):
        raise TypeError("torque_tracking is no experiment with a torque controller")
    return experiment


def show(figures: dict[str, Any]) -> None:
    rows = figures["experiments"]
    print(f"{'controller':>12} {'torque':>7} {'speed':>6} {'limit':>6} {'failed':>7} fresh failed")
    for row in rows:
        print(
            f"{row['controller']:>12} {row['torque']:>7.3f} {row['speed']:>6.1f} "
            f"{row['torque_limit']:>6.2f} {row['part']:>7.3f} {row['fresh_failed']}"
        )
    through = [row for row in rows if not row["refused"]]
    refused = [row for row in rows if row["refused"]]
    trials, failed = (sum(row[key] for row in through) for key in ("fresh", "fresh_failed"))
    print(f"{len(through)} let through: {failed} of {trials} fresh trials fail")
    if refused:
        true = sum(row["fresh_failed"] > 0 for row in refused)
        part = float(np.median([row["fresh_failed"] / row["fresh"] for row in refused]))
        print(
            f"{len(refused)} refused: {true} fail on a fresh rig, {part:.2f} of them in the median"
        )


if __name__ == "__main__":
    main()
