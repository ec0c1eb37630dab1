"""What a use case says while it works: steps done, and notes for whoever asked for it.

A use case takes ``watch``, a function of one event, and never prints. ``ignore`` watches nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal


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


Level = Literal["warning", "note", "detail"]


@dataclass(frozen=True)
class Note:
    """One line for the user.

    level: ``warning`` is what a user must know however quiet the program is, ``note`` what was
    decided for the user, ``detail`` which files and plugins are used.
    """

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
            watch(Note("warning", text))
