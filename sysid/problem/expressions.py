"""Products and sums of parameters: their texts and units, and how easily a unit is measured."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence

_FACTOR = re.compile(r"([^\W\d]+|1)(?:\^(-?\d+))?")
_UNIT = re.compile(r"(?P<above>[^/()]+)(?:/(?:\((?P<several>[^/()]+)\)|(?P<single>[^/()*]+)))?")
# (unit, unit that it cancels, units that the first is made of)
_DERIVED: tuple[tuple[str, str, dict[str, int]], ...] = (
    ("H", "ohm", {"ohm": 1, "s": 1}),
    ("H", "V", {"V": 1, "s": 1, "A": -1}),
    ("ohm", "V", {"V": 1, "A": -1}),
    ("N", "kg", {"kg": 1, "m": 1, "s": -2}),
)

# Units of what a lab measures with a meter, a scale or a data sheet, easiest first.
_MEASURABLE = ("ohm", "H", "kg", "m", "N*m/A", "V*s/rad", "kg*m^2", "N/m")


def measuring_effort(unit: str) -> int:
    """Rank of a unit by how easily a lab measures what has it."""
    return _MEASURABLE.index(unit) if unit in _MEASURABLE else len(_MEASURABLE)


def product_text(powers: Iterable[tuple[str, float]], times: str = " ", over: str = " / ") -> str:
    """A product of powers: ``a b^2 / (c d)``, or ``a*b^2/(c*d)`` with ``*`` and ``/``."""
    above: list[str] = []
    below: list[str] = []
    for name, power in powers:
        factor = name if abs(power) == 1 else f"{name}^{abs(power):g}"
        (above if power > 0 else below).append(factor)
    bottom = times.join(below) if len(below) < 2 else f"({times.join(below)})"
    return (times.join(above) or "1") + (over + bottom if below else "")


def sum_text(terms: Sequence[tuple[str, float]]) -> str:
    """``a + 2 b - c`` of factors 1, 2 and -1."""
    parts: list[str] = []
    for name, factor in terms:
        size = name if abs(factor) == 1.0 else f"{abs(factor):.4g} {name}"
        if parts:
            parts.append(f" - {size}" if factor < 0.0 else f" + {size}")
        else:
            parts.append(size if factor > 0.0 else f"-{size}")
    return "".join(parts)


def product_unit(factors: Iterable[tuple[str, float]]) -> str:
    """Unit of a product of units, each to its power: ``N*m/rad`` of 1/rad and N*m.

    Empty where a unit is not written as ``a*b^2/(c*d)`` or a power is not whole: no unit is
    better than a wrong one.
    """
    powers: Counter[str] = Counter()
    for unit, power in factors:
        symbols = _powers(unit or "1")
        if symbols is None or power != round(power):
            return ""
        for symbol, exponent in symbols.items():
            powers[symbol] += int(power) * exponent
    for unit, cancelled, parts in _DERIVED:
        if powers[unit] * powers[cancelled] < 0:
            exponent = powers.pop(unit)
            powers.update({symbol: exponent * part for symbol, part in parts.items()})
    return product_text([(symbol, power) for symbol, power in powers.items() if power], "*", "/")


def _powers(unit: str) -> Counter[str] | None:
    """Powers of a unit by symbol; None for a unit not written as ``a*b^2/(c*d)``."""
    parts = _UNIT.fullmatch(unit)
    if parts is None:
        return None
    powers: Counter[str] = Counter()
    for text, sign in ((parts["above"], 1), (parts["several"] or parts["single"] or "1", -1)):
        for factor in text.split("*"):
            symbol = _FACTOR.fullmatch(factor.strip())
            if symbol is None:
                return None
            if symbol[1] != "1":
                powers[symbol[1]] += sign * int(symbol[2] or 1)
    return powers
