"""Process models by name, or in a user's own Python file; what they declare."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from daq.errors import ConfigError, suggestion
from daq.lookup.user_code import from_file, locate
from daq.plugins import load_plugin
from sysid import ModelError, ProcessModel

DEFAULT_MODEL = "actuator"


@dataclass(frozen=True)
class ModelName:
    """``model`` or ``file.py:object``, and ``:option=value,...`` behind either.

    attribute: the object in a file, None for an installed model.
    """

    source: str
    attribute: str | None
    options: str

    @classmethod
    def parse(cls, text: str) -> ModelName:
        """Take a name apart."""
        # Not at the first colon: a Windows path has one behind its drive.
        file = re.match(r"^(.*\.py)(?::([^:=]*))?(?::(.*))?$", text)
        if file:
            return cls(file[1], file[2] or "model", file[3] or "")
        source, _, options = text.partition(":")
        return cls(source, None, options)


@dataclass(frozen=True)
class ModelOption:
    """An option of a function that makes models, and what may be written for it."""

    name: str
    default: Any
    choices: list[str]
    description: str


def find_model(name: str, relative_to: Path | None = None) -> ProcessModel:
    """An installed model, or an object of a Python file given as ``file.py:object``.

    The object is a ProcessModel or a function that makes one; ``:option=value,...`` behind it
    are the function's arguments. File names are looked up from the working folder, then from
    ``relative_to``. Raises ConfigError naming file, line and cause.
    """
    parsed = ModelName.parse(name)
    where = f"model {parsed.source!r}"
    if parsed.attribute is not None:
        where = f"{locate(Path(parsed.source), 'model', relative_to)}:{parsed.attribute}"
    return _as_model(_source(parsed, relative_to), where, parsed.options)


def _source(name: ModelName, relative_to: Path | None = None) -> Any:
    """The model, or the function that makes it."""
    if name.attribute is None:
        return load_plugin("rig.models", name.source)
    path = locate(Path(name.source), "model", relative_to)
    return from_file(path, name.attribute, "model", lambda value: isinstance(value, ProcessModel))


def whole_name(name: str, relative_to: Path | None = None) -> str:
    """The name by which ``find_model`` finds the same model from any folder."""
    parsed = ModelName.parse(name)
    if parsed.attribute is None:
        return name
    path = locate(Path(parsed.source), "model", relative_to).resolve()
    return f"{path}{name.removeprefix(parsed.source)}"


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


def _as_model(source: Any, where: str, options: str) -> ProcessModel:
    if callable(source) and not isinstance(source, ProcessModel):
        source = _made(source, where, _split(options, where, _lists(source)))
    elif options:
        raise ConfigError(f"{where} is a finished model", cure=f"it takes no options ({options!r})")
    if not isinstance(source, ProcessModel):
        raise ConfigError(
            f"{where} is of type {type(source).__name__}, not a sysid.ProcessModel or a function "
            "that returns one"
        )
    return source


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
                f"{item!r} is no option", cure="write NAME:option=value,option=value", file=where
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
    from pydantic import ValidationError

    names = list(inspect.signature(factory).parameters)
    for key in options:
        if key not in names:
            raise ConfigError(f"{where} has no option {key!r}", cure=suggestion(key, names))
    try:
        # Turns text into what the function's annotations ask for.
        return _validated(factory)(**options) if options else factory()
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0]) if first["loc"] else "its options"
        raise ConfigError(f"{key}={options.get(key, '')}: {first['msg']}", file=where) from None
    except ModelError as error:
        raise ConfigError(str(error), file=where) from None
    except Exception as error:
        raise ConfigError(
            f"calling it fails: {type(error).__name__}: {error}", file=where
        ) from None


def _validated(_factory: Callable[..., Any]) -> Callable[..., Any]:
    # pydantic looks names of annotations up among the caller's variables first: there are no
    # others here that a user's module may have, too.
    from pydantic import validate_call

    return validate_call(_factory)


def model_options(name: str) -> list[ModelOption]:
    """Options of the function that makes a model; none of a finished model. ConfigError."""
    factory = _source(ModelName.parse(name))
    if not callable(factory) or isinstance(factory, ProcessModel):
        return []
    hints = get_type_hints(factory, include_extras=True)
    options = []
    for key, parameter in inspect.signature(factory).parameters.items():
        hint: Any = hints.get(key)
        notes: list[Any] = []
        if get_origin(hint) is Annotated:
            hint, *notes = get_args(hint)
        choices = _choices(hint)
        if choices and parameter.default is not inspect.Parameter.empty:
            text = next((t for note in notes if (t := getattr(note, "description", None))), "")
            options.append(ModelOption(key, parameter.default, choices, text))
    return options


def _choices(hint: Any) -> list[str]:
    """What may be written for an option; nothing for one that cannot be given as text."""
    if get_origin(hint) is Literal:
        return [str(choice) for choice in get_args(hint)]
    if hint is bool:
        return ["false", "true"]
    return {float: ["number"], int: ["whole number"], str: ["text"]}.get(hint, [])
