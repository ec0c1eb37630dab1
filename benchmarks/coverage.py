"""Do the intervals cover the truth, and does a noise-free record give the true parameters?

python -m benchmarks.coverage [--json] [--seeds 200] [--exact 20] [--experiment prbs.yaml ...]
                              [--verdicts] [--jobs N] [--dask ADDRESS]

Noise: shipped experiments on the simulated rig, a new seed of noise, offsets and search each time,
identified from the shipped ranges; every quantity that gets an interval is asked whether it holds
the truth. Strong quantities have an interval by the curvature, weak ones one by the profile
likelihood, perhaps with one end. The bars: of each strong one 93 to 97 % hold and the mean error
is below 0.3 standard deviations, of each weak one 90 to 99 %. --verdicts: and how many are called
good, as of a right model 95 % should be, and why the others are not. Noise-free: the model's own
outputs, identified with another seed of the search each time; every determined quantity is compared
with the truth. Ctrl-C ends an experiment with the seeds that are done.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, rig_of, simulated_logs, spread, spreading, timed
from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset
from sysid.arrays import FloatArray
from sysid.gassi import GASSI
from sysid.judging.examination import verdict_of
from sysid.problem.model import ProcessModel
from sysid.uncertainty import Estimate
from sysid.uncertainty.estimate import Z95

_HYSTERESIS_START = -1.1  # where the wound load leaves z
_EXPERIMENTS = ("prbs.yaml", "constant_velocity.yaml", "hysteresis_loop.yaml")


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=200, help="of noise")
    parser.add_argument("--exact", type=int, default=20, help="seeds of the search without noise")
    parser.add_argument("--experiment", nargs="+", default=_EXPERIMENTS, help="shipped ones")
    parser.add_argument("--verdicts", action="store_true", help="how many are called good, too")
    spreading(parser)
    options = parser.parse_args()
    figures = {
        "coverage": {name: coverage(name, options) for name in options.experiment},
        "noise_free": noise_free(actuator(), options.exact) if options.exact else None,
    }
    report(figures, options.json, show)


@dataclass(frozen=True)
class _Held:
    """Whether an interval holds the truth; error: in standard deviations, None of a weak one."""

    name: str
    holds: bool
    error: float | None


@dataclass(frozen=True)
class _Seed:
    """What became of one seed's intervals. joint: the share that is stated to hold at once.

    doubts: why not all is called good; None where that was not asked.
    """

    seed: int
    seconds: float
    answers: int
    joint: float | None
    intervals: tuple[_Held, ...]
    doubts: tuple[str, ...] | None = None

    @property
    def missed(self) -> list[str]:
        """Quantities whose intervals do not hold the truth."""
        return [interval.name for interval in self.intervals if not interval.holds]


def coverage(experiment: str, options: argparse.Namespace) -> dict[str, Any]:
    """Share of the 95 % intervals that hold the truth, for each quantity and together."""
    seeds: list[_Seed] = spread(
        functools.partial(
            _intervals,
            experiment,
            threads=1 if options.jobs != 1 else None,
            verdicts=options.verdicts,
        ),
        range(options.seeds),
        options,
        lambda seed: f"{len(seed.intervals)} intervals, missed: {', '.join(seed.missed) or 'none'}",
    )
    quantities: dict[str, list[_Held]] = defaultdict(list)
    for interval in (interval for seed in seeds for interval in seed.intervals):
        quantities[interval.name].append(interval)
    every = [interval for intervals in quantities.values() for interval in intervals]
    return {
        "seeds": len(seeds),
        "missed": {seed.seed: seed.missed for seed in seeds if seed.missed},
        **{key: value for key, value in _figures(every).items() if key.endswith("_coverage")},
        "joint_coverage": _mean([not seed.missed for seed in seeds]),
        "joint_coverage_stated": _mean([s.joint for s in seeds if s.joint is not None]),
        "several_answers": _mean([seed.answers > 1 for seed in seeds]),
        "good": _mean([not seed.doubts for seed in seeds if seed.doubts is not None]),
        "doubts": {seed.seed: seed.doubts for seed in seeds if seed.doubts},
        "processor_seconds_each": _mean([seed.seconds for seed in seeds]),
        "quantities": {name: _figures(intervals) for name, intervals in quantities.items()},
    }


def _intervals(experiment: str, seed: int, *, threads: int | None, verdicts: bool) -> _Seed:
    """The intervals from one run of a shipped experiment, beside the truth."""
    plant = rig_of(experiment)[1].options.plant
    load = "measured" if plant.sensor == "load" else plant.load
    model, truth = actuator(load=load, sensor=plant.sensor), _truth(plant.process_model())
    training, validation = simulated_logs(model, seed, experiment)
    begin = time.process_time()
    fitted = GASSI(model, random_state=seed, threads=threads).fit(training)
    uncertainty = fitted.uncertainty(training)
    seconds = time.process_time() - begin
    estimates = [e for e in uncertainty.determined() if "(0)" not in e.name]
    held = tuple(_held(estimate, estimate.at(truth)) for estimate in estimates)
    doubts = None
    if verdicts:
        others = [] if validation is training else [validation]
        verdict = verdict_of(fitted, [training], others, uncertainty)
        doubts = () if verdict.trust == "good" else verdict.reasons
    return _Seed(seed, seconds, 1 + len(uncertainty.rivals), uncertainty.joint, held, doubts)


def _held(estimate: Estimate, truth: float) -> _Held:
    holds = estimate.low is None or estimate.low <= truth
    holds = holds and (estimate.high is None or truth <= estimate.high)
    error = None if estimate.std is None else _in_deviations(estimate, truth)
    return _Held(estimate.name, bool(holds), error)


def _figures(intervals: list[_Held]) -> dict[str, Any]:
    """Shares that held, and the mean error in standard deviations."""
    strong = [interval for interval in intervals if interval.error is not None]
    weak = [interval for interval in intervals if interval.error is None]
    return {
        "strong": len(strong),
        "strong_coverage": _mean([interval.holds for interval in strong]),
        "bias_in_deviations": _mean([interval.error for interval in strong]),
        "weak": len(weak),
        "weak_coverage": _mean([interval.holds for interval in weak]),
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
        between = [e for e in determined if e.low is not None and e.high is not None]
        worst.append(max(abs(e.value / e.at(truth) - 1.0) for e in between))
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
        if noisy["good"] is not None:
            print(f"  {_percent(noisy['good'])} are called good")
        for seed, reasons in noisy["doubts"].items():
            print(f"  seed {seed}: {' '.join(reasons)}")
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
