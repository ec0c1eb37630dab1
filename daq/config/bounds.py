"""How large and how involved a file of settings or results may be, judged before it is built.

A few lines of YAML can stand for billions of values, and one line for a number that takes minutes
to convert. Text and parser events are counted, which costs no more than reading them; the bounds
are far beyond what anybody writes.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from daq.errors import ConfigError, Mistake

MOST_BYTES = 20_000_000
MOST_VALUES = 100_000  # keys and values, those that aliases repeat among them
DEEPEST = 20  # levels of nesting
LONGEST_NUMBER = 200  # characters: every whole number is within the range of floats
_NUMBERS = {"tag:yaml.org,2002:int", "tag:yaml.org,2002:float"}
# Brackets, words, and strings as a whole, also one without an end, as nothing in it counts.
_JSON_PARTS = re.compile(r'"(?:[^"\\]|\\.)*+"?|[][{}]|[-+.\w]++', re.DOTALL)


def text_of(path: Path) -> str:
    """Text of a file; OSError, or ConfigError where it is too large or no text in UTF-8."""
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        problem = f"larger than {MOST_BYTES / 1e6:g} MB"
        cure = "is it the right file? Keep tables in CSV files"
        raise ConfigError(problem, cure=cure, file=path)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        cure = "save the file with this encoding: editors have it beside 'Save as'"
        raise ConfigError("not text in UTF-8", cure=cure, file=path, line=line) from None
    control = yaml.reader.Reader.NON_PRINTABLE.search(text)
    if control:
        line = text.count("\n", 0, control.start()) + 1
        problem = f"not text: it holds a control character (byte {ord(control[0])})"
        cure = "is it the right file? Else write this line anew"
        raise ConfigError(problem, cure=cure, file=path, line=line)
    return text.replace("\r\n", "\n")


def check_json(text: str, path: Path) -> None:
    """Raise ConfigError for JSON beyond the bounds, at the line where it passes them."""
    level = n_values = 0
    for part in _JSON_PARTS.finditer(text):
        first = text[part.start()]
        level += (first in "[{") - (first in "]}")
        n_values += first not in "]}"
        digits = 0 if first == '"' else part.end() - part.start()
        problem = _excess(level, n_values, digits)
        if problem is not None:
            line = text.count("\n", 0, part.start()) + 1
            raise ConfigError.of([Mistake(*problem, path, line)])


def check_yaml(
    events: Iterable[yaml.Event], tag_of: Callable[[yaml.ScalarEvent], Any], path: Path | None
) -> None:
    """Raise ConfigError for YAML beyond the bounds, at the place where it passes them.

    tag_of: the type that a scalar is read as. path: None for what was typed.
    """
    budget = _Budget(tag_of)
    for event in events:
        problem = budget.spend(event)
        if problem is not None:
            mark = event.start_mark
            assert mark is not None  # of a parser's event it never is
            raise ConfigError.of([Mistake(*problem, path, mark.line + 1, mark.column + 1)])


def _excess(level: int, n_values: int, digits: int) -> tuple[str, str] | None:
    """Problem and cure where one of the bounds is passed."""
    if level > DEEPEST:
        return f"nested more than {DEEPEST} levels deep", "is a bracket before it not closed?"
    if n_values > MOST_VALUES:
        problem = f"more than {MOST_VALUES} keys and values up to here"
        return problem, "is it the right file? Keep tables in CSV files"
    if digits > LONGEST_NUMBER:
        return f"a number of {digits} characters", f"write at most {LONGEST_NUMBER}"
    return None


@dataclass
class _Section:
    """A mapping or list: its anchor, its levels of nesting, how many values it makes."""

    anchor: str | None = None
    levels: int = 1
    values: int = 1

    def add(self, levels: int, values: int) -> None:
        self.levels = max(self.levels, 1 + levels)
        self.values += values


class _Budget:
    """What a document has come to so far, aliases and merges (``<<``) written out."""

    def __init__(self, tag_of: Callable[[yaml.ScalarEvent], Any]) -> None:
        self._tag_of = tag_of
        self._n_values = 0
        self._unclosed = [_Section()]  # the document, and in it the sections down to this place
        self._marked: dict[str, _Section] = {}  # by anchor

    def spend(self, event: yaml.Event) -> tuple[str, str] | None:
        """Problem and cure where an event passes one of the bounds."""
        levels, values, digits = 0, 1, 0
        if isinstance(event, yaml.CollectionEndEvent):
            self._close()
            return None
        if isinstance(event, yaml.CollectionStartEvent):
            self._unclosed.append(_Section(event.anchor))
        elif isinstance(event, yaml.ScalarEvent):
            digits = len(event.value) if self._is_number(event) else 0
            self._unclosed[-1].add(levels, values)
        elif isinstance(event, yaml.AliasEvent):
            if any(event.anchor == section.anchor for section in self._unclosed):
                problem = f"alias *{event.anchor} stands inside its own anchor &{event.anchor}"
                return problem, "write out what is meant"
            marked = self._marked.get(event.anchor or "", _Section(levels=0))
            levels, values = marked.levels, marked.values
            self._unclosed[-1].add(levels, values)
            if self._n_values + values > MOST_VALUES:
                problem = f"aliases (*name) make more than {MOST_VALUES} keys and values of it"
                return problem, "write out what is meant"
        else:
            return None
        self._n_values += values
        return _excess(len(self._unclosed) - 1 + levels, self._n_values, digits)

    def _close(self) -> None:
        section = self._unclosed.pop()
        self._unclosed[-1].add(section.levels, section.values)
        if section.anchor is not None:
            self._marked[section.anchor] = section

    def _is_number(self, scalar: yaml.ScalarEvent) -> bool:
        # What is short enough need not be looked at closely.
        return len(scalar.value) > LONGEST_NUMBER and self._tag_of(scalar) in _NUMBERS
