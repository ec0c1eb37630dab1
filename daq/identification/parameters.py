"""Parameters of a model on disk, as an identification wrote them or a person did."""

import math
from pathlib import Path
from typing import Any

from daq.config import check, yaml_file
from daq.config.identification import Signals
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError, suggestion
from daq.identification.settings import with_signals
from daq.lookup.models import find_model
from sysid import ProcessModel


def read_parameters(path: Path) -> tuple[ProcessModel, dict[str, float]]:
    """Model and parameters from a parameters.yaml, as identification writes it.

    Raises ConfigError naming line and key of what is missing or wrong.
    """
    file = yaml_file.load(path)
    name = file.content.get("model")
    if not isinstance(name, str):
        raise file.error(("model",), "this key is missing; it names the process model")
    try:
        model = find_model(name, path.parent)
    except ConfigError as error:
        raise file.error(("model",), str(error)) from None
    signals = {key: file.content[key] for key in Signals.model_fields if key in file.content}
    model = with_signals(file, check.validate(file, Signals, signals), model)
    entries = file.content.get("parameters")
    if not isinstance(entries, dict):
        raise file.error(("parameters",), "this key is missing; it holds 'name: value' lines")
    values = {}
    for key, entry in entries.items():
        if key not in model.parameter_names:
            hint = suggestion(str(key), model.parameter_names)
            raise file.error(
                ("parameters", str(key)), f"model {model.name} has no such parameter; {hint}"
            )
        values[key] = _value(file, ("parameters", str(key)), entry)
    return model, values


def _value(file: YamlFile, key: tuple[str, ...], entry: Any) -> float:
    value = entry.get("value") if isinstance(entry, dict) else entry
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise file.error(key, f"expected a number, found {value!r}")
    if not math.isfinite(value):
        raise file.error(key, f"expected a finite number, found {value}")
    return float(value)
