"""Physical settings: each number in a file has a declared unit, and may be written with one.

    amplitude: Volts = Field(0.5, ge=0.0, le=10.0, description="half the step between levels")
    slope: Annotated[float, Unit("V/s")] = Field(gt=0.0, description="of the ramp")
    levels: list[RadiansPerSecond] = Field(min_length=1, description="speeds to visit")

In YAML ``0.5``, ``0.5 V`` and ``500 mV`` are then the same. The unit stands in the reference and
in the JSON Schema, so a description does not repeat it. A number whose unit only a model or
another key can tell is a ``Quantity``, as ``converted`` or ``split`` makes it a number.
"""

import functools
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, get_args

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, WithJsonSchema
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
# Atomic: 1e3 is no 1 with the unit e3.
_QUANTITY = re.compile(rf"\s*((?>{_NUMBER}))(?:\s*([^\s\d.,].*?)|\s+(1/[^\s\d.,].*?))\s*")
# Bounds in a JSON Schema hold for numbers only, and patterns for text only.
QUANTITY_SCHEMA: JsonSchemaValue = {
    "type": ["number", "string"],
    "pattern": rf"^\s*{_NUMBER}(\s*[^\s\d.,]|\s+1/[^\s\d.,]).*$",
}


@dataclass(frozen=True)
class Unit:
    """Marks a number of a configuration model as being in this unit, ``1`` for a plain part.

    Text such as ``5 ms`` is converted to it; what does not convert is a mistake in the file.
    """

    symbol: str

    def number(self, value: Any) -> Any:
        """The number that a text with a unit stands for; anything else as it is."""
        try:
            return converted(value, self.symbol)
        except ValueError as error:
            raise PydanticCustomError("unit", "{problem}", {"problem": str(error)}) from None

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self.number, handler(kind))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return {**handler(schema), **QUANTITY_SCHEMA, "unit": self.symbol}


Volts = Annotated[float, Unit("V")]
Amperes = Annotated[float, Unit("A")]
Seconds = Annotated[float, Unit("s")]
Hertz = Annotated[float, Unit("Hz")]
Radians = Annotated[float, Unit("rad")]
RadiansPerSecond = Annotated[float, Unit("rad/s")]
NewtonMetres = Annotated[float, Unit("N*m")]
Turns = Annotated[float, Unit("turn")]
Percent = Annotated[float, Unit("%")]
Part = Annotated[float, Unit("1")]
# Given with a unit that stands elsewhere, and a plain number when it is checked.
Quantity = Annotated[float, WithJsonSchema(QUANTITY_SCHEMA)]


def unit_of(kind: Any, marks: Iterable[Any] = ()) -> str | None:
    """The unit of a type's numbers, among its marks or wherever in it; None without one."""
    for mark in (*marks, *getattr(kind, "__metadata__", ())):
        if isinstance(mark, Unit):
            return mark.symbol
    return next(filter(None, map(unit_of, get_args(kind))), None)


def converted(value: Any, unit: str) -> Any:
    """The number of units that a text such as ``5 ms`` stands for; anything else as it is.

    Raises ValueError for a unit that does not convert.
    """
    quantity = split(value)
    return value if quantity is None else quantity[0] * factor(quantity[1], unit)


def split(value: Any) -> tuple[float, str] | None:
    """Number and unit of a text such as ``5 ms`` or ``2 1/m``; None for anything else."""
    parts = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    return None if parts is None else (float(parts[1]), parts[2] or parts[3])


def factor(given: str, wanted: str) -> float:
    """Factor from one unit to another, as in ``mm/s`` or ``N*m``.

    Raises ValueError that says why there is none.
    """
    if given == wanted:
        return 1.0
    import pint

    registry = _registry()
    try:
        have, want = (registry.Quantity(1.0, _spelt(unit)) for unit in (given, wanted))
        result = float(have.to(want.units).magnitude)
    except pint.DimensionalityError:
        raise ValueError(f"{given!r} does not convert to {wanted!r}") from None
    except Exception:
        problem = f"unit {given!r} is not understood; write it as in 'mm/s' or 'N*m'"
        raise ValueError(problem) from None
    if _angles(have) != _angles(want):
        # A number per minute may count turns or radians, and so may hertz.
        raise ValueError(
            f"{given!r} does not say whether it counts turns or radians, as {wanted!r} does, or "
            "the other way round; write 'rpm', 'turn/s', 'deg' or 'rad/s'"
        )
    return result


_SI = {"kilogram": "kg", "meter": "m", "second": "s", "ampere": "A", "kelvin": "K", "mole": "mol",
       "candela": "cd", "radian": "rad"}  # fmt: skip


def base_units(unit: str) -> tuple[float, dict[str, int]] | None:
    """A unit as a factor and whole powers of kg, m, s, A, K, mol, cd and rad; None for others.

    >>> base_units("mN*m")
    (0.001, {'kg': 1, 'm': 2, 's': -2})
    """
    try:
        quantity = _registry().Quantity(1.0, _spelt(unit)).to_base_units()
    except Exception:
        return None
    powers = {_SI.get(name): power for name, power in quantity.unit_items()}
    if None in powers or any(power != int(power) for power in powers.values()):
        return None
    named = [name for name in _SI.values() if name in powers]
    return float(f"{quantity.magnitude:.12g}"), {name: int(powers[name]) for name in named}


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def _angles(quantity: Any) -> float:
    """Power of the angle in a quantity's unit."""
    powers = dict(quantity.to_root_units().unit_items())
    return float(powers.get("radian", 0.0))


def _spelt(unit: str) -> str:
    if unit == "1":
        return "dimensionless"
    per = "1" if unit.startswith("/") else ""  # 5/m, as in 5 1/m
    return per + unit.replace("·", "*").replace("^", "**")
