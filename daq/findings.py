"""What a protocol concludes from its run: numbers, tables and charts, however they are shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from daq.hal import FloatArray


@dataclass(frozen=True)
class Number:
    """One result: value and unit; low, high: its 95 % interval where there is one."""

    name: str
    value: float
    unit: str
    low: float | None = None
    high: float | None = None
    meaning: str = ""


@dataclass(frozen=True)
class Table:
    """Columns of equal length under names with units, written as a CSV of that name.

    columns: name -> (n,). units: of those that have one. printed: whether a terminal shows it.
    """

    name: str
    title: str
    columns: Mapping[str, FloatArray]
    units: Mapping[str, str]
    printed: bool = True


@dataclass(frozen=True)
class Axis:
    """What stands along an axis of a chart."""

    label: str
    unit: str = ""


@dataclass(frozen=True)
class Series:
    """Points of a chart, (n,) each; spread: half the height of their error bars."""

    label: str
    x: FloatArray
    y: FloatArray
    spread: FloatArray | None = None
    style: Literal["line", "points"] = "line"


@dataclass(frozen=True)
class Chart:
    """A figure of that file name: series over common axes."""

    name: str
    title: str
    x: Axis
    y: Axis
    series: tuple[Series, ...]


@dataclass(frozen=True)
class Heatmap:
    """A figure of that file name: a value over a plane of two quantities.

    across (n,), up (m,), values (m, n). series: curves drawn over it, such as a theory's bound.
    """

    name: str
    title: str
    x: Axis
    y: Axis
    value: Axis
    across: FloatArray
    up: FloatArray
    values: FloatArray
    series: tuple[Series, ...] = ()


@dataclass(frozen=True)
class Findings:
    """All that a protocol concludes.

    ranges: parameter -> (low, high), where an identification may search it. remarks: a line each.
    """

    numbers: tuple[Number, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Chart | Heatmap, ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
