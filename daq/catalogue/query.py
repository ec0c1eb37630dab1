"""Which runs somebody means: conditions on what is known of them, words, or their folders."""

from __future__ import annotations

import fnmatch
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.catalogue.entries import RunEntry
from daq.config.metadata import SYNONYMS
from daq.errors import ConfigError, suggestion

_CONDITION = re.compile(r"\s*([^<>=!]+?)\s*(<=|>=|!=|=|<|>)\s*(.*?)\s*", re.DOTALL)
_DATE = re.compile(r"\d{4}(-\d\d(-\d\d.*)?)?$")  # or a month, or a year: texts in their order
_ORDERS: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


@dataclass(frozen=True)
class Condition:
    """``KEY OPERATOR VALUE``: ``=`` and ``!=`` know ``*``, the others numbers or dates."""

    key: str
    operator: str
    value: str

    def holds(self, entry: RunEntry) -> bool:
        """Whether it does for a run; never for one of which the key is not known."""
        fact = entry.fact(self.key)
        if fact is None or fact == "":
            return self.operator == "!=" and self.value != ""
        facts = fact if isinstance(fact, list | tuple) else [fact]
        if self.operator in ("=", "!="):
            return any(_equals(each, self.value) for each in facts) == (self.operator == "=")
        return any(self._ordered(each) for each in facts)

    def _ordered(self, fact: Any) -> bool:
        compare = _ORDERS[self.operator]
        if isinstance(fact, str):
            return compare(fact.casefold(), self.value.casefold())
        return compare(float(fact), float(self.value))


def _equals(fact: Any, value: str) -> bool:
    if isinstance(fact, bool):
        return str(fact).casefold() == value.casefold()
    if isinstance(fact, int | float):
        try:
            return float(value) == fact
        except ValueError:
            return False
    return fnmatch.fnmatchcase(str(fact).casefold(), value.casefold())


@dataclass(frozen=True)
class Query:
    """Folders of runs, of which any may be meant; conditions and words, which must all hold."""

    folders: frozenset[str]
    conditions: tuple[Condition, ...]
    words: tuple[str, ...]

    def matches(self, entry: RunEntry) -> bool:
        """Whether a run is meant."""
        if self.folders and entry.folder not in self.folders:
            return False
        if not all(condition.holds(entry) for condition in self.conditions):
            return False
        texts = _texts(entry) if self.words else ()
        return all(any(word in text for text in texts) for word in self.words)


def select(root: Path, entries: Sequence[RunEntry], terms: Iterable[str]) -> list[RunEntry]:
    """The runs that terms mean, in their order. Raises ConfigError for terms that mean none.

    A term is a capture folder (any of several is meant), ``KEY=VALUE`` and its like, or a word to
    stand anywhere in what is known of a run.
    """
    query = _parsed(root, entries, terms)
    return [entry for entry in entries if query.matches(entry)]


def ordered(entries: Sequence[RunEntry], key: str) -> list[RunEntry]:
    """Runs by a fact, those without it first. Raises ConfigError for a key that none has."""
    key = _require_key(entries, key, "--sort")
    facts = [entry.fact(key) for entry in entries]
    numbers = all(isinstance(fact, int | float) for fact in facts if fact is not None)

    def place(entry: RunEntry) -> tuple[bool, Any]:
        fact = entry.fact(key)
        if fact is None:
            return False, 0.0 if numbers else ""
        return True, fact if numbers else str(fact).casefold()

    return sorted(entries, key=place)


def require_quantities(entries: Sequence[RunEntry], names: Sequence[str]) -> None:
    """Raise ConfigError for a parameter or combination that no run has."""
    for name in names:
        if not any(name in entry.values for entry in entries):
            present = dict.fromkeys(quantity for entry in entries for quantity in entry.values)
            cure = suggestion(name, list(present))
            raise ConfigError(f"no run has {name!r}", cure=cure, key="--parameters")


def _parsed(root: Path, entries: Sequence[RunEntry], terms: Iterable[str]) -> Query:
    folders, conditions, words = set(), [], []
    for term in terms:
        condition = _CONDITION.fullmatch(term)
        folder = _folder(root, term)
        if folder is not None:
            if folder not in {entry.folder for entry in entries}:
                problem, cure = f"no run below {root}", "name the folder it is in with --in"
                raise ConfigError(problem, cure=cure, file=term)
            folders.add(folder)
        elif condition is not None:
            key = _require_key(entries, condition[1], term)
            conditions.append(_checked(entries, Condition(key, condition[2], condition[3])))
        else:
            words.append(_word(entries, term))
    return Query(frozenset(folders), tuple(conditions), tuple(words))


def _word(entries: Sequence[RunEntry], term: str) -> str:
    """A term as a word of some run; ConfigError for a path that is no folder, nor part of one's."""
    word = term.casefold()
    if "/" in term and not any(word in text for entry in entries for text in _texts(entry)):
        cure = "rig runs lists the runs, of another folder with --in"
        raise ConfigError("there is no such folder of a run", cure=cure, file=term)
    return word


def _folder(root: Path, term: str) -> str | None:
    """A term as the name of a folder below the root, as ``RunEntry`` has it; None for none."""
    for path in (Path(term), root / term):
        if term and path.is_dir():
            try:
                return path.resolve().relative_to(root.resolve()).as_posix()
            except ValueError:
                return path.as_posix()
    return None


def _checked(entries: Sequence[RunEntry], condition: Condition) -> Condition:
    """A condition that can be asked; ConfigError where an order wants a number or a date."""
    numbers = any(isinstance(entry.fact(condition.key), int | float) for entry in entries)
    if numbers and condition.operator in _ORDERS:
        try:
            float(condition.value)
        except ValueError:
            problem = f"{condition.value!r} is no number, as {condition.key} is"
            raise ConfigError(problem, cure=f"for example '{condition.key}>0.1'") from None
    dated = condition.key == "started" and condition.operator in _ORDERS
    if dated and not _DATE.match(condition.value):
        problem = f"{condition.value!r} is no date, as started is"
        raise ConfigError(problem, cure="write year-month-day, 'started>=2026-11-01'")
    return condition


def _require_key(entries: Sequence[RunEntry], key: str, place: str) -> str:
    key = SYNONYMS.get(key, key)
    if entries and all(entry.fact(key) is None for entry in entries):
        keys = list(dict.fromkeys(k for entry in entries for k in entry.facts))
        raise ConfigError(f"no run has {key!r}", cure=suggestion(key, keys), key=place)
    return key


def _texts(entry: RunEntry) -> list[str]:
    facts = entry.described.values()
    parts = [part for fact in facts for part in (fact if isinstance(fact, list) else [fact])]
    return [str(part).casefold() for part in parts]
