"""From configuration and command line to a checked model and its search settings."""

from __future__ import annotations

from collections.abc import Mapping as MappingType
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.cli import terminal as console
from daq.cli.models import DEFAULT_MODEL, find_model, whole_name
from daq.config import checking, yaml_file
from daq.config.identification import IdentificationConfig, Signals
from daq.config.yaml_file import TypedSettings, YamlFile
from daq.errors import ConfigError, suggestion
from daq.identification import datasheets
from daq.identification import records as datasets
from daq.identification.quantities import in_model_units
from daq.identification.records import Mapping
from daq.identification.request import Asked
from sysid import ModelError, SearchSpace
from sysid.problem.model import ProcessModel


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
    written = yaml_file.load(config) if config is not None else None
    if written is not None:
        checking.refuse_other_kind(written, "an identification's settings")
    file = TypedSettings.of(given, more, written)
    found = _find_all(config, file, names)
    file, wrong = in_model_units(file, [model for model, _ in found])
    settings = checking.validate(file, IdentificationConfig, others=wrong)
    for model, name in found:
        console.report_detail(f"model {name}: {model.description}")
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


def _find_all(
    config: Path | None, file: TypedSettings, names: Sequence[str | None]
) -> list[tuple[ProcessModel, str]]:
    """Models and their whole names; when one is not found, the file's other mistakes as well."""
    try:
        return [_find(config, file, name) for name in names]
    except ConfigError as error:
        if error.key == "model":
            checking.validate(file, IdentificationConfig, others=error.mistakes)
        raise


def _find(config: Path | None, file: TypedSettings, typed: str | None) -> tuple[ProcessModel, str]:
    """A model and its whole name, from the command line or else the configuration."""
    given = file.content.get("model")
    if given is not None and not isinstance(given, str):
        checking.validate(file, IdentificationConfig)
    # A name on the command line is relative to where it is typed, one in a file to that file.
    if typed is None and "model" in file.typed:
        typed = given
    beside = config.parent if config is not None and typed is None else None
    name = typed or given or DEFAULT_MODEL
    try:
        return find_model(name, beside), whole_name(name, beside)
    except ConfigError as error:
        if beside is None or given is None:
            raise
        raise ConfigError.of(file.blamed(("model",), error)) from None


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
    config: Path | None, file: TypedSettings, settings: IdentificationConfig
) -> list[Path]:
    """Typed names are relative to where they are typed, those in a file to that file."""
    beside = config.parent if config is not None and "datasheet" not in file.typed else Path()
    return [beside / name for name in settings.datasheet]


def _range_sources(file: TypedSettings) -> dict[str, str]:
    """Where the range or value of each parameter was given, for those not left to the model."""
    found = {}
    for group in ("ranges", "fixed", "tied"):
        for name in file.content.get(group) or {}:
            found[str(name)] = file.line((group, str(name)))
    return found


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
