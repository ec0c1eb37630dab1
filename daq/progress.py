"""What a use case says while it works: steps done, and notes for whoever asked for it.

A use case takes ``watch``, a function of one event, and never prints. ``ignore`` watches nothing.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """An activity has come so far; status: the same in words, as ``generation 3/40``."""

    activity: str
    done: float
    total: float
    status: str


@dataclass(frozen=True)
class Started:
    """Something begins that takes its time, as ``prbs on simulated rig``."""

    title: str


class Level(enum.Enum):
    """How much a note matters."""

    WARNING = "warning"
    """What a user must know, however quiet."""
    NOTE = "note"
    """What a user may want to know."""
    DETAIL = "detail"
    """Which files and plugins are used, for those who ask."""


@dataclass(frozen=True)
class Note:
    """One line for the user."""

    level: Level
    text: str


Event = Progress | Started | Note
Watch = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Watch nothing."""


def warn(watch: Watch, *texts: str | None) -> None:
    """Tell warnings, leaving out those that are None."""
    for text in texts:
        if text is not None:
            watch(Note(Level.WARNING, text))
