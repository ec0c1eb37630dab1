"""YAML files with errors that name file, line, column and key."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from daq.errors import ConfigError

Key = tuple[str | int, ...]
_DEEPEST = 20  # levels of nesting
_MOST_COPIES = 10_000  # of keys and values by aliases; a few lines of them could make billions
_LISTED = 8  # line numbers in a message
_LOOK = "{problem}; check the indentation, colons and quotes here and in the line before"


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


@dataclass(frozen=True, order=True)
class Mistake:
    """Something wrong at a line and column, both (0, 0) outside of a file; text: all of it."""

    place: tuple[int, int]
    text: str


@dataclass(frozen=True)
class YamlFile:
    """Parsed content of a file and the place of each key in it.

    repeated: keys that stand twice, of which ``content`` has the last.
    """

    path: Path
    content: dict[str, Any]
    places: dict[Key, tuple[int, int]]
    repeated: tuple[Mistake, ...] = ()

    def where(self, key: Key) -> str:
        """``file:line:column`` of a key, or of its nearest parent that stands in the file."""
        line, column = self.place(key)
        return f"{self.path}:{line}:{column}"

    def line_of(self, key: Key) -> str:
        """``file:line`` of a key, as a person looks for it."""
        return f"{self.path}:{self.place(key)[0]}"

    def place(self, key: Key) -> tuple[int, int]:
        """Line and column of a key, or of its nearest parent that stands in the file."""
        while key and key not in self.places:
            key = key[:-1]
        return self.places.get(key, (1, 1))

    def error(self, key: Key, message: str) -> ConfigError:
        """A ConfigError that points at a key."""
        return ConfigError(self.mistake(key, message).text)

    def mistake(self, key: Key, message: str) -> Mistake:
        """The same, to be told with others."""
        return Mistake(self.place(key), f"{self.named(key)}: {message}")

    def named(self, key: Key) -> str:
        """Place and name of a key, as error messages begin."""
        return f"{self.where(key)}: {dotted(key)}" if key else self.where(key)


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
        places, repeated = (file.places, file.repeated) if file else ({}, ())
        return cls(path, content, places, repeated, typed, frozenset(options))

    def where(self, key: Key) -> str:
        """``command line``, or the place in the file."""
        return "command line" if self._is_typed(key) else super().where(key)

    def line_of(self, key: Key) -> str:
        """``command line``, or the line in the file."""
        return "command line" if self._is_typed(key) else super().line_of(key)

    def place(self, key: Key) -> tuple[int, int]:
        """Before all lines of the file, or the place in it."""
        return (0, 0) if self._is_typed(key) else super().place(key)

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
    return ".".join(str(part) for part in key)


def load(path: Path) -> YamlFile:
    """Read a YAML mapping; ConfigError when it is missing, unreadable or malformed."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        cure = nearest_file(path) or "check its name"
        raise ConfigError(f"{path}: there is no such file; {cure}") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: this is a folder; name a YAML file") from None
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ConfigError(
            f"{path}:{line}: not text in UTF-8; save the file with this "
            "encoding, or name the right one"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        node = yaml.compose(text, Loader=_Loader)
        content = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise ConfigError(_syntax_error(path, text, error)) from None
    if content is None:
        raise ConfigError(f"{path}: the file is empty; it must hold 'key: value' lines")
    if not isinstance(node, yaml.MappingNode) or not isinstance(content, dict):
        raise ConfigError(f"{path}:1:1: expected 'key: value' lines, found {_kind(content)}")
    found = _Places(path)
    found.collect(node, ())
    return YamlFile(path, content, found.places, tuple(found.repeated))


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
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"known are {', '.join(sorted(known))}" if known else "none are known"


def nearest_file(path: Path, others: Sequence[str] = ()) -> str:
    """Which file beside a missing one, or which of other names, it may mean; nothing without."""
    try:
        beside = {each.stem: each for each in path.parent.iterdir() if each.suffix == path.suffix}
    except OSError:
        beside = {}
    known = {**{Path(name).stem: Path(name) for name in others}, **beside}
    near = difflib.get_close_matches(path.stem, known, n=1, cutoff=0.7)
    return f"did you mean {str(known[near[0]])!r}?" if near else ""


class _Places:
    """Where each key of a file stands."""

    def __init__(self, path: Path) -> None:
        self.places: dict[Key, tuple[int, int]] = {}
        self.repeated: list[Mistake] = []
        self._path = path
        self._met: set[int] = set()
        self._copies = 0

    def collect(self, node: yaml.Node, key: Key) -> None:
        """Note the places of all keys below a node; ConfigError where there is no end to them."""
        if len(key) > _DEEPEST:
            raise ConfigError(
                f"{self._path}:{node.start_mark.line + 1}: nested too deeply; does an alias "
                "(*name) stand inside its own anchor (&name)?"
            )
        self._copies += id(node) in self._met
        self._met.add(id(node))
        if self._copies > _MOST_COPIES:
            raise ConfigError(
                f"{self._path}:{node.start_mark.line + 1}: aliases (*name) repeat this more than "
                f"{_MOST_COPIES} times over; write out what is meant"
            )
        self.places.setdefault(key, _place(node))
        if isinstance(node, yaml.MappingNode):
            self._mapping(node, key)
        elif isinstance(node, yaml.SequenceNode):
            for index, value in enumerate(node.value):
                self.collect(value, (*key, index))

    def _mapping(self, node: yaml.MappingNode, key: Key) -> None:
        seen: dict[str, int] = {}
        for name, value in node.value:
            child, place = (*key, str(name.value)), _place(name)
            if name.value in seen:
                self.repeated.append(
                    Mistake(
                        place,
                        f"{self._path}:{place[0]}:{place[1]}: {dotted(child)}: this key stands "
                        f"twice, first in line {seen[name.value]}; keep one",
                    )
                )
            seen.setdefault(str(name.value), place[0])
            self.places[child] = place
            self.collect(value, child)


def _place(node: yaml.Node) -> tuple[int, int]:
    return node.start_mark.line + 1, node.start_mark.column + 1


# How PyYAML's messages about frequent mistakes begin, and what people make of them; context: the
# line where what is amiss begins.
_CURES = {
    "mapping values are not allowed": (
        "a second ':' where one value should stand, or a line indented too far; check the "
        "indentation of this line and the one before, and put text with ': ' in quotes"
    ),
    "could not find expected ':'": (
        "a line without ':' here or before; write 'key: value', with a space behind the colon"
    ),
    "expected <block end>, but found '<block mapping start>'": (
        "a line indented differently from its neighbours; keys of one section begin in the same "
        "column"
    ),
    "expected <block end>, but found '?'": (
        "a key among the lines of a list; put it where its neighbours begin"
    ),
    "expected <block end>, but found '-'": (
        "a '-' among 'key: value' lines; leave out the '-', or indent the list below its key"
    ),
    "expected ',' or": "a bracket opened in line {context} is not closed; close it",
    "found unexpected end of stream": "a quote opened in line {context} is not closed; close it",
    "found undefined alias": "*name stands for what &name marks, and there is no such mark; put "
    "text that begins with * in quotes",
    "found character": "{problem}; put text that begins so in quotes",
    "but found another document": "a second document begins with '---'; keep one in a file",
    "could not determine a constructor": "text behind '!' is a tag, of which none is known here; "
    "leave it out, or put text that begins so in quotes",
}


def _syntax_error(path: Path, text: str, error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or str(error)
    if mark is None:
        return f"{path}: not valid YAML: {problem}"
    where = f"{path}:{mark.line + 1}:{mark.column + 1}: not valid YAML"
    tabs = [i for i, line in enumerate(text.splitlines(), 1) if re.match(r" *\t", line)]
    if mark.line + 1 in tabs:
        lines = "this line begins" if len(tabs) == 1 else f"lines {_listed(tabs)} begin"
        return f"{where}: {lines} with a tab; indent with spaces"
    opened = getattr(error, "context_mark", None) or mark
    cure = next((cure for said, cure in _CURES.items() if problem.startswith(said)), _LOOK)
    return f"{where}: {cure.format(problem=problem, context=opened.line + 1)}"


def _listed(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:_LISTED]))
    return f"{shown}, ..." if len(numbers) > _LISTED else shown


def _kind(content: object) -> str:
    if isinstance(content, str):
        return "plain text; write a space behind each colon"
    return "a list" if isinstance(content, list) else repr(content)
