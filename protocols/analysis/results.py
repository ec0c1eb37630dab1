"""What findings are made of: estimates with their intervals, axes, model lines, tables by rows."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from daq.findings import Axis, Number, Series, Table
from daq.hal import FloatArray

TIME, ANGLE = Axis("time", "s"), Axis("angle", "rad")
VELOCITY, TORQUE = Axis("velocity", "rad/s"), Axis("torque", "N*m")
DAMPING, STIFFNESS = Axis("damping", "N*m*s/rad"), Axis("stiffness", "N*m/rad")


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


def estimated(*rows: tuple[str, Estimate | None, str, str]) -> Iterator[Number]:
    """Results by name, estimate, unit and meaning; those without an estimate are left out."""
    for name, x, unit, meaning in rows:
        if x is not None:
            yield Number(name, x.value, unit, x.low, x.high, meaning)


def estimates(
    values: Sequence[float] | FloatArray, errors: FloatArray, freedom: int
) -> list[Estimate]:
    """Estimates of values by their standard errors and degrees of freedom."""
    from scipy.special import stdtrit

    quantile = float(stdtrit(freedom, 0.975))
    return [Estimate(float(v), float(e), quantile) for v, e in zip(values, errors, strict=True)]


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


def low_passed(values: FloatArray, highest: float, sample_rate: float) -> FloatArray:
    """What values, (n,), have up to a frequency, without delay; both in hertz."""
    from scipy.signal import butter, sosfiltfilt

    sections = butter(2, highest, fs=sample_rate, output="sos")
    filtered: FloatArray = sosfiltfilt(sections, values)
    return filtered
