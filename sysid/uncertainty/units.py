"""The unit of a product of parameters."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

_FACTOR = re.compile(r"([^\W\d]+|1)(?:\^(-?\d+))?")
_WRITTEN = re.compile(r"(?P<above>[^/()]+)(?:/(?:\((?P<all>[^/()]+)\)|(?P<one>[^/()*]+)))?")
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
        own = _powers(unit or "1")
        if own is None or power != round(power):
            return ""
        for name, times in own.items():
            powers[name] += int(power) * times
    for unit, against, parts in _MADE_OF:
        if powers[unit] * powers[against] < 0:
            times = powers.pop(unit)
            powers.update({name: times * part for name, part in parts.items()})
    above = [_power(name, times) for name, times in powers.items() if times > 0]
    below = [_power(name, -times) for name, times in powers.items() if times < 0]
    bottom = "*".join(below)
    divided = f"/({bottom})" if len(below) > 1 else f"/{bottom}" if below else ""
    return ("*".join(above) or "1") + divided


def _powers(unit: str) -> Counter[str] | None:
    """Symbols of a unit with their powers; None of one that is written otherwise."""
    found = _WRITTEN.fullmatch(unit)
    if found is None:
        return None
    powers: Counter[str] = Counter()
    for text, sign in ((found["above"], 1), (found["all"] or found["one"] or "1", -1)):
        for factor in text.split("*"):
            symbol = _FACTOR.fullmatch(factor.strip())
            if symbol is None:
                return None
            if symbol[1] != "1":
                powers[symbol[1]] += sign * int(symbol[2] or 1)
    return powers


def _power(name: str, times: int) -> str:
    return name if times == 1 else f"{name}^{times}"
