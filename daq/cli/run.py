"""``rig run``: an experiment on a rig, and the identification from it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.cli import terminal
from daq.cli.options import (
    AsJson,
    ConfigFile,
    ExperimentName,
    ModelName,
    PortName,
    RigOfRun,
    RunsFolder,
    WithReport,
)

if TYPE_CHECKING:
    from daq.identification.settings import Problem
    from daq.recording.session import SessionResult


def run(
    experiment: ExperimentName,
    rig: RigOfRun = None,
    port: PortName = None,
    out: RunsFolder = Path("runs"),
    identify: Annotated[
        bool,
        typer.Option(
            "--identify", help="Record a validation run as well, then identify the model."
        ),
    ] = False,
    model: ModelName = None,
    config: ConfigFile = None,
    realtime: Annotated[
        bool,
        typer.Option("--realtime", help="Keep a simulated rig at the pace of the clock."),
    ] = False,
    report: WithReport = True,
    json: AsJson = False,
) -> None:
    """Run an experiment on a rig and log every sample."""
    from daq.recording.session import open_session

    with terminal.Watching(quiet=json) as watch:
        session = open_session(experiment, rig, port, realtime, watch=watch)
        # A mistake in the model must show before the rig moves.
        problem = _problem(config, model, watch) if identify else None
        result = session.record(out, validation=identify, watch=watch)
    document = _document(result)
    if not json:
        _show(result, identify)
    if problem is not None:
        if result.validation is None and not json:
            terminal.report_note(
                f"{session.loaded.file.path} has no 'validation' section, so there is no "
                "validation run"
            )
        document["identification"] = _identify(problem, result, report, json)
    if json:
        terminal.print_json(document)


def _problem(config: Path | None, model: str | None, watch: Any) -> Problem:
    from daq.identification.request import SettingsRequest
    from daq.identification.settings import problem_of

    file = None if config is None else str(config)
    return problem_of(SettingsRequest(file, {"model": model}), watch)


def _identify(problem: Problem, result: SessionResult, report: bool, json: bool) -> dict[str, Any]:
    from daq.cli.identification import show_identification
    from daq.identification.fit import fit

    validation = [result.validation.folder] if result.validation is not None else []
    folder = result.run.folder / "identification"
    with terminal.Watching(quiet=json) as watch:
        identification = fit(problem, [result.run.folder], validation, folder, watch)
    return show_identification(identification, report, json)


def _document(result: SessionResult) -> dict[str, Any]:
    from daq.recording.analysis import Analysis

    runs = {"run": result.run, "validation": result.validation}
    document: dict[str, Any] = {
        name: None if run is None else run.document for name, run in runs.items()
    }
    document["warnings"] = result.doubts
    if result.findings is not None:
        document["findings"] = Analysis(result.run.folder, result.findings).document
    return document


def _show(result: SessionResult, identified: bool) -> None:
    from daq.cli.analyse import next_commands, show_findings
    from daq.diagnose import punctuality

    if result.findings is not None:
        show_findings(result.findings, result.run.folder)
    for label, run in (("Log", result.run), ("Validation log", result.validation)):
        if run is None:
            continue
        flagged = run.timing["flagged_samples"]
        notes = ", ".join(f"{count} {name}" for name, count in flagged.items())
        terminal.print_line(
            f"{label}: {run.folder / 'log.csv'} ({run.n_samples} samples"
            + (f"; flagged: {notes})" if notes else ")")
        )
        line = punctuality.summary_line(run)
        if line is not None:
            terminal.print_line(line)
        for note in punctuality.notes(run):
            terminal.report_note(note)
    for doubt in result.doubts:
        terminal.report_warning(doubt)
    if not identified:
        terminal.print_next(*next_commands(result.run.folder))
