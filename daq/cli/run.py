"""``rig run``: an experiment on a rig, and the identification from it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from daq.cli import options, terminal
from daq.cli.interrupt import heeded

if TYPE_CHECKING:
    from daq.identification.settings import Problem
    from daq.lookup.experiments import LoadedExperiment
    from daq.recording.session import SessionResult


def run(
    experiment: options.ExperimentName,
    rig: options.RigOfRun = None,
    port: options.PortName = None,
    out: options.RunsFolder = Path("runs"),
    identify: Annotated[
        bool, Option("--identify", help="Record a validation run as well, then identify the model.")
    ] = False,
    model: options.ModelName = None,
    config: options.ConfigFile = None,
    note: options.Notes = None,
    realtime: Annotated[
        bool, Option("--realtime", help="Keep a simulated rig at the pace of the clock.")
    ] = False,
    report: options.WithReport = True,
    json: options.AsJson = False,
) -> None:
    """Run an experiment on a rig and log every sample."""
    from daq.cli.analyse import next_commands
    from daq.recording.session import open_session

    with terminal.watching(json) as watch:
        session = open_session(experiment, rig, port, realtime, watch=watch).noting(note or [])
        # A mistake in the model must show before the rig moves.
        problem = _problem(config, model, session.loaded, watch) if identify else None
        result = session.record(out, validation=identify, watch=watch)
    document = _document(result)
    if not json:
        _show(result)
        if not session.plan.excites:
            _show_rest(result.run.folder, options.rig_words(rig, port))
        elif not identify:
            terminal.print_next(*next_commands(result.run.folder))
    if problem is not None:
        if result.validation is None and not json:
            path = session.loaded.file.path
            terminal.report(
                "note", f"{path} has no 'validation' section, so there is no validation run"
            )
        document["identification"] = _identify(problem, result, report, json)
    if json:
        terminal.print_json(document)


def _problem(
    config: Path | None, model: str | None, loaded: LoadedExperiment, watch: Any
) -> Problem:
    from daq.config import yaml_file
    from daq.identification.request import SettingsRequest
    from daq.identification.settings import problem_of

    if model is None and (config is None or "model" not in yaml_file.load(config).content):
        model = _intended_model(loaded)
    file = None if config is None else str(config)
    return problem_of(SettingsRequest(file, {"model": model}), watch)


def _intended_model(loaded: LoadedExperiment) -> str | None:
    """Whole name of the model that the experiment is for; ConfigError names file and line."""
    from daq.errors import ConfigError
    from daq.lookup.models import find_model, whole_name

    name, file = loaded.experiment.model, loaded.file
    if not name:
        return None
    try:
        find_model(name, file.path.parent)
    except ConfigError as error:
        raise ConfigError.of(file.blamed(("model",), error)) from None
    return whole_name(name, file.path.parent)


def _identify(problem: Problem, result: SessionResult, report: bool, json: bool) -> dict[str, Any]:
    from daq.cli.identification import drafting, show_identification
    from daq.identification.fit import fit

    validation = [result.validation.folder] if result.validation is not None else []
    folder = result.run.folder / "identification"
    with drafting(report) as draft:
        with terminal.watching(json) as watch, heeded():
            runs = [result.run.folder]
            identification = fit(problem, runs, validation, folder, watch, draft=draft)
        return show_identification(identification, report, json, draft=draft)


def _document(result: SessionResult) -> dict[str, Any]:
    from daq.recording.analysis import Analysis

    document: dict[str, Any] = {
        "run": result.run.document,
        "validation": None if result.validation is None else result.validation.document,
        "warnings": result.doubts,
    }
    if result.findings is not None:
        document["findings"] = Analysis(result.run.folder, result.findings).document
    return document


def _show_rest(folder: Path, on_rig: str) -> None:
    """What the sensors read at zero command, by the calibration, and what may follow on the rig."""
    from daq.logs.capture import LOG_NAME, read_record
    from daq.logs.columns import UNITS
    from daq.lookup.starter import FIRST_EXPERIMENTS
    from daq.notation import quantity

    record = read_record(folder / LOG_NAME) or {}
    offsets, noise = record["offsets"], record["calibration"]["noise"]
    rows = [[k, *(quantity(x[k], UNITS[k]) for x in (offsets, noise))] for k in noise]
    terminal.print_table("Sensors at zero command", ["sensor", "offset", "noise"], rows)
    first = f"rig run {FIRST_EXPERIMENTS[1]}.yaml{on_rig}"
    terminal.print_next(first, purpose="If the sensors should read this, the first commands:")


def _show(result: SessionResult) -> None:
    from daq.cli.analyse import show_findings
    from daq.diagnose import punctuality

    if result.findings is not None:
        show_findings(result.findings, result.run.folder)
    for label, run in (("Log", result.run), ("Validation log", result.validation)):
        if run is None:
            continue
        flags = run.timing["flagged_samples"].items()
        flagged = f"; flagged: {', '.join(f'{count} {name}' for name, count in flags)}"
        samples = f"{run.n_samples} samples{flagged if flags else ''}"
        print(f"{label}: {run.folder / 'log.csv'} ({samples})")
        line = punctuality.summary_line(run)
        if line is not None:
            terminal.print_text(line)
        for note in punctuality.notes(run):
            terminal.report("note", note)
    for doubt in result.doubts:
        terminal.report("warning", doubt)
