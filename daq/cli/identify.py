"""``rig identify``: from logs to parameters, metrics and files."""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable, Sequence
from collections.abc import Mapping as MappingType
from pathlib import Path
from typing import Any

import yaml

from daq.cli import identification as reporting
from daq.cli import terminal as console
from daq.errors import ConfigError
from daq.files import make_folder, write_whole
from daq.identification import records as datasets
from daq.identification import request as resuming
from daq.identification.records import Loaded
from daq.identification.result import Identified, document
from daq.identification.settings import Prepared, gassi_settings, prepare
from daq.logs.capture import LOG_NAME
from daq.logs.recording import log_path
from sysid import Dataset, ModelError
from sysid.arrays import FloatArray
from sysid.gassi import GASSI, PRESETS, Progress
from sysid.judging.assessment import examine
from sysid.uncertainty import Profile

_STAGES = {
    "search": ("Genetic search", "generation"),
    "refine": ("Local refinement", "generation"),
    "weigh": ("Weighing by noise", "iteration"),
}


def identify_command(
    logs: list[Path],
    validate: list[Path],
    config: Path | None,
    out: Path | None,
    options: MappingType[str, Any],
    settings: list[str],
    publishing: bool,
    as_json: bool,
) -> None:
    """Identify one parameter set from logs and print it; publishing: write its report as well."""
    prepared = prepare(config, options, settings)
    folder = out or default_folder(logs, prepared.model.name)
    check_writable(folder)
    report = identify_logs(prepared, logs, validate, folder, as_json, publishing=publishing)
    if as_json:
        console.print_json(report)


def resume_command(folder: Path, publishing: bool, as_json: bool) -> None:
    """Go on with an identification that was interrupted, and print it."""
    folder, request = resuming.recall(folder)
    asked = request.asked
    config = Path(asked.config) if asked.config is not None else None
    prepared = prepare(config, asked.options, asked.settings)
    report = identify_logs(
        prepared, request.training, request.validation, folder, as_json, resume=True,
        publishing=publishing,
    )  # fmt: skip
    if as_json:
        console.print_json(report)


def identify_logs(
    prepared: Prepared,
    training: list[Path],
    validation: list[Path],
    folder: Path,
    as_json: bool,
    resume: bool = False,
    publishing: bool = True,
) -> dict[str, Any]:
    """Identify, print for people unless ``as_json``, write files; the report for machines.

    resume: go on from the checkpoint in the folder. publishing: write the report's files too,
    after everything is printed.
    """
    train, check = load_logs(prepared, training, validation)
    for log in (*train, *check):
        if log.warning is not None:
            console.report_warning(log.warning)
    train, ends = datasets.hold_back(train, prepared.settings.hold_back)
    check = [*ends, *check]
    if not resume:
        resuming.remember(folder, prepared.asked, training, validation)
    estimator = _fit(prepared, train, folder, as_json, resume)
    result = assemble(prepared, estimator, train, check, as_json)
    report = document(result)
    path = write_parameters(folder, report)
    report["files"] = {"parameters": str(path)}
    if not as_json:
        reporting.show(result, path)
    if estimator.stopped_ != "interrupted":
        resuming.forget(folder)
        if publishing:
            publish_report(prepared, result, report, folder, as_json)
        if not as_json:
            reporting.show_next(result, path)
    elif as_json:
        report["search"]["resume"] = resuming.command(folder)
    else:
        console.print_line(f"Go on with the search: {resuming.command(folder)}")
    return report


def publish_report(
    prepared: Prepared,
    result: Identified,
    report: dict[str, Any],
    folder: Path,
    as_json: bool,
) -> None:
    """Write the report's files and name them in ``report``."""
    from daq.report.publication import (
        publish,  # matplotlib: the printed result does not wait for it
    )

    report["files"] |= publish(prepared, result, report, folder, as_json)
    if not as_json:
        console.print_line(f"Report: {report['files']['report']}")


def load_logs(
    prepared: Prepared, training: list[Path], validation: list[Path]
) -> tuple[list[Loaded], list[Loaded]]:
    """Logs for training and for validation; ConfigError when one is given for both."""

    def loaded(paths: list[Path]) -> list[Loaded]:
        return [
            datasets.load(path, prepared.model, prepared.mapping) for path in datasets.expand(paths)
        ]

    train, check = loaded(training), loaded(validation)
    refuse_overlap(train, check)
    return train, check


def refuse_overlap(train: list[Loaded], check: list[Loaded]) -> None:
    """Raise ConfigError when a log is given for training and for validation."""
    known = {log.path.resolve() for log in train}
    for log in check:
        if log.path.resolve() in known:
            raise ConfigError(
                f"{log.path}: the same log is given for training and for validation; "
                "a model proves itself only on data it has not seen"
            )


def default_folder(logs: list[Path], model: str) -> Path:
    """Beside a single capture's log; otherwise a new folder under runs/."""
    first = log_path(logs[0])
    # A folder without a log.csv stands for the CSVs in it, and is no place for results.
    if len(logs) == 1 and first.name == LOG_NAME and first.exists():
        return first.parent / "identification"
    now = datetime.datetime.now(datetime.UTC)
    return Path("runs") / f"{now:%Y%m%dT%H%M%SZ}-identify-{model}" / "identification"


def check_writable(folder: Path) -> None:
    """Raise ConfigError now, not after a long search, when results could not be written."""
    there = next((path for path in (folder, *folder.absolute().parents) if path.exists()), folder)
    if not there.is_dir():
        reason = f"{there} is not a folder"
    elif not os.access(there, os.W_OK | os.X_OK):
        reason = "permission denied"
    else:
        return
    raise ConfigError(f"{folder}: cannot be created: {reason}; choose a folder with --out")


def _fit(prepared: Prepared, train: list[Loaded], folder: Path, quiet: bool, resume: bool) -> GASSI:
    checkpoint = resuming.checkpoint(folder)
    estimator = GASSI(prepared.model, **gassi_settings(prepared.settings))
    with console.progress(quiet) as bar:

        def watch(step: Progress) -> None:
            title, unit = _STAGES[step.stage]
            note = f"{unit} {step.done}/{step.total}, best error {step.error:.3g}"
            bar.update(title, step.done, step.total, note)

        try:
            return estimator.fit(
                [log.dataset for log in train],
                on_progress=watch,
                checkpoint=checkpoint,
                resume=checkpoint if resume else None,
            )
        except ModelError as error:
            if not resume:
                resuming.forget(folder)
            raise ConfigError(str(error)) from None


def assemble(
    prepared: Prepared,
    estimator: GASSI,
    train: Sequence[Loaded],
    check: Sequence[Loaded],
    quiet: bool,
) -> Identified:
    """A fitted estimator with its intervals, and how it does on every log."""
    records, held_back = ([log.dataset for log in logs] for logs in (train, check))
    runs, unseen_runs = ([estimator.predict(one) for one in some] for some in (records, held_back))
    refined = PRESETS[estimator.preset].refine and estimator.stopped_ != "interrupted"
    return Identified(
        model=prepared.model,
        model_name=prepared.model_name,
        settings=prepared.settings,
        sources={n: g.source for n, g in estimator.guesses_.items()} | dict(prepared.sources),
        columns_file=Path(prepared.mapping.file.path) if prepared.mapping is not None else None,
        estimator=estimator,
        uncertainty=estimator.uncertainty(records) if refined else None,
        profiles=_profiles(prepared, estimator, records, quiet) if refined else [],
        training=examine(records, _known(records, runs)),
        validation=examine(held_back, _known(held_back, unseen_runs)),
        training_logs=train,
        validation_logs=check,
        training_runs=runs,
        validation_runs=unseen_runs,
    )


def _known(
    records: Sequence[Dataset], runs: Sequence[FloatArray]
) -> Callable[[Dataset], FloatArray]:
    """A function that knows the free run of each record."""
    known = {id(record): run for record, run in zip(records, runs, strict=True)}
    return lambda record: known[id(record)]


def _profiles(
    prepared: Prepared, estimator: GASSI, records: Sequence[Dataset], quiet: bool
) -> list[Profile]:
    wanted = prepared.settings.profile
    found = []
    with console.progress(quiet) as bar:
        for k, name in enumerate(wanted):
            bar.update("Profiles", k, len(wanted), f"of {name}")
            found.append(estimator.profile(name, list(records)))
            bar.update("Profiles", k + 1, len(wanted), f"of {name}")
    return found


def write_parameters(folder: Path, report: dict[str, Any]) -> Path:
    """Write a report as ``parameters.yaml``; ConfigError when the folder cannot be made."""
    make_folder(folder)
    path = folder / "parameters.yaml"
    text = yaml.safe_dump(report, sort_keys=False, allow_unicode=True)
    write_whole(path, text)
    return path
