"""An identified quantity: a parameter, or a product or sum of several, with its unit."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Z95 = 1.959963984540054  # of a normal distribution, two-sided 95 %

Why = Literal["", "tied", "vague", "bound", "rival"]

_FACTOR = re.compile(r"([^\W\d]+|1)(?:\^(-?\d+))?")
_UNIT = re.compile(r"(?P<above>[^/()]+)(?:/(?:\((?P<several>[^/()]+)\)|(?P<single>[^/()*]+)))?")
# (unit, unit that it cancels, units that the first is made of)
_DERIVED: tuple[tuple[str, str, dict[str, int]], ...] = (
    ("H", "ohm", {"ohm": 1, "s": 1}),
    ("ohm", "V", {"V": 1, "A": -1}),
    ("N", "kg", {"kg": 1, "m": 1, "s": -2}),
)


@dataclass(frozen=True)
class Estimate:
    """A value with its standard deviation and 95 % interval, or the reason why it has none.

    terms: (parameter, exponent) of a product, (parameter, factor) of a sum. why: empty, ``tied``
    (it acts only together with other parameters), ``vague`` (the data hardly feel it), ``bound``
    (it stands on an end of its range), or ``rival`` (it has another value in a rival minimum).

    >>> inertia = Estimate("J_m + 2 J_b", "kg*m^2", 5.0, (("J_m", 1.0), ("J_b", 2.0)), "sum")
    >>> inertia.at({"J_m": 1.0, "J_b": 3.0})
    7.0
    """

    name: str
    unit: str
    value: float
    terms: tuple[tuple[str, float], ...]
    form: Literal["product", "sum"]
    std: float | None = None
    low: float | None = None
    high: float | None = None
    why: Why = ""

    def at(self, parameters: Mapping[str, float]) -> float:
        """Value of the quantity for other values of the parameters."""
        if self.form == "product":
            return float(np.prod([parameters[name] ** power for name, power in self.terms]))
        return float(sum(factor * parameters[name] for name, factor in self.terms))

    def excludes(self, parameters: Mapping[str, float]) -> bool:
        """Whether the quantity has an interval, and lies outside it for these parameters."""
        if self.low is None or self.high is None:
            return False
        return not self.low <= self.at(parameters) <= self.high


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
