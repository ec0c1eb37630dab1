"""What an identification tells people: tables and sentences on a terminal."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from daq import notation
from daq.cli import terminal as console
from daq.identification.result import NOTES, Identified
from sysid.judging.assessment import RecordResult
from sysid.problem.metrics import Metrics, mean_known
from sysid.problem.model import Parameter, ProcessModel
from sysid.problem.ranges import Range
from sysid.uncertainty import Ambiguity, Estimate, Profile, Uncertainty

_STRONG = 0.95  # correlation above which two parameters are named together


def show(result: Identified, path: Path) -> None:
    """Tables and sentences on standard output; path: of the parameters that were written."""
    console.print_line()
    _show_parameters(result)
    for name, guess in result.estimator.guesses_.items():
        console.print_text(f"{name} searched as the data suggest: {guess.source}.")
    if result.uncertainty is not None:
        _show_open_questions(result.uncertainty)
    _show_profiles(result.profiles)
    _show_metrics(result)
    _show_residuals(result)
    _show_notes(result)
    console.print_line(f"Parameters: {path}")


def show_next(result: Identified, path: Path) -> None:
    """What to do with the parameters that were written to a file."""
    columns = f" --config {result.columns_file}" if result.columns_file is not None else ""
    log = (*result.validation_logs, *result.training_logs)[0].path
    console.print_next(f"rig replay {log} --parameters {path}{columns}")


def _show_parameters(result: Identified) -> None:
    head = ["parameter", "value", "95 % interval", "unit", "searched in", "from", ""]
    rows = [_parameter_row(result, p) for p in result.model.parameters]
    # Ranges that all come from the model need no column that says so.
    hidden = set() if result.sources else {head.index("from")}
    if result.uncertainty is None:
        hidden.add(head.index("95 % interval"))
    kept = [i for i in range(len(head)) if i not in hidden]
    console.print_table(
        f"Parameters of {result.model.name}",
        [head[i] for i in kept],
        [[row[i] for i in kept] for row in rows],
        text=["unit", "from", ""],
    )


def _parameter_row(result: Identified, parameter: Parameter) -> list[str]:
    name, space = parameter.name, result.estimator.space_
    # All of a row in the same unit, which is that of its value.
    scale, unit = console.engineering(result.estimator.parameters_[name], parameter.unit)
    value = scale * result.estimator.parameters_[name]
    source = "data" if name in result.estimator.guesses_ else result.source(name)
    if name not in space.names:
        how = f"= {result.settings.tied[name]}" if name in result.settings.tied else "fixed"
        return [name, console.number(value), "", unit, how, source, ""]
    searched = space.parameters[space.names.index(name)]
    span = _span(searched, result.settings.ranges.get(name), scale)
    estimate = result.estimate(name)
    if estimate is None:
        note = NOTES["bound" if result.on_bound(name) else ""]
        return [name, console.number(value), "", unit, span, source, note]
    digits = _digits(estimate)
    return [
        name, console.number(value, digits), _interval_text(estimate, scale), unit, span, source,
        NOTES[estimate.why],
    ]  # fmt: skip


def _span(parameter: Parameter, given: Range | None, scale: float) -> str:
    """A range; in brackets an end that is only where the search starts."""
    ends = (parameter.lower, parameter.upper)
    bounds = zip(ends, given or ends, strict=True)
    return " .. ".join(
        f"({scale * end:g})" if bound is None else f"{scale * end:g}" for end, bound in bounds
    )


def _digits(estimate: Estimate) -> int:
    """As many as the uncertainty supports; few where there is no telling."""
    return notation.digits(estimate.value, estimate.std)


def _interval_text(estimate: Estimate, scale: float) -> str:
    if estimate.why:
        return "-"
    assert estimate.low is not None and estimate.high is not None
    digits = _digits(estimate)
    ends = (console.number(scale * end, digits) for end in (estimate.low, estimate.high))
    return " .. ".join(ends)


def _show_open_questions(found: Uncertainty) -> None:
    """What the data do not tell, what they tell instead, and what measurement would."""
    _show_rivals(found)
    exact = [a for a in found.ambiguities if a.kind in ("product", "sum")]
    if exact:
        console.print_line("What these data cannot tell apart:")
    for ambiguity in exact:
        for line in _exact_lines(ambiguity):
            console.print_text(line)
    vague = [a for a in found.ambiguities if a.kind == "vague"]
    if vague:
        names = "; ".join(" with ".join(a.parameters) for a in vague)
        console.print_text(f"Hardly felt by these data: {names}.")
    close = _close_pairs(found)
    if close:
        console.print_text(f"Known mostly together (correlation above {_STRONG:g}): "
                           f"{'; '.join(close)}.")  # fmt: skip
    if exact or vague or close:
        console.print_line()


def _show_rivals(found: Uncertainty) -> None:
    """Other minima that explain the data as well."""
    for ambiguity in found.ambiguities:
        if ambiguity.kind != "rival":
            continue
        here = {estimate.name: estimate for estimate in found.parameters}
        console.print_table(
            "Sets of parameters that explain these data alike",
            ["parameter", "this one", *["another"] * len(found.rivals), "unit"],
            [_rival_row(here[name], found.rivals) for name in ambiguity.parameters],
            text=["unit"],
        )
        console.print_text(
            f"A measured {ambiguity.measure[0]}, given under 'fixed', would tell which it is."
        )
        console.print_line()


def _rival_row(here: Estimate, rivals: Sequence[Mapping[str, float]]) -> list[str]:
    """One parameter in each of the sets, all in the unit of the first."""
    scale, unit = console.engineering(here.value, here.unit)
    values = (here.value, *(rival[here.name] for rival in rivals))
    return [here.name, *(console.number(scale * value, 3) for value in values), unit]


def _exact_lines(ambiguity: Ambiguity) -> list[str]:
    lines = [f"  {', '.join(ambiguity.parameters)} act only together."]
    for estimate in ambiguity.determined:
        scale, unit = console.engineering(estimate.value, estimate.unit)
        value = console.number(scale * estimate.value, _digits(estimate))
        quantity = value if unit in {"", "1"} else f"{value} {unit}"
        interval = _interval_text(estimate, scale)
        lines.append(f"    {estimate.name} = {quantity}, 95 % interval {interval}")
    lines.append(
        f"    To tell them apart, measure {' and '.join(ambiguity.measure)} by other means (or "
        "choose a value) and give it under 'fixed'."
    )
    return lines


def _close_pairs(found: Uncertainty) -> list[str]:
    own = [j for j, p in enumerate(found.parameters) if not p.why]
    correlation = found.correlation()
    return [
        f"{found.parameters[i].name} and {found.parameters[j].name}"
        for i, j in itertools.combinations(own, 2)
        if abs(correlation[i, j]) > _STRONG
    ]


def _show_profiles(profiles: Sequence[Profile]) -> None:
    if not profiles:
        return
    console.print_table(
        "Profile likelihood",
        ["parameter", "value", "95 % interval", "unit"],
        [
            [one.name, console.number(one.value), " .. ".join(map(_end, (one.low, one.high))),
             one.unit]
            for one in profiles
        ],
        text=["unit"],
    )  # fmt: skip


def _end(value: float | None) -> str:
    """An end of an interval; the data set none where the profile stays low."""
    return "open" if value is None else console.number(value)


def _show_metrics(result: Identified) -> None:
    model, training, validation = result.model, result.training, result.validation
    if len(training) == 1 and len(validation) <= 1:
        print_metrics(model, training[0].metrics, [record.metrics for record in validation])
        return
    _print_logs("Training logs", model, training)
    if validation:
        _print_logs("Validation logs", model, validation)


def _show_residuals(result: Identified) -> None:
    """Residual tests on the validation data, or else on the training data."""
    records, part = (result.validation, "validation") if result.validation else (
        result.training, "training",
    )  # fmt: skip
    model = result.model
    tested = [i for i in range(len(model.inputs)) if any(r.residuals.tested[i] for r in records)]
    head = ["residual of", "with itself", *(f"with {model.input_names[i]}" for i in tested)]
    rows = []
    for j, name in enumerate(model.output_names):
        white = float(np.mean([r.residuals.white[j] for r in records]))
        shares = np.array([[r.residuals.independent[j, i] for i in tested] for r in records])
        own = mean_known(shares, 0)
        rows.append([name, *(f"{100.0 * share:.0f} %" for share in (white, *own))])
    console.print_table(
        f"Residuals, {part}: share of correlations inside their 95 % band", head, rows
    )


def _show_notes(result: Identified) -> None:
    estimator = result.estimator
    if estimator.stopped_ == "interrupted":
        console.print_text(
            f"Stopped by Ctrl-C after {len(estimator.history_)} generations: "
            "these are the best parameters until then."
        )
    if any(result.on_bound(name) for name in estimator.space_.names):
        console.print_text(
            "At the end of its range: the data want more room there. Set 'ranges' in a file "
            "given with --config."
        )
    verdict = result.verdict
    console.print_text(f"Trust: {verdict.trust}. {' '.join(verdict.reasons)}")
    if (found := result.uncertainty) is not None:
        free = [e for e in found.parameters if e.name in result.model.parameter_names]
        own = sum(not estimate.why for estimate in free)
        together = sum(len(a.determined) for a in found.ambiguities)
        several = "s" if together != 1 else ""
        also = f", and {together} combination{several} of others" if together else ""
        console.print_text(f"Determined: {own} of {len(free)} free parameters by themselves{also}.")


def print_metrics(
    model: ProcessModel, training: Metrics, validation: list[Metrics], label: str = "training"
) -> None:
    """Table of RMSE, MSD and fit of each output, on one log or on two."""
    head = ["output", f"RMSE, {label}", "MSD", "fit [%]"]
    if validation:
        head += ["RMSE, validation", "MSD", "fit [%]"]
    rows = []
    for j, name in enumerate(model.output_names):
        row = [name]
        for metrics in (training, *validation):
            row += [
                console.number(float(metrics.rmse[j]), 3),
                console.number(float(metrics.msd[j]), 2),
                f"{metrics.fit[j]:.1f}",
            ]
        rows.append(row)
    console.print_table("Free-run simulation, RMSE and MSD in parts of max|y|", head, rows)


def _print_logs(title: str, model: ProcessModel, records: Sequence[RecordResult]) -> None:
    head = ["log", *(f"fit of {name} [%]" for name in model.output_names)]
    head += [f"RMSE of {name}" for name in model.output_names]
    rows = [
        [
            record.name,
            *(f"{value:.1f}" for value in record.metrics.fit),
            *(console.number(float(value), 3) for value in record.metrics.rmse),
        ]
        for record in records
    ]
    fits = mean_known(np.array([record.metrics.fit for record in records]), 0)
    errors = mean_known(np.array([record.metrics.rmse for record in records]), 0)
    rows.append(
        ["mean", *(f"{v:.1f}" for v in fits), *(console.number(float(v), 3) for v in errors)]
    )
    console.print_table(title, head, rows)
