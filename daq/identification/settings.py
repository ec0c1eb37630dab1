"""From configuration and command line to a checked model and its search settings."""

import dataclasses
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar, get_args

from daq.config import check, yaml_file
from daq.config.identification import IdentificationConfig, Signals, TermSetting
from daq.config.units import converted
from daq.config.yaml_file import Key, TypedSettings, YamlFile
from daq.errors import ConfigError, Mistake, suggestion, together
from daq.identification import datasheets, stages
from daq.identification.foreign import ColumnMapping, check_columns, check_mapping
from daq.identification.records import intended_model
from daq.identification.request import SettingsRequest
from daq.identification.selection import EVERYTHING, KEYS, Selection
from daq.logs.recording import log_path
from daq.lookup.models import DEFAULT_MODEL, find_model, whole_name
from daq.progress import Note, Watch, ignore
from sysid import Given, ModelError, ProcessModel, SearchSpace
from sysid.problem.corrections import Correction, Kind, with_corrections
from sysid.problem.model import InitialValue
from sysid.problem.terms import AddedTerm, with_terms

File = TypeVar("File", bound=YamlFile)

# Settings with a key for each of a model's names, by what these are names of.
_KEYED_BY = {
    **dict.fromkeys(("ranges", "fixed", "tied", "scale"), "parameter_names"),
    "weights": "output_names",
    "initial": "state_names",
    "process_noise": "state_names",
    "hold": "input_names",
}


@dataclass(frozen=True, repr=False)
class Problem:
    """What is to be identified, checked before any log is read or rig moved.

    sources: where each parameter's range or value stands that is not the model's own. request:
    what all this was made from. selection: which samples of its logs count. given: what earlier
    identifications found.
    """

    model: ProcessModel
    model_name: str
    settings: IdentificationConfig
    mapping: ColumnMapping | None
    sources: Mapping[str, str]
    request: SettingsRequest
    selection: Selection = EVERYTHING
    given: Given | None = None

    def __repr__(self) -> str:
        return f"<Problem: parameters of {self.model_name}>"

    @property
    def fixed(self) -> dict[str, float]:
        """Values that are not searched: of the settings, and what earlier identifications found."""
        return {**self.settings.fixed, **(self.given.values if self.given else {})}

    @property
    def space(self) -> SearchSpace:
        """Where the others are searched. Raises ModelError for what contradicts the model."""
        chosen = self.settings
        return SearchSpace.of(
            self.model, chosen.ranges, self.fixed, tied=chosen.tied, scale=chosen.scale
        )

    @property
    def reading(self) -> list[str]:
        """Of what was typed as ``key=value`` all that says how logs are read."""
        keys = ("columns", *KEYS)
        return [s for s in self.request.settings if re.split(r"[.=]", s)[0].strip() in keys]

    def starting(self, estimated: Collection[str]) -> Self:
        """The same with starts of states estimated, as if that had been asked for."""
        if not estimated:
            return self
        starts: dict[str, InitialValue] = dict.fromkeys(estimated, "estimate")
        settings = self.settings.model_copy(update={"initial": {**self.settings.initial, **starts}})
        words = [*self.request.settings, *(f"initial.{name}=estimate" for name in estimated)]
        return dataclasses.replace(
            self,
            model=self.model.with_initial(starts),
            settings=settings,
            request=dataclasses.replace(self.request, settings=words),
        )


def problem_of(
    request: SettingsRequest,
    watch: Watch = ignore,
    record: Path | None = None,
    logs: Sequence[Path] = (),
) -> Problem:
    """Read and check settings and model; ConfigError names file, line, key and cure.

    record: which the request comes from, and whose files of models are not to be run. logs: whose
    columns are looked for as well, and whose experiments name the model where nothing else does.
    """
    return problems_of(request, [request.options.get("model")], watch, record, [logs])[0]


def problems_of(
    request: SettingsRequest,
    names: Sequence[str | None],
    watch: Watch = ignore,
    record: Path | None = None,
    logs_of: Sequence[Sequence[Path]] | None = None,
) -> list[Problem]:
    """The same settings for each of several models, None for that of the settings or its logs.

    Each takes the ranges, fixed values and the like that it has a name for; names that no model
    has are mistakes. logs_of: of each model, as ``logs`` of ``problem_of``.
    """
    config = None if request.config is None else Path(request.config)
    options = {k: value for k, value in request.options.items() if value is not None}
    written = yaml_file.load(config) if config is not None else None
    if written is not None:
        check.refuse_other_kind(written, "an identification's settings")
    file = TypedSettings.of(options, request.settings, written)
    logs_of = logs_of or [()] * len(names)
    declared = _find_models(config, file, names, record, logs_of)
    file, freed = _without_nulls(file, [model for model, _ in declared])
    file, unconverted = in_model_units(file, [model for model, _ in declared])
    plain = [model for model, _ in declared]
    doubts: Sequence[Mistake] = ()
    if check.mistakes(file, IdentificationConfig, file.content):
        fixed = file.content.get("fixed")
        values = fixed if isinstance(fixed, Mapping) else {}
        beyond = [m for model in plain for m in _beyond_limits(file, values, model)]
        doubts = [*unconverted, *_unknown_names(file, plain, before_additions=True), *beyond]
    settings = check.validate(file, IdentificationConfig, others=doubts)
    selection = Selection.under(settings, file)
    for model, name in declared:
        watch(Note("detail", f"model {name}: {model.description}"))

    doubts = [*unconverted]

    def attempt(step: Callable[[], Any], instead: Any) -> Any:
        """What a step returns; its mistakes are told with all others."""
        try:
            return step()
        except ConfigError as error:
            doubts.extend(error.mistakes)
            return instead

    models = attempt(lambda: [_with_additions(file, settings, model) for model in plain], plain)
    doubts += _unknown_names(file, models, before_additions=models is plain)
    mapping = ColumnMapping(file, settings.columns) if settings.columns else None
    signals = [name for m in plain for name in (*m.output_names, *m.state_names)]
    spare = {"inputs": _all_names(models, "input_names"), "outputs": signals}
    attempt(
        lambda: selection.check_channels(
            list(dict.fromkeys([*spare["inputs"], *signals])), _all_names(models, "output_names")
        ),
        None,
    )
    # Typed names are relative to where they are typed, those in a file to that file.
    beside = config.parent if config is not None and "datasheet" not in file.typed else Path()
    sheets = [beside / name for name in settings.datasheet]
    entries = attempt(lambda: datasheets.load(sheets, models), {})
    beside = config.parent if config is not None and "given" not in file.typed else Path()
    results = attempt(lambda: stages.load([beside / name for name in settings.given]), [])

    def problem(model: ProcessModel, name: str, logs: Sequence[Path]) -> Problem:
        given = _restricted(settings, model)
        earlier, sources = stages.under(given, results, model, freed)
        sheet = {n: entry for n, entry in entries.items() if n not in freed or n in given.tied}
        sheet = {n: entry for n, entry in sheet.items() if n not in sources}
        completed, of_sheets = datasheets.under(given, sheet, model)
        sources |= of_sheets
        completed = _with_freed(file, completed, model, freed)
        started, *_ = together(
            lambda: _with_starts(file, completed, model),
            lambda: _check_space(file, completed, model, earlier),
            lambda: None if mapping is None else check_mapping(model, mapping, spare),
            *[partial(_check_columns, model, mapping, selection, log) for log in logs],
            lambda: _check_guesses(file, completed, model),
        )
        sources |= {
            str(parameter): file.line((group, str(parameter)))
            for group in ("ranges", "fixed", "tied")
            for parameter in file.content.get(group) or {}
        }
        origin = request.absolute(name)
        return Problem(started, name, completed, mapping, sources, origin, selection, earlier)

    _, *problems = _in_order(
        partial(check.refuse, doubts),
        *[
            partial(problem, model, name, logs)
            for (_, name), model, logs in zip(declared, models, logs_of, strict=True)
        ],
    )
    return problems


def _check_columns(
    model: ProcessModel, mapping: ColumnMapping | None, selection: Selection, log: Path
) -> None:
    """Raise ConfigError where a log lacks a column; of a folder of logs only its reader knows."""
    path = log_path(log)
    if mapping is not None and path.is_file():
        check_columns(model, mapping, path, selection.merged(path))


def _in_order(*steps: Callable[[], Any]) -> list[Any]:
    """What each step returns; ConfigError with all their mistakes as a file has them."""
    try:
        return together(*steps)
    except ConfigError as error:
        check.refuse(error.mistakes)
        raise


def _check_guesses(file: YamlFile, settings: IdentificationConfig, model: ProcessModel) -> None:
    if settings.guess and model.guesses is None:
        missing = "no 'guesses' function that reads ranges from logs; leave this out"
        raise file.error(("guess",), f"model {model.name} has {missing}")


def in_model_units(file: File, models: Sequence[ProcessModel]) -> tuple[File, list[Mistake]]:
    """The file with plain numbers for ``fixed: {L_m: 0.5 mH}``, and what does not convert."""
    parameters = {p.name: p.unit for model in models for p in model.parameters}
    states = {s.name: s.unit for model in models for s in model.states}
    inputs = {given.name: given.unit for model in models for given in model.inputs}
    outputs = {output.name: output.unit for model in models for output in model.outputs}
    content, mistakes = dict(file.content), []
    for group, units in (
        ("ranges", parameters),
        ("fixed", parameters),
        ("initial", states),
        ("noise", {**states, **inputs, **outputs}),
    ):
        given = content.get(group)
        if not isinstance(given, Mapping):
            continue
        content[group] = numbers = dict(given)
        for name, value in given.items():
            if name not in units:
                continue
            try:
                if isinstance(value, list):
                    numbers[name] = [converted(end, units[name]) for end in value]
                else:
                    numbers[name] = converted(value, units[name])
            except ValueError as error:
                mistakes.append(file.mistake((group, name), f"{error}; found {value!r}"))
                del numbers[name]  # said once
    return dataclasses.replace(file, content=content), mistakes


def _without_nulls(file: File, models: Sequence[ProcessModel]) -> tuple[File, frozenset[str]]:
    """The file without entries that are null, ``fixed.R_m=null``; parameters not to be fixed.

    ConfigError for the name of such an entry that no model has.
    """
    content, mistakes = dict(file.content), []
    for group, kind in _KEYED_BY.items():
        entries, names = content.get(group), _all_names(models, kind)
        if group in content and entries is None:
            content[group] = {}
        if not isinstance(entries, Mapping):
            continue
        for name in entries:
            if entries[name] is None and name not in names:
                cure = suggestion(str(name), names)
                key = group, str(name)
                mistakes.append(file.mistake(key, "the model has no such name", cure))
        content[group] = {name: value for name, value in entries.items() if value is not None}
    check.refuse(mistakes)
    fixed = file.content.get("fixed")
    freed = [n for n, value in fixed.items() if value is None] if isinstance(fixed, Mapping) else []
    return dataclasses.replace(file, content=content), frozenset(freed)


def _with_freed(
    file: YamlFile, settings: IdentificationConfig, model: ProcessModel, freed: frozenset[str]
) -> IdentificationConfig:
    """Settings in which parameters freed by ``null`` that the model fixes have its range."""
    ranges = dict(settings.ranges)
    for parameter in model.parameters:
        name = parameter.name
        if not (parameter.fixed and name in freed) or name in ranges or name in settings.tied:
            continue
        if not parameter.lower < parameter.upper:
            problem = f"model {model.name} fixes {name} and has no range to search it in"
            raise file.error(("fixed", name), problem, f"give one: ranges.{name}=[low, high]")
        ranges[name] = (parameter.lower, parameter.upper)
    return settings.model_copy(update={"ranges": ranges})


def with_signals(file: YamlFile, signals: Signals, model: ProcessModel) -> ProcessModel:
    """The model with outputs, starts and holds as a file has them; ConfigError names the key."""
    return _with_starts(file, signals, _with_additions(file, signals, model))


def reading_of(
    config: Path | None, typed: Sequence[str], model: ProcessModel
) -> tuple[ColumnMapping | None, Selection]:
    """How logs are read for a model that has its parameters: columns, and which samples count.

    config: may name another model, for which the columns serve as well. typed: settings over it, as
    ``key=value``. Raises ConfigError.
    """
    written = None if config is None else yaml_file.load(config)
    if written is not None:
        check.refuse_other_kind(written, "an identification's settings")
    file, unconverted = in_model_units(TypedSettings.of({}, typed, written), [model])
    settings = check.validate(file, IdentificationConfig, others=unconverted)
    selection, columns = Selection.under(settings, file), settings.columns
    if columns is None:
        return None, selection
    mapping = ColumnMapping(file, columns)
    # The file may be of a comparison, in which other models have other signals.
    check_mapping(model, mapping, {"inputs": columns.inputs, "outputs": columns.outputs})
    return mapping, selection


def gassi_settings(problem: Problem) -> dict[str, Any]:
    """Arguments of ``GASSI``, all but the model."""
    settings = problem.settings
    search = ("preset", "population", "generations", "elite_percent", "search_samples")
    simulation = ("accuracy", "max_steps")
    space = ("ranges", "fixed", "tied", "scale", "guess")
    error = ("per_log", "balance", "criterion")
    names = (*search, *simulation, *space, *error)
    arguments = {name: getattr(settings, name) for name in names}
    arguments |= {"given": problem.given, "random_state": settings.seed}
    arguments["first_samples"] = tuple(k for k, v in settings.initial.items() if v == "first")
    optional = {"weights": settings.weights, "process_noise": settings.process_noise}
    return {**arguments, **{name: value or None for name, value in optional.items()}}


def _find_models(
    config: Path | None,
    file: TypedSettings,
    names: Sequence[str | None],
    record: Path | None,
    logs_of: Sequence[Sequence[Path]],
) -> list[tuple[ProcessModel, str]]:
    """Models and their whole names; when one is not found, the file's other mistakes as well."""
    try:
        return [
            _find_model(config, file, name, record, logs)
            for name, logs in zip(names, logs_of, strict=True)
        ]
    except ConfigError as error:
        if error.key == "model":
            check.validate(file, IdentificationConfig, others=error.mistakes)
        raise


def _find_model(
    config: Path | None,
    file: TypedSettings,
    typed: str | None,
    record: Path | None,
    logs: Sequence[Path],
) -> tuple[ProcessModel, str]:
    """A model and its whole name: of the command line, the configuration, or the logs' runs."""
    configured = file.content.get("model")
    if configured is not None and not isinstance(configured, str):
        check.validate(file, IdentificationConfig)
    # A name on the command line is relative to where it is typed, one in a file to that file.
    if typed is None and "model" in file.typed:
        typed = configured
    beside = config.parent if config is not None and typed is None else None
    name = typed or configured or intended_model(logs) or DEFAULT_MODEL
    try:
        return find_model(name, beside, record), whole_name(name, beside)
    except ConfigError as error:
        if beside is None or configured is None:
            raise
        raise ConfigError.of(file.blamed(("model",), error)) from None


def _with_additions(file: YamlFile, signals: Signals, model: ProcessModel) -> ProcessModel:
    """The model with terms in its equations, the outputs that count, and errors of channels."""
    mistakes = []
    for key, add in _additions(signals):
        try:
            model = add(model)
        except ModelError as error:
            mistakes.append(file.mistake(key, str(error)))
    check.refuse(mistakes)
    return model


def _additions(
    signals: Signals,
) -> Iterator[tuple[Key, Callable[[ProcessModel], ProcessModel]]]:
    """What is added to a model in its order, each with its key."""
    for k, setting in enumerate(signals.terms):
        yield ("terms", k), partial(_with_term, setting)
    if signals.outputs:
        yield ("outputs",), lambda model: model.with_outputs(signals.outputs)
    for channel, errors in signals.channels.items():
        for kind in get_args(Kind):
            if (ends := getattr(errors, kind)) is not None:
                yield ("channels", channel), partial(_with_correction, channel, kind, *ends)


def _with_term(setting: TermSetting, model: ProcessModel) -> ProcessModel:
    return with_terms(model, [_term(setting)])


def _with_correction(
    channel: str, kind: Kind, low: float, high: float, model: ProcessModel
) -> ProcessModel:
    return with_corrections(model, [Correction(channel, kind, low, high)])


def _term(setting: TermSetting) -> AddedTerm:
    values = setting.model_dump(exclude={"range"})
    low, high = setting.range
    return AddedTerm(**values, low=low, high=high)


def setting_of(term: AddedTerm) -> TermSetting:
    """What makes a term in a configuration."""
    values = dataclasses.asdict(term)
    ends = values.pop("low"), values.pop("high")
    del values["unit"]
    return TermSetting(**values, range=ends)


def _with_starts(file: YamlFile, signals: Signals, model: ProcessModel) -> ProcessModel:
    key: tuple[str, ...] = ()
    try:
        for name, start in signals.initial.items():
            key = ("initial", name)
            model = model.with_initial({name: start})
        key = ("hold",)
        return model.with_holds(signals.hold)
    except ModelError as error:
        raise file.error(key, str(error)) from None


def _unknown_names(
    file: YamlFile, models: Sequence[ProcessModel], before_additions: bool = False
) -> list[Mistake]:
    """Names in the settings that no model has, each at its key; a list has no keys of its own.

    before_additions: names that terms, outputs and errors of channels may give are let pass.
    """
    whose = " or ".join(dict.fromkeys(model.name for model in models))
    unknown = []
    for group, kind in (*_KEYED_BY.items(), ("profile", "parameter_names")):
        entries, declared = file.content.get(group), _all_names(models, kind)
        names = entries if isinstance(entries, Mapping | list) else ()
        for name in (name for name in names if isinstance(name, str) and name not in declared):
            added = "_of_" in name or (group == "weights" and file.content.get("outputs"))
            if before_additions and added:
                continue
            keyed = isinstance(entries, Mapping)
            problem = f"{'' if keyed else f'{name}: '}model {whose} has no such name"
            key, cure = (group, name) if keyed else (group,), suggestion(name, declared)
            unknown.append(file.mistake(key, problem, cure))
    return unknown


def _all_names(models: Sequence[ProcessModel], kind: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for model in models for name in getattr(model, kind)))


def _restricted(settings: IdentificationConfig, model: ProcessModel) -> IdentificationConfig:
    """The settings without what is meant for other models."""
    update = {}
    for group, kind in _KEYED_BY.items():
        values = getattr(settings, group)
        update[group] = {name: values[name] for name in values if name in getattr(model, kind)}
    return settings.model_copy(update=update)


def _check_space(
    file: YamlFile, settings: IdentificationConfig, model: ProcessModel, earlier: Given | None
) -> None:
    ranges, fixed, tied, scale = settings.ranges, settings.fixed, settings.tied, settings.scale
    # One parameter at a time first, so that each message can point at it.
    singles: list[tuple[str, str, dict[str, Any]]] = [
        *(("ranges", name, {"ranges": {name: ranges[name]}}) for name in ranges),
        *(("tied", name, {"tied": {name: tied[name]}}) for name in tied),
    ]
    for name in scale:
        within = {"ranges": {name: ranges[name]}} if name in ranges else {}
        if name not in fixed and name not in tied:
            singles.append(("scale", name, {"scale": {name: scale[name]}, **within}))
    mistakes = _beyond_limits(file, fixed, model)
    for group, name, part in singles:
        try:
            SearchSpace.of(model, **part)
        except ModelError as error:
            mistakes += file.error((group, name), str(error)).mistakes
    check.refuse(mistakes)
    groups = ("tied", "fixed", "scale", "ranges")
    group = next((key for key in groups if file.content.get(key)), "ranges")
    values = {**fixed, **(earlier.values if earlier else {})}
    space = _try_space(file, (group,), model, ranges, values, tied=tied, scale=scale)
    for name in settings.profile:
        if name not in space.names:
            problem = f"{name} is not searched, so it has no profile; free it by a range"
            raise file.error(("profile",), problem)


def _beyond_limits(file: YamlFile, fixed: Mapping[str, Any], model: ProcessModel) -> list[Mistake]:
    """Fixed numbers that a parameter of the model cannot have."""
    mistakes: list[Mistake] = []
    for name, value in fixed.items():
        if name not in model.parameter_names or not isinstance(value, int | float):
            continue
        parameter = model.parameter(name)
        if value < parameter.minimum or value > parameter.maximum:  # no number is no finite one
            limits = f"{parameter.minimum:g} .. {parameter.maximum:g} {parameter.unit}"
            problem = f"{value:g} is outside the physical limits of {name}, {limits}"
            cure = "write a value within them, or search it: leave it out here"
            mistakes.append(file.mistake(("fixed", name), problem, cure))
    return mistakes


def _try_space(file: YamlFile, key: tuple[str, ...], *args: Any, **more: Any) -> SearchSpace:
    """A search space; ConfigError at the key that makes none."""
    try:
        return SearchSpace.of(*args, **more)
    except ModelError as error:
        raise file.error(key, str(error)) from None
