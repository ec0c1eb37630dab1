"""Torque controllers by the names that users write: settings, and the files that rig tune makes."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from daq.config import check, yaml_file
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError
from daq.hal import FloatArray
from daq.lookup.classes import file_and_class, find_class
from daq.lookup.models import find_model
from daq.lookup.shipped import find_file, shipped_files
from daq.lookup.user_code import locate
from daq.progress import Watch, ignore
from daq.torque import TorqueControl, TorqueLaw
from sysid import ModelError, ProcessModel
from sysid.uncertainty.draws import plausible_parameters

_MOST_ROUNDS = 20  # of draws, where the model's constraints refuse most
_AGAIN = "make it anew with rig tune"


@dataclass(frozen=True)
class TunedController:
    """A controller's settings and the actuator that it is tuned to.

    parameters: (n_parameters,). source: where they come from. path: of the file with all this.
    spread: names of parameters that have one, and the factor of their covariance.
    """

    path: Path
    control: TorqueControl
    model: ProcessModel
    parameters: FloatArray
    source: str
    spread: tuple[tuple[str, ...], FloatArray]

    def plausible(self, n: int, seed: int = 0) -> FloatArray:
        """Plausible parameters, (n, n_parameters); none where no spread is known."""
        names, factor = self.spread
        if not names:
            return np.empty((0, len(self.parameters)))
        rows = np.empty((0, len(self.parameters)))
        for again in range(_MOST_ROUNDS):
            drawn = plausible_parameters(
                self.model, self.parameters, names, factor, n, seed + again
            )
            rows = np.concatenate([rows, drawn])[:n]
            if len(rows) == n:
                break
        return rows

    @cached_property
    def most_volts(self) -> tuple[float, float]:
        """Largest commands of motor, either way, and brake [V]."""
        return self.control.most_volts(self.model, self.parameters)

    def law(self) -> TorqueLaw:
        """A new law for one run."""
        return self.control.law(self.model, self.parameters)


def load_settings(name: str, watch: Watch = ignore) -> TorqueControl:
    """Settings of a controller, as rig tune reads them; ConfigError names file, line and cure."""
    file = yaml_file.load(find_file("controller", name, watch))
    check.refuse_other_kind(file, "a torque controller's settings")
    return _control(file, ())


def load_controller(name: str, folder: Path) -> TunedController:
    """A file that rig tune made; ConfigError names file, line, key and cure.

    It is looked up from the working folder, then from ``folder``, then among the shipped ones.
    """
    shipped = shipped_files("controller").get(name, Path())
    candidates = (Path(name), folder / name, shipped)
    path = next((path for path in candidates if path.is_file()), None)
    if path is None:
        cure = "make it with rig tune torque.yaml --parameters PARAMETERS.yaml"
        raise ConfigError("there is no such file", cure=cure, file=name)
    file = yaml_file.load(path)
    for key in ("settings", "parameters"):
        if not isinstance(file.content.get(key), dict):
            problem = "this key is missing; no file that rig tune made"
            raise file.error((key,), problem, _AGAIN)
    control = _control(file, ("settings",))
    if not isinstance(file.content.get("model"), str):
        raise file.error(("model",), "this key is missing; it names the process model", _AGAIN)
    model = find_model(file.content["model"], path.parent, record=path)
    values = file.content["parameters"]
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise file.error(("parameters", str(key)), f"expected a number, found {value!r}")
    try:
        source = str(file.content.get("source", "parameters of unknown origin"))
        spread = _spread(file, model)
        controller = TunedController(path, control, model, model.vector(values), source, spread)
        controller.most_volts  # noqa: B018 - refuses what cannot be controlled
    except ModelError as error:
        raise file.error(("parameters",), str(error), _AGAIN) from None
    return controller


def _spread(file: YamlFile, model: ProcessModel) -> tuple[tuple[str, ...], FloatArray]:
    """What the file says of the covariance. Raises ConfigError."""
    if "covariance" not in file.content:
        return (), np.empty((0, 0))
    try:
        names = tuple(map(str, file.content["covariance"]["parameters"]))
        factor = np.array(file.content["covariance"]["factor"], dtype=float).reshape(-1, len(names))
    except (KeyError, TypeError, ValueError):
        names, factor = (), np.full((1, 1), np.nan)
    if not np.isfinite(factor).all() or not set(names) <= set(model.parameter_names):
        raise file.error(("covariance",), "no covariance of the model's parameters", _AGAIN)
    return names, factor


def _control(file: YamlFile, at: tuple[str, ...]) -> TorqueControl:
    """The settings at a key of a file."""
    content = file.content
    for key in at:
        content = content[key]
    name = content.get("controller")
    if not isinstance(name, str):
        problem = "this key is missing or not a name"
        raise file.error((*at, "controller"), problem, "for example 'controller: feedforward'")
    try:
        kind = find_class("controller", name, file.path.parent)
    except ConfigError as error:
        raise ConfigError.of(file.blamed((*at, "controller"), error)) from None
    parts = file_and_class(name)
    if parts is not None:
        path = locate(parts[0], "controller", file.path.parent).resolve()
        content = {**content, "controller": f"{path}:{parts[1]}"}
    control: TorqueControl = check.validate(file, kind, content, at)
    return control
