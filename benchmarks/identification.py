"""The main job timed: 40 generations of 300 chromosomes, and how good the result is.

python -m benchmarks.identification [--json] [--seeds 10]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, simulated_logs, timed
from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset, evaluate, free_run
from sysid.gassi import GASSI, PresetName
from sysid.gassi.estimator import Criterion
from sysid.problem.model import ProcessModel
from sysid.problem.space import SearchSpace
from tests.sysid.reference import simulate

GENERATIONS, POPULATION = 40, 300
THESIS_RMSE = {"current_motor": 0.0112, "current_brake": 0.136, "omega": 0.151}
PEER_SAMPLES = 50  # SciPy is timed on the record's start; its time per sample is constant


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=10, help="seeds for the DC motor")
    options = parser.parse_args()
    model = actuator()
    training, validation = simulated_logs(model)
    figures = {
        "identification": identification(model, training, validation),
        "simulation": simulation(model, training),
        "dc_motor": dc_motor(options.seeds),
    }
    report(figures, options.json, show)


def identification(model: ProcessModel, training: Dataset, validation: Dataset) -> dict[str, Any]:
    """Search, refinement and validation of the shipped experiment, kernels warm."""

    def fit(preset: PresetName, criterion: Criterion = "likelihood") -> GASSI:
        return GASSI(
            model, preset=preset, population=POPULATION, generations=GENERATIONS,
            criterion=criterion,
        ).fit(training)  # fmt: skip

    GASSI(model, population=16, generations=1).fit(training)
    search, search_cpu, _ = timed_twice(lambda: fit("thesis"))
    without, without_cpu, _ = timed_twice(lambda: fit("default", "error"))
    whole, whole_cpu, estimator = timed_twice(lambda: fit("default"))
    truth = actuator(parameters="rig").nominal
    simulator = BatchSimulator(model)
    floor = evaluate(validation.outputs, free_run(simulator, truth, validation))
    found = evaluate(validation.outputs, estimator.predict(validation))
    return {
        "generations": GENERATIONS,
        "population": POPULATION,
        "samples": training.n_samples,
        "free_parameters": len(estimator.space_.index),
        "thesis_preset_seconds": search,
        "thesis_preset_cpu_seconds": search_cpu,
        "search_and_refinement_seconds": without,
        "search_and_refinement_cpu_seconds": without_cpu,
        "default_preset_seconds": whole,
        "default_preset_cpu_seconds": whole_cpu,
        "validation": {
            name: {
                "rmse": found.rmse[j],
                "noise_floor": floor.rmse[j],
                "ratio": found.rmse[j] / floor.rmse[j],
                "thesis": THESIS_RMSE[name],
            }
            for j, name in enumerate(model.output_names)
        },
    }


def timed_twice(function: Callable[[], GASSI]) -> tuple[float, float, GASSI]:
    """Least seconds of two calls, by the clock and of the processors, and what a call returns.

    The latter hardly depend on what else the machine does.
    """
    spent = []
    for _ in range(2):
        before = time.process_time()
        seconds, result = timed(function)
        spent.append((seconds, time.process_time() - before))
    by_clock, of_cpu = (min(column) for column in zip(*spent, strict=True))
    return by_clock, of_cpu, result


def simulation(model: ProcessModel, record: Dataset) -> dict[str, Any]:
    """Time of one simulation in a population over the search box, beside SciPy's."""
    rng = np.random.default_rng(0)
    space = SearchSpace.of(model)
    low, high = space.encode(np.stack([space.lower, space.upper]))
    drawn = space.full(space.decode(rng.uniform(low, high, (POPULATION, len(low)))))
    simulator = BatchSimulator(model)
    simulator.errors(drawn[:16], [record])
    ours, result = timed(lambda: simulator.errors(drawn, [record]))
    short = Dataset(record.inputs[:PEER_SAMPLES], record.outputs[:PEER_SAMPLES], record.dt)
    middle = space.full(space.decode((low + high) / 2.0)[None])[0]
    scale = record.n_samples / PEER_SAMPLES
    peers = {}
    for method, rtol in (("LSODA", 1e-4), ("RK45", 1e-4), ("Radau", 1e-4)):
        seconds, _ = timed(
            lambda m=method, r=rtol: simulate(model, middle, short, method=m, rtol=r, atol=1e-8)
        )
        peers[f"solve_ivp {method}"] = seconds * scale * 1e3
    each = ours / POPULATION * 1e3
    return {
        "box_mean_steps_per_sample": float(np.mean(result.steps) / (record.n_samples - 1)),
        "milliseconds_each": each,
        "peers_milliseconds": peers,
        "ratio": {name: value / each for name, value in peers.items()},
        "flagged": int(np.sum(result.status != 0)),
    }


def dc_motor(seeds: int) -> dict[str, Any]:
    """Section 4.1.4: preset thesis within ten per cent, and default a decade either side."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))
    import dc_motor as example
    import dc_motor_data

    model, record = example.model, dc_motor_data.training()
    close = {p.name: (0.9 * p.nominal, 1.1 * p.nominal) for p in model.parameters}
    cases = {"thesis, +-10 %": ("thesis", close), "default, a decade either side": ("default", {})}
    figures = {}
    for label, (preset, ranges) in cases.items():

        def fit(seed: int, preset: str = preset, ranges: dict[str, Any] = ranges) -> GASSI:
            return GASSI(
                model, preset=preset, population=400, generations=50, elite_percent=1.0,
                ranges=ranges, random_state=seed,
            ).fit(record)  # fmt: skip

        runs = [timed(lambda s=seed: fit(s)) for seed in range(seeds)]
        errors = np.array([estimator.error_ for _, estimator in runs])
        figures[label] = {
            "median_error": float(np.median(errors)),
            "worst_error": float(errors.max()),
            "below_2.67e-5": int(np.sum(errors < 2.67e-5)),
            "seeds": seeds,
            "median_seconds": float(np.median([seconds for seconds, _ in runs])),
        }
    return figures


def show(figures: dict[str, Any]) -> None:
    job = figures["identification"]
    print(
        f"\n{job['generations']} x {job['population']} on {job['samples']} samples, "
        f"{job['free_parameters']} parameters free, warm:"
    )
    for label, key in (
        ("thesis preset (search alone)", "thesis_preset"),
        ("default, criterion error", "search_and_refinement"),
        ("default, likelihood and rivals", "default_preset"),
    ):
        seconds, cpu = job[f"{key}_seconds"], job[f"{key}_cpu_seconds"]
        print(f"  {label:<33} {seconds:5.2f} s, {cpu:5.2f} s of the processors")
    print("\nValidation RMSE        ours   noise floor  ratio   thesis")
    for name, row in job["validation"].items():
        print(
            f"  {name:<16} {row['rmse']:9.4f} {row['noise_floor']:11.4f} {row['ratio']:8.2f} "
            f"{row['thesis']:8.4f}"
        )
    one = figures["simulation"]
    print(
        f"\nOne simulation over the search box: {one['milliseconds_each']:.3f} ms "
        f"({one['box_mean_steps_per_sample']:.0f} steps a sample on average)"
    )
    for name, value in one["peers_milliseconds"].items():
        print(f"  {name:<18} {value:9.0f} ms, {one['ratio'][name]:9.0f} times ours")
    print("\nDC motor of section 4.1.4, 400 x 50, mean-per-sample error")
    for label, row in figures["dc_motor"].items():
        print(
            f"  {label:<30} median {row['median_error']:.2e}, worst {row['worst_error']:.2e}, "
            f"{row['below_2.67e-5']}/{row['seeds']} below 2.67e-5, {row['median_seconds']:.2f} s"
        )


if __name__ == "__main__":
    main()
