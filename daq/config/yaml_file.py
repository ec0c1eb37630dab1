"""YAML files with errors that name file, line, column and key."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from daq.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)
Key = tuple[str | int, ...]


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
        return ConfigError(f"{self.where(key)}: {dotted(key)}: {message}")


def dotted(key: Key) -> str:
    """A key as people write it: motor.amplitude."""
    return ".".join(str(part) for part in key) or "(file)"


def load(path: Path) -> YamlFile:
    """Read a YAML mapping; ConfigError when it is missing, unreadable or malformed."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file") from None
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
    key: Key = (*at, *(part for part in item["loc"] if part != "[key]"))
    kind, value = item["type"], item.get("input")
    parent = _fields(model, item["loc"][:-1])
    if kind == "extra_forbidden":
        name = str(item["loc"][-1])
        return f"{file.where(key)}: {dotted(key)}: unknown key; {suggestion(name, parent)}"
    if kind == "missing":
        return f"{file.where(key)}: {dotted(key)}: this key is missing"
    message = item["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    shown = "" if isinstance(value, Mapping) else f" (got {value!r})"
    return f"{file.where(key)}: {dotted(key)}: {message}{shown}"


def _fields(model: type[BaseModel], loc: tuple[str | int, ...]) -> list[str]:
    """Names of the keys allowed at a location."""
    current: Any = model
    for part in loc:
        fields = getattr(current, "model_fields", None)
        if not fields or part not in fields:
            return []
        current = fields[part].annotation
        options = [a for a in get_args(current) if hasattr(a, "model_fields")]
        current = options[0] if options else current
    return list(getattr(current, "model_fields", {}))


def _kind(content: object) -> str:
    return {"list": "a list", "str": "plain text"}.get(type(content).__name__, repr(content))
