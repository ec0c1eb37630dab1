"""Identification of one parameter set from logs."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from daq.config import yaml_file
from daq.errors import ConfigError, Terminated
from daq.files import stamp
from daq.identification import records, request
from daq.identification.foreign import ColumnMapping
from daq.identification.placement import placement_faults
from daq.identification.records import LoggedRecord, Split
from daq.identification.request import PARAMETERS, SettingsRequest
from daq.identification.result import FittedLog, Identification, filter_noise, least_noise
from daq.identification.selection import EVERYTHING, Selection
from daq.identification.settings import Problem, gassi_settings, problem_of
from daq.logs.capture import LOG_NAME, VALIDATION
from daq.logs.recording import Recording, log_path
from daq.lookup.models import trust_option
from daq.progress import Note, Progress, Watch, ignore, warn
from sysid import EarlierMinima, ModelError, ProcessModel
from sysid.judging.lags import lag_faults
from sysid.judging.plausibility import implausible, start_faults
from sysid.problem.copies import shared_samples
from sysid.problem.data import require_information
from sysid.problem.faults import DataFault, Part, after_explaining, after_mending, data_faults

if TYPE_CHECKING:
    import pandas as pd

    from daq.identification.draft import Draft, Tests
    from daq.identification.earlier_fit import EarlierFit
    from sysid.gassi import GASSI
    from sysid.gassi import Progress as SearchProgress
    from sysid.uncertainty import Uncertainty

    Source = str | Path | Recording | pd.DataFrame

_COPY = 0.99  # of a log's samples that stand in another as well

_STAGES = {
    "search": ("Genetic search", "generation"),
    "refine": ("Local refinement", "generation"),
    "weigh": ("Weighing by noise", "iteration"),
}


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
    >>> result = identify(run, preset="thesis", generations=2, fixed={"R_m": 1.2})
    >>> result.parameters.loc["R_m", "value"]
    np.float64(1.2)
    >>> result.trust in ("good", "limited", "poor")
    True
    """
    typed = [f"{key}={json.dumps(value)}" for key, value in settings.items()]
    file = None if config is None else str(config)
    training, validation = _as_sources(logs), _as_sources(validate)
    request = SettingsRequest(file, {"model": model}, typed)
    problem = problem_of(request, watch, logs=_paths([*training, *validation]))
    return fit(problem, training, validation, None, watch)


def identify_files(
    logs: Sequence[Path],
    validate: Sequence[Path],
    settings: SettingsRequest,
    out: Path | None,
    watch: Watch = ignore,
    draft: Draft | None = None,
) -> Identification:
    """Identify and write the results into ``out``, or else beside the log.

    draft: as of ``fit``. Raises ConfigError before anything is computed, with cause and cure.
    """
    problem = problem_of(settings, watch, logs=[*logs, *validate])
    folder = out or default_folder(logs, problem.model.name)
    check_writable(folder)
    tell_replaced(folder / PARAMETERS, watch)
    return fit(problem, logs, validate, folder, watch, draft=draft)


def resume(
    folder: str | Path,
    watch: Watch = ignore,
    *,
    trust: bool = False,
    draft: Draft | None = None,
) -> Identification:
    """Continue an identification that was interrupted, as it was requested.

    folder: of its results, or the capture folder above. trust: run the Python file of a model that
    the request names. draft: as of ``fit``. Raises ConfigError without such a one.

    >>> resume("runs")
    Traceback (most recent call last):
    daq.errors.ConfigError: runs: no identification was interrupted there; name the folder ...
    """
    place, settings, training, validation = request.recall(Path(folder))
    problem = problem_of(settings, watch, record=None if trust else place / request.FILE)
    return fit(problem, training, validation, place, watch, resume=True, draft=draft)


def fit(
    problem: Problem,
    training: Sequence[Source],
    validation: Sequence[Source],
    folder: Path | None = None,
    watch: Watch = ignore,
    resume: bool = False,
    examine: Callable[[Identification], bool] = lambda result: True,
    draft: Draft | None = None,
    earlier: EarlierFit | None = None,
) -> Identification:
    """Fit a problem that has been checked to logs.

    folder: for ``parameters.yaml``, and while the search runs for what it takes to continue it.
    resume: continue from there. examine: whether what the model may lack is to be tested, which
    may take longer than the fit. draft: what else can be done meanwhile. earlier: where some of the
    logs have led; if these left nothing open, nothing is searched for unless all of them disagree,
    and a search begins there as well. Raises ConfigError.
    """
    train, check = load_logs(problem, training, validation)
    warn(watch, *(log.warning for log in (*train, *check)))
    for log in (*train, *check):
        if log.preparation is not None:
            watch(Note("note", f"{log.path}: {'; '.join(log.preparation.steps)}"))
    train, ends = records.hold_back(train, problem.settings.hold_back)
    _require_information(problem, train)
    logs = train, [*ends, *check]
    _tell_validation_runs(train, check, watch)
    if draft is not None:
        draft.begin(problem, logs)
    faults = faults_of(problem, logs)
    for fault in faults:
        watch(Note("warning" if fault.severity == "doubt" else "note", fault.sentence))
    if folder is not None and not resume:
        request.remember(folder, problem.request, _paths(training), _paths(validation))
    try:
        result, missing = None, None
        minima = None if earlier is None else replace(earlier.minima, is_settled=False)
        if earlier is not None and earlier.minima.is_settled and not resume:
            result, minima = _beside(earlier, problem, logs, folder, watch, faults)
        if result is None:
            estimator = _searched(problem, train, folder, watch, resume, minima)
            problem = problem.starting(estimator.estimated_starts_)
            tell_starts(estimator.estimated_starts_, watch)
            datasets = [log.dataset for log in train]
            missing = draft.score_tests(problem, estimator, datasets) if draft is not None else None
            result = assemble(problem, estimator, logs, folder, watch, faults)
        if examine(result):
            result = examined(result, logs, watch, missing)
    except (KeyboardInterrupt, Terminated) as stop:
        if folder is not None and (folder / request.CHECKPOINT).exists():
            command = request.resume_command(folder) + trust_option(problem.model_name)
            stop.add_note(f"the search so far is kept; go on with: {command}")
        raise
    if folder is not None:
        result.save(folder)
        if not result.interrupted:
            request.forget(folder)
    return result


def _beside(
    earlier: EarlierFit,
    problem: Problem,
    logs: Split,
    folder: Path | None,
    watch: Watch,
    faults: tuple[DataFault, ...],
) -> tuple[Identification | None, EarlierMinima]:
    """The minimum of all logs beside that of some, and where a search for another one begins.

    None where it is not the right one; then the search begins there as well.
    """
    minima = replace(earlier.minima, is_settled=False)
    with contextlib.suppress(ConfigError):  # a simulation that fails there
        estimator = _searched(problem, logs[0], None, watch, False, earlier.minima)
        interrupted = estimator.stopped_ == "interrupted"
        noise = filter_noise(estimator), least_noise(estimator)
        minima = EarlierMinima([estimator.parameters_, *minima.values], noise[0] or minima.noise)
        if interrupted or earlier.explains(estimator.parameters_, *noise):
            problem = problem.starting(estimator.estimated_starts_)
            tell_starts(estimator.estimated_starts_, watch)
            result = assemble(problem, estimator, logs, folder, watch, faults)
            if interrupted or earlier.agrees(result):
                return result, minima
    watch(Note("note", "the logs together want other parameters than before: a search begins"))
    return None, minima


def tell_starts(names: Iterable[str], watch: Watch) -> None:
    """Tell of which states a fit has estimated the starts by itself."""
    for name in names:
        text = (
            f"where {name} starts is estimated, as the noise of its first sample would move "
            f"parameters; --set initial.{name}=first keeps it there"
        )
        watch(Note("note", text))


def _tell_validation_runs(
    train: Sequence[LoggedRecord], check: Sequence[LoggedRecord], watch: Watch
) -> None:
    """Tell which of the logs were recorded to validate by, where they are fitted as well."""
    names = [log.dataset.name for log in train if log.of_a_rig]
    names = [name for name in names if name.endswith(VALIDATION)]
    if names and not check:
        text = f"{', '.join(names)}: recorded to validate by, and fitted as well"
        watch(Note("note", f"{text}; --validate RUN keeps a run out of the fit"))


def _require_information(problem: Problem, train: Sequence[LoggedRecord]) -> None:
    """Raise ConfigError, before anything is written, for logs that determine nothing."""
    names, n_free = problem.model.output_names, len(problem.space.names)
    try:
        require_information([log.dataset for log in train], names, n_free)
    except ModelError as error:
        raise ConfigError(str(error), file=train[0].path) from None


def load_logs(problem: Problem, training: Sequence[Source], validation: Sequence[Source]) -> Split:
    """Records for training and for validation; ConfigError for none, and when one is given twice.

    That is also what has the samples of another log under a name of its own.
    """
    if not training:
        cure = "name a run's folder, a CSV file, a recording or a table"
        raise ConfigError("no log is given to train on", cure=cure)
    train = _records(training, "training", problem)
    check = _records(validation, "validation", problem)
    problem.selection.check_names([log.path for log in (*train, *check)])
    paths = {log.path.resolve() for log in train}
    for log in check:
        if log.path.resolve() in paths:
            twice = "the same log is given for training and for validation"
            raise ConfigError(twice, cure=_UNSEEN, file=log.path)
    _refuse_copies(train, check)
    return train, check


_UNSEEN = "a model proves itself only on data it has not seen"


def _refuse_copies(train: Sequence[LoggedRecord], check: Sequence[LoggedRecord]) -> None:
    """Raise ConfigError for a log that has the samples of an earlier one, or of training."""
    logs = [*train, *check]
    shares = shared_samples([log.dataset for log in logs]) if len(logs) > 1 else np.zeros((1, 1))
    for i, log in enumerate(logs):
        is_validation = i >= len(train)
        earlier = shares[i, : len(train) if is_validation else i]
        if np.max(earlier, initial=0.0) < _COPY:
            continue
        source = logs[int(np.argmax(earlier))]
        held = "for training" if is_validation else "already"
        raise ConfigError(
            f"its samples are those of {source.path}, which is given {held}",
            cure=_UNSEEN if is_validation else "leave one out: twice the same tells nothing more",
            file=log.path,
        )


def default_folder(logs: Sequence[Path], model: str) -> Path:
    """Beside a single capture's log; otherwise a new folder under runs/."""
    first = log_path(logs[0])
    # A folder without a log.csv stands for the CSVs in it, and is no place for results.
    if len(logs) == 1 and first.name == LOG_NAME and first.exists():
        return first.parent / "identification"
    return Path("runs") / f"{stamp()}-identify-{model}" / "identification"


def check_writable(folder: Path) -> None:
    """Raise ConfigError now, not after a long search, when results could not be written."""
    there = next((path for path in (folder, *folder.absolute().parents) if path.exists()), folder)
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        reason = "permission denied" if there.is_dir() else f"{there} is not a folder"
        cure = "choose a folder with --out"
        raise ConfigError(f"cannot be created: {reason}", cure=cure, file=folder)


def tell_replaced(file: Path, watch: Watch) -> None:
    """Tell of the result or comparison that a file holds, if any, before another replaces it."""
    if not file.exists():
        return
    try:
        content = yaml_file.load(file).content
        logs = content.get("training", (content.get("metrics") or {}).get("training")) or ()
        count = f" of {len(logs)} log{'s' * (len(logs) != 1)}"
    except (AttributeError, TypeError, ConfigError):
        content, count = {}, ""
    kind = "comparison" if "structures" in content else "result"
    model = f" with {content['model']}" if content.get("model") else ""
    written = datetime.datetime.fromtimestamp(file.stat().st_mtime, datetime.UTC)
    text = f"this replaces the {kind}{count}{model}, written {written:%Y-%m-%d %H:%M} UTC"
    watch(Note("note", f"{file}: {text}; --out DIR keeps it"))


def faults_of(problem: Problem, logs: Split) -> tuple[DataFault, ...]:
    """What is wrong with the data of logs for training and for validation, as they were read."""
    model = problem.model
    faults = data_faults(model, *[[log.unmended for log in part] for part in logs])
    if problem.selection.robust:
        faults = after_mending(faults, model)
    units: list[DataFault] = []
    parts: tuple[Part, ...] = ("training", "validation")
    for part, records_of_part in zip(parts, logs, strict=True):
        if not records_of_part:
            continue
        units += placement_faults(model, records_of_part, part)
        datasets = [log.dataset for log in records_of_part]
        try:
            units += implausible(model, problem.space, datasets, part)
            units += start_faults(model, datasets, part)
        except ModelError as error:
            raise ConfigError(str(error)) from None
    late = lag_faults(model, [log.dataset for log in logs[0]])
    return (*units, *late, *faults)


def assemble(
    problem: Problem,
    estimator: GASSI,
    logs: Split,
    folder: Path | None,
    watch: Watch,
    faults: tuple[DataFault, ...] | None = None,
) -> Identification:
    """A fitted estimator with its intervals and profiles, and how it does on every log.

    faults: of the logs, where they have been looked for.
    """
    datasets = [log.dataset for log in logs[0]]
    uncertainty = None
    if estimator.is_refined_:
        watch(Progress("Intervals", 0, 1, "what the data determine"))
        uncertainty = estimator.uncertainty(datasets)
        watch(Progress("Intervals", 1, 1, "what the data determine"))
    profiles, names = [], problem.settings.profile if estimator.is_refined_ else []
    for k, name in enumerate(names):
        watch(Progress("Profiles", k, len(names), f"of {name}"))
        profiles.append(estimator.profile(name, datasets))
        watch(Progress("Profiles", k + 1, len(names), f"of {name}"))
    training, validation = ([_fitted(log, estimator, uncertainty) for log in part] for part in logs)
    faults = faults_of(problem, logs) if faults is None else faults
    runs = [(fitted.log.dataset, fitted.run, fitted.result.evened) for fitted in training]
    faults = after_explaining(faults, problem.model, "training", runs)
    parts = profiles, training, validation, folder
    return Identification(problem, estimator, uncertainty, *parts, faults=faults)


def examined(
    result: Identification, logs: Split, watch: Watch, missing: Tests | None = None
) -> Identification:
    """With what the model may lack tested, and the surest variant fitted.

    missing: as of ``suspected``.
    """
    from sysid.judging.examination import suspected

    watch(Progress("Verdict", 0, 1, "what the model may lack"))
    training, validation = ([log.dataset for log in part] for part in logs)
    runs = [fitted.run for fitted in result.training]
    suspicion = suspected(result.estimator, result.uncertainty, training, validation, missing, runs)
    watch(Progress("Verdict", 1, 1, "what the model may lack"))
    return replace(result, suspicion=suspicion)


def take(
    source: Source,
    name: str,
    model: ProcessModel,
    mapping: ColumnMapping | None,
    selection: Selection = EVERYTHING,
) -> LoggedRecord:
    """A record from whatever holds one; name: of a table, which has none of its own."""
    if isinstance(source, str | Path):
        return records.load(Path(source), model, mapping, selection)
    if mapping is not None:
        raise ConfigError(
            "its 'columns' are those of files",
            cure="rename a table's columns to the model's signals instead, and leave them out",
            file=mapping.file.path,
        )
    try:
        if isinstance(source, Recording):
            return records.from_recording(source, model, selection)
        return records.from_frame(source, name, model, selection)
    except ModelError as error:
        raise ConfigError(str(error), file=name) from None


def _fitted(log: LoggedRecord, estimator: GASSI, uncertainty: Uncertainty | None) -> FittedLog:
    from sysid.judging.examination import examined

    return FittedLog(log, *examined(estimator, log.dataset, uncertainty))


def _searched(
    problem: Problem,
    train: Sequence[LoggedRecord],
    folder: Path | None,
    watch: Watch,
    resume: bool,
    earlier: EarlierMinima | None,
) -> GASSI:
    from sysid.gassi import GASSI

    def report(step: SearchProgress) -> None:
        activity, unit = _STAGES[step.stage]
        # Of weighing nobody knows how long it takes, nor does the search's error tell.
        progress = f"/{step.total}, best error {step.error:.3g}" if step.stage != "weigh" else ""
        status = f"{unit} {step.done}{progress}"
        watch(Progress(activity, step.done, step.total, status))

    checkpoint = folder / request.CHECKPOINT if folder is not None else None
    try:
        estimator = GASSI(problem.model, **gassi_settings(problem))
        datasets = [log.dataset for log in train]
        return estimator.fit(
            datasets,
            on_progress=report,
            checkpoint=checkpoint,
            resume=checkpoint if resume else None,
            earlier=earlier,
        )
    except ModelError as error:
        if folder is not None and not resume:
            request.forget(folder)
        raise ConfigError(str(error)) from None


def _records(sources: Sequence[Source], name: str, problem: Problem) -> list[LoggedRecord]:
    logs: list[Source] = []
    for source in sources:
        logs += records.expand(Path(source)) if isinstance(source, str | Path) else [source]
    several = len(logs) != 1
    return [
        take(
            log,
            f"{name} {k}" if several else name,
            problem.model,
            problem.mapping,
            problem.selection,
        )
        for k, log in enumerate(logs, 1)
    ]


def _as_sources(given: Source | Sequence[Source]) -> list[Source]:
    """One source or several, however nested, as a list."""
    if isinstance(given, list | tuple):
        return [source for item in given for source in _as_sources(item)]
    return [cast("Source", given)]


def _paths(sources: Sequence[Source]) -> list[Path]:
    """Files that sources were read from."""
    files = [s.path if isinstance(s, Recording) else s for s in sources]
    return [Path(file) for file in files if isinstance(file, str | Path)]
