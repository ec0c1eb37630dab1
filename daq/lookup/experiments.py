"""Experiments by the names that users write."""

import difflib
from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import ConfigDict, create_model

from daq.config import check, yaml_file
from daq.config.base import Section
from daq.config.rig import RigConfig
from daq.config.yaml_file import Key, YamlFile
from daq.errors import ConfigError, Mistake
from daq.experiment import Experiment, Plan
from daq.logs.capture import VALIDATION
from daq.lookup.classes import file_and_class, find_class
from daq.lookup.shipped import find_file
from daq.lookup.user_code import locate
from daq.progress import Note, Watch, ignore
from daq.run.plan import plan


@dataclass(frozen=True)
class LoadedExperiment:
    """An experiment's file, its checked content, and the name that its captures get."""

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

    def validation(self) -> "LoadedExperiment | None":
        """The validation run: the same with the keys under ``validation`` changed, if any."""
        if not self.experiment.validation:
            return None
        file = _validation_file(self.file)
        experiment = _experiment(file, type(self.experiment))
        return LoadedExperiment(file, experiment, f"{self.name}{VALIDATION}")


def load_experiment(name: str, watch: Watch = ignore) -> LoadedExperiment:
    """Read and check an experiment; ConfigError names file, line, key and cure."""
    file = yaml_file.load(find_file("protocol", name, watch))
    check.refuse_other_kind(file, "an experiment")
    protocol_name = file.content.get("protocol")
    try:
        if not isinstance(protocol_name, str):
            problem, keys = "this key is missing or not a name", list(map(str, file.content))
            near = difflib.get_close_matches("protocol", keys, n=1)
            cure = "for example 'protocol: prbs'"
            if near and near != ["protocol"]:
                cure = f"is {near[0]!r} meant to be it?"
            raise ConfigError(problem, cure=cure)
        protocol = find_class("protocol", protocol_name, file.path.parent)
    except ConfigError as error:
        check.validate(file, _common_settings(), others=file.blamed(("protocol",), error))
        raise
    mistakes = check.mistakes(file, protocol, file.content)
    if isinstance(file.content.get("validation"), dict) and file.content["validation"]:
        validation = _validation_file(file)
        mistakes += check.mistakes(validation, protocol, validation.content)
    check.refuse([*file.repeated, *mistakes])
    experiment = _experiment(file, protocol)
    class_name = f"{protocol.__module__}.{protocol.__qualname__}"
    watch(Note("detail", f"{file.path}: protocol {experiment.protocol} is {class_name}"))
    return LoadedExperiment(file, experiment, experiment.name or file.path.stem)


@dataclass(frozen=True)
class _ValidationFile(YamlFile):
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
    return _ValidationFile(file.path, content, places, changed=frozenset(moved) - {()})


def _experiment(file: YamlFile, protocol: type[Experiment]) -> Experiment:
    """The checked content of an experiment's file."""
    content = dict(file.content)
    parts = file_and_class(content["protocol"])
    if parts is not None:
        # The capture must find it from any folder.
        path = locate(parts[0], "protocol", file.path.parent).resolve()
        content["protocol"] = f"{path}:{parts[1]}"
    experiment = check.validate(file, protocol, content)
    experiment._folder = file.path.parent
    return experiment


def _common_settings() -> type[Section]:
    """What can be checked of an experiment whose protocol is not known."""

    class Common(Section):
        model_config = ConfigDict(extra="ignore")

    fields: dict[str, Any] = {
        name: (info.annotation, info)
        for name, info in Experiment.model_fields.items()
        if name != "protocol"
    }
    return create_model("Common", __base__=Common, **fields)
