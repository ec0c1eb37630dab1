"""What a report's page says beside its tables: sentences, and what to do next."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from daq.identification.request import from_here, set_options
from daq.identification.rows import (
    OutputErrors,
    Rows,
    StartRow,
    logs_of,
    mean_errors,
    start_sentences,
)
from daq.lookup.models import title_of, trust_option
from sysid import ProcessModel

_ENDED = {
    "generations": "it ended with the budget given",
    "converged": "it ended where nothing better came any more",
    "settled": "it ended early, for no better minimum was to be expected",
    "interrupted": "it was interrupted",
}


@dataclass(frozen=True)
class Step:
    """Something to do with a result: a sentence around symbols, and a command."""

    before: str
    names: Sequence[str] = ()
    after: str = ""
    command: str = ""


def view(model: ProcessModel, document: Mapping[str, Any], rows: Rows) -> dict[str, Any]:
    """Variables of the page's template, beside the document and its rows."""
    comparison, search = document["comparison"], document["search"]
    logs = rows.logs["training"]
    quantities = [*rows.determined, *rows.bounded, *rows.combinations]
    names = " ".join(row.name for row in rows.starts)
    unrefined = f"the preset {search['preset']} does not refine to a minimum"
    interrupted = search["stopped"] == "interrupted"
    return {
        "title": logs[0].name if len(logs) == 1 else f"{len(logs)} logs, the first {logs[0].name}",
        "recorded": _recorded(document["reproduction"]["runs"]),
        "model": model,
        "model_title": title_of(document["model"], model),
        "quantities": quantities,
        "grouped_starts": StartRow.grouped,
        "determined": _determined(document, rows),
        "data_sentence": _data_sentence(document["reproduction"]["logs"]),
        "tables": {
            part: _errors(rows, comparison.get("baselines", ()), part)
            for part in ("training", "validation")
        },
        "log_rows": _log_rows(document["reproduction"]["logs"], rows),
        "baseline_sentences": _baseline_sentences(comparison, rows),
        "meanings": {p.name: p.description for p in model.parameters},
        "described": any(p.description for p in model.parameters),
        "no_intervals": "the search was interrupted" if interrupted else unrefined,
        "rival": next(iter(rows.ambiguities_of("rival")), None),
        # States that a combination holds the start of.
        "starts": {name: f"{name}(0)" for name in model.state_names if f"{name}(0)" in names},
        "several_logs": len(rows.logs["training"]) > 1,
        "start_sentences": start_sentences(document["metrics"]["validation"]),
        "steps": _steps(document, rows),
        "ended": _ENDED[search["stopped"]],
    }


def _recorded(runs: Sequence[Mapping[str, Any]]) -> str:
    """Which experiment on which rig, where all logs are of one."""
    origins = {(run["experiment"], run["rig"]) for run in runs}
    experiment, rig = origins.pop() if len(origins) == 1 else ("", "")
    return f"{experiment} on {rig}" if experiment and rig else ""


def _determined(document: Mapping[str, Any], rows: Rows) -> str:
    """What may be done with the numbers, in one sentence."""
    if not rows.refined:
        return "Its parameters have no intervals, so how surely each is known is not known."
    alone, free, together = len(rows.determined), len(rows.free), len(rows.combinations)
    if alone == free:
        return f"The data determine all {alone} free parameters, each by itself."
    bounded = f", and bound {len(rows.bounded)} more on one side" if rows.bounded else ""
    combined = f" and {_count(together, 'combination')} of others" if together else ""
    outputs = "; the model's outputs are as good with any of their values that fit"
    usable = "" if document["verdict"]["predictions"]["trust"] == "poor" else outputs
    rest = f" The rest is not to be used one by one{usable}."
    return (
        f"The data determine {alone} of {_count(free, 'free parameter')} by themselves{combined}"
        f"{bounded}.{rest if alone + len(rows.bounded) < free else ''}"
    )


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _data_sentence(logs: Sequence[Mapping[str, Any]]) -> str:
    parts = []
    for use, verb in (("training", "It was fitted to"), ("validation", "and judged on")):
        used = [log for log in logs if log["use"] == use]
        if used:
            seconds = sum(log["samples"] / log["sample_rate"] for log in used)
            samples = sum(log["samples"] for log in used)
            measured = sum(log.get("measured", log["samples"]) for log in used)
            rates = sorted({log["sample_rate"] for log in used})
            rate = " to ".join(f"{rate:.4g}" for rate in dict.fromkeys((rates[0], rates[-1])))
            parts.append(
                f"{verb} {_count(len(used), 'log')} of {_of_samples(measured, samples)} "
                f"({seconds:.3g} s at {rate} Hz)"
            )
    if len(parts) == 1:
        return f"{parts[0]}; none was held back to judge it."
    return f"{', '.join(parts)}, which took no part in the fit."


def _of_samples(measured: int, places: int) -> str:
    """How much was measured, where that is not a sample at every sample time."""
    if measured == places:
        return f"{places} samples"
    return f"{measured} measured samples on {places} sample times"


def _errors(
    rows: Rows, baselines: Sequence[Mapping[str, Any]], part: str
) -> dict[str, dict[str, OutputErrors]]:
    """Of each output the errors of the model, then of each baseline, mean over the logs."""
    models = {"identified": mean_errors(rows.logs[part])}
    models |= {each["name"]: mean_errors(logs_of(each["metrics"], part)) for each in baselines}
    return {
        output: {name: errors[output] for name, errors in models.items() if errors}
        for output in models["identified"]
    }


def _log_rows(fingerprints: Sequence[Mapping[str, Any]], rows: Rows) -> list[dict[str, Any]]:
    """A row for every log: its length, and the errors of each output."""
    # Logs of several folders may have one name; of each use they stand in one order.
    errors = {use: iter(logs) for use, logs in rows.logs.items()}
    return [
        {
            **{key: log[key] for key in ("name", "use", "samples")},
            "seconds": log["samples"] / log["sample_rate"],
            "outputs": next(errors[log["use"]]).outputs,
        }
        for log in fingerprints
    ]


def _baseline_sentences(comparison: Mapping[str, Any], rows: Rows) -> list[str]:
    """What the linear models are, and how they were made as good as they can be."""
    if "left_out" in comparison:
        return [f"No linear baseline: {comparison['left_out']}."]
    first, *others = comparison["baselines"]
    outputs = list(rows.logs["training"][0].outputs)
    sentences = [
        "OE (output error) is a linear model of the same data that knows no physics, "
        "y = B(q)/F(q) u + constant + e with the shift q: what the equations must beat. It is "
        "fitted by the error of its free run, by which all are judged here; of its orders those "
        f"that serve the end of the training data best ({_orders(first['orders'], outputs)})."
    ]
    for baseline in others:
        if "more_inputs" in baseline:
            more = " and ".join(baseline["more_inputs"])
            sentences.append(
                f"“{baseline['name']}” has {more} as an input as well, of measured outputs, which "
                "is more than a free run is otherwise given."
            )
        if not baseline["metrics"]["training"]:
            sentences.append(
                f"“{baseline['name']}” is fitted to the validation data themselves: where even "
                "that is far below the identified model, no linear model would do."
            )
    return sentences


def _orders(orders: Mapping[str, Any], outputs: Sequence[str]) -> str:
    """Poles and coefficients of every output."""

    def of(name: str, j: int) -> Any:
        return orders[name][j] if isinstance(orders[name], list) else orders[name]

    return "; ".join(
        f"{output} nf = {of('nf', j)}, nb = {of('nb', j)}" for j, output in enumerate(outputs)
    )


def _steps(document: Mapping[str, Any], rows: Rows) -> list[Step]:
    """What a reader may do with the result, or to better it: the most useful first."""
    verdict, steps, better = document["verdict"], _cures(rows), document.get("next")
    if verdict["predictions"]["trust"] != "poor":
        again = document["reproduction"]
        use = (
            "Use the model for inputs like those of the logs; it is proven for no others. To "
            f"simulate it on another log of the rig, in {again['folder']}:"
        )
        columns, parameters = again["columns"], again.get("parameters", "parameters.yaml")
        command = f"rig replay LOG --parameters {shlex.quote(parameters)}"
        command += f" --config {shlex.quote(from_here(columns))}" if columns else ""
        command += set_options(again["settings"])
        steps.insert(0, Step(use, command=command + trust_option(document["model"])))
    elif not steps:
        steps.append(Step("See in the residuals below when and where the model errs."))
    if better:
        steps.insert(0, Step(better["purpose"], command=better["command"]))
    elif rows.weak:
        text = (
            " matter: these data hardly feel them. `rig design`, or `sysid.design` of a model "
            "without a rig, finds such runs."
        )
        steps.append(Step("Record an experiment that makes ", [r.name for r in rows.weak], text))
    unsure = verdict["predictions"]["trust"] != "good"
    if rows.logs["validation"] and unsure and rows.weak:
        steps.append(
            Step(
                "Fit the logs of the validation as well, and judge on others: they may feel ",
                [row.name for row in rows.weak],
                ", which those of the training hardly do.",
            )
        )
    if not rows.logs["validation"]:
        judge = "Judge it on data that it has not seen, with another log:"
        steps.insert(0, Step(judge, command="--validate LOG"))
    return steps


def _cures(rows: Rows) -> list[Step]:
    """What would determine more of the parameters."""
    measure = dict.fromkeys(name for a in rows.ambiguities_of("tied") for name in a.measure)
    starts = [name for name in measure if "(0)" in name]
    rival = [a.measure[0] for a in rows.ambiguities_of("rival")]
    at_ends = [row for row in rows.parameters if row.on_bound and not row.at_limit]
    held = [row.name for row in at_ends if not row.harmless]
    cures = (
        Step("Give ", held, " more room under `ranges`, or a value under `fixed`: now an end of "
             "the range decides."),
        Step("Measure ", rival, ", to tell which of the sets of parameters below it is."),
        Step("Measure ", [name for name in measure if name not in starts], " by other means (an "
             "ohmmeter, a scale, a data sheet) and give the values under `fixed` in a file for "
             "`--config`: then those that act together get intervals of their own. To simulate, "
             "this is not needed."),
        Step("Give the start of ", list(dict.fromkeys(n.partition("(")[0] for n in starts)),
             " under `initial` in a file for `--config`."),
    )  # fmt: skip
    return [step for step in cures if step.names]
