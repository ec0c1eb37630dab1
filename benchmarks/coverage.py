"""Do the intervals cover the truth, and does a noise-free record give the true parameters?

python -m benchmarks.coverage [--json] [--seeds 100] [--exact 20]

Noise: the shipped experiment on the simulated rig, a new seed of noise, offsets and search each
time, identified from the shipped ranges; every quantity that gets an interval is asked whether it
holds the truth. Noise-free: the model's own outputs, identified with another seed of the search
each time; every determined quantity is compared with the truth.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, simulated_logs, timed
from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset
from sysid.arrays import FloatArray
from sysid.gassi import GASSI
from sysid.problem.model import ProcessModel
from sysid.uncertainty import Estimate

_HYSTERESIS_START = -1.1  # where the wound load leaves z


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=100, help="of noise")
    parser.add_argument("--exact", type=int, default=20, help="seeds of the search without noise")
    options = parser.parse_args()
    model = actuator()
    figures = {
        "coverage": coverage(model, options.seeds),
        "noise_free": noise_free(model, options.exact),
    }
    report(figures, options.json, show)


def coverage(model: ProcessModel, seeds: int) -> dict[str, Any]:
    """Share of the 95 % intervals that hold the truth, for each quantity and together."""
    truth = _truth(model)
    inside: dict[str, list[bool]] = defaultdict(list)
    deviations: dict[str, list[float]] = defaultdict(list)
    seconds = []
    for seed in range(seeds):
        training, _ = simulated_logs(model, seed)

        def identify(record: Dataset = training, seed: int = seed) -> list[Estimate]:
            estimator = GASSI(model, random_state=seed).fit(record)
            return list(estimator.uncertainty(record).determined())

        duration, estimates = timed(identify)
        seconds.append(duration)
        for estimate in estimates:
            if all(name in truth for name, _ in estimate.terms):
                value = estimate.at(truth)
                assert estimate.low is not None and estimate.high is not None
                inside[estimate.name].append(bool(estimate.low <= value <= estimate.high))
                deviations[estimate.name].append(_in_deviations(estimate, value))
    everything = [held for each in inside.values() for held in each]
    return {
        "seeds": seeds,
        "coverage": float(np.mean(everything)),
        "intervals": len(everything),
        "seconds_each": float(np.median(seconds)),
        "quantities": {
            name: {
                "intervals": len(held),
                "coverage": float(np.mean(held)),
                "worst_deviation": float(np.max(np.abs(deviations[name]))),
            }
            for name, held in inside.items()
        },
    }


def noise_free(model: ProcessModel, seeds: int) -> dict[str, Any]:
    """Worst relative error of the determined quantities, for each seed of the search."""
    record = _exact_record(model)
    truth = {**_truth(model), "z(0)": _HYSTERESIS_START}
    worst, errors, seconds = [], [], []
    for seed in range(seeds):
        duration, estimator = timed(lambda s=seed: GASSI(model, random_state=s).fit(record))
        seconds.append(duration)
        errors.append(estimator.error_)
        found = estimator.uncertainty(record).determined()
        worst.append(max(abs(e.value / e.at(truth) - 1.0) for e in found))
    return {
        "seeds": seeds,
        "within_0.1_percent": int(np.sum(np.array(worst) < 1e-3)),
        "worst_relative_errors": worst,
        "errors": errors,
        "seconds_each": float(np.median(seconds)),
    }


def _truth(model: ProcessModel) -> dict[str, float]:
    return dict(
        zip(model.parameter_names, actuator(parameters="rig").nominal.tolist(), strict=True)
    )


def _in_deviations(estimate: Estimate, truth: float) -> float:
    assert estimate.std is not None
    if estimate.form == "product" and estimate.value / truth > 0.0:
        return float(np.log(estimate.value / truth) / (estimate.std / abs(estimate.value)))
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
    noisy = figures["coverage"]
    print(
        f"\n{noisy['seeds']} seeds of noise: {100.0 * noisy['coverage']:.1f} % of "
        f"{noisy['intervals']} intervals hold the truth, {noisy['seconds_each']:.2f} s each"
    )
    for name, row in noisy["quantities"].items():
        print(
            f"  {name:<24} {row['intervals']:4d} intervals, {100.0 * row['coverage']:5.1f} %, "
            f"worst {row['worst_deviation']:.1f} standard deviations off"
        )
    exact = figures["noise_free"]
    print(
        f"\nNoise-free: every determined quantity within 0.1 % for {exact['within_0.1_percent']} "
        f"of {exact['seeds']} seeds, {exact['seconds_each']:.2f} s each"
    )


if __name__ == "__main__":
    main()
