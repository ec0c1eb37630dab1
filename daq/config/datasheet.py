"""A data sheet: what is known of parameters before anything is measured."""

from __future__ import annotations

from typing import Any

from pydantic import Field, model_validator

from daq.config.base import Section
from daq.config.identification import Range
from daq.config.units import Percent, Quantity, factor, split


class DatasheetEntry(Section):
    """One parameter: a value and how exact it is, or a range, and who says so."""

    value: Quantity | None = Field(None, description="nominal value")
    tolerance: Percent | None = Field(None, gt=0.0, description="either side of the value")
    range: Range | None = Field(None, description="in place of value and tolerance")
    fixed: bool = Field(False, description="the value is exact enough not to be searched")
    unit: str | None = Field(None, min_length=1, description="of the numbers; default the model's")
    source: str = Field("", description="which data sheet, for the table of results")

    @model_validator(mode="before")
    @classmethod
    def _with_own_unit(cls, given: Any) -> Any:
        """Value or range written with a unit, as the number and a unit."""
        if not isinstance(given, dict) or given.get("unit") is not None:
            return given
        value, ends = split(given.get("value")), given.get("range")
        if value is not None:
            return {**given, "value": value[0], "unit": value[1]}
        if not isinstance(ends, list):
            return given
        quantities = [split(end) for end in ends]
        unit = next((quantity[1] for quantity in quantities if quantity is not None), None)
        if unit is None:
            return given
        numbers = [
            end if quantity is None else quantity[0] * factor(quantity[1], unit)
            for end, quantity in zip(ends, quantities, strict=True)
        ]
        return {**given, "range": numbers, "unit": unit}

    @model_validator(mode="after")
    def _complete(self) -> DatasheetEntry:
        if (self.value is None) == (self.range is None):
            raise ValueError("give either 'value' or 'range'")
        if self.value is None:
            if self.fixed or self.tolerance is not None:
                raise ValueError("a range has no tolerance and cannot be fixed; give a value")
        elif self.fixed == (self.tolerance is not None):
            raise ValueError(
                "say how exact the value is: 'tolerance: 10 %', or 'fixed: true' not to search it"
            )
        return self

    def ends(self, factor: float) -> tuple[float | None, float | None]:
        """The range, converted by a unit's factor."""
        if self.range is not None:
            low, high = self.range
            return (
                None if low is None else factor * low,
                None if high is None else factor * high,
            )
        assert self.value is not None and self.tolerance is not None
        off = abs(self.value) * self.tolerance / 100.0
        return factor * (self.value - off), factor * (self.value + off)
