"""From names on the command line to experiments, rigs and devices."""

from __future__ import annotations

import importlib.resources
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.config import yaml_file
from daq.config.experiment import Experiment
from daq.config.rig import RigConfig
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError
from daq.hal import Device, FloatArray
from daq.plugins import load_plugin
from daq.run import plan


@dataclass(frozen=True)
class LoadedExperiment:
    """An experiment file, its checked content, and the class that checks it."""

    file: YamlFile
    experiment: Experiment
    name: str

    def plan(self, rig: RigConfig) -> FloatArray:
        """The commands of the run; ConfigError that names this file when they cannot be."""
        try:
            return plan(self.experiment, rig)
        except ConfigError as error:
            key = tuple(str(error).split(":", 1)[0].split("."))
            raise ConfigError(f"{self.file.where(key)}: {error}") from None

    def validation(self) -> LoadedExperiment | None:
        """The validation run: the same with the keys under ``validation`` changed, if any."""
        changes = self.experiment.validation
        if not changes:
            return None
        content = yaml_file.merge(self.file.content, {**changes, "validation": {}})
        places = {
            **self.file.places,
            **{k[1:]: v for k, v in self.file.places.items() if k[:1] == ("validation",) and k[1:]},
        }
        file = YamlFile(self.file.path, content, places)
        experiment = yaml_file.validate(file, type(self.experiment), content)
        return LoadedExperiment(file, experiment, f"{self.name}-validation")


def find(name: str, package: str) -> Path:
    """A file in the working folder, or the one shipped with a package under a bare name."""
    path = Path(name)
    if path.exists():
        return path
    candidates = [name] if path.suffix else [name, f"{name}.yaml"]
    shipped = importlib.resources.files(package)
    if path.name == name:
        for candidate in candidates:
            if Path(candidate).exists():
                return Path(candidate)
            resource = shipped / candidate
            if resource.is_file():
                return Path(str(resource))
    known = sorted(item.name for item in shipped.iterdir() if item.name.endswith(".yaml"))
    raise ConfigError(
        f"{name}: there is no such file; check its name, or use a shipped one: {', '.join(known)}"
    )


def load_experiment(name: str) -> LoadedExperiment:
    """Read and check an experiment; ConfigError names file, line, key and cure."""
    file = yaml_file.load(find(name, "protocols"))
    protocol = file.content.get("protocol")
    if not isinstance(protocol, str):
        raise file.error(
            ("protocol",), "this key is missing or not a name; for example 'protocol: prbs'"
        )
    try:
        kind: type[Experiment] = load_plugin("rig.protocols", protocol)
    except ConfigError as error:
        raise file.error(("protocol",), str(error)) from None
    experiment = yaml_file.validate(file, kind)
    return LoadedExperiment(file, experiment, experiment.name or file.path.stem)


def load_rig(name: str) -> tuple[RigConfig, Any]:
    """Read and check a rig file; its configuration and the backend's device, not yet open."""
    file = yaml_file.load(find(name, "sim_rig"))
    config = yaml_file.validate(file, RigConfig)
    return config, _make_device(file, config)


def _make_device(file: YamlFile, config: RigConfig) -> Device:
    try:
        backend = load_plugin("rig.backends", config.backend)
    except ConfigError as error:
        raise file.error(("backend",), str(error)) from None
    options = yaml_file.validate(file, backend.Options, config.options, ("options",))
    device: Device = backend(options)
    return device
