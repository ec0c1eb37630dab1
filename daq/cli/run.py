"""``rig run``: an experiment on a rig, and the identification from it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from daq.cli import options, terminal
from daq.cli.interrupt import heeded
from daq.errors import ConfigError, RigError, Terminated, together

if TYPE_CHECKING:
    from daq.identification.settings import Problem
    from daq.lookup.experiments import LoadedExperiment
    from daq.progress import Watch
    from daq.recording.session import Session, SessionResult


def run(
    experiments: options.ExperimentNames,
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
    """Run experiments on a rig and log every sample.

    Of several all are checked before the first is run; what stops a run stops those behind it.
    """
    from daq.cli.analyse import next_commands
    from daq.designs.files import COMMANDS

    with terminal.watching(json) as watch:
        files = options.experiment_files(experiments)
        if identify and len(files) > 1:
            cure = "run them without it, and then rig identify with all runs"
            several = "it identifies from one experiment and its validation run"
            raise ConfigError(several, cure=cure, key="--identify")
        sessions = together(
            *(partial(_session, f, rig, port, realtime, note, watch) for f in files)
        )
        session = sessions[0]
        # A mistake in the model must show before the rig moves.
        problem = _problem(config, model, session.loaded, watch) if identify else None
        if len(files) > 1:
            again = options.rig_words(rig, port) + f" --out {shlex.quote(str(out))}"
            results = _record_each(sessions, files, out, again, watch)
        else:
            results = [session.record(out, validation=identify, watch=watch)]
    behind = options.next_of_design(files, out)
    if len(results) > 1:
        _finish(results, behind, json)
        return
    result = results[0]
    document = _document(result)
    if not json:
        _show(result)
        if not session.plan.excites:
            _show_rest(result.run.folder, options.rig_words(rig, port))
        elif not identify:
            commands = Path(files[0]).with_name(COMMANDS)
            if not behind and commands.exists():
                terminal.print_text(
                    f"It is a run of a design, whose runs are identified together: {commands}"
                )
            terminal.print_next(*(behind or next_commands(result.run.folder)))
    if problem is not None:
        if result.validation is None and not json:
            path = session.loaded.file.path
            terminal.report(
                "note", f"{path} has no 'validation' section, so there is no validation run"
            )
        document["identification"] = _identify(problem, result, report, json)
    if json:
        terminal.print_json(document)


def _session(
    experiment: str,
    rig: str | None,
    port: str | None,
    realtime: bool,
    notes: list[str] | None,
    watch: Watch,
) -> Session:
    from daq.recording.session import open_session

    return open_session(experiment, rig, port, realtime, watch=watch).noting(notes or [])


def _record_each(
    sessions: Sequence[Session], files: Sequence[str], out: Path, words: str, watch: Watch
) -> list[SessionResult]:
    """Run one after the other; what stops a run is told with the command for the rest."""
    results: list[SessionResult] = []
    try:
        for session in sessions:
            results.append(session.record(out, validation=False, watch=watch))
    except (KeyboardInterrupt, Terminated, RigError) as stop:
        n = len(results)
        rest = f"rig run {shlex.join(files[n:])}{words}"
        stop.add_note(f"{n} of {len(files)} runs were completed; go on with: {rest}")
        raise
    return results


def _finish(results: Sequence[SessionResult], behind: Sequence[str], json: bool) -> None:
    """Show several runs, and what serves after them."""
    if json:
        terminal.print_json({"runs": [_document(result) for result in results]})
        return
    for result in results:
        _show(result)
    folders = [str(result.run.folder) for result in results]
    terminal.print_next(*(behind or [f"rig identify {shlex.join(folders)}"]))


def _problem(
    config: Path | None, model: str | None, loaded: LoadedExperiment, watch: Watch
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
