"""What a report's page says beside its document: sentences, tables, meanings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from daq.identification.result import NOTES
from sysid.problem.metrics import mean_known
from sysid.problem.model import ProcessModel

_FIGURES = ("rmse", "msd", "fit_percent")
_ENDED = {
    "generations": "it ended with the budget given",
    "converged": "it ended where nothing better came any more",
    "interrupted": "it was interrupted",
}


@dataclass(frozen=True)
class Step:
    """Something to do with a result: a sentence around symbols, and a command."""

    before: str
    names: Sequence[str] = ()
    after: str = ""
    command: str = ""


def view(model: ProcessModel, document: Mapping[str, Any]) -> dict[str, Any]:
    """Variables of the page's template."""
    parameters = document["parameters"]
    found = document.get("ambiguities", [])
    comparison = document["comparison"]
    baseline = comparison if "metrics" in comparison else None
    free = [one for one in parameters.values() if "range" in one]
    return {
        "title": _title(document),
        "recorded": _recorded(document["reproduction"]["runs"]),
        "model_name": model.name,
        "description": model.description,
        "equations": model.equations,
        "inputs": model.inputs,
        "outputs": model.outputs,
        "n_free": len(free),
        "quantities": _quantities(document),
        "determined": _determined(document, free),
        "data_sentence": _data_sentence(document["reproduction"]["logs"]),
        "tables": {part: _errors(document, baseline, part) for part in ("training", "validation")},
        "baseline": baseline,
        "baseline_sentence": _baseline_sentence(comparison),
        "meanings": {p.name: p.description for p in model.parameters},
        "described": any(p.description for p in model.parameters),
        "notes": {name: _note(one) for name, one in parameters.items()},
        "has_intervals": "determined_directions" in document,
        "no_intervals": _no_intervals(document["search"]),
        "exact": [a for a in found if a["kind"] in ("product", "sum")],
        "vagues": [a for a in found if a["kind"] == "vague"],
        "rivals": _rivals(document),
        "tested": _tested(document),
        "starts": _starts(model, document),
        "steps": _steps(document),
        "ended": _ENDED[document["search"]["stopped"]],
    }


def _title(document: Mapping[str, Any]) -> str:
    names = [one["name"] for one in document["metrics"]["training"]]
    return names[0] if len(names) == 1 else f"{len(names)} logs, the first {names[0]}"


def _recorded(runs: Sequence[Mapping[str, Any]]) -> str:
    """Which experiment on which rig, where all logs are of one."""
    known = {(run["experiment"], run["rig"]) for run in runs}
    experiment, rig = known.pop() if len(known) == 1 else ("", "")
    return f"{experiment} on {rig}" if experiment and rig else ""


def _quantities(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Parameters and combinations that have an interval."""
    own = [{"name": n, **one} for n, one in document["parameters"].items() if "interval" in one]
    return own + [one for a in document.get("ambiguities", []) for one in a["determined"]]


def _determined(document: Mapping[str, Any], free: Sequence[Mapping[str, Any]]) -> str:
    """What may be done with the numbers, in one sentence."""
    if "determined_directions" not in document:
        return "Its parameters have no intervals, so how surely each is known is not known."
    own = sum("interval" in one for one in free)
    together = sum(len(a["determined"]) for a in document["ambiguities"])
    combined = f" and {_count(together, 'combination')} of others" if together else ""
    spite = "" if document["verdict"]["trust"] == "poor" else (
        "; the model's outputs are as good with any of their values that fit"
    )  # fmt: skip
    if own == len(free):
        return f"The data determine all {own} free parameters, each by itself."
    return (
        f"The data determine {own} of {_count(len(free), 'free parameter')} by themselves{combined}"
        f". The rest is not to be used one by one{spite}."
    )


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


def _data_sentence(logs: Sequence[Mapping[str, Any]]) -> str:
    parts = []
    for use, said in (("training", "It was fitted to"), ("validation", "and judged on")):
        own = [log for log in logs if log["use"] == use]
        if own:
            seconds = sum(log["samples"] / log["sample_rate"] for log in own)
            samples = sum(log["samples"] for log in own)
            rates = sorted({log["sample_rate"] for log in own})
            rate = " to ".join(f"{rate:.4g}" for rate in dict.fromkeys((rates[0], rates[-1])))
            parts.append(
                f"{said} {_count(len(own), 'log')} of {samples} samples ({seconds:.3g} s at "
                f"{rate} Hz)"
            )
    end = (
        ", which took no part in the fit" if len(parts) > 1 else "; none was held back to judge it"
    )
    return ", ".join(parts) + f"{end}."


def _errors(
    document: Mapping[str, Any], baseline: Mapping[str, Any] | None, part: str
) -> list[dict[str, Any]]:
    """A row for each output: errors of the model, then of the baseline, mean over the logs."""
    own = document["metrics"][part]
    if not own:
        return []
    sources = [own, *([baseline["metrics"][part]] if baseline else [])]
    return [
        {"name": name, "cells": [_mean_errors(source, name) for source in sources]}
        for name in own[0]["outputs"]
    ]


def _mean_errors(logs: Sequence[Mapping[str, Any]], output: str) -> dict[str, float | None]:
    if len(logs) == 1:
        return {key: logs[0]["outputs"][output][key] for key in _FIGURES}
    means = {
        key: float(
            mean_known(np.array([log["outputs"][output][key] for log in logs], dtype=np.float64))
        )
        for key in _FIGURES
    }
    return {key: value if np.isfinite(value) else None for key, value in means.items()}


def _baseline_sentence(comparison: Mapping[str, Any]) -> str:
    if "left_out" in comparison:
        return f"No linear baseline: {comparison['left_out']}."
    orders = ", ".join(f"{name} = {order}" for name, order in comparison["orders"].items())
    return (
        f"{comparison['name']} is a linear model of the same data that knows no physics "
        f"(A(q) y = B(q) u + C(q) e with the shift q, white noise e and the orders {orders}): what "
        "the equations must beat."
    )


def _note(one: Mapping[str, Any]) -> str:
    return NOTES[one.get("undetermined", "bound" if one.get("on_bound") else "")]


def _no_intervals(search: Mapping[str, Any]) -> str:
    if search["stopped"] == "interrupted":
        return "the search was interrupted"
    return f"the preset {search['preset']} does not refine to a minimum"


def _rivals(document: Mapping[str, Any]) -> dict[str, Any] | None:
    found = next((a for a in document.get("ambiguities", []) if a["kind"] == "rival"), None)
    if found is None:
        return None
    return {
        "names": [name for name in found["parameters"] if name in document["parameters"]],
        "others": document["rivals"],
        "measure": found["measure"][0],
    }


def _tested(document: Mapping[str, Any]) -> dict[str, Any]:
    """Residual tests on the validation data, or else on the training data."""
    part = "validation" if document["metrics"]["validation"] else "training"
    logs = [log["outputs"] for log in document["metrics"][part]]
    inputs = list(next(iter(logs[0].values()))["residual_independent_of"])
    rows = []
    for name in logs[0]:
        own = [log[name]["residual_autocorrelation_in_band"] for log in logs]
        shares = [_mean_share(own)]
        for signal in inputs:
            shares.append(
                _mean_share([log[name]["residual_independent_of"].get(signal) for log in logs])
            )
        rows.append({"name": name, "shares": shares})
    return {"part": part, "inputs": inputs, "rows": rows}


def _mean_share(shares: Sequence[float | None]) -> float | None:
    known = [share for share in shares if share is not None]
    return sum(known) / len(known) if known else None


def _starts(model: ProcessModel, document: Mapping[str, Any]) -> dict[str, str]:
    """States that a combination holds the start of: the start's name by the state's."""
    said = " ".join(one["name"] for one in _quantities(document))
    return {name: f"{name}(0)" for name in model.state_names if f"{name}(0)" in said}


def _steps(document: Mapping[str, Any]) -> list[Step]:
    """What a reader may do with the result, or to better it: the most useful first."""
    steps = [*_cures(document)]
    trust = document["verdict"]["trust"]
    if trust != "poor":
        steps.insert(0, Step(
            "Use the model for inputs like those of the logs; it is proven for no others. To "
            "simulate it on another log of the rig:", command=_replay(document),
        ))  # fmt: skip
    elif not steps:
        steps.append(Step("See in the residuals below when and where the model errs."))
    if not document["metrics"]["validation"]:
        steps.insert(0, Step(
            "Judge it on data that it has not seen, with another log:", command="--validate LOG",
        ))  # fmt: skip
    return steps


def _cures(document: Mapping[str, Any]) -> list[Step]:
    """What would determine more of the parameters."""
    found = document.get("ambiguities", [])
    measure = [name for a in found if a["kind"] in ("product", "sum") for name in a["measure"]]
    vague = [name for a in found if a["kind"] == "vague" for name in a["parameters"]]
    rival = [a["measure"][0] for a in found if a["kind"] == "rival"]
    held = [name for name, one in document["parameters"].items() if one.get("on_bound")]
    return [
        Step(before, list(dict.fromkeys(names)), after)
        for names, before, after in (
            (held, "Give ", " more room under `ranges`, or a value under `fixed`: an end of the "
             "range decides now."),
            (rival, "Measure ", ", to tell which of the sets of parameters below it is."),
            (measure, "Measure ", " by other means (an ohmmeter, a scale, a data sheet) and give "
             "the values under `fixed` in a file for `--config`: then those that act together get "
             "intervals of their own. To simulate, this is not needed."),
            (vague, "Record an experiment that makes ", " matter, larger or slower or faster than "
             "this one: these data hardly feel them."),
        ) if names
    ]  # fmt: skip


def _replay(document: Mapping[str, Any]) -> str:
    columns = document["reproduction"]["columns"]
    return "rig replay LOG --parameters parameters.yaml" + (
        f" --config {columns}" if columns else ""
    )
