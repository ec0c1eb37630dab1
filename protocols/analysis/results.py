"""What findings are made of: estimates with their intervals, axes, model lines, tables by rows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daq.findings import Axis, Number, Series, Table
from daq.hal import FloatArray

TIME, ANGLE = Axis("time", "s"), Axis("angle", "rad")
VELOCITY, TORQUE = Axis("velocity", "rad/s"), Axis("torque", "N*m")


@dataclass(frozen=True)
class Estimate:
    """A value, its standard error, and half its 95 % interval in standard errors."""

    value: float
    error: float
    quantile: float

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.value - self.quantile * self.error

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.value + self.quantile * self.error

    def number(self, name: str, unit: str, meaning: str) -> Number:
        """The estimate as a result of a run."""
        return Number(name, self.value, unit, self.low, self.high, meaning)


def student(freedom: int) -> float:
    """Half the 95 % interval by Student's distribution, in standard errors."""
    from scipy.stats import t

    return float(t.ppf(0.975, freedom))


def model_line(label: str, parts: Sequence[tuple[FloatArray, FloatArray]]) -> Series:
    """One line through the points of each part, (n,) x and y, with gaps between the parts."""
    x, y = (
        np.concatenate([np.append(values, math.nan) for values in ends])
        for ends in zip(*parts, strict=True)
    )
    return Series(label, x, y, style="model")


def table_of_rows(
    name: str, title: str, heading: str, rows: Sequence[Sequence[float]], printed: bool = True
) -> Table:
    """A table from its rows; heading: ``name [unit], ...`` of the columns, in order."""
    columns = [column.partition(" ") for column in heading.split(", ")]
    values = {column: each for (column, *_), each in zip(columns, np.array(rows).T, strict=True)}
    units = {column: unit.strip("[]") for column, _, unit in columns if unit}
    return Table(name, title, values, units, printed)
