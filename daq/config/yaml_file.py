"""YAML files with errors that name file, line, column and key."""

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import yaml

from daq.config import bounds
from daq.errors import ConfigError, Mistake, RigError

Key = tuple[str | int, ...]
_LONG = 50_000  # characters that PyYAML's own parser would take a while for
_SHOWN = 60  # characters of a setting in a message
_LISTED = 8  # line numbers in a message
_TYPED = "command line"  # in place of a file's name
_LOOK = "{problem}; check the indentation, colons and quotes here and in the line before"


_FastLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # not every PyYAML has it


class _Loader(_FastLoader):  # type: ignore[misc]
    """Safe YAML in which 1e-3 is a number, as everybody but YAML 1.1 expects."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node; a ConstructorError also for text that is none of its tag's."""
        try:
            return super().construct_object(node, deep)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            kind = node.tag.rpartition(":")[2]
            problem = f"this is no {_TAGS.get(kind, kind)}; put text in quotes"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None


_TAGS = {"int": "whole number", "float": "number", "bool": "truth value", "timestamp": "date"}
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
    """Parsed content of a file and the place of each key in it.

    repeated: keys that stand twice, of which ``content`` has the last.
    """

    path: Path
    content: dict[str, Any]
    places: dict[Key, tuple[int, int]]
    repeated: tuple[Mistake, ...] = ()

    def place(self, key: Key) -> tuple[int, int]:
        """Line and column of a key, or of its nearest parent that stands in the file."""
        while key and key not in self.places:
            key = key[:-1]
        return self.places.get(key, (1, 1))

    def mistake(self, key: Key, problem: str, cure: str = "") -> Mistake:
        """What is wrong at a key."""
        return Mistake(problem, cure, self.path, *self.place(key), dotted(key))

    def error(self, key: Key, problem: str, cure: str = "") -> ConfigError:
        """A ConfigError that points at a key."""
        return ConfigError.of([self.mistake(key, problem, cure)])

    def blamed(self, key: Key, error: RigError) -> list[Mistake]:
        """The mistakes of an error that the value of a key has led to."""
        return [mistake.behind(self.mistake(key, "")) for mistake in error.mistakes]

    def where(self, key: Key) -> str:
        """``FILE:LINE:COLUMN`` of a key, or ``command line``."""
        return self.mistake(key, "").place or _TYPED

    def line(self, key: Key) -> str:
        """``FILE:LINE`` of a key, or ``command line``."""
        return replace(self.mistake(key, ""), column=None).place or _TYPED


@dataclass(frozen=True)
class TypedSettings(YamlFile):
    """Settings given as options of a command, over those of a file if there is one.

    content: both together. typed: what the command line gave; its keys below ``named_options``
    have options of their own, the others were given with ``--set``.
    """

    typed: Mapping[str, Any] = field(default_factory=dict)
    named_options: frozenset[str] = frozenset()

    @classmethod
    def of(
        cls, options: Mapping[str, Any], settings: Sequence[str] = (), file: YamlFile | None = None
    ) -> Self:
        """Options by name without their dashes, and settings as ``key.key=value``.

        Raises ConfigError for a setting that is not of that form, or that an option gives as well.
        """
        typed: dict[str, Any] = dict(options)
        for text in settings:
            setting = _setting(text)
            (name, value), *_ = setting.items()
            if options.get(name) is not None and not isinstance(value, dict):
                option = f"--{name.replace('_', '-')}"
                raise ConfigError(
                    f"{option} gives it as well", cure="keep one of them", key=f"--set {name}"
                )
            typed = merge(typed, setting)
        path = file.path if file else Path(_TYPED)
        content = merge(file.content if file else {}, typed)
        places, repeated = (file.places, file.repeated) if file else ({}, ())
        return cls(path, content, places, repeated, typed, frozenset(options))

    def mistake(self, key: Key, problem: str, cure: str = "") -> Mistake:
        """What is wrong with an option as it was typed, or at a key of the file."""
        if not self._is_typed(key):
            return super().mistake(key, problem, cure)
        is_option = key[0] in self.named_options
        option = f"--{dotted(key).replace('_', '-')}" if is_option else f"--set {dotted(key)}"
        return Mistake(problem, cure, key=option)

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
    option = f"--set {_short(text)}"
    if not equals or not all(keys) or len(keys) > bounds.DEEPEST:
        raise ConfigError("write KEY=VALUE, for example ranges.K_m=[0.1,0.2]", key=option)
    try:
        # An alias has nothing to stand for here: it is a pattern, as of ``merge``.
        content: Any = value if value.startswith("*") else _built(value, None)[1]
    except yaml.YAMLError:
        raise ConfigError(f"{_short(value)!r} is not valid YAML", key=option) from None
    except ConfigError as error:
        problem, cure = error.mistakes[0].problem, error.cure
        raise ConfigError(problem, cure=cure, key=option) from None
    for key in reversed(keys[1:]):
        content = {key: content}
    return {keys[0]: content}


def dotted(key: Key) -> str:
    """A key as people write it: motor.amplitude."""
    return ".".join(str(part) for part in key)


def load(path: Path) -> YamlFile:
    """Read a YAML mapping; ConfigError when it is missing, unreadable or malformed."""
    text = _text_of(path)
    try:
        places, content = _built(text, path)
    except yaml.YAMLError as error:
        raise ConfigError.of([_syntax_mistake(path, text, _explicable(error, text))]) from None
    if content is None:
        raise ConfigError("the file is empty", cure="it must hold 'key: value' lines", file=path)
    if not isinstance(content, dict):
        problem = f"expected 'key: value' lines, found {_kind(content)}"
        raise ConfigError(problem, file=path, line=1, column=1)
    return YamlFile(path, content, places.places, tuple(places.repeated))


def _built(text: str, path: Path | None) -> tuple["_Places", Any]:
    """Places of a text's keys and what it says; YAMLError, or ConfigError beyond the bounds."""
    loader = _Loader(text)

    def tag_of(scalar: yaml.ScalarEvent) -> Any:
        return scalar.tag or loader.resolve(yaml.ScalarNode, scalar.value, scalar.implicit)

    try:
        bounds.check_yaml(yaml.parse(text, Loader=_Loader), tag_of, path)
    except yaml.MarkedYAMLError as error:
        # libyaml looks so far ahead that its own bound is met before ours is counted.
        if "nesting" in (error.problem or ""):
            bounds.check_yaml(yaml.parse(text, Loader=yaml.SafeLoader), tag_of, path)
        raise
    node, places = loader.get_single_node(), _Places(path)
    if node is None:
        return places, None
    # Before the mappings that << merges are put in.
    places.collect(node, ())
    return places, loader.construct_document(node)


def _explicable(error: yaml.YAMLError, text: str) -> yaml.YAMLError:
    """The same error in the words of PyYAML's own parser, which ``_CURES`` explains."""
    if isinstance(error, yaml.MarkedYAMLError) and len(text) < _LONG:
        try:
            for _ in yaml.parse(text, Loader=yaml.SafeLoader):
                pass
        except yaml.YAMLError as explicable:
            return explicable
    return error


def _text_of(path: Path) -> str:
    try:
        return bounds.text_of(path)
    except FileNotFoundError:
        cure = nearest_file(path) or "check its name"
        raise ConfigError("there is no such file", cure=cure, file=path) from None
    except OSError as error:
        if path.is_dir():  # for Windows one that may not be opened
            raise ConfigError("this is a folder", cure="name a YAML file", file=path) from None
        raise ConfigError(f"cannot be read: {error.strerror}", file=path) from None


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``changes`` laid over it, mapping by mapping."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged


def nearest_file(path: Path, shipped: Sequence[str] = ()) -> str:
    """The cure for a missing file: the nearest name beside it or among the shipped, if any."""
    try:
        files = sorted(path.parent.iterdir())
        beside = {each.stem: each for each in files if each.suffix in (path.suffix, ".yaml")}
    except OSError:
        beside = {}
    candidates = {**{Path(name).stem: Path(name) for name in shipped}, **beside}
    near = difflib.get_close_matches(path.stem, candidates, n=1, cutoff=0.7)
    return f"did you mean {str(candidates[near[0]])!r}?" if near else ""


class _Places:
    """Where each key of a file stands."""

    def __init__(self, path: Path | None) -> None:
        self.places: dict[Key, tuple[int, int]] = {}
        self.repeated: list[Mistake] = []
        self._path = path

    def collect(self, node: yaml.Node, key: Key) -> None:
        """Note the places of all keys below a node, those that aliases repeat among them."""
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
                problem = f"this key stands twice, first in line {seen[name.value]}"
                mistake = Mistake(problem, "keep one", self._path, *place, dotted(child))
                self.repeated.append(mistake)
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
    "this is no": "{problem}",
    "could not determine a constructor": "text behind '!' is a tag, of which none is known here; "
    "leave it out, or put text that begins so in quotes",
}


def _syntax_mistake(path: Path, text: str, error: yaml.YAMLError) -> Mistake:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or str(error)
    if mark is None:
        return Mistake(f"not valid YAML: {problem}", file=path)
    tabs = [i for i, line in enumerate(text.splitlines(), 1) if re.match(r" *\t", line)]
    if mark.line + 1 in tabs:
        shown = ", ".join(map(str, tabs[:_LISTED])) + ", ..." * (len(tabs) > _LISTED)
        lines = "this line begins" if len(tabs) == 1 else f"lines {shown} begin"
        cause = f"{lines} with a tab; indent with spaces"
    else:
        opened = getattr(error, "context_mark", None) or mark
        cure = next((cure for start, cure in _CURES.items() if problem.startswith(start)), _LOOK)
        cause = cure.format(problem=problem, context=opened.line + 1)
    return Mistake(f"not valid YAML: {cause}", "", path, mark.line + 1, mark.column + 1)


def _kind(content: object) -> str:
    if isinstance(content, str):
        return "plain text; write a space behind each colon"
    return "a list" if isinstance(content, list) else _short(repr(content))


def _short(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
