"""YAML files with errors that name file, line, column and key."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from daq.config.units import unit_of
from daq.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)
Key = tuple[str | int, ...]
_DEEPEST = 20  # levels of nesting
_SHOWN = 60  # characters of a value in a message


class _Loader(yaml.SafeLoader):
    """Safe YAML in which 1e-3 is a number, as everybody but YAML 1.1 expects."""


_Loader.yaml_implicit_resolvers = {
    key: list(value) for key, value in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


@dataclass(frozen=True)
class YamlFile:
    """Parsed content of a file and the place of each key in it."""

    path: Path
    content: dict[str, Any]
    places: dict[Key, tuple[int, int]]

    def where(self, key: Key) -> str:
        """``file:line:column`` of a key, or of its nearest parent that stands in the file."""
        while key and key not in self.places:
            key = key[:-1]
        line, column = self.places.get(key, (1, 1))
        return f"{self.path}:{line}:{column}"

    def error(self, key: Key, message: str) -> ConfigError:
        """A ConfigError that points at a key."""
        return ConfigError(f"{self.named(key)}: {message}")

    def named(self, key: Key) -> str:
        """Place and name of a key, as error messages begin."""
        return f"{self.where(key)}: {dotted(key)}"


@dataclass(frozen=True)
class CommandLine(YamlFile):
    """Settings given as options of a command, over those of a file if there is one.

    content: both together. typed: what the command line gave; its keys below ``named_options``
    have options of their own, the others were given with ``--set``.
    """

    typed: Mapping[str, Any] = field(default_factory=dict)
    named_options: frozenset[str] = frozenset()

    @classmethod
    def of(
        cls, options: Mapping[str, Any], settings: Sequence[str] = (), file: YamlFile | None = None
    ) -> CommandLine:
        """Options by name without their dashes, and settings as ``key.key=value``.

        Raises ConfigError for a setting that is not of that form.
        """
        typed: dict[str, Any] = dict(options)
        for text in settings:
            typed = merge(typed, _setting(text))
        path = file.path if file else Path("command line")
        content = merge(file.content if file else {}, typed)
        places = file.places if file else {}
        return cls(path, content, places, typed, frozenset(options))

    def where(self, key: Key) -> str:
        """``command line``, or the place in the file."""
        return "command line" if self._is_typed(key) else super().where(key)

    def named(self, key: Key) -> str:
        """The option as it is typed, or the key in the file."""
        if not self._is_typed(key):
            return super().named(key)
        if key[0] in self.named_options:
            return f"--{dotted(key).replace('_', '-')}"
        return f"--set {dotted(key)}"

    def _is_typed(self, key: Key) -> bool:
        """Whether a key, or all there is of the section it belongs in, was typed."""
        level: Any = self.typed
        for depth, part in enumerate(key):
            if not isinstance(level, Mapping):
                return True
            if part not in level:
                return depth > 0 and key[:depth] not in self.places
            level = level[part]
        return not isinstance(level, Mapping) or key not in self.places


def _setting(text: str) -> dict[str, Any]:
    """``a.b=value`` as {a: {b: value}}, the value read as YAML."""
    name, equals, value = text.partition("=")
    keys = [part.strip() for part in name.split(".")]
    if not equals or not all(keys):
        raise ConfigError(f"--set {text}: write KEY=VALUE, for example ranges.K_m=[0.1,0.2]")
    try:
        content: Any = yaml.load(value, Loader=_Loader)
    except yaml.YAMLError:
        raise ConfigError(f"--set {text}: {value!r} is not valid YAML") from None
    for key in reversed(keys):
        content = {key: content}
    found: dict[str, Any] = content
    return found


def dotted(key: Key) -> str:
    """A key as people write it: motor.amplitude."""
    return ".".join(str(part) for part in key) or "(file)"


def load(path: Path) -> YamlFile:
    """Read a YAML mapping; ConfigError when it is missing, unreadable or malformed."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file; check its name") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: this is a folder; name a YAML file") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file in UTF-8 (byte {error.start})") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        node = yaml.compose(text, Loader=_Loader)
        content = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise ConfigError(_syntax_error(path, error)) from None
    if content is None:
        raise ConfigError(f"{path}: the file is empty; it must hold 'key: value' lines")
    if not isinstance(node, yaml.MappingNode) or not isinstance(content, dict):
        raise ConfigError(f"{path}:1:1: expected 'key: value' lines, found {_kind(content)}")
    places: dict[Key, tuple[int, int]] = {}
    _collect(path, node, (), places)
    return YamlFile(path, content, places)


def validate(
    file: YamlFile, model: type[Model], content: Mapping[str, Any] | None = None, at: Key = ()
) -> Model:
    """Check a file's content, or the part of it at a key, against a model.

    Raises one ConfigError that lists every mistake, each with line, key, value and cure.
    """
    data = file.content if content is None else content
    try:
        return model.model_validate(data)
    except ValidationError as error:
        lines = [_explain(file, model, at, item) for item in error.errors()]
        raise ConfigError("\n".join(dict.fromkeys(lines))) from None


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``changes`` laid over it, mapping by mapping."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        merged[key] = merge(old, value) if both else value  # type: ignore[arg-type]
    return merged


def suggestion(name: str, known: Sequence[str]) -> str:
    """What a misspelt name may have meant, as the end of an error message."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"known are {', '.join(sorted(known))}" if known else "none are known"


def _collect(path: Path, node: yaml.Node, key: Key, places: dict[Key, tuple[int, int]]) -> None:
    if len(key) > _DEEPEST:
        raise ConfigError(
            f"{path}:{node.start_mark.line + 1}: nested too deeply; does an alias (*name) "
            "stand inside its own anchor (&name)?"
        )
    places[key] = (node.start_mark.line + 1, node.start_mark.column + 1)
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            child = (*key, str(name.value))
            place = (name.start_mark.line + 1, name.start_mark.column + 1)
            if child in places:
                first = places[child][0]
                raise ConfigError(
                    f"{path}:{place[0]}:{place[1]}: {dotted(child)}: this key stands twice, "
                    f"first in line {first}; keep one"
                )
            _collect(path, value, child, places)
            places[child] = place
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            _collect(path, value, (*key, index), places)


def _syntax_error(path: Path, error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or str(error)
    if mark is None:
        return f"{path}: not valid YAML: {problem}"
    return (
        f"{path}:{mark.line + 1}:{mark.column + 1}: not valid YAML: {problem}; "
        "check the indentation, colons and quotes here and in the line before"
    )


def _explain(file: YamlFile, model: type[BaseModel], at: Key, item: ErrorDetails) -> str:
    # pydantic adds the names of union branches and of the key/value side to the location.
    loc = tuple(part for part in item["loc"] if part != "[key]")
    kind, value = item["type"], item.get("input")
    if kind == "missing" and isinstance(loc[-1], int):
        kind, loc = "too_short", loc[:-1]
    key: Key = (*at, *(str(p) if kind == "invalid_key" else p for p in loc))
    if kind in {"extra_forbidden", "invalid_key"}:
        hint = suggestion(str(loc[-1]), _fields(model, loc[:-1]))
        return f"{file.named(key)}: unknown key; {hint}"
    description = _description(model, loc)
    # A message of the project's own says what it needs to.
    about = f" ({description})" if description and kind != "value_error" else ""
    if kind == "missing":
        return f"{file.named(key)}: this key is missing; add it{about}"
    return f"{file.named(key)}: {_complaint(kind, item, value)}{about}"


_NUMBER, _WHOLE, _LINES = (
    "expected a number",
    "expected a whole number",
    "expected 'key: value' lines",
)
_EXPECTED = {
    "float_parsing": _NUMBER,
    "float_type": _NUMBER,
    "finite_number": "expected a finite number",
    "int_parsing": _WHOLE,
    "int_parsing_size": _WHOLE,
    "int_type": _WHOLE,
    "int_from_float": _WHOLE,
    "bool_parsing": "expected true or false",
    "bool_type": "expected true or false",
    "string_type": "expected text",
    "dict_type": _LINES,
    "model_type": _LINES,
    "list_type": "expected a list [a, b]",
    "tuple_type": "expected two values [low, high]",
    "too_long": "expected two values [low, high]",
    "too_short": "expected two values [low, high]",
    "greater_than": "it must be above {gt:g}",
    "greater_than_equal": "it must be at least {ge:g}",
    "less_than": "it must be below {lt:g}",
    "less_than_equal": "it must be at most {le:g}",
    "literal_error": "it must be {expected}",
    "string_too_short": "it must not be empty",
    "string_too_long": "it must have at most {max_length} characters",
}


def _complaint(kind: str, item: ErrorDetails, value: object) -> str:
    """What is wrong with a value, in plain English, with the value."""
    expected = _EXPECTED.get(kind)
    if expected is not None:
        return f"{expected.format(**item.get('ctx', {}))}, found {_shown(value)}"
    message = item["msg"].removeprefix("Value error, ")
    found = "" if isinstance(value, Mapping) else f"; found {_shown(value)}"
    return message[0].lower() + message[1:] + found


def _shown(value: object) -> str:
    """A value as it stood in the YAML, shortened."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and not math.isfinite(value):
        return f"{'-' * (value < 0)}.{'nan' if math.isnan(value) else 'inf'}"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def _section(model: type[BaseModel], loc: Key) -> Any:
    """The configuration model at a location; None where there is none."""
    current: Any = model
    for part in loc:
        fields = getattr(current, "model_fields", None)
        if fields:
            if part not in fields:
                return None
            current = fields[part].annotation
            options = [a for a in get_args(current) if hasattr(a, "model_fields")]
            # A dict of sections stands for itself until its key has been passed.
            current = current if get_origin(current) is dict else (options or [current])[0]
        elif get_origin(current) is dict:
            current = get_args(current)[1]
        else:
            return None
    return current


def _fields(model: type[BaseModel], loc: Key) -> list[str]:
    """Names of the keys allowed at a location."""
    return list(getattr(_section(model, loc), "model_fields", {}))


def _description(model: type[BaseModel], loc: Key) -> str | None:
    """What a key means and its unit, as its field says."""
    while loc:
        fields = getattr(_section(model, loc[:-1]), "model_fields", {})
        if loc[-1] in fields:
            found = fields[loc[-1]]
            unit = unit_of(found)
            text: str | None = found.description
            return f"{text} [{unit}]" if text and unit not in {None, "1"} else text
        loc = loc[:-1]
    return None


def _kind(content: object) -> str:
    return {"list": "a list", "str": "plain text"}.get(type(content).__name__, repr(content))
