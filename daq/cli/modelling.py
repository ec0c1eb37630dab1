"""Finding process models by name or file, and ``rig models``."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from daq.cli import console
from daq.config.yaml_file import suggestion
from daq.errors import ConfigError
from daq.plugins import installed, load_plugin
from sysid.model import ModelError, ProcessModel

DEFAULT_MODEL = "actuator"


def find_model(name: str, relative_to: Path | None = None) -> ProcessModel:
    """An installed model, or an object of a Python file given as ``file.py:object``.

    The object is a ProcessModel or a function without arguments that makes one. File names are
    looked up from the working folder, then from ``relative_to``. Raises ConfigError naming
    file, line and cause.
    """
    file, colon, attribute = name.rpartition(":")
    if colon and file.endswith(".py"):
        return _from_file(_locate(Path(file), relative_to), attribute)
    if name.endswith(".py"):
        return _from_file(_locate(Path(name), relative_to), "model")
    return _as_model(load_plugin("rig.models", name), f"model {name!r}")


def whole_name(name: str, relative_to: Path | None = None) -> str:
    """The name by which ``find_model`` finds the same model from any folder."""
    file, colon, attribute = name.rpartition(":") if not name.endswith(".py") else (name, "", "")
    if not file.endswith(".py"):
        return name
    return f"{_locate(Path(file), relative_to).resolve()}{colon}{attribute}"


def models_command(name: str | None, as_json: bool) -> None:
    """List models, or describe one."""
    if name is not None:
        _describe(find_model(name), as_json)
        return
    found = {key: find_model(key) for key in sorted(installed("rig.models"))}
    if as_json:
        console.print_json({key: describe(model) for key, model in found.items()})
        return
    console.print_table(
        "Process models",
        ["name", "states", "inputs", "outputs", "free parameters", "what it is"],
        [
            [
                key,
                str(len(model.states)),
                str(len(model.inputs)),
                str(len(model.outputs)),
                str(sum(not p.fixed for p in model.parameters)),
                model.description,
            ]
            for key, model in found.items()
        ],
        text=["what it is"],
    )
    console.print_line("Next: rig models NAME, or rig models my_model.py:model for one of your own")


def describe(model: ProcessModel) -> dict[str, Any]:
    """All that a model declares, for machines."""
    signals = {
        "states": [{"name": s.name, "unit": s.unit, "initial": s.initial} for s in model.states],
        "inputs": [{"name": s.name, "unit": s.unit, "hold": s.hold} for s in model.inputs],
        "outputs": [{"name": s.name, "unit": s.unit} for s in model.outputs],
    }
    parameters = [
        {
            "name": p.name,
            "unit": p.unit,
            "nominal": p.nominal,
            "range": None if p.fixed else [p.lower, p.upper],
            "scale": p.scale,
            "fixed": p.fixed,
            "description": p.description,
        }
        for p in model.parameters
    ]
    return {
        "name": model.name,
        "description": model.description,
        **signals,
        "parameters": parameters,
        "constraints": [constraint.text for constraint in model.constraints],
    }


def _describe(model: ProcessModel, as_json: bool) -> None:
    if as_json:
        console.print_json(describe(model))
        return
    console.print_line(f"{model.name}: {model.description}")
    rows = [["state", s.name, s.unit, f"starts at {s.initial:g}"] for s in model.states]
    rows += [["input", s.name, s.unit, s.hold] for s in model.inputs]
    rows += [["output", s.name, s.unit, s.description] for s in model.outputs]
    console.print_table(
        "Signals", ["kind", "name", "unit", "note"], rows, text=["name", "unit", "note"]
    )
    console.print_table(
        "Parameters",
        ["name", "unit", "nominal", "range", "scale", "what it is"],
        [
            [
                p.name,
                p.unit,
                console.number(p.nominal),
                "fixed" if p.fixed else f"{console.number(p.lower)} .. {console.number(p.upper)}",
                "" if p.fixed else p.scale,
                p.description,
            ]
            for p in model.parameters
        ],
        text=["unit", "scale", "what it is"],
    )
    for constraint in model.constraints:
        console.print_line(f"Constraint: {constraint.text}")


def _locate(path: Path, relative_to: Path | None) -> Path:
    for candidate in (path, *([relative_to / path] if relative_to else [])):
        if candidate.is_file():
            return candidate
    raise ConfigError(f"{path}: there is no such model file")


def _from_file(path: Path, attribute: str) -> ProcessModel:
    module = _import_file(path)
    if not hasattr(module, attribute):
        models = [key for key, value in vars(module).items() if isinstance(value, ProcessModel)]
        raise ConfigError(
            f"{path}: it defines no {attribute!r}; {suggestion(attribute, models)} "
            "(--model file.py:object names a ProcessModel in it)"
        )
    return _as_model(getattr(module, attribute), f"{path}:{attribute}")


def _import_file(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"_rig_model_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # A model file may import its neighbours, as a script in that folder could.
    folder = str(path.resolve().parent)
    sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{_place(path, error)}: the model file does not import: "
                          f"{type(error).__name__}: {error}") from None  # fmt: skip
    finally:
        sys.path.remove(folder)
    return module


def _place(path: Path, error: BaseException) -> str:
    """``file:line`` of the last line of the user's file that the error passed through."""
    if isinstance(error, SyntaxError) and _same(error.filename, path):
        return f"{path}:{error.lineno}"
    line, trace = None, error.__traceback__
    while trace is not None:
        if _same(trace.tb_frame.f_code.co_filename, path):
            line = trace.tb_lineno
        trace = trace.tb_next
    return f"{path}:{line}" if line is not None else str(path)


def _same(file: str | None, path: Path) -> bool:
    return file is not None and Path(file).resolve() == path.resolve()


def _as_model(found: Any, where: str) -> ProcessModel:
    if callable(found) and not isinstance(found, ProcessModel):
        try:
            found = found()
        except ModelError as error:
            raise ConfigError(f"{where}: {error}") from None
        except Exception as error:
            raise ConfigError(
                f"{where}: calling it fails: {type(error).__name__}: {error}"
            ) from None
    if not isinstance(found, ProcessModel):
        raise ConfigError(
            f"{where} is of type {type(found).__name__}, not a sysid.ProcessModel or a function "
            "without arguments that returns one"
        )
    return found
