"""Notes that a use case gives while it works; only the command line prints them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

Level = Literal["detail", "note", "warning"]


@dataclass(frozen=True)
class Note:
    """One line for the user.

    level: ``detail`` names files and plugins that are used, ``note`` what was decided for the
    user, ``warning`` what a user must know however quiet the program is.
    """

    level: Level
    text: str


Notify = Callable[[Note], None]


def ignore(note: Note) -> None:
    """The listener where nobody listens."""
