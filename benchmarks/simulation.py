"""Simulation of the actuator: ours beside what else a lab could use, and how its cost grows.

python -m benchmarks.simulation [--json] [--chromosomes 1000] [--figure FILE]
python -m benchmarks.simulation --memory

Seven states, 1000 samples at 800 Hz, held commands. Peers that are not installed
(`pip install -e ".[bench]"`), or a missing C compiler, are left out and named. Times are per
simulation on one core; errors are normalised RMS of the worst output against a tight solution.
``--memory`` runs nothing but a large
population on a long record, which takes minutes, and says how much memory that took.
"""

from __future__ import annotations

import resource
import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, timed
from benchmarks._peers import engines, fixed_steps
from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset
from sysid.arrays import FloatArray
from sysid.problem.model import ProcessModel
from sysid.problem.space import SearchSpace

SAMPLES, RATE = 1000, 800.0
TIGHT_STEPS = 256  # of the exponential scheme: within 1e-8 of DOP853 at 1e-10
LARGE = (100_000, 60_000)  # chromosomes, samples


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--chromosomes", type=int, default=1000, help="drawn from the box")
    parser.add_argument("--figure", metavar="FILE", help="draw cost against problem size")
    parser.add_argument("--memory", action="store_true", help="only a large population's memory")
    options = parser.parse_args()
    model = actuator()
    if options.memory:
        report(memory(model), options.json, show_memory)
        return
    record = excitation(model)
    table, missing = engines(model, record)
    figures = {
        "engines": table,
        "missing": missing,
        "box": box(model, record, options.chromosomes),
        "scaling": scaling(model),
    }
    report(figures, options.json, show)
    if options.figure:
        draw(figures["scaling"], options.figure)


def excitation(model: ProcessModel, samples: int = SAMPLES) -> Dataset:
    """PRBS-like held commands and a constant load."""
    rng = np.random.default_rng(4)
    motor = np.repeat(rng.choice([-0.65, 0.85], samples // 4 + 1), 4)[:samples]
    brake = np.repeat(rng.choice([0.0, 0.14], samples // 40 + 1), 40)[:samples]
    inputs = np.stack([motor, brake, np.full(samples, -0.012)], axis=1)
    blank = Dataset(inputs, np.zeros((samples, 3)), 1.0 / RATE)
    outputs = BatchSimulator(model).trajectories(model.nominal, blank, TIGHT_STEPS)[0]
    return Dataset(inputs, outputs, 1.0 / RATE)


def draws(space: SearchSpace, n: int) -> FloatArray:
    """Parameter vectors drawn from the shipped ranges."""
    low, high = space.encode(np.stack([space.lower, space.upper]))
    drawn = np.random.default_rng(11).uniform(low, high, (n, len(low)))
    return space.full(space.decode(drawn))


def box(model: ProcessModel, record: Dataset, n: int) -> dict[str, Any]:
    """Distribution of the error over chromosomes drawn from the shipped ranges."""
    space = SearchSpace.of(model)
    drawn = draws(space, n)
    simulator = BatchSimulator(model)
    tight = simulator.trajectories(drawn, record, TIGHT_STEPS)
    errors = np.empty(n)
    for i in range(n):
        # Each against its own tight solution: the residual is then the integration error.
        own = Dataset(record.inputs, tight[i], record.dt)
        scale = np.abs(tight[i]).max(axis=0)
        result = simulator.errors(drawn[i : i + 1], [own], [scale])
        errors[i] = np.sqrt(result.sse[0, 0].max() / record.n_samples)
    start = time.process_time()
    whole = simulator.errors(drawn, [record])
    seconds = time.process_time() - start
    feasible = np.all(space.violations(drawn[:, list(space.index)]) <= 0.0, axis=1)
    worst = np.argsort(np.where(feasible, errors, 0.0))[::-1][:5]
    return {
        "chromosomes": n,
        "cpu_milliseconds_each": seconds / n * 1e3,
        "mean_steps_per_sample": float(whole.steps.mean() / (record.n_samples - 1)),
        "median_error": float(np.median(errors)),
        "p99_error": float(np.percentile(errors, 99)),
        "share_above_1e-3": float(np.mean(~(errors < 1e-3))),
        # Outside the constraints the hysteresis may feed energy: chaos, for which no step size
        # gives one right answer.
        "feasible": int(feasible.sum()),
        "feasible_share_above_1e-3": float(np.mean(~(errors[feasible] < 1e-3))),
        "share_flagged": float(np.mean(whole.status != 0)),
        "worst": [
            {
                "error": float(errors[i]),
                "fastest_rate": float(_fastest(model, drawn[i])),
            }
            for i in worst
        ],
    }


def scaling(model: ProcessModel) -> dict[str, list[dict[str, float]]]:
    """CPU milliseconds against samples, chromosomes and integration steps per sample."""
    simulator, record = BatchSimulator(model), excitation(model)

    def population(n: int) -> float:
        parameters = np.repeat(model.nominal[None], n, axis=0)
        return _cpu(lambda: simulator.errors(parameters, [record]))

    samples = [
        (n, fixed_steps(simulator, excitation(model, n), 8))
        for n in (250, 500, 1000, 2000, 4000, 8000, 16_000)
    ]
    chromosomes = [(n, population(n)) for n in (80, 160, 320, 640, 1280, 2560)]
    substeps = [(n, fixed_steps(simulator, record, n)) for n in (1, 2, 4, 8, 16, 32, 64)]
    return {
        name: [{"size": size, "milliseconds": seconds * 1e3} for size, seconds in rows]
        for name, rows in (
            ("samples (one chromosome, 8 steps each)", samples),
            ("chromosomes (of 1000 samples)", chromosomes),
            ("steps per sample (one chromosome)", substeps),
        )
    }


def memory(model: ProcessModel) -> dict[str, Any]:
    """Arrays of small populations, and the whole process's memory with a large one."""
    space = SearchSpace.of(model)
    simulator = BatchSimulator(model)
    simulator.errors(model.nominal, [excitation(model)])  # compiled before anything is counted
    rows = []
    for chromosomes, samples in ((1000, 5000), (4000, 5000), (1000, 20_000), (4000, 20_000)):
        parameters, record = draws(space, chromosomes), excitation(model, samples)
        tracemalloc.start()
        simulator.errors(parameters, [record])
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        rows.append({"chromosomes": chromosomes, "samples": samples, "megabytes": peak / 1e6})
    before = _resident()
    parameters, record = draws(space, LARGE[0]), excitation(model, LARGE[1])
    seconds, _ = timed(lambda: simulator.errors(parameters, [record]))
    return {
        "arrays": rows,
        "chromosomes": LARGE[0],
        "samples": LARGE[1],
        "minutes": seconds / 60.0,
        "megabytes_before": before,
        "peak_megabytes": _resident(),
    }


def _resident() -> float:
    """Largest resident memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def _cpu(function: Callable[[], Any]) -> float:
    """CPU seconds of all threads, the least of several runs."""
    times = []
    until = time.perf_counter() + 1.0
    while len(times) < 4 or time.perf_counter() < until:
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def draw(scaling_: dict[str, list[dict[str, float]]], path: str) -> None:
    """One panel per size, both axes logarithmic, beside a straight line through the last point."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(scaling_), figsize=(12.0, 4.0), constrained_layout=True)
    for panel, (name, rows) in zip(panels, scaling_.items(), strict=True):
        sizes = np.array([row["size"] for row in rows])
        costs = np.array([row["milliseconds"] for row in rows])
        panel.loglog(sizes, costs[-1] * sizes / sizes[-1], "--", color="0.6", label="proportional")
        panel.loglog(sizes, costs, "o-", label="measured")
        panel.set_xlabel(name)
        panel.set_xticks(sizes, [f"{size:g}" for size in sizes])
        panel.set_xticks([], minor=True)
        panel.grid(True, which="both", alpha=0.2)
    panels[0].set_ylabel("CPU time [ms]")
    panels[0].legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _fastest(model: ProcessModel, p: FloatArray) -> float:
    from sysid import jacobian

    rates = np.linalg.eigvals(jacobian(model, model.initial_state, np.zeros(3), p))
    return float(np.abs(rates).max())


def show(figures: dict[str, Any]) -> None:
    print(f"\nOne simulation, 7 states, {SAMPLES} samples, one core")
    print(f"  {'engine':<36} {'ms':>9} {'error':>9} {'ratio':>9}")
    for row in figures["engines"]:
        error = "-" if row["error"] is None else f"{row['error']:.0e}"
        ms, ratio = row["milliseconds"], row["ratio"]
        print(f"  {row['engine']:<36} {ms:9.3f} {error:>9} {ratio:9.1f}")
    for line in figures["missing"]:
        print(f"  left out: {line}")
    box_ = figures["box"]
    print(
        f"\n{box_['chromosomes']} chromosomes of the shipped ranges at accuracy 1e-3: "
        f"{box_['cpu_milliseconds_each']:.3f} ms of CPU and "
        f"{box_['mean_steps_per_sample']:.1f} steps a sample on average\n"
        f"  error: median {box_['median_error']:.1e}, 99th percentile {box_['p99_error']:.1e}, "
        f"above 1e-3: {100 * box_['share_above_1e-3']:.1f} %, "
        f"flagged: {100 * box_['share_flagged']:.1f} %\n"
        f"  of the {box_['feasible']} that satisfy the constraints, above 1e-3: "
        f"{100 * box_['feasible_share_above_1e-3']:.1f} %"
    )
    for row in box_["worst"]:
        print(
            f"  worst of these: error {row['error']:.1e}, "
            f"fastest rate {row['fastest_rate']:.0f} rad/s"
        )
    for name, rows in figures["scaling"].items():
        print(f"\nCPU time against {name}")
        for row in rows:
            each = row["milliseconds"] / row["size"]
            print(
                f"  {row['size']:>6.0f}: {row['milliseconds']:10.4f} ms, "
                f"{each * 1e3:10.4f} us for each"
            )


def show_memory(figures: dict[str, Any]) -> None:
    print("\nLargest size of all arrays during a simulation")
    for row in figures["arrays"]:
        print(
            f"  {row['chromosomes']:>6} chromosomes, {row['samples']:>6} samples: "
            f"{row['megabytes']:7.2f} MB"
        )
    print(
        f"\n{figures['chromosomes']} chromosomes of the shipped ranges on {figures['samples']} "
        f"samples: {figures['minutes']:.1f} minutes, {figures['peak_megabytes']:.0f} MB resident "
        f"at most ({figures['megabytes_before']:.0f} MB before)"
    )


if __name__ == "__main__":
    main()
