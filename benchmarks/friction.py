"""Friction of worn brushes (figure 4.4) in the plant: physical models against ARMAX.

The shipped experiment on the simulated rig with its usual noise, the torque sensor's brushes
rubbing as Coulomb, Stribeck and viscous friction with a part that follows the angle. From the
training log: the actuator with that friction, the actuator without, and ARMAX.

ARMAX gets what can be given to it: orders by free runs over the end of the training log (192
combinations, also an input acting on its own row), refitted to all of it; stable poles; an offset;
its start on the validation log fitted to that log, every lag of every output, where the physical
models estimate one state. Beside it stands the best of all orders on the validation log itself,
for each output by itself, which nobody could know beforehand. OE is the linear model whose free run
errs least on the training log, orders of each output chosen likewise, by itself and with the
measured brake current times the sign of the speed as one more input. Two bounds say what a linear
model can do at all: OE fitted to the validation log itself, and ARMAX one sample ahead.

python -m benchmarks.friction [--json] [--seeds 3] [--searches 2]
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, simulated_logs, timed
from sim_rig.actuator import actuator
from sysid import (
    ARMAX,
    OE,
    BatchSimulator,
    Candidate,
    campaign,
    combinations,
    compare,
    evaluate,
    free_run,
    select_orders,
)
from sysid.judging.comparison import Row
from sysid.linear.selection import TRIED, tuned
from sysid.problem.regressors import with_regressors

WITH, WITHOUT, LINEAR = "with friction", "without friction", "ARMAX"
OUTPUT_ERROR, INFORMED = "OE", "OE, brake current * sign(omega)"
# Table 4.3: the thesis's own figures on its own rig.
THESIS = {
    "GASSI": {"current_motor": 0.0112, "current_brake": 0.136, "omega": 0.151},
    "ARMAX": {"current_motor": 0.00528, "current_brake": 0.1024, "omega": 0.119},
}


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=3, help="seeds of the rig's noise")
    parser.add_argument(
        "--searches", type=int, default=2, help="seeds of the search, the best kept"
    )
    options = parser.parse_args()
    runs = []
    for seed in range(options.seeds):
        seconds, found = timed(lambda s=seed: measure(s, searches=options.searches))
        runs.append(found | {"seconds": seconds})
    report({"runs": runs, "thesis": THESIS, "demands": demands(runs)}, options.json, show)


def measure(
    seed: int,
    *,
    searches: int = 1,
    orders: Mapping[str, Iterable[Any]] = TRIED,
    settings: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """One pair of logs, every structure fitted to one and judged on the other."""
    models = {WITH: actuator(friction="cyclic"), WITHOUT: actuator()}
    training, validation = simulated_logs(models[WITH], seed, friction="cyclic")
    found = campaign(
        combinations(models, {"training": [training]}, range(searches), settings), n_jobs=1
    )
    candidates = [
        Candidate.of(name, outcome.estimator, [training], [validation])
        for (name, _), outcome in found.best().items()
        if outcome.estimator is not None
    ]
    armax = ARMAX(stable=True)
    linear = tuned(armax, training, **_of(armax, orders))
    candidates.append(Candidate.of(LINEAR, linear.model, [training], [validation]))
    for name, extended in ((OUTPUT_ERROR, False), (INFORMED, True)):
        logs = [training, validation]
        if extended:
            logs = [with_regressors(models[WITH], record)[0] for record in logs]
        output_error = tuned(OE(), logs[0], **_of(OE(), orders))
        candidates.append(Candidate.of(name, output_error.model, logs[:1], logs[1:]))
    result = compare(candidates, [training], [validation])
    hindsight = select_orders(armax, training, validation, **_of(armax, orders))
    names = models[WITH].output_names
    ahead = evaluate(validation.outputs, linear.model.predict_ahead(validation))
    best = OE(nf=6, nb=4).fit(validation)
    truth = actuator(friction="cyclic", parameters="rig")
    floor = evaluate(validation.outputs, free_run(BatchSimulator(truth), truth.nominal, validation))
    return {
        "seed": seed,
        "structures": {row.name: _figures(row, names) for row in result.rows},
        "hindsight": _named(
            names, np.nanmin([c.rmse for c in hindsight.candidates if c.stable], axis=0)
        ),
        "fitted_to_validation": _named(
            names, evaluate(validation.outputs, best.predict(validation)).rmse
        ),
        "one_sample_ahead": _named(names, ahead.rmse),
        "true_parameters": _named(names, floor.rmse),
        "armax_orders": linear.best.orders,
        "preferred": result.preferred,
        "verdict": result.verdict,
    }


def _of(estimator: ARMAX | OE, orders: Mapping[str, Iterable[Any]]) -> dict[str, Any]:
    """Those of the orders that an estimator has."""
    return {name: orders[name] for name in orders.keys() & estimator.get_params()}


def demands(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How often each demand was met, of how many."""

    def rmse(run: Mapping[str, Any], name: str) -> np.ndarray:
        return np.array(list(run["structures"][name]["rmse"].values()))

    ours = [rmse(run, WITH) for run in runs]
    hindsight = [np.array(list(run["hindsight"].values())) for run in runs]
    return {
        "runs": len(runs),
        "beats ARMAX on every output": sum(
            bool(np.all(a < rmse(run, LINEAR))) for a, run in zip(ours, runs, strict=True)
        ),
        "beats ARMAX with orders by hindsight on every output": sum(
            bool(np.all(a < b)) for a, b in zip(ours, hindsight, strict=True)
        ),
        "without friction is called worse": sum(
            run["structures"][WITHOUT]["verdict"] == "worse" for run in runs
        ),
        "with friction is preferred": sum(run["preferred"] == WITH for run in runs),
    }


def _figures(row: Row, names: Sequence[str]) -> dict[str, Any]:
    return {
        "rmse": _named(names, row.rmse),
        "msd": _named(names, row.msd),
        "fit_percent": _named(names, row.fit),
        "free_parameters": row.n_free,
        "effective_parameters": row.n_effective,
        "dbic": row.dbic,
        "squared_errors_relative": None
        if row.ratio is None
        else [row.ratio.value, row.ratio.low, row.ratio.high],
        "verdict": row.verdict,
    }


def _named(names: Sequence[str], values: np.ndarray) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


def show(figures: dict[str, Any]) -> None:
    runs = figures["runs"]
    outputs = list(runs[0]["true_parameters"])
    print(f"\nValidation, free run, mean over {len(runs)} seed(s) of noise (as in table 4.3)")
    print(f"{'':34}" + "".join(f"{name:>24}" for name in outputs))
    print(f"{'':34}" + f"{'RMSE':>14}{'MSD':>10}" * len(outputs))
    for name in (WITH, WITHOUT, LINEAR, OUTPUT_ERROR, INFORMED):
        cells = ""
        for output in outputs:
            rmse = np.mean([run["structures"][name]["rmse"][output] for run in runs])
            msd = np.mean([run["structures"][name]["msd"][output] for run in runs])
            cells += f"{rmse:14.4f}{msd:10.4f}"
        print(f"{name:34}{cells}")
    for label, key in (
        ("ARMAX, orders by hindsight", "hindsight"),
        ("OE fitted to the validation log", "fitted_to_validation"),
        ("ARMAX, one sample ahead", "one_sample_ahead"),
        ("true parameters", "true_parameters"),
    ):
        means = [np.mean([run[key][output] for run in runs]) for output in outputs]
        print(f"{label:34}" + "".join(f"{value:14.4f}{'':10}" for value in means))
    for name, row in figures["thesis"].items():
        print(f"{'thesis, ' + name:34}" + "".join(f"{row[o]:14.4f}{'':10}" for o in outputs))
    print("\nSeed by seed: RMSE with friction, in parts of ARMAX's and of that by hindsight")
    for run in runs:
        ours = run["structures"][WITH]["rmse"]
        cells = "".join(
            f"{ours[o] / run['structures'][LINEAR]['rmse'][o]:14.3f}"
            f"{ours[o] / run['hindsight'][o]:10.3f}"
            for o in outputs
        )
        print(f"  seed {run['seed']} ({run['seconds']:.0f} s){'':20}"[:34] + cells)
        print(f"    {run['verdict']}")
    total = figures["demands"]["runs"]
    print()
    for demand, met in figures["demands"].items():
        if demand != "runs":
            print(f"  {demand:56} {met} of {total}")


if __name__ == "__main__":
    main()
