"""From names on the command line to experiments, rigs and devices."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, create_model

from daq.cli import terminal as console
from daq.config import checking, yaml_file
from daq.config.base import Section
from daq.config.rig import OwnLimit, RigConfig, with_options
from daq.config.yaml_file import Key, YamlFile
from daq.errors import ConfigError, Mistake
from daq.experiment import Experiment, Plan
from daq.hal import Device
from daq.limits import Limit
from daq.lookup.shipped import EXPERIMENTS, RIGS, shipped_files
from daq.lookup.user_code import from_file, locate
from daq.plugins import Group, load_plugin
from daq.run.plan import plan

DEFAULT_RIG = "simulated.yaml"


@dataclass(frozen=True)
class LoadedExperiment:
    """An experiment file, its checked content, and the class that checks it."""

    file: YamlFile
    experiment: Experiment
    name: str

    def plan(self, rig: RigConfig) -> Plan:
        """What the run will do; ConfigError that names this file when it cannot be."""
        try:
            return plan(self.experiment, rig)
        except ConfigError as error:
            raise ConfigError.of(map(self._placed, error.mistakes)) from None

    def _placed(self, mistake: Mistake) -> Mistake:
        """A mistake in a setting, at its line of the file."""
        if mistake.file is not None:
            return mistake.behind(self.file.mistake((), ""))
        line, column = self.file.place(tuple(mistake.key.split(".")))
        return replace(mistake, file=self.file.path, line=line, column=column)

    def validation(self) -> LoadedExperiment | None:
        """The validation run: the same with the keys under ``validation`` changed, if any."""
        if not self.experiment.validation:
            return None
        file = _validation_file(self.file)
        experiment = make_experiment(file, type(self.experiment))
        return LoadedExperiment(file, experiment, f"{self.name}-validation")


@dataclass(frozen=True)
class _Validation(YamlFile):
    """An experiment's file with ``changed`` keys of its ``validation`` section over the others."""

    changed: frozenset[Key] = field(default_factory=frozenset)

    def mistake(self, key: Key, problem: str, cure: str = "") -> Mistake:
        """What is wrong at a key, named under the section that it stands in."""
        mistake = super().mistake(key, problem, cure)
        return replace(mistake, key=f"validation.{mistake.key}") if key in self.changed else mistake


def _validation_file(file: YamlFile) -> YamlFile:
    """An experiment's file as if its ``validation`` section stood over the rest."""
    changes = file.content["validation"]
    content = yaml_file.merge(file.content, {**changes, "validation": {}})
    moved = {key[1:]: place for key, place in file.places.items() if key[:1] == ("validation",)}
    places = {**file.places, **moved, (): file.place(())}
    return _Validation(file.path, content, places, changed=frozenset(moved))


def find(name: str, packages: Iterable[str]) -> Path:
    """A file in the working folder, or the one shipped with the packages under a bare name."""
    path = Path(name)
    if path.exists():
        return path
    shipped = {file.name: file for file in shipped_files(packages)}
    if path.name == name:
        for candidate in [name] if path.suffix else [name, f"{name}.yaml"]:
            if Path(candidate).exists():
                return Path(candidate)
            if candidate in shipped:
                console.report_detail(f"{name}: the shipped {shipped[candidate]}")
                return shipped[candidate]
    cure = yaml_file.nearest_file(path, list(shipped) if path.name == name else [])
    cure = cure or f"check its name, or use a shipped one: {', '.join(shipped)}"
    raise ConfigError("there is no such file", cure=cure, file=name)


def rig_for(experiment: str) -> str:
    """The rig file that an experiment's file says it is for; the simulated rig's without."""
    try:
        file = yaml_file.load(find(experiment, EXPERIMENTS))
    except ConfigError:
        return DEFAULT_RIG  # what is wrong with the experiment is told when it is loaded
    name = file.content.get("rig")
    if not isinstance(name, str) or not name:
        return DEFAULT_RIG
    beside = file.path.parent / name
    return str(beside) if beside.exists() else name


def load_experiment(name: str) -> LoadedExperiment:
    """Read and check an experiment; ConfigError names file, line, key and cure."""
    file = yaml_file.load(find(name, EXPERIMENTS))
    checking.refuse_other_kind(file, "an experiment")
    try:
        kind = find_protocol(_protocol_name(file), file.path.parent)
    except ConfigError as error:
        checking.validate(file, _common_settings(), others=file.blamed(("protocol",), error))
        raise
    own = checking.mistakes(file, kind, file.content)
    if file.content.get("validation") and isinstance(file.content["validation"], dict):
        validation = _validation_file(file)
        own += checking.mistakes(validation, kind, validation.content)
    checking.refuse([*file.repeated, *own])
    experiment = make_experiment(file, kind)
    _tell(file, f"protocol {experiment.protocol}", kind)
    return LoadedExperiment(file, experiment, experiment.name or file.path.stem)


def _tell(file: YamlFile, what: str, kind: type[Any]) -> None:
    console.report_detail(f"{file.path}: {what} is {kind.__module__}.{kind.__qualname__}")


def _protocol_name(file: YamlFile) -> str:
    name = file.content.get("protocol")
    if not isinstance(name, str):
        problem = "this key is missing or not a name"
        raise ConfigError(problem, cure="for example 'protocol: prbs'")
    return name


def _common_settings() -> type[Section]:
    """What can be checked of an experiment whose protocol is not known."""

    class Common(Section):
        model_config = ConfigDict(extra="ignore")

    fields: dict[str, Any] = {
        name: (field.annotation, field)
        for name, field in Experiment.model_fields.items()
        if name != "protocol"
    }
    return create_model("Common", __base__=Common, **fields)


def together(*steps: Callable[[], Any]) -> list[Any]:
    """What each step gives; one ConfigError with the mistakes of all of them."""
    results: list[Any] = []
    mistakes: dict[str, Mistake] = {}  # by text: each once
    for step in steps:
        try:
            results.append(step())
        except ConfigError as error:
            mistakes |= {mistake.text: mistake for mistake in error.mistakes}
    if mistakes:
        raise ConfigError.of(mistakes.values())
    return results


def find_protocol(name: str, folder: Path) -> type[Experiment]:
    """An installed protocol, or a class in a file given as ``FILE.py:CLASS``.

    File names are looked up from the working folder, then from ``folder``. Raises ConfigError.
    """
    cure = (
        "make it a class derived from daq.experiment.Timed, OpenLoop or ClosedLoop, with all of "
        "its methods"
    )
    found: type[Experiment] = _find("protocol", name, folder, _is_protocol, cure)
    return found


def _find_limit(name: str, folder: Path) -> type[Limit]:
    cure = "make it a class derived from daq.limits.Limit with a method check"
    found: type[Limit] = _find("limit", name, folder, _is_limit, cure)
    return found


def _find_backend(name: str, folder: Path) -> Any:
    cure = "make it a class with Options and the methods of daq.hal.Device"
    return _find("backend", name, folder, _is_backend, cure)


def _find(
    kind: Literal["backend", "limit", "protocol"],
    name: str,
    folder: Path,
    is_one: Callable[[Any], bool],
    cure: str,
) -> Any:
    """What is installed under a name, or a class of ``FILE.py:CLASS``; ConfigError with a cure."""
    groups: dict[str, Group] = {
        "backend": "rig.backends",
        "limit": "rig.limits",
        "protocol": "rig.protocols",
    }
    file = _in_file(name)
    if file is None:
        found = load_plugin(groups[kind], name)
    else:
        found = from_file(locate(Path(file[1]), kind, folder), file[2], kind, is_one)
    if not is_one(found):
        raise ConfigError(f"{name} is no {kind}", cure=cure)
    return found


def make_experiment(file: YamlFile, kind: type[Experiment]) -> Experiment:
    """The checked content of an experiment's file."""
    content = dict(file.content)
    own = _in_file(content["protocol"])
    if own is not None:
        # The capture must find it from any folder.
        path = locate(Path(own[1]), "protocol", file.path.parent).resolve()
        content["protocol"] = f"{path}:{own[2]}"
    experiment = checking.validate(file, kind, content)
    experiment._folder = file.path.parent
    return experiment


def _in_file(name: str) -> re.Match[str] | None:
    """File and class of ``FILE.py:CLASS``."""
    # Not at the first colon: a Windows path has one behind its drive.
    return re.match(r"^(.*\.py):(\w+)$", name)


def _is_protocol(found: Any) -> bool:
    is_class = inspect.isclass(found) and issubclass(found, Experiment)
    return is_class and not inspect.isabstract(found)


def load_rig(name: str, options: Mapping[str, Any] | None = None) -> tuple[RigConfig, Any]:
    """Read and check a rig file; its configuration and the backend's device, not yet open.

    options: the backend's own settings that take precedence over the file's.
    """
    file = yaml_file.load(find(name, RIGS))
    checking.refuse_other_kind(file, "a rig")
    if options:
        file = replace(file, content=yaml_file.merge(file.content, {"options": options}))
    backend_name = file.content.get("backend", RigConfig.model_fields["backend"].default)
    if not isinstance(backend_name, str):
        checking.validate(file, RigConfig)
    try:
        backend = _find_backend(backend_name, file.path.parent)
    except ConfigError as error:
        checking.validate(file, RigConfig, others=file.blamed(("backend",), error))
        raise
    config = checking.validate(file, with_options(backend.Options))
    _tell(file, f"backend {backend_name}", backend)
    for index, own in enumerate(config.limits.own):
        own._make = _limit_maker(file, own, ("limits", "own", index))
    config = _with_fitting_limits(config)
    device: Device = backend(config.options)
    return config, device


def _with_fitting_limits(config: RigConfig) -> RigConfig:
    """Without the limit of a cable where the simulated plant has none."""
    least = config.limits.winding
    if least is None or getattr(config.options, "cable", True):
        return config
    console.report_note(
        f"limits.winding of {least:g} turns is left out: options.plant.load is without a cable"
    )
    limits = config.limits.model_copy(update={"winding": None})
    return config.model_copy(update={"limits": limits})


def _limit_maker(file: YamlFile, own: OwnLimit, key: Key) -> Callable[[], Limit]:
    """What makes the limit that an entry of ``limits.own`` names, its settings checked."""
    try:
        kind = _find_limit(own.use, file.path.parent)
    except ConfigError as error:
        raise ConfigError.of(file.blamed((*key, "use"), error)) from None
    options = kind.Options
    if options is None:
        if own.options:
            raise file.error((*key, "options"), f"the limit {own.use} has no settings")
        return kind
    settings = checking.validate(file, options, own.options, (*key, "options"))
    make: Callable[..., Limit] = kind
    return lambda: make(settings)


def _is_limit(found: Any) -> bool:
    return inspect.isclass(found) and issubclass(found, Limit) and not inspect.isabstract(found)


def _is_backend(found: Any) -> bool:
    options = getattr(found, "Options", None)
    methods = [name for name, value in vars(Device).items() if inspect.isfunction(value)]
    own = [name for name in methods if not name.startswith("_")]
    is_section = inspect.isclass(options) and issubclass(options, Section)
    return inspect.isclass(found) and is_section and all(hasattr(found, name) for name in own)
