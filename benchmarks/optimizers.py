"""Our search beside others at equal numbers of simulations; and what each part of ours brings.

python -m benchmarks.optimizers [--json] [--seeds 10] [--budget N] [--case NAME] [--ablation]

Every method gets the same objective, ranges, search scale, batches of simulations and budget.
SciPy's and pymoo's differential evolution, pymoo's genetic algorithm and CMA-ES (pycma, started
anew with twice the population when it stops) see infeasible parameters as worse than any
feasible ones, in order of their violation, and are not charged for them. "SciPy DE, polished"
keeps a quarter of the budget for the descent (L-BFGS-B) that SciPy ends with by default. Ours is
charged for everything, the refinement included.

Cases (--case, may be repeated): the actuator's 19 parameters and the hysteresis's start, from a
noisy simulated record, or an exact one (actuator_exact); the DC motor of section 4.1.4,
noise-free, a decade either side; the damper of examples/mr_damper, where its measured logs are
at hand, one of each motion, thinned.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import damper
from benchmarks._common import arguments, report, simulated_logs, timed
from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset, SearchSpace
from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.gassi import PRESETS, GeneticSearch, Preset
from sysid.gassi.search_run import SearchRun
from sysid.problem.model import ProcessModel

LOGS = damper.ROOT.parent / "shared" / "data" / "mr_damper"
OURS = "ours"


@dataclass(frozen=True)
class Case:
    """A problem: objective over the parameters alone, and how ours spends the budget."""

    name: str
    model: ProcessModel
    records: list[Dataset]
    population: int
    generations: int
    per_log: bool = False

    def objective(self, use_log: bool = True) -> Objective:
        """The objective with a count of its own."""
        space = SearchSpace.of(self.model, use_log=use_log)
        return Objective(BatchSimulator(self.model), space, self.records, per_log=self.per_log)


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=10, help="runs of each method")
    parser.add_argument("--budget", type=int, help="simulations of a run; default each case's own")
    parser.add_argument("--case", action="append", help=", ".join(CASES))
    parser.add_argument("--data", type=Path, default=LOGS, help="the damper's logs; %(default)s")
    parser.add_argument("--ablation", action="store_true", help="variants of ours instead of peers")
    options = parser.parse_args()
    usual = ["actuator_exact", "actuator", "dc_motor"]
    names = options.case or (usual if options.ablation else [*usual[1:], "damper"])
    figures: dict[str, Any] = {"seeds": options.seeds, "cases": {}}
    for name in names:
        case = CASES[name](options.data)
        if case is None:
            figures["cases"][name] = {"skipped": f"the logs are not in {options.data}"}
            continue
        if options.budget is not None:
            case = replace(case, generations=max(1, options.budget // case.population))
        run = ablation if options.ablation else compare
        figures["cases"][name] = run(case, options.seeds)
    report(figures, options.json, show)


# --- cases --------------------------------------------------------------------------------------


def actuator_case(_: Path) -> Case:
    """The shipped experiment on the simulated rig, with its sensors' noise."""
    model = actuator()
    return Case("actuator", model, [simulated_logs(model)[0]], 300, 40)


def actuator_exact_case(_: Path) -> Case:
    """The same commands and load, simulated by the model itself: its error can be zero."""
    noisy = actuator_case(_)
    record, truth = noisy.records[0], actuator(parameters="rig").nominal
    outputs = BatchSimulator(noisy.model, accuracy=1e-6).trajectories(truth, record)[0]
    exact = Dataset(record.inputs, outputs, record.dt)
    return replace(noisy, name="actuator_exact", records=[exact])


def dc_motor_case(_: Path) -> Case:
    """Section 4.1.4, the ranges a decade either side."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))
    import dc_motor
    import dc_motor_data

    return Case("dc_motor", dc_motor.model, [dc_motor_data.training()], 400, 50)


def damper_case(folder: Path) -> Case | None:
    """A measured log of each motion, the currents in turn; None where they are not at hand."""
    if not folder.is_dir():
        return None
    model, logs = damper.load(folder)
    chosen = [damper.thinned(log) for i, log in enumerate(logs) if (i // 3 + i) % 3 == 0]
    return Case("damper", model, chosen, 150, 30, per_log=True)


CASES: dict[str, Callable[[Path], Case | None]] = {
    "actuator": actuator_case,
    "actuator_exact": actuator_exact_case,
    "dc_motor": dc_motor_case,
    "damper": damper_case,
}


# --- ours ---------------------------------------------------------------------------------------


def ours(case: Case, seed: int, preset: Preset = PRESETS["default"]) -> float:
    """Error that a preset ends with."""
    objective, rng = case.objective(preset.log_scale), np.random.default_rng(seed)
    own = max(1, round((1.0 - preset.local_share) * case.generations))
    search = GeneticSearch(objective.space, preset, case.population, own, rng)
    run = SearchRun(objective, search, case.generations, likelihood=False)
    while not run.done:
        run.step()
    assert run.best is not None
    if objective.simulations > case.population * case.generations:
        print(f"over budget: {objective.simulations} simulations", file=sys.stderr)
    return run.best.error


# --- the others ---------------------------------------------------------------------------------


class SpentError(Exception):
    """The budget is used up."""


class Scorer:
    """The objective on the unit cube, counting simulations and keeping the best."""

    def __init__(self, case: Case, budget: int) -> None:
        objective = case.objective()
        space = objective.space.with_starts(objective.records)
        self.objective = objective.over(space)
        self.lower, upper = space.encode(space.lower), space.encode(space.upper)
        self.width = upper - self.lower
        self.left = budget
        self.best = np.inf
        self.best_at: FloatArray = np.full(len(self.width), 0.5)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.width)

    def __call__(self, rows: FloatArray) -> FloatArray:
        """Scores of rows (n, n_free) of the unit cube; raises SpentError when none is left."""
        if self.left <= 0:
            raise SpentError
        space = self.objective.space
        chromosomes = space.decode(self.lower + np.clip(rows, 0.0, 1.0) * self.width)
        violation = space.violations(chromosomes).sum(axis=1)
        scores = 1e3 * (1.0 + np.minimum(violation, 1e6))
        feasible = np.flatnonzero(violation == 0.0)
        charged = feasible[: self.left]
        self.left -= len(charged)
        if len(charged):
            errors, _ = self.objective.evaluate(chromosomes[charged])
            scores[charged] = np.minimum(errors, 1e3)
            first = int(np.argmin(errors))
            if errors[first] < self.best:
                self.best, self.best_at = float(errors[first]), rows[charged[first]].copy()
        return scores


def scipy_de(score: Scorer, seed: int) -> None:
    from scipy.optimize import differential_evolution

    differential_evolution(
        lambda x: score(np.atleast_2d(x.T)), [(0.0, 1.0)] * score.size, vectorized=True,
        updating="deferred", maxiter=10**6, tol=0.0, polish=False, rng=seed,
    )  # fmt: skip


def scipy_de_polished(score: Scorer, seed: int) -> None:
    from scipy.optimize import minimize

    kept = score.left // 4
    score.left -= kept
    try:
        scipy_de(score, seed)
    except SpentError:
        score.left += kept
    step = 1e-6

    def value_and_slope(x: FloatArray) -> tuple[float, FloatArray]:
        signs = np.where(x + step > 1.0, -1.0, 1.0)
        scores = score(np.vstack([x, x + np.diag(step * signs)]))
        return float(scores[0]), (scores[1:] - scores[0]) / (step * signs)

    minimize(
        value_and_slope, score.best_at, jac=True, method="L-BFGS-B",
        bounds=[(0.0, 1.0)] * score.size, options={"maxiter": 10**6, "ftol": 0.0, "gtol": 0.0},
    )  # fmt: skip


def pymoo(score: Scorer, seed: int, name: str) -> None:
    from pymoo.algorithms.soo.nonconvex.de import DE
    from pymoo.algorithms.soo.nonconvex.ga import GA
    from pymoo.core.problem import Problem
    from pymoo.optimize import minimize

    class Cube(Problem):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(n_var=score.size, n_obj=1, xl=0.0, xu=1.0)

        def _evaluate(self, x: FloatArray, out: dict[str, Any], *_: Any, **__: Any) -> None:
            out["F"] = score(x)

    algorithm = {"GA": GA, "DE": DE}[name](pop_size=100)
    minimize(Cube(), algorithm, ("n_gen", 10**6), seed=seed, verbose=False)


def cma_es(score: Scorer, seed: int) -> None:
    import cma

    rng = np.random.default_rng(seed)
    population = 4 + int(3 * np.log(score.size))
    while True:
        search = cma.CMAEvolutionStrategy(
            rng.uniform(0.2, 0.8, score.size), 0.3,
            {"bounds": [0.0, 1.0], "popsize": population, "seed": int(rng.integers(1, 2**31)),
             "verbose": -9},
        )  # fmt: skip
        while not search.stop():
            rows = search.ask()
            search.tell(rows, list(score(np.array(rows))))
        population *= 2


PEERS: dict[str, Callable[[Scorer, int], None]] = {
    "SciPy DE": scipy_de,
    "SciPy DE, polished": scipy_de_polished,
    "pymoo GA": lambda score, seed: pymoo(score, seed, "GA"),
    "pymoo DE": lambda score, seed: pymoo(score, seed, "DE"),
    "CMA-ES": cma_es,
}


def peer(case: Case, seed: int, method: Callable[[Scorer, int], None]) -> float:
    """Error that a method has found when the budget is used up, or it stops."""
    score = Scorer(case, case.population * case.generations)
    with contextlib.suppress(SpentError):
        method(score, seed)
    return score.best


# --- tables -------------------------------------------------------------------------------------


def compare(case: Case, seeds: int) -> dict[str, Any]:
    methods: dict[str, Callable[[int], float]] = {OURS: lambda seed: ours(case, seed)}
    for name, method in PEERS.items():
        methods[name] = lambda seed, method=method: peer(case, seed, method)
    return table(case, seeds, methods)


def ablation(case: Case, seeds: int) -> dict[str, Any]:
    default = PRESETS["default"]
    alone = replace(default, local_share=0.0)
    variants = {
        OURS: default,
        "half for the local refinement": replace(default, local_share=0.5),
        "a tenth for the local refinement": replace(default, local_share=0.1),
        "linear scale": replace(default, log_scale=False),
        "uniform start": replace(default, stratified=False),
        "no refinement": alone,
        "no refinement, no restarts": replace(alone, collapse=0.0),
        "no refinement, initial spread": replace(alone, spread="initial"),
        "no refinement, linear scale": replace(alone, log_scale=False),
        "no refinement, ranges not kept": replace(alone, keep_in_range=False),
        "thesis": PRESETS["thesis"],
    }
    methods: dict[str, Callable[[int], float]] = {}
    for name, preset in variants.items():
        methods[name] = lambda seed, preset=preset: ours(case, seed, preset)
    return table(case, seeds, methods)


def table(case: Case, seeds: int, methods: dict[str, Callable[[int], float]]) -> dict[str, Any]:
    case.objective().evaluate(SearchSpace.of(case.model).lower[None])  # compiles
    rows: dict[str, Any] = {}
    for name, method in methods.items():
        seconds, errors = timed(lambda run=method: [run(seed) for seed in range(seeds)])
        rows[name] = {
            "median": float(np.median(errors)),
            "worst": float(np.max(errors)),
            "best": float(np.min(errors)),
            "seconds": seconds / seeds,
        }
    for row in rows.values():
        # Errors below this are those of the arithmetic.
        row["ratio"] = max(row["median"], 1e-12) / max(rows[OURS]["median"], 1e-12)
    return {
        "simulations": case.population * case.generations,
        "records": len(case.records),
        "samples": sum(record.n_samples for record in case.records),
        "methods": rows,
    }


def show(figures: dict[str, Any]) -> None:
    for name, case in figures["cases"].items():
        if "skipped" in case:
            print(f"\n{name}: skipped, {case['skipped']}")
            continue
        print(
            f"\n{name}: {case['simulations']} simulations of {case['samples']} samples in "
            f"{case['records']} record(s), {figures['seeds']} seeds"
        )
        print(
            f"  {'method':<32} {'median':>10} {'worst':>10} {'best':>10} {'ratio':>9} {'time':>8}"
        )
        for method, row in case["methods"].items():
            print(
                f"  {method:<32} {row['median']:10.3e} {row['worst']:10.3e} {row['best']:10.3e} "
                f"{row['ratio']:9.3g} {row['seconds']:6.2f} s"
            )


if __name__ == "__main__":
    main()
