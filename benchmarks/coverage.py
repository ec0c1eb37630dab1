"""Do the intervals cover the truth, and does a noise-free record give the true parameters?

python -m benchmarks.coverage [--json] [--seeds 200] [--minutes M] [--exact 20]
                              [--experiment prbs.yaml ...]

Noise: shipped experiments on the simulated rig, a new seed of noise, offsets and search each time,
identified from the shipped ranges; every quantity that gets an interval is asked whether it holds
the truth. Strong quantities have an interval by the curvature, weak ones one by the profile
likelihood, perhaps with one end. The bars: of each strong one 93 to 97 % hold and the mean error
is below 0.3 standard deviations, of each weak one 90 to 99 %. Noise-free: the model's own outputs,
identified with another seed of the search each time; every determined quantity is compared with
the truth.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, rig_of, simulated_logs, timed
from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset
from sysid.arrays import FloatArray
from sysid.gassi import GASSI
from sysid.problem.model import ProcessModel
from sysid.uncertainty import Estimate
from sysid.uncertainty.estimate import Z95

_HYSTERESIS_START = -1.1  # where the wound load leaves z
_EXPERIMENTS = ("prbs.yaml", "constant_velocity.yaml", "hysteresis_loop.yaml")


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=200, help="of noise")
    parser.add_argument(
        "--minutes", type=float, default=np.inf, help="of processor time, for each experiment"
    )
    parser.add_argument("--exact", type=int, default=20, help="seeds of the search without noise")
    parser.add_argument("--experiment", nargs="+", default=_EXPERIMENTS, help="shipped ones")
    options = parser.parse_args()
    figures = {
        "coverage": {
            name: coverage(options.seeds, name, options.minutes) for name in options.experiment
        },
        "noise_free": noise_free(actuator(), options.exact) if options.exact else None,
    }
    report(figures, options.json, show)


@dataclass
class _Tally:
    """What became of one quantity's intervals: how often they held, and errors of strong ones."""

    strong: list[bool] = field(default_factory=list)
    weak: list[bool] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)

    def add(self, estimate: Estimate, truth: float) -> bool:
        """Count an interval; whether it holds."""
        held = bool(estimate.low is None or estimate.low <= truth)
        held = held and bool(estimate.high is None or truth <= estimate.high)
        (self.weak if estimate.std is None else self.strong).append(held)
        if estimate.std is not None:
            self.errors.append(_in_deviations(estimate, truth))
        return held

    def figures(self) -> dict[str, Any]:
        """Shares that held, and the mean error in standard deviations."""
        return {
            "strong": len(self.strong),
            "strong_coverage": _mean(self.strong),
            "bias_in_deviations": _mean(self.errors),
            "weak": len(self.weak),
            "weak_coverage": _mean(self.weak),
        }


def coverage(seeds: int, experiment: str, minutes: float = np.inf) -> dict[str, Any]:
    """Share of the 95 % intervals that hold the truth, for each quantity and together.

    minutes: of processor time, after which no further seed is begun.
    """
    begun = time.process_time()
    plant = rig_of(experiment)[1].options.plant
    load = "measured" if plant.sensor == "load" else plant.load
    model, truth = actuator(load=load, sensor=plant.sensor), _truth(plant.process_model())
    tallies: dict[str, _Tally] = defaultdict(_Tally)
    seconds, together, nominal, answers = [], [], [], []
    missed: dict[int, list[str]] = {}
    for seed in range(seeds):
        if time.process_time() - begun > 60.0 * minutes:
            break
        training, _ = simulated_logs(model, seed, experiment)

        start = time.process_time()
        intervals = GASSI(model, random_state=seed).fit(training).uncertainty(training)
        seconds.append(time.process_time() - start)
        answers.append(1 + len(intervals.rivals))
        held = {
            estimate.name: tallies[estimate.name].add(estimate, estimate.at(truth))
            for estimate in intervals.determined()
            if "(0)" not in estimate.name
        }
        together.append(all(held.values()))
        print(f"{experiment} seed {seed}: {sum(held.values())} of {len(held)}", file=sys.stderr)
        missed[seed] = [name for name, holds in held.items() if not holds]
        nominal.append(intervals.joint)
    return {
        "seeds": len(seconds),
        "missed": {seed: names for seed, names in missed.items() if names},
        "strong_coverage": _mean([held for t in tallies.values() for held in t.strong]),
        "weak_coverage": _mean([held for t in tallies.values() for held in t.weak]),
        "joint_coverage": _mean(together),
        "joint_coverage_stated": _mean(nominal),
        "several_answers": _mean([count > 1 for count in answers]),
        "processor_seconds_each": float(np.median(seconds)),
        "quantities": {name: tally.figures() for name, tally in tallies.items()},
    }


def _mean(values: list[Any]) -> float | None:
    return float(np.mean(values)) if values else None


def noise_free(model: ProcessModel, seeds: int) -> dict[str, Any]:
    """Worst relative error of the determined quantities, for each seed of the search."""
    record = _exact_record(model)
    truth = {**_truth(actuator(parameters="rig")), "z(0)": _HYSTERESIS_START}
    worst, errors, seconds = [], [], []
    for seed in range(seeds):
        duration, estimator = timed(lambda s=seed: GASSI(model, random_state=s).fit(record))
        seconds.append(duration)
        errors.append(estimator.error_)
        determined = estimator.uncertainty(record).determined()
        strong = [e for e in determined if e.std is not None]
        worst.append(max(abs(e.value / e.at(truth) - 1.0) for e in strong))
    return {
        "seeds": seeds,
        "within_0.1_percent": int(np.sum(np.array(worst) < 1e-3)),
        "worst_relative_errors": worst,
        "errors": errors,
        "seconds_each": float(np.median(seconds)),
    }


def _truth(model: ProcessModel) -> dict[str, float]:
    return dict(zip(model.parameter_names, model.nominal.tolist(), strict=True))


def _in_deviations(estimate: Estimate, truth: float) -> float:
    """Error of an estimate in standard deviations, on the scale of its interval."""
    assert estimate.low is not None and estimate.high is not None
    if estimate.low * estimate.high > 0.0:
        width = np.log(estimate.high / estimate.low) / (2.0 * Z95)
        return float(np.log(estimate.value / truth) / width)
    assert estimate.std is not None
    return (estimate.value - truth) / estimate.std


def _exact_record(model: ProcessModel) -> Dataset:
    """The true model's outputs for the inputs of the shipped experiment."""
    inputs = simulated_logs(model)[0].inputs
    start = model.initial_state
    start[model.state_names.index("z")] = _HYSTERESIS_START
    blank = Dataset(inputs, np.full((len(inputs), len(model.outputs)), np.nan), 1.0 / 800.0)
    vector: FloatArray = actuator(parameters="rig").nominal
    simulator = BatchSimulator(model, accuracy=1e-8)
    outputs = simulator.trajectories(vector, blank, starts=start[None])[0]
    return Dataset(inputs, outputs, blank.dt)


def show(figures: dict[str, Any]) -> None:
    for experiment, noisy in figures["coverage"].items():
        strong, weak, together, stated, several = (
            _percent(noisy[key])
            for key in (
                "strong_coverage", "weak_coverage", "joint_coverage", "joint_coverage_stated",
                "several_answers",
            )
        )  # fmt: skip
        print(
            f"\n{experiment}, {noisy['seeds']} seeds of noise, "
            f"{noisy['processor_seconds_each']:.1f} s of processor time each: "
            f"{strong} of the strong and {weak} of the weak intervals hold the truth, all at "
            f"once {together} (stated: {stated}); several answers in {several}"
        )
        for seed, names in noisy["missed"].items():
            print(f"  seed {seed} misses {', '.join(names)}")
        for name, row in noisy["quantities"].items():
            bias = "" if row["strong"] == 0 else f", off by {row['bias_in_deviations']:+.2f}"
            print(
                f"  {name:<24} strong {row['strong']:4d} {_percent(row['strong_coverage'])}{bias}; "
                f"weak {row['weak']:4d} {_percent(row['weak_coverage'])}"
            )
    exact = figures["noise_free"]
    if exact is None:
        return
    print(
        f"\nNoise-free: every determined quantity within 0.1 % for {exact['within_0.1_percent']} "
        f"of {exact['seeds']} seeds, {exact['seconds_each']:.2f} s each"
    )


def _percent(share: float | None) -> str:
    return "   -" if share is None else f"{100.0 * share:.1f} %"


if __name__ == "__main__":
    main()
