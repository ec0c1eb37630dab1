"""The unit of a product of parameters."""

import re
from collections import Counter
from collections.abc import Iterable

from sysid.uncertainty.estimate import fraction

_FACTOR = re.compile(r"([^\W\d]+|1)(?:\^(-?\d+))?")
_UNIT = re.compile(r"(?P<above>[^/()]+)(?:/(?:\((?P<several>[^/()]+)\)|(?P<single>[^/()*]+)))?")
# Units made of others, which cancel the one named second.
_MADE_OF: tuple[tuple[str, str, dict[str, int]], ...] = (
    ("H", "ohm", {"ohm": 1, "s": 1}),
    ("ohm", "V", {"V": 1, "A": -1}),
    ("N", "kg", {"kg": 1, "m": 1, "s": -2}),
)


def product_unit(factors: Iterable[tuple[str, float]]) -> str:
    """The unit of units to their powers: ``N*m/rad`` of 1/rad and N*m.

    Empty where a unit is not written as ``a*b^2/(c*d)`` or a power is not whole: none is better
    than a wrong one.
    """
    powers: Counter[str] = Counter()
    for unit, power in factors:
        symbols = _powers(unit or "1")
        if symbols is None or power != round(power):
            return ""
        for symbol, times in symbols.items():
            powers[symbol] += int(power) * times
    for unit, against, parts in _MADE_OF:
        if powers[unit] * powers[against] < 0:
            times = powers.pop(unit)
            powers.update({symbol: times * part for symbol, part in parts.items()})
    return fraction([(symbol, times) for symbol, times in powers.items() if times], "*", "/")


def _powers(unit: str) -> Counter[str] | None:
    """Symbols of a unit with their powers; None of a unit that is written otherwise."""
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
