"""What a protocol concludes from its run: numbers, tables and charts, however they are shown."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

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

    def __post_init__(self) -> None:
        """Raises TypeError for a value that is no number."""
        for name in ("value", "low", "high"):
            value = getattr(self, name)
            if value is not None or name == "value":
                object.__setattr__(self, name, float(value))


@dataclass(frozen=True)
class Table:
    """Columns of equal length under names with units, written as a CSV of that name.

    columns: name -> (n,). units: of those that have one. printed: whether a terminal shows it.
    """

    name: str
    title: str
    columns: Mapping[str, FloatArray]
    units: Mapping[str, str] = field(default_factory=dict)
    printed: bool = True

    def __post_init__(self) -> None:
        """Raises ValueError for columns that make no table."""
        _require_file_name(self.name)
        object.__setattr__(self, "columns", _columns(f"table {self.name!r}", self.columns))


@dataclass(frozen=True)
class Axis:
    """What stands along an axis of a chart."""

    label: str
    unit: str = ""


@dataclass(frozen=True)
class Series:
    """Points of a chart, (n,) each; spread: half the height of their error bars.

    style: ``model`` of what was computed, drawn in black over what was measured.
    """

    label: str
    x: FloatArray
    y: FloatArray
    spread: FloatArray | None = None
    style: Literal["line", "points", "model"] = "line"

    def __post_init__(self) -> None:
        """Raises ValueError for points that are none."""
        points = {"x": self.x, "y": self.y}
        if self.spread is not None:
            points["spread"] = self.spread
        for name, values in _columns(f"series {self.label!r}", points).items():
            object.__setattr__(self, name, values)


@dataclass(frozen=True)
class Chart:
    """A figure of that file name: series over common axes."""

    name: str
    title: str
    x: Axis
    y: Axis
    series: tuple[Series, ...]

    def __post_init__(self) -> None:
        """Raises ValueError for a name that no file can have."""
        _require_file_name(self.name)


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

    def __post_init__(self) -> None:
        """Raises ValueError for values that do not belong to the plane."""
        _require_file_name(self.name)
        if np.shape(self.values) != (len(self.up), len(self.across)):
            raise ValueError(
                f"heatmap {self.name!r}: values are of shape {np.shape(self.values)}, where up has "
                f"{len(self.up)} and across {len(self.across)}"
            )


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

    def __post_init__(self) -> None:
        """Raises ValueError for ranges that are none, and a text in place of a tuple of texts."""
        if isinstance(self.remarks, str):
            raise ValueError("remarks: write a tuple of texts, a line each: ('...',)")
        for name, (low, high) in self.ranges.items():
            if not low < high:
                raise ValueError(f"ranges: {name}: {low:g} is not below {high:g}")


def _columns(what: str, values: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Arrays of numbers, (n,) each."""
    columns = {}
    for name, column in values.items():
        columns[name] = array = np.asarray(column, dtype=np.float64)
        if array.ndim != 1:
            raise ValueError(f"{what}: {name} is of shape {array.shape}; expected (n,)")
    if len({len(values) for values in columns.values()}) > 1:
        lengths = ", ".join(f"{name} has {len(values)}" for name, values in columns.items())
        raise ValueError(f"{what}: its columns must be of one length; {lengths} values")
    return columns


def _require_file_name(name: str) -> None:
    if not re.fullmatch(r"[\w-][\w.-]*", name):
        raise ValueError(f"{name!r} becomes a file's name: write letters, digits, _ and - only")
