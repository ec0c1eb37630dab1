"""Finding process models by name or file, and ``rig models``."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from daq.cli import terminal as console
from daq.errors import ConfigError, suggestion
from daq.lookup.user_code import from_file, locate
from daq.plugins import installed, load_plugin
from sysid.problem.model import ModelError, ProcessModel, State

DEFAULT_MODEL = "actuator"


@dataclass(frozen=True)
class _Name:
    """``model`` or ``file.py:object``, and ``:option=value,...`` behind either."""

    source: str
    attribute: str | None
    options: str

    @classmethod
    def parse(cls, text: str) -> _Name:
        # Not at the first colon: a Windows path has one behind its drive.
        file = re.match(r"^(.*\.py)(?::([^:=]*))?(?::(.*))?$", text)
        if file:
            return cls(file[1], file[2] or "model", file[3] or "")
        source, _, options = text.partition(":")
        return cls(source, None, options)


def find_model(name: str, relative_to: Path | None = None) -> ProcessModel:
    """An installed model, or an object of a Python file given as ``file.py:object``.

    The object is a ProcessModel or a function that makes one; ``:option=value,...`` behind it
    are the function's arguments. File names are looked up from the working folder, then from
    ``relative_to``. Raises ConfigError naming file, line and cause.
    """
    parsed = _Name.parse(name)
    where = f"model {parsed.source!r}"
    if parsed.attribute is not None:
        where = f"{locate(Path(parsed.source), 'model', relative_to)}:{parsed.attribute}"
    return _as_model(_find(parsed, relative_to), where, parsed.options)


def _find(name: _Name, relative_to: Path | None = None) -> Any:
    """The model, or the function that makes it."""
    if name.attribute is None:
        return load_plugin("rig.models", name.source)
    path = locate(Path(name.source), "model", relative_to)
    return from_file(path, name.attribute, "model", lambda found: isinstance(found, ProcessModel))


def whole_name(name: str, relative_to: Path | None = None) -> str:
    """The name by which ``find_model`` finds the same model from any folder."""
    parsed = _Name.parse(name)
    if parsed.attribute is None:
        return name
    path = locate(Path(parsed.source), "model", relative_to).resolve()
    return f"{path}{name.removeprefix(parsed.source)}"


def models_command(name: str | None, as_json: bool) -> None:
    """List models, or describe one."""
    if name is not None:
        _describe(name, find_model(name), as_json)
        return
    found = {key: find_model(key) for key in sorted(installed("rig.models"))}
    if as_json:
        console.print_json(
            {
                key: {**describe(model), "options": model_options(_find(_Name.parse(key)))}
                for key, model in found.items()
            }
        )
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
    console.print_next("rig models NAME, or rig models my_model.py:model for one of your own")


def describe(model: ProcessModel) -> dict[str, Any]:
    """All that a model declares, for machines."""
    signals = {
        "states": [
            {"name": s.name, "unit": s.unit, "initial": s.initial, "estimated": s.initial_range}
            for s in model.states
        ],
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
        "equations": list(model.equations),
        **signals,
        "parameters": parameters,
        "constraints": [constraint.text for constraint in model.constraints],
    }


def _describe(name: str, model: ProcessModel, as_json: bool) -> None:
    parsed = _Name.parse(name)
    choices = model_options(_find(parsed))
    if as_json:
        console.print_json({**describe(model), "options": choices})
        return
    console.print_line(f"{model.name}: {model.description}")
    for equation in model.equations:
        console.print_line(f"  {equation}")
    if model.equations:
        console.print_line()
    rows = [["state", s.name, s.unit, _start(s)] for s in model.states]
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
    if choices:
        _print_options(parsed.source, choices)


def _print_options(source: str, choices: list[dict[str, Any]]) -> None:
    console.print_table(
        "Options",
        ["name", "default", "choices", "what it is"],
        [
            [
                choice["name"],
                _as_text(choice["default"]),
                ", ".join(choice["choices"]),
                choice["description"],
            ]
            for choice in choices
        ],
        text=["default", "choices", "what it is"],
    )
    last = choices[-1]
    console.print_line(
        f"Another combination: rig models {source}:{last['name']}={last['choices'][-1]}, with "
        "a comma between options; --model takes the same name"
    )


def _start(state: State) -> str:
    if state.initial_range is None:
        return f"starts at {state.initial:g}"
    low, high = state.initial_range
    return f"start estimated from each log, {low:g} .. {high:g}"


def _as_text(value: Any) -> str:
    """A default as one would write it."""
    if isinstance(value, bool):
        return str(value).lower()
    return console.number(value) if isinstance(value, float) else str(value)


def _as_model(found: Any, where: str, options: str) -> ProcessModel:
    if callable(found) and not isinstance(found, ProcessModel):
        found = _made(found, where, _split(options, where, _lists(found)))
    elif options:
        raise ConfigError(f"{where} is a finished model; it takes no options ({options!r})")
    if not isinstance(found, ProcessModel):
        raise ConfigError(
            f"{where} is of type {type(found).__name__}, not a sysid.ProcessModel or a function "
            "that returns one"
        )
    return found


def _split(options: str, where: str, lists: frozenset[str]) -> dict[str, Any]:
    """``a=1,b=2`` by name; an option among ``lists`` takes values up to the next one's name."""
    chosen: dict[str, Any] = {}
    last = ""
    for item in filter(None, options.split(",")):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals and last in lists:
            chosen[last] = (*chosen[last], key)
            continue
        if not (key and equals and value):
            raise ConfigError(
                f"{where}: {item!r} is no option; write NAME:option=value,option=value"
            )
        chosen[key] = (value,) if key in lists else value
        last = key
    return chosen


def _lists(factory: Callable[..., Any]) -> frozenset[str]:
    """Options of a function that take several values."""
    hints = get_type_hints(factory)
    return frozenset(key for key, hint in hints.items() if get_origin(hint) is tuple)


def _made(factory: Callable[..., Any], where: str, options: dict[str, Any]) -> Any:
    """The model that a function makes of options given as text."""
    from pydantic import ValidationError, validate_call

    known = list(inspect.signature(factory).parameters)
    for key in options:
        if key not in known:
            raise ConfigError(f"{where} has no option {key!r}; {suggestion(key, known)}")
    try:
        # Turns text into what the function's annotations ask for.
        return validate_call(factory)(**options) if options else factory()
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0]) if first["loc"] else "its options"
        raise ConfigError(f"{where}: {key}={options.get(key, '')}: {first['msg']}") from None
    except ModelError as error:
        raise ConfigError(f"{where}: {error}") from None
    except Exception as error:
        raise ConfigError(f"{where}: calling it fails: {type(error).__name__}: {error}") from None


def model_options(factory: Any) -> list[dict[str, Any]]:
    """Options of a function that makes models: name, default, choices, what it is."""
    if not callable(factory) or isinstance(factory, ProcessModel):
        return []
    hints = get_type_hints(factory, include_extras=True)
    found = []
    for key, parameter in inspect.signature(factory).parameters.items():
        hint: Any = hints.get(key)
        notes: list[Any] = []
        if get_origin(hint) is Annotated:
            hint, *notes = get_args(hint)
        choices = _choices(hint)
        if choices and parameter.default is not inspect.Parameter.empty:
            text = next((t for note in notes if (t := getattr(note, "description", None))), "")
            found.append(
                {"name": key, "default": parameter.default, "choices": choices, "description": text}
            )
    return found


def _choices(hint: Any) -> list[str]:
    """What may be written for an option; nothing for one that cannot be given as text."""
    if get_origin(hint) is Literal:
        return [str(choice) for choice in get_args(hint)]
    if hint is bool:
        return ["false", "true"]
    return {float: ["number"], int: ["whole number"], str: ["text"]}.get(hint, [])
