"""``rig identify``: from logs to parameters, metrics and files."""

from __future__ import annotations

import datetime
import os
import re
from collections.abc import Mapping as MappingType
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from daq import capture
from daq.cli import console, datasets, datasheets, reporting, resuming
from daq.cli.datasets import Loaded, Mapping
from daq.cli.modelling import DEFAULT_MODEL, find_model, whole_name
from daq.cli.reporting import Identified
from daq.cli.resuming import Asked
from daq.config import yaml_file
from daq.config.identification import IdentificationConfig, Signals
from daq.config.yaml_file import CommandLine, YamlFile, suggestion
from daq.errors import ConfigError
from sysid import Dataset, ModelError, SearchSpace
from sysid.assessment import examine
from sysid.gassi import GASSI, PRESETS, Progress
from sysid.model import ProcessModel
from sysid.uncertainty import Profile

_STAGES = {
    "search": ("Genetic search", "generation"),
    "refine": ("Local refinement", "generation"),
    "weigh": ("Weighing by noise", "iteration"),
}


@dataclass(frozen=True)
class Prepared:
    """Settings of an identification, checked before any log is read or rig moved.

    sources: where each parameter's range or value stands that is not the model's own. asked:
    what all this was made from.
    """

    model: ProcessModel
    model_name: str
    settings: IdentificationConfig
    mapping: Mapping | None
    sources: MappingType[str, str]
    asked: Asked


def identify_command(
    logs: list[Path],
    validate: list[Path],
    config: Path | None,
    out: Path | None,
    options: MappingType[str, Any],
    settings: list[str],
    as_json: bool,
) -> None:
    """Identify one parameter set from logs and print it."""
    prepared = prepare(config, options, settings)
    folder = out or default_folder(logs, prepared.model.name)
    check_writable(folder)
    report = identify_logs(prepared, logs, validate, folder, as_json)
    if as_json:
        console.print_json(report)


def resume_command(folder: Path, as_json: bool) -> None:
    """Go on with an identification that was interrupted, and print it."""
    folder, request = resuming.recall(folder)
    asked = request.asked
    config = Path(asked.config) if asked.config is not None else None
    prepared = prepare(config, asked.options, asked.settings)
    report = identify_logs(
        prepared, request.training, request.validation, folder, as_json, resume=True
    )
    if as_json:
        console.print_json(report)


def prepare(
    config: Path | None, options: MappingType[str, Any], more: Sequence[str] = ()
) -> Prepared:
    """Read and check settings and model; ConfigError names file, line, key and cure.

    options: by name, None for those not given. more: any setting as ``key=value``.
    """
    return prepare_models(config, options, [options.get("model")], more)[0]


def prepare_models(
    config: Path | None,
    options: MappingType[str, Any],
    names: Sequence[str | None],
    more: Sequence[str] = (),
) -> list[Prepared]:
    """The same settings for each of several models.

    Each takes the ranges, fixed values and the like that it has a name for; names that none has
    are mistakes.
    """
    given = {key: value for key, value in options.items() if value is not None}
    file = CommandLine.of(given, more, yaml_file.load(config) if config is not None else None)
    settings = yaml_file.validate(file, IdentificationConfig)
    if settings.preset not in PRESETS:
        raise file.error(
            ("preset",), f"unknown preset {settings.preset!r}; "
            f"{suggestion(settings.preset, list(PRESETS))}"
        )  # fmt: skip
    found = [_find(config, file, settings, name) for name in names]
    models = [_with_outputs(file, settings, model) for model, _ in found]
    _check_names(file, settings, models)
    mapping = Mapping(file, settings.columns) if settings.columns else None
    spare = {
        "inputs": _all_names(models, "input_names"),
        "outputs": tuple(
            n for model, _ in found for n in (*model.output_names, *model.state_names)
        ),
    }
    sheets = [datasheets.load(path) for path in _datasheets(config, file, settings)]
    datasheets.check_names(sheets, models)
    prepared = []
    for (_, name), model in zip(found, models, strict=True):
        own, sources = datasheets.under(_own_settings(settings, model), sheets, model)
        _check_space(file, own, model)
        if mapping is not None:
            datasets.check_mapping(model, mapping, spare)
        used = _with_starts(file, own, model)
        if own.guess and model.guesses is None:
            raise file.error(("guess",), f"model {model.name} has no 'guesses' function that "
                             "reads ranges from logs; leave this out")  # fmt: skip
        asked = Asked.of(config, options, more, name)
        all_sources = sources | _range_sources(file)
        prepared.append(Prepared(used, name, own, mapping, all_sources, asked))
    return prepared


def as_told(file: YamlFile, signals: Signals, model: ProcessModel) -> ProcessModel:
    """The model with outputs, starts and holds as a file has them; ConfigError names the key."""
    return _with_starts(file, signals, _with_outputs(file, signals, model))


def gassi_settings(settings: IdentificationConfig) -> dict[str, Any]:
    """Arguments of ``GASSI``, all but the model."""
    return {
        "preset": settings.preset,
        "population": settings.population,
        "generations": settings.generations,
        "ranges": settings.ranges,
        "fixed": settings.fixed,
        "tied": settings.tied,
        "scale": settings.scale,
        "guess": settings.guess,
        "elite_percent": settings.elite_percent,
        "weights": settings.weights or None,
        "per_log": settings.per_log,
        "balance": settings.balance,
        "criterion": settings.criterion,
        "accuracy": settings.accuracy,
        "max_steps": settings.max_steps,
        "random_state": settings.seed,
    }


def _find(
    config: Path | None, file: CommandLine, settings: IdentificationConfig, typed: str | None
) -> tuple[ProcessModel, str]:
    """A model and its whole name, from the command line or else the configuration."""
    # A name on the command line is relative to where it is typed, one in a file to that file.
    if typed is None and "model" in file.typed:
        typed = settings.model
    beside = config.parent if config is not None and typed is None else None
    name = typed or settings.model or DEFAULT_MODEL
    try:
        return find_model(name, beside), whole_name(name, beside)
    except ConfigError as error:
        if beside is None or settings.model is None:
            raise
        raise file.error(("model",), str(error)) from None


def _with_outputs(file: YamlFile, signals: Signals, model: ProcessModel) -> ProcessModel:
    if not signals.outputs:
        return model
    try:
        return model.with_outputs(signals.outputs)
    except ModelError as error:
        raise file.error(("outputs",), str(error)) from None


def _with_starts(file: YamlFile, signals: Signals, model: ProcessModel) -> ProcessModel:
    for name, start in signals.initial.items():
        try:
            model = model.with_initial({name: start})
        except ModelError as error:
            raise file.error(("initial", name), str(error)) from None
    try:
        return model.with_holds(signals.hold)
    except ModelError as error:
        raise file.error(("hold",), str(error)) from None


def _datasheets(
    config: Path | None, file: CommandLine, settings: IdentificationConfig
) -> list[Path]:
    """Typed names are relative to where they are typed, those in a file to that file."""
    beside = config.parent if config is not None and "datasheet" not in file.typed else Path()
    return [beside / name for name in settings.datasheet]


def _range_sources(file: CommandLine) -> dict[str, str]:
    """Where the range or value of each parameter was given, for those not left to the model."""
    found = {}
    for group in ("ranges", "fixed", "tied"):
        for name in file.content.get(group) or {}:
            # Without the column: the line is what one looks for.
            found[str(name)] = re.sub(r"(:\d+):\d+$", r"\1", file.where((group, str(name))))
    return found


def identify_logs(
    prepared: Prepared,
    training: list[Path],
    validation: list[Path],
    folder: Path,
    as_json: bool,
    resume: bool = False,
) -> dict[str, Any]:
    """Identify, print for people unless ``as_json``, write files; the report for machines.

    resume: go on from the checkpoint in the folder.
    """
    train, check = load_logs(prepared, training, validation)
    for log in (*train, *check):
        if log.warning is not None:
            console.report_note(log.warning)
    train, ends = datasets.hold_back(train, prepared.settings.hold_back)
    check = [*ends, *check]
    if not resume:
        resuming.remember(folder, prepared.asked, training, validation)
    estimator = _fit(prepared, train, folder, as_json, resume)
    result = assemble(prepared, estimator, train, check, as_json)
    report = reporting.document(result)
    path = write_parameters(folder, report)
    report["files"] = {"parameters": str(path)}
    if not as_json:
        reporting.show(result, path)
    if estimator.stopped_ != "interrupted":
        resuming.forget(folder)
    elif as_json:
        report["search"]["resume"] = resuming.command(folder)
    else:
        console.print_line(f"Go on with the search: {resuming.command(folder)}")
    return report


def _check_names(
    file: YamlFile, settings: IdentificationConfig, models: Sequence[ProcessModel]
) -> None:
    names = " or ".join(dict.fromkeys(model.name for model in models))
    parameters, outputs = _all_names(models, "parameter_names"), _all_names(models, "output_names")
    groups: tuple[tuple[str, dict[str, Any], tuple[str, ...]], ...] = (
        ("ranges", settings.ranges, parameters),
        ("fixed", settings.fixed, parameters),
        ("tied", settings.tied, parameters),
        ("scale", settings.scale, parameters),
        ("weights", settings.weights, outputs),
        ("initial", settings.initial, _all_names(models, "state_names")),
        ("hold", settings.hold, _all_names(models, "input_names")),
        ("profile", dict.fromkeys(settings.profile), parameters),
    )
    for group, given, known in groups:
        for name in given:
            if name not in known:
                hint = f"model {names} has no such name; {suggestion(name, known)}"
                if isinstance(file.content.get(group), dict):
                    raise file.error((group, name), hint)
                raise file.error((group,), f"{name}: {hint}")  # a list has no keys of its own


def _all_names(models: Sequence[ProcessModel], kind: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for model in models for name in getattr(model, kind)))


def _own_settings(settings: IdentificationConfig, model: ProcessModel) -> IdentificationConfig:
    """The settings without what is meant for other models."""
    known = dict.fromkeys(("ranges", "fixed", "tied", "scale"), model.parameter_names)
    known |= {"weights": model.output_names, "initial": model.state_names}
    known["hold"] = model.input_names
    own = {
        group: {name: value for name, value in getattr(settings, group).items() if name in names}
        for group, names in known.items()
    }
    return settings.model_copy(update=own)


def _check_space(file: YamlFile, settings: IdentificationConfig, model: ProcessModel) -> None:
    ranges, fixed, tied, scale = (
        settings.ranges, settings.fixed, settings.tied, settings.scale,
    )  # fmt: skip
    # One parameter at a time first, so that the message can point at it.
    for name in ranges:
        _try_space(file, ("ranges", name), model, {name: ranges[name]})
    for name in scale:
        own = {name: ranges[name]} if name in ranges else {}
        if name not in fixed and name not in tied:
            _try_space(file, ("scale", name), model, own, scale={name: scale[name]})
    for name in tied:
        _try_space(file, ("tied", name), model, tied={name: tied[name]})
    groups = ("tied", "fixed", "scale", "ranges")
    group = next((key for key in groups if file.content.get(key)), "ranges")
    space = _try_space(file, (group,), model, ranges, fixed, tied=tied, scale=scale)
    for name in settings.profile:
        if name not in space.names:
            raise file.error(
                ("profile",), f"{name} is not searched, so it has no profile; free it by a range"
            )


def _try_space(file: YamlFile, key: tuple[str, ...], *args: Any, **more: Any) -> SearchSpace:
    """A search space; ConfigError at the key that makes none."""
    try:
        return SearchSpace.of(*args, **more)
    except ModelError as error:
        raise file.error(key, str(error)) from None


def load_logs(
    prepared: Prepared, training: list[Path], validation: list[Path]
) -> tuple[list[Loaded], list[Loaded]]:
    """Logs for training and for validation; ConfigError when one is given for both."""

    def loaded(paths: list[Path]) -> list[Loaded]:
        return [
            datasets.load(path, prepared.model, prepared.mapping) for path in datasets.expand(paths)
        ]

    train, check = loaded(training), loaded(validation)
    _no_overlap(train, check)
    return train, check


def _no_overlap(train: list[Loaded], check: list[Loaded]) -> None:
    known = {log.path.resolve() for log in train}
    for log in check:
        if log.path.resolve() in known:
            raise ConfigError(
                f"{log.path}: the same log is given for training and for validation; "
                "a model proves itself only on data it has not seen"
            )


def default_folder(logs: list[Path], model: str) -> Path:
    """Beside a single capture's log; otherwise a new folder under runs/."""
    first = capture.log_path(logs[0])
    # A folder without a log.csv stands for the CSVs in it, and is no place for results.
    if len(logs) == 1 and first.name == capture.LOG_NAME and first.exists():
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
    records = [log.dataset for log in train]
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
        training=examine(records, estimator.predict),
        validation=examine([log.dataset for log in check], estimator.predict),
        training_paths=[log.path for log in train],
        validation_paths=[log.path for log in check],
    )


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
    capture.make_folder(folder)
    path = folder / "parameters.yaml"
    text = yaml.safe_dump(report, sort_keys=False, allow_unicode=True)
    capture.write_whole(path, text)
    return path
