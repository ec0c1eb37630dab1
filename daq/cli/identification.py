"""Output of an identification: tables and sentences on a terminal, a document for machines."""

from __future__ import annotations

import contextlib
import itertools
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from daq import notation
from daq.cli import terminal

if TYPE_CHECKING:
    from daq.identification.comparison import ComparisonResult, SeedsResult
    from daq.identification.draft import Draft
    from daq.identification.result import Identification
    from daq.identification.rows import (
        OutputErrors,
        ParameterRow,
        QuantityRow,
        RivalRow,
        Rows,
        StartRow,
    )
    from sysid import Campaign
    from sysid.judging.comparison import Comparison, Row
    from sysid.uncertainty import Profile

_COLOURED = 0.8  # share with itself inside the band, below which residuals are called coloured
_STRONG = 0.95  # correlation above which two parameters are named together


def show_identification(
    result: Identification,
    report: bool,
    json: bool,
    seeds: Sequence[str] = (),
    draft: Draft | None = None,
) -> dict[str, Any]:
    """Print a result whose files are written, and publish its report; the document for machines.

    seeds: lines on all seeds of the search, of which this result is the best. draft: what was begun
    of the report.
    """
    document = {**result.document, "files": {"parameters": str(result.parameters_file)}}
    if not json:
        _show(result)
        for line in seeds:
            terminal.print_text(line)
    if result.interrupted:
        if json:
            document["search"] = {**document["search"], "resume": result.resume_command}
            return document
        print(f"Go on with the search: {result.resume_command}")
        return document
    if report:
        document["files"] |= _publish(result, json, draft)
    if not json:
        _show_next(result)
    return document


@contextlib.contextmanager
def drafting(report: bool) -> Iterator[Draft]:
    """What a second process does meanwhile, of a report as well where that is wanted."""
    from daq.second_process import SecondProcess

    with SecondProcess() as second:
        from daq.identification.draft import Draft  # while that begins

        yield Draft(second, report)


def _publish(result: Identification, json: bool, draft: Draft | None) -> dict[str, str]:
    # Imports matplotlib, for which the printed result does not wait.
    from daq.report.publication import publish

    assert result.folder is not None
    with terminal.watching(json) as watch:
        files = publish(result, result.folder, watch, draft)
    if not json:
        print(f"Report: {files['report']}")
    return files


def _show(result: Identification) -> None:
    """Tables and sentences on standard output."""
    rows = result.rows
    print()
    _show_parameters(result)
    for name, guess in result.estimator.guesses_.items():
        terminal.print_text(f"{name} searched as the data suggest: {guess.source}.")
    if rows.refined:
        _show_open_questions(rows)
    for assumption in result.model.assumptions:
        terminal.print_text(assumption)
        print()
    _show_profiles(result.profiles)
    _show_errors(rows)
    _show_residuals(rows, any(log.log.dataset.input_noise.any() for log in result.training))
    _show_notes(result)
    print(f"Parameters: {result.parameters_file}")


def _show_next(result: Identification) -> None:
    from daq.identification.request import set_options

    step = result.next_step
    mapping = result.problem.mapping
    log = (*result.validation, *result.training)[0].log.path
    words = ["rig", "replay", str(log), "--parameters", str(result.parameters_file)]
    words += ["--config", str(mapping.file.path)] if mapping is not None else []
    replay = f"{shlex.join(words)}{set_options(result.problem.reading)}{result.trust_option}"
    if step is None:
        terminal.print_next(replay)
    else:
        terminal.print_next(step.command, replay, purpose=step.purpose)


def _show_parameters(result: Identification) -> None:
    head = ["parameter", "value", "95 % interval", "unit", "searched in", "from", ""]
    rows = [_parameter_row(result, row) for row in result.rows.parameters]
    shown = [True] * len(head)
    shown[head.index("95 % interval")] = result.rows.refined
    # Ranges that all come from the model need no column that says so.
    shown[head.index("from")] = any(row.source != "model" for row in result.rows.parameters)
    head, *rows = (list(itertools.compress(cells, shown)) for cells in (head, *rows))
    title = f"Parameters of {result.title}"
    terminal.print_table(title, head, rows, text=["unit", "from", ""])


def _parameter_row(result: Identification, row: ParameterRow) -> list[str]:
    # One unit for the whole row, chosen by its value.
    scale, unit = row.engineering
    source = "data" if row.name in result.estimator.guesses_ else row.source
    value = row.text(row.value, scale)
    if row.range is None:
        return [row.name, value, "", unit, row.held, source, ""]
    span = _span(row.range, result.problem.settings.ranges.get(row.name), scale)
    interval = row.span(scale) if result.rows.refined else ""
    return [row.name, value, interval, unit, span, source, row.label]


def _span(
    ends: tuple[float, float], configured: tuple[float | None, float | None] | None, scale: float
) -> str:
    """A range as text; brackets mark an end where the search starts, but which is no bound."""
    bounds = zip(ends, configured or ends, strict=True)
    return " .. ".join(
        f"({notation.shortest(scale * end)})" if bound is None else notation.shortest(scale * end)
        for end, bound in bounds
    )


def _show_open_questions(rows: Rows) -> None:
    """Parameters that the data do not determine, and what measurement would tell them."""
    _show_rivals(rows)
    _show_products(rows)
    strong = [pair for pair, value in rows.correlations.items() if abs(value) > _STRONG]
    if strong:
        pairs = "; ".join(" and ".join(pair) for pair in strong)
        terminal.print_text(f"Known mostly together (correlation above {_STRONG:g}): {pairs}.")
    if rows.ambiguities_of("tied") or strong:
        print()


def _show_rivals(rows: Rows) -> None:
    """Sets of parameters in other minima, which explain the data as well."""
    for ambiguity in rows.ambiguities_of("rival"):
        table = [_rival_row(rows.parameter(name), rows.rivals) for name in ambiguity.parameters]
        head = ["parameter", "this one", *["another"] * len(rows.rivals), "unit"]
        title = "Sets of parameters that explain these data alike"
        terminal.print_table(title, head, table, text=["unit"])
        terminal.print_text(
            f"A measured {ambiguity.measure[0]}, given under 'fixed', would tell which it is."
        )
        print()


def _rival_row(row: ParameterRow, rivals: Sequence[RivalRow]) -> list[str]:
    """One parameter in this result and in each rival, all in the unit of the first."""
    scale, unit = row.engineering
    answers = [(row.value, row.here or (None, None))]
    answers += [(r.values[row.name], r.intervals.get(row.name, (None, None))) for r in rivals]
    cells = [row.text(value, scale) for value, _ in answers]
    for k, (_, ends) in enumerate(answers):
        low, high = ("" if end is None else row.text(end, scale) for end in ends)
        interval = f"{low} .. {high}" if low and high else f"< {high}" if high else f"> {low}"
        cells[k] += f" ({interval})" if low or high else " (no interval)"
    return [row.name, *cells, unit]


def _show_products(rows: Rows) -> None:
    """Products and sums that the data determine, of parameters that they do not."""
    from daq.identification.rows import StartRow, by_state

    for index, ambiguity in enumerate(rows.ambiguities_of("tied")):
        if index == 0:
            print("What no data of these outputs can tell apart:")
        names = dict.fromkeys(map(by_state, ambiguity.parameters))
        terminal.print_text(f"  {', '.join(names)} act only together.")
        for row in ambiguity.determined:
            if not row.is_start:
                terminal.print_text(f"    {_determined(row)}")
        for start in StartRow.grouped(row for row in ambiguity.determined if row.is_start):
            alone = len(start.rows) == 1
            terminal.print_text(f"    {_determined(start.rows[0]) if alone else _starts(start)}")
        starts = [name for name in ambiguity.measure if "(0)" in name]
        measure = " and ".join(name for name in ambiguity.measure if name not in starts)
        if measure:
            terminal.print_text(
                f"    To tell them apart, measure {measure} by other means (or choose a value) and "
                "give it under 'fixed'."
            )
        if starts:
            states = " and ".join(dict.fromkeys(name.partition("(")[0] for name in starts))
            terminal.print_text(
                f"    {'Give' if not measure else 'Give also'} the start of {states} under "
                "'initial'."
            )


def _determined(row: QuantityRow) -> str:
    scale, unit = row.engineering
    ends = f"95 % interval {row.span(scale)}" if row.interval else row.undetermined_label
    return f"{row.name} = {notation.with_unit(row.text(row.value, scale), unit)}, {ends}"


def _starts(start: StartRow) -> str:
    """A combination with the starts of several logs, of which parameters.yaml has each."""
    scale, unit = start.rows[0].engineering

    def span(ends: tuple[float, float]) -> str:
        return " .. ".join(start.rows[0].text(end, scale) for end in ends)

    values = notation.with_unit(span(start.values), unit)
    ends = f", 95 % intervals within {span(start.interval)}" if start.interval else ""
    return f"{start.name} = {values} in the {len(start.rows)} logs{ends}"


def _show_profiles(profiles: Sequence[Profile]) -> None:
    from daq.identification.rows import QuantityRow

    rows = []
    for profile in profiles:
        # None where the profile never rises enough: the data set no end on that side.
        ends = profile.low, profile.high
        row = QuantityRow(profile.name, profile.value, profile.unit, ends)
        scale, unit = row.engineering
        rows.append([row.name, row.text(row.value, scale), row.span(scale), unit])
    if rows:
        head = ["parameter", "value", "95 % interval", "unit"]
        terminal.print_table("Profile likelihood", head, rows, text=["unit"])


def _show_errors(rows: Rows) -> None:
    from daq.identification.rows import mean_errors

    training, validation = rows.logs["training"], rows.logs["validation"]
    if len(training) == 1 and len(validation) <= 1:
        print_errors({part: logs[0].outputs for part, logs in rows.logs.items() if logs}, "data")
        return
    for part, logs in rows.logs.items():
        if logs:
            errors = {log.name: log.outputs for log in logs}
            mean = {"mean": mean_errors(logs)} if len(logs) > 1 else {}
            print_errors({**errors, **mean}, f"{part} log")


def _show_residuals(rows: Rows, noisy: bool) -> None:
    """Residual tests on the validation data, or else on the training data.

    noisy: whether an input is known to be measured with noise.
    """
    table = rows.residuals
    head = ["residual of", "with itself", *(f"with {name}" for name in table.inputs)]
    cells = [
        [name, *(f"{100.0 * s:.0f} %" for s in shares)] for name, shares in table.shares.items()
    ]
    title = f"Residuals, {table.part}: share of correlations inside their 95 % band"
    terminal.print_table(title, head, cells)
    coloured = [name for name, (past, *_) in table.shares.items() if past < _COLOURED]
    if coloured:
        cause = "as what the model lacks makes it, or a sensor's own noise"
        if noisy:
            cause = "as noise of a measured input makes it"
        terminal.print_text(
            f"What is left of {' and '.join(coloured)} goes with its own past, {cause}: the "
            "intervals allow for that. Going with an input would speak against the model."
        )


def _show_notes(result: Identification) -> None:
    from daq.identification.rows import start_sentences

    rows = result.rows
    if result.interrupted:
        terminal.print_text(
            f"Stopped by Ctrl-C after {len(result.estimator.history_)} generations: "
            "these are the best parameters so far."
        )
    pushed = [row.name for row in rows.free if row.pushed and not row.at_limit]
    if pushed:
        terminal.print_text(
            f"The data want {', '.join(pushed)} beyond the end of the range: set 'ranges' in a "
            "file given with --config."
        )
    if rows.refined:
        criterion = result.document["criterion"]
        terminal.print_text(f"Criterion: {criterion['name']} ({criterion['reason']}).")
    if excerpt := result.document["search"].get("excerpt"):
        share = f"{excerpt['samples']} of {excerpt['of']} samples"
        parts = f"{share}, in {len(excerpt['parts'])} parts"
        terminal.print_text(
            f"Searched by {parts}, and fitted to all of them; 'search_samples: 0' searches by all."
            if excerpt["fitted_to_all"]
            else f"Fitted to {parts} with which the log is most varied; errors are those of all. "
            "More of them ('search_samples') narrow intervals, and take as much longer."
        )
    for name, how in result.document.get("averaged", {}).items():
        terminal.print_text(f"Output {name}: {how}.")
    print_verdict(result.document["verdict"])
    for line in start_sentences(result.document["metrics"]["validation"]):
        terminal.print_text(line)
    if rows.refined:
        terminal.print_text(rows.determined_sentence)
        for sentence in (rows.together_sentence, rows.disagreement_sentence):
            if sentence:
                terminal.print_text(sentence)


def print_verdict(verdict: Mapping[str, Any]) -> None:
    """Both statements with their reasons, and notes, of a result's document."""
    for subject in ("predictions", "parameters"):
        statement = verdict[subject]
        reasons = " ".join(statement["reasons"])
        terminal.print_text(f"{subject.capitalize()}: {statement['trust']}. {reasons}")
    for note in verdict["notes"]:
        terminal.print_text(note)


def print_errors(errors: Mapping[str, Mapping[str, OutputErrors]], of: str = "") -> None:
    """Table of RMSE, MSD and fit of each output, a line for each log.

    errors: by log, by output. of: what the logs are called, empty of a single one.
    """
    head = ["output", *([of] if of else []), "RMSE", "MSD", "in its unit", "fit [%]"]
    rows = []
    for output in next(iter(errors.values())):
        for place, (log, outputs) in enumerate(errors.items()):
            error = outputs[output]
            cells = [terminal.number(error.rmse, 3), terminal.number(error.msd, 2)]
            cells += [notation.quantity(error.rmse_absolute, error.unit)]
            cells += [notation.percent(error.fit_percent)]
            rows.append(["" if place else output, *([log] if of else []), *cells])
    title = "Free run: RMSE and MSD in parts of max|y|, RMSE in the output's unit, fit"
    terminal.print_table(title, head, rows, text=[of])


def show_comparison(
    result: ComparisonResult | SeedsResult, report: bool, json: bool
) -> dict[str, Any]:
    """Print a comparison and write its page; the document for machines."""
    from daq.identification.comparison import ComparisonResult
    from daq.lookup.models import trust_option

    if not isinstance(result, ComparisonResult):
        return show_identification(result.best, report, json, _runs_lines(result.campaign))
    files: dict[str, Any] = {"comparison": str(result.file)}
    if not json:
        _show_comparison(result)
    if report:
        from daq.report.comparison import publish_comparison  # matplotlib, as for reports

        files["page"] = publish_comparison(result)
        if not json:
            print(f"Page: {files['page']}")
    name = result.comparison.preferred
    if not json and name in result.files:
        parameters = shlex.quote(str(result.files[name]))
        terminal.print_next(f"rig replay LOG --parameters {parameters}{trust_option(name)}")
    return {**result.document, "files": files}


def _show_comparison(result: ComparisonResult) -> None:
    from daq.lookup.models import without_folders

    shown = without_folders([row.name for row in result.comparison.rows])
    comparison = replace(
        result.comparison,
        rows=tuple(replace(row, name=shown[row.name]) for row in result.comparison.rows),
        preferred=shown[result.comparison.preferred],
    )
    print()
    if comparison.validated:
        title = "Validation, free run: RMSE in parts of max|y| (fit in %)"
        head = ["structure", *result.outputs, "squared errors", "95 % interval", ""]
        rows = [_validation_row(row) for row in comparison.rows]
        terminal.print_table(title, head, rows, text=[""])
    _print_in_units(result, comparison)
    head = ["structure", "free parameters", "effective", "mean RMSE", "dAIC", "dBIC"]
    terminal.print_table("Training", head, [_training_row(row) for row in comparison.rows])
    terminal.print_text(
        f"AIC and BIC count {comparison.n_samples} training samples as "
        f"{comparison.n_independent:.0f} independent ones."
    )
    if result.n_left_out:
        terminal.print_text(
            f"All errors here are without the first {result.n_left_out} samples of each log, which "
            "the linear models are given."
        )
    terminal.print_text(comparison.verdict)
    for line in _runs_lines(result.campaign):
        terminal.print_text(line)
    for name, path in result.files.items():
        print(f"Parameters of {shown[name]}: {path}")
    print(f"Comparison: {result.file}")


def _print_in_units(result: ComparisonResult, comparison: Comparison) -> None:
    """RMSE of every structure and output, in validation and in training."""
    outputs = result.group.problem.model.outputs
    rows = []
    for row in comparison.rows:
        tested = [("validation", row.rmse_absolute)] if comparison.validated else []
        for data, values in (*tested, ("training", row.training_rmse_absolute)):
            cells = [terminal.number(value, 3) for value in values.tolist()]
            rows.append(["" if tested and data == "training" else row.name, data, *cells])
    head = ["structure", "data", *(f"{output.name} [{output.unit}]" for output in outputs)]
    terminal.print_table("RMSE of the free run in the outputs' units", head, rows, text=["data"])


def _runs_lines(campaign: Campaign) -> list[str]:
    """Spread over seeds, what failed, and whether Ctrl-C ended it."""
    number = terminal.number
    lines = [
        f"{spread.model}: error of {spread.runs} seeds {number(spread.best)} to "
        f"{number(spread.worst)}, {spread.agreeing} within 1 % of the best."
        for spread in campaign.spread()
        if spread.runs > 1
    ]
    problems = dict.fromkeys(f"{o.run.name}: {o.problem}" for o in campaign.failed)
    lines += [f"Failed: {problem}" for problem in problems]
    if campaign.interrupted:
        lines.append(f"Stopped by Ctrl-C after {len(campaign.outcomes)} runs.")
    return lines


def _validation_row(row: Row) -> list[str]:
    from sysid.judging.comparison import times

    cells = [
        f"{terminal.number(float(rmse), 3)} ({fit:.1f})"
        for rmse, fit in zip(row.rmse, row.fit, strict=True)
    ]
    ratio = row.ratio
    if ratio is None:
        return [row.name, *cells, "", "", row.verdict]
    value, low, high = map(times, (ratio.value, ratio.low, ratio.high))
    return [row.name, *cells, f"x {value}", f"{low} .. {high}", row.verdict]


def _training_row(row: Row) -> list[str]:
    from sysid.judging.comparison import above

    error = terminal.number(row.training_error, 3)
    counts = [str(row.n_free), str(row.n_effective)]
    return [row.name, *counts, error, above(row.daic), above(row.dbic)]
