"""What an earlier identification found, taken over with its covariance."""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from daq.config import yaml_file
from daq.config.identification import IdentificationConfig
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError
from daq.identification.foreign import unit_factor
from daq.identification.request import result_file
from sysid import Given, ModelError, ProcessModel

_WELL = 0.3  # standard deviation in parts of a value, up to which it counts as found
_ANEW = "identify again"
_AGAIN = "name the parameters.yaml that rig identify wrote, or its folder"


def load(paths: Sequence[Path]) -> list[YamlFile]:
    """Results of identifications, by file or folder; ConfigError for what is none."""
    files = []
    for path in paths:
        file = yaml_file.load(result_file(path))
        for key in ("parameters", "covariance"):
            if not isinstance(file.content.get(key), dict):
                raise file.error((key,), "this key is missing; no result with intervals", _AGAIN)
        files.append(file)
    return files


def under(
    settings: IdentificationConfig,
    files: Sequence[YamlFile],
    model: ProcessModel,
    freed: Collection[str] = (),
) -> tuple[Given | None, dict[str, str]]:
    """Parameters of a model that were found earlier, and the line that each comes from.

    Found are those with a narrow interval, and those of which a combination has one. What the
    settings say of a parameter goes before, also that it is freed. Raises ConfigError for a
    parameter that two files tell, a file without any of the model's, or numbers that are none.
    """
    settled = {*settings.ranges, *settings.fixed, *settings.tied, *freed}
    values: dict[str, float] = {}
    factors: list[list[float]] = []
    sources: dict[str, str] = {}
    for file in files:
        estimates = _found(file, model)
        if not estimates:
            problem = f"it found no parameter of model {model.name}"
            raise file.error(("parameters",), problem, "leave the file out")
        kept = [name for name in estimates if name not in settled]
        for name in kept:
            if name in sources:
                raise file.error(("parameters", name), f"also in {sources[name]}; keep one")
            values[name], sources[name] = estimates[name], _source(file, name)
        rows = factor(file, kept, model)
        before = len(values) - len(kept)
        factors = [[*row, *[0.0] * len(kept)] for row in factors]
        factors += [[*[0.0] * before, *row] for row in rows]
    given = Given(values, factors) if values else None
    if given is not None:
        try:
            given.check(model)
        except ModelError as error:
            raise ConfigError(str(error), file=files[0].path) from None
    return given, sources


def _found(file: YamlFile, model: ProcessModel) -> dict[str, float]:
    """Values of the parameters that a result knows well, alone or in a combination."""
    try:
        combined = {
            name
            for ambiguity in file.content.get("ambiguities") or ()
            for combination in ambiguity["determined"]
            if _is_known(combination)
            for name in re.findall(r"\w+", combination["name"])
        }
    except (AttributeError, KeyError, TypeError):
        raise file.error(("ambiguities",), "not as rig identify writes it", _ANEW) from None
    return {
        str(name): value(file, name, model)
        for name, entry in file.content["parameters"].items()
        if name in model.parameter_names
        and isinstance(entry, dict)
        and (_is_known(entry) or (entry.get("undetermined") and name in combined))
    }


def _is_known(estimate: Mapping[str, Any]) -> bool:
    """Whether an interval is narrow enough to hold for small changes, as a covariance does."""
    std, value = estimate.get("std"), estimate.get("value")
    if not isinstance(std, int | float) or not isinstance(value, int | float):
        return std is not None  # to be refused where it is read
    return std <= _WELL * abs(value)


def value(file: YamlFile, name: str, model: ProcessModel) -> float:
    """A result's value of a parameter, in the model's unit; ConfigError for none."""
    entry = file.content["parameters"][name]
    number = entry.get("value") if isinstance(entry, dict) else entry
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise file.error(("parameters", name, "value"), f"expected a number, found {number!r}")
    return number * _unit(file, name, entry, model)


def _unit(file: YamlFile, name: str, entry: Any, model: ProcessModel) -> float:
    """The unit of a result's parameter in the model's."""
    key = ("parameters", name, "unit")
    unit = entry.get("unit") if isinstance(entry, dict) else None
    return unit_factor(file, key, unit, model.parameter(name).unit)


def factor(file: YamlFile, names: Sequence[str], model: ProcessModel) -> list[list[float]]:
    """Rows of the covariance's factor for some parameters, those without any left out.

    In the model's units; raises ConfigError for numbers that are none.
    """
    content = file.content["covariance"]
    columns, rows = content.get("parameters"), content.get("factor")
    try:
        table = np.array(rows, dtype=np.float64).reshape(len(rows), len(columns))
        places = [columns.index(name) for name in names]
    except (TypeError, ValueError, AttributeError):
        problem = "it does not hold 'parameters' and as many numbers in each row of 'factor'"
        raise file.error(("covariance",), problem, _ANEW) from None
    entries = file.content["parameters"]
    units = [_unit(file, name, entries[name], model) for name in names]
    kept = table[:, places] * units
    return cast("list[list[float]]", kept[np.any(kept != 0.0, axis=1)].tolist())


def _source(file: YamlFile, name: str) -> str:
    """Where a value stands, and how well it is known."""
    interval = file.content["parameters"][name].get("interval")
    text = f"{interval[0]:.4g} .. {interval[1]:.4g}" if interval else "with others"
    return f"given: {text}, {file.line(('parameters', name))}"
