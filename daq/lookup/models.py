"""Process models by installed name or from a user's Python file, their options and contents."""

import inspect
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from daq.errors import ConfigError, suggestion
from daq.lookup.user_code import from_file, locate
from daq.plugins import load_plugin
from sysid import ModelError, ProcessModel
from sysid.time_limit import AT_LENGTH, time_limit

DEFAULT_MODEL = "actuator"
# Of designed runs, which drive amplifiers to their ends: known ends tell what nothing else does.
DRIVEN_MODEL = f"{DEFAULT_MODEL}:limits=true"


def name_parts(name: str) -> tuple[str, str | None, str]:
    """Parts of ``model`` or ``file.py:object``, and ``:option=value,...`` behind either.

    The model or file, the object in a file or None for an installed model, and the options.
    """
    # Not at the first colon: a Windows path has one behind its drive.
    file = re.match(r"^(.*\.py)(?::([^:=]*))?(?::(.*))?$", name)
    if file:
        return file[1], file[2] or "model", file[3] or ""
    source, _, options = name.partition(":")
    return source, None, options


def find_model(
    name: str, relative_to: Path | None = None, record: Path | None = None
) -> ProcessModel:
    """An installed model, or an object of a Python file given as ``file.py:object``.

    The object is a ProcessModel or a function that makes one; ``:option=value,...`` behind it
    are the function's arguments. File names are looked up from the working folder, then from
    ``relative_to``. record: which names it, and whose files are not to be run. Raises ConfigError
    naming file, line and cause.
    """
    source, where, options = _source(name, relative_to, record)
    if callable(source) and not isinstance(source, ProcessModel):
        source = _call_factory(source, where, options)
    elif options:
        raise ConfigError(f"{where} is a finished model", cure=f"it takes no options ({options!r})")
    if not isinstance(source, ProcessModel):
        raise ConfigError(
            f"{where} is of type {type(source).__name__}, not a sysid.ProcessModel or a function "
            "that returns one"
        )
    return source


def _source(
    name: str, relative_to: Path | None = None, record: Path | None = None
) -> tuple[Any, str, str]:
    """A model or the function that makes one, where it is defined, and the text of its options."""
    source, attribute, options = name_parts(name)
    if attribute is None:
        return load_plugin("model", source), f"model {source!r}", options
    path = locate(Path(source), "model", relative_to)
    model = from_file(path, attribute, "model", _is_model, record)
    return model, f"{path}:{attribute}", options


def _is_model(candidate: Any) -> bool:
    return isinstance(candidate, ProcessModel)


def whole_name(name: str, relative_to: Path | None = None) -> str:
    """The name by which ``find_model`` finds the same model from any folder."""
    source, attribute, _ = name_parts(name)
    if attribute is None:
        return name
    path = locate(Path(source), "model", relative_to).resolve()
    return f"{path}{name.removeprefix(source)}"


def without_folders(names: Iterable[str]) -> dict[str, str]:
    """What to show of each name: a file without its folder, where that still tells them apart.

    >>> without_folders(["actuator", "/home/ann/lag.py:model"])["/home/ann/lag.py:model"]
    'lag.py:model'
    """
    short = {name: name.removeprefix(_folder(name)) for name in names}
    return short if len(set(short.values())) == len(short) else {name: name for name in short}


def title_of(name: str, model: ProcessModel) -> str:
    """What to call a model that was named so: the name with its options, a file's by its model.

    >>> title_of("actuator:limits=true", find_model("actuator:limits=true"))
    'actuator:limits=true'
    """
    source, attribute, options = name_parts(name)
    head = source if attribute is None else model.name
    return f"{head}:{options}" if options else head


def _folder(name: str) -> str:
    source, attribute, _ = name_parts(name)
    return "" if attribute is None else source.removesuffix(Path(source).name)


def trust_option(name: str) -> str:
    """`` --trust`` for a model in a file, as commands need it that read the name in a result.

    >>> trust_option("actuator"), trust_option("lag.py:model")
    ('', ' --trust')
    """
    return "" if name_parts(name)[1] is None else " --trust"


def describe(model: ProcessModel) -> dict[str, Any]:
    """All that a model declares, as JSON can hold it."""
    return {
        **_attributes(model, "name", "description", "equations", "assumptions"),
        "states": [
            {**_attributes(s, "name", "unit", "initial"), "estimated": s.initial_range}
            for s in model.states
        ],
        "inputs": [_attributes(signal, "name", "unit", "hold") for signal in model.inputs],
        "outputs": [_attributes(signal, "name", "unit") for signal in model.outputs],
        "parameters": [
            {
                **_attributes(p, "name", "unit", "nominal"),
                "range": None if p.fixed else [p.lower, p.upper],
                **_attributes(p, "scale", "fixed", "description"),
            }
            for p in model.parameters
        ],
        "constraints": [constraint.text for constraint in model.constraints],
    }


def _attributes(part: Any, *names: str) -> dict[str, Any]:
    return {name: getattr(part, name) for name in names}


def _parse_options(text: str, where: str, factory: Callable[..., Any]) -> dict[str, Any]:
    """Options by name from ``a=1,b=2``; a tuple takes all values up to the next name."""
    tuples = {key for key, hint in get_type_hints(factory).items() if get_origin(hint) is tuple}
    options: dict[str, Any] = {}
    last = ""
    for item in filter(None, text.split(",")):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals and last in tuples:
            options[last] = (*options[last], key)
            continue
        if not (key and equals and value):
            cure = "write NAME:option=value,option=value"
            raise ConfigError(f"{item!r} is no option", cure=cure, file=where)
        options[key] = (value,) if key in tuples else value
        last = key
    return options


def _call_factory(factory: Callable[..., Any], where: str, text: str) -> Any:
    """The model that a function makes from options given as text."""
    from pydantic import ValidationError

    options = _parse_options(text, where, factory)
    names = list(inspect.signature(factory).parameters)
    for key in options:
        if key not in names:
            raise ConfigError(f"{where} has no option {key!r}", cure=suggestion(key, names))
    try:
        # Turns text into what the function's annotations ask for.
        with time_limit(AT_LENGTH):
            return _validated(factory)(**options) if options else factory()
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0]) if first["loc"] else "its options"
        raise ConfigError(f"{key}={options.get(key, '')}: {first['msg']}", file=where) from None
    except ModelError as error:
        raise ConfigError(str(error), file=where) from None
    except Exception as error:
        problem = f"calling it fails: {type(error).__name__}: {error}"
        raise ConfigError(problem, file=where) from None


def _validated(_factory: Callable[..., Any]) -> Callable[..., Any]:
    # pydantic resolves a user's annotations among its caller's locals first: this caller has no
    # local that a user's module is likely to name.
    from pydantic import validate_call

    return validate_call(_factory)


def model_options(name: str) -> list[dict[str, Any]]:
    """Options of the function that makes a model, with the values that each accepts as text.

    A finished model has none: an empty list. Raises ConfigError.
    """
    factory, _, _ = _source(name)
    if not callable(factory) or isinstance(factory, ProcessModel):
        return []
    hints = get_type_hints(factory, include_extras=True)
    options = []
    for key, parameter in inspect.signature(factory).parameters.items():
        hint: Any = hints.get(key)
        notes: list[Any] = []
        if get_origin(hint) is Annotated:
            hint, *notes = get_args(hint)
        choices = _accepted_values(hint)
        if choices and parameter.default is not inspect.Parameter.empty:
            descriptions = [getattr(note, "description", None) for note in notes]
            facts = {"name": key, "default": parameter.default, "choices": choices}
            options.append({**facts, "description": next(filter(None, descriptions), "")})
    return options


def _accepted_values(hint: Any) -> list[str]:
    """Values that may be written for an option, by its type; empty if it cannot be text."""
    if get_origin(hint) is Literal:
        return [str(choice) for choice in get_args(hint)]
    if hint is bool:
        return ["false", "true"]
    return {float: ["number"], int: ["whole number"], str: ["text"]}.get(hint, [])
