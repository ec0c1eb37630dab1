"""Identification of one parameter set from logs."""

from __future__ import annotations

import dataclasses
import datetime
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from daq.errors import ConfigError
from daq.identification import records, request
from daq.identification.records import ColumnMapping, LoggedRecord
from daq.identification.request import SettingsRequest
from daq.identification.result import FittedLog, Identification
from daq.identification.settings import Problem, gassi_settings, problem_of
from daq.logs.capture import LOG_NAME
from daq.logs.recording import Recording, log_path
from daq.progress import Progress, Watch, ignore, warn
from sysid import Dataset, ModelError, ProcessModel
from sysid.gassi import GASSI, PRESETS
from sysid.gassi import Progress as SearchProgress
from sysid.judging.assessment import examine
from sysid.uncertainty import Profile

if TYPE_CHECKING:
    import pandas as pd

    Source = str | Path | Recording | pd.DataFrame

_STAGES = {
    "search": ("Genetic search", "generation"),
    "refine": ("Local refinement", "generation"),
    "weigh": ("Weighing by noise", "iteration"),
}


@dataclass(frozen=True)
class IdentificationRequest:
    """One parameter set wanted from logs.

    logs, validate: run folders, CSV files, folders of them, recordings, or tables with a column
    ``t`` [s] and one for each of the model's signals. out: the folder for results. save: write
    them, into ``out`` or else beside the log.
    """

    logs: Sequence[Source]
    validate: Sequence[Source] = ()
    settings: SettingsRequest = field(default_factory=SettingsRequest)
    out: Path | None = None
    save: bool = False


def identify(
    logs: Source | Sequence[Source],
    validate: Source | Sequence[Source] = (),
    model: str | None = None,
    config: str | Path | None = None,
    *,
    watch: Watch = ignore,
    **settings: Any,
) -> Identification:
    """One parameter set from logs, as ``rig identify`` finds it.

    logs, validate: run folders, CSV files, recordings, or tables with a column ``t`` [s] and one
    for each of the model's inputs and outputs. model: a name or ``file.py:object``. config: a file
    of settings; settings: keys of such a file. Raises ConfigError with cause and cure.

    >>> from daq import identify, record
    >>> run = record("prbs.yaml")
    >>> result = identify(run, population=16, generations=2, fixed={"R_m": 1.2})
    >>> result.parameters.loc["R_m", "value"]
    np.float64(1.2)
    >>> result.trust in ("good", "limited", "poor")
    True
    """
    return identify_request(
        IdentificationRequest(
            _as_sources(logs),
            _as_sources(validate),
            SettingsRequest(
                None if config is None else str(config),
                {"model": model},
                [f"{key}={json.dumps(value)}" for key, value in settings.items()],
            ),
        ),
        watch,
    )


def identify_request(wanted: IdentificationRequest, watch: Watch = ignore) -> Identification:
    """Identify as requested; ConfigError before anything is computed, with cause and cure."""
    problem = problem_of(wanted.settings, watch)
    folder = None
    if wanted.save:
        folder = wanted.out or default_folder(_paths(wanted.logs), problem.model.name)
        check_writable(folder)
    return fit(problem, wanted.logs, wanted.validate, folder, watch)


def resume(folder: str | Path, watch: Watch = ignore) -> Identification:
    """Continue an identification that was interrupted, as it was requested.

    folder: of its results, or the capture folder above. Raises ConfigError without such a one.

    >>> resume("runs")
    Traceback (most recent call last):
    daq.errors.ConfigError: runs: no identification was interrupted there; name the folder ...
    """
    interrupted = request.recall(Path(folder))
    problem = problem_of(interrupted.settings, watch)
    logs = interrupted.training, interrupted.validation
    return fit(problem, *logs, interrupted.folder, watch, resume=True)


def fit(
    problem: Problem,
    training: Sequence[Source],
    validation: Sequence[Source],
    folder: Path | None = None,
    watch: Watch = ignore,
    resume: bool = False,
) -> Identification:
    """Fit a problem that has been checked to logs.

    folder: for ``parameters.yaml``, and while the search runs for what it takes to continue it.
    resume: continue from there. Raises ConfigError.
    """
    train, check = load_logs(problem, training, validation)
    warn(watch, *(log.warning for log in (*train, *check)))
    train, ends = records.hold_back(train, problem.settings.hold_back)
    if folder is not None and not resume:
        request.remember(folder, problem.request, _paths(training), _paths(validation))
    estimator = _searched(problem, train, folder, watch, resume)
    result = assemble(problem, estimator, train, [*ends, *check], watch)
    if folder is None:
        return result
    result = dataclasses.replace(result, folder=folder)
    result.save(folder)
    if not result.interrupted:
        request.forget(folder)
    return result


def load_logs(
    problem: Problem, training: Sequence[Source], validation: Sequence[Source]
) -> tuple[list[LoggedRecord], list[LoggedRecord]]:
    """Records for training and for validation; ConfigError when a log is given for both."""
    train = _records(training, "training", problem)
    check = _records(validation, "validation", problem)
    paths = {log.path.resolve() for log in train}
    for log in check:
        if log.path.resolve() in paths:
            raise ConfigError(
                "the same log is given for training and for validation",
                cure="a model proves itself only on data it has not seen",
                file=log.path,
            )
    return train, check


def default_folder(logs: Sequence[Path], model: str) -> Path:
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
    raise ConfigError(
        f"cannot be created: {reason}", cure="choose a folder with --out", file=folder
    )


def assemble(
    problem: Problem,
    estimator: GASSI,
    train: Sequence[LoggedRecord],
    check: Sequence[LoggedRecord],
    watch: Watch = ignore,
) -> Identification:
    """A fitted estimator with its intervals and profiles, and how it does on every log."""
    datasets = [log.dataset for log in train]
    refined = PRESETS[estimator.preset].refine and estimator.stopped_ != "interrupted"
    return Identification(
        problem=problem,
        estimator=estimator,
        uncertainty=estimator.uncertainty(datasets) if refined else None,
        profiles=_profiles(problem, estimator, datasets, watch) if refined else [],
        training=[_fitted(log, estimator) for log in train],
        validation=[_fitted(log, estimator) for log in check],
    )


def take(
    source: Source, name: str, model: ProcessModel, mapping: ColumnMapping | None
) -> LoggedRecord:
    """A record from whatever holds one; name: of a table, which has none of its own."""
    if isinstance(source, str | Path):
        return records.load(Path(source), model, mapping)
    if mapping is not None:
        raise ConfigError(
            "its 'columns' are those of files",
            cure="rename a table's columns to the model's signals instead, and leave them out",
            file=mapping.file.path,
        )
    try:
        if isinstance(source, Recording):
            return records.from_recording(source, model)
        return records.from_frame(source, name, model)
    except ModelError as error:
        raise ConfigError(str(error), file=name) from None


def _fitted(log: LoggedRecord, estimator: GASSI) -> FittedLog:
    run = estimator.predict(log.dataset)
    (result,) = examine([log.dataset], lambda record: run)
    return FittedLog(log, run, result)


def _searched(
    problem: Problem, train: Sequence[LoggedRecord], folder: Path | None, watch: Watch, resume: bool
) -> GASSI:
    def report(step: SearchProgress) -> None:
        activity, unit = _STAGES[step.stage]
        status = f"{unit} {step.done}/{step.total}, best error {step.error:.3g}"
        watch(Progress(activity, step.done, step.total, status))

    checkpoint = request.checkpoint(folder) if folder is not None else None
    try:
        estimator = GASSI(problem.model, **gassi_settings(problem.settings))
        return estimator.fit(
            [log.dataset for log in train],
            on_progress=report,
            checkpoint=checkpoint,
            resume=checkpoint if resume else None,
        )
    except ModelError as error:
        if folder is not None and not resume:
            request.forget(folder)
        raise ConfigError(str(error)) from None


def _profiles(
    problem: Problem, estimator: GASSI, datasets: list[Dataset], watch: Watch
) -> list[Profile]:
    names = problem.settings.profile
    profiles = []
    for k, name in enumerate(names):
        watch(Progress("Profiles", k, len(names), f"of {name}"))
        profiles.append(estimator.profile(name, datasets))
        watch(Progress("Profiles", k + 1, len(names), f"of {name}"))
    return profiles


def _records(sources: Sequence[Source], name: str, problem: Problem) -> list[LoggedRecord]:
    logs = _expanded(sources)
    labels = [f"{name} {k}" for k in range(1, len(logs) + 1)] if len(logs) != 1 else [name]
    return [
        take(log, label, problem.model, problem.mapping)
        for log, label in zip(logs, labels, strict=True)
    ]


def _expanded(sources: Sequence[Source]) -> list[Source]:
    """Each log by itself; a folder without a log.csv stands for the CSVs in it."""
    logs: list[Source] = []
    for source in sources:
        logs += records.expand([Path(source)]) if isinstance(source, str | Path) else [source]
    return logs


def _as_sources(given: Source | Sequence[Source]) -> list[Source]:
    """One source or several, however nested, as a list."""
    if isinstance(given, list | tuple):
        return [source for item in given for source in _as_sources(item)]
    return [cast("Source", given)]


def _paths(sources: Sequence[Source]) -> list[Path]:
    """Files that sources were read from."""
    return [
        source.path if isinstance(source, Recording) else Path(source)
        for source in sources
        if isinstance(source, str | Path | Recording)
    ]
