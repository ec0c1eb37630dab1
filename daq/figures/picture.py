"""A figure with what is to be said of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Picture:
    """name: stem of its files. topic: what it belongs to in a report. caption: plain text."""

    name: str
    topic: str
    caption: str
    figure: Figure
