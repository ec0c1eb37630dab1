"""An identified quantity: a parameter, or a product or sum of several."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Z95 = 1.959963984540054  # of a normal distribution, two-sided 95 %

Why = Literal["", "tied", "vague", "bound", "rival"]


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
        """The same quantity of these parameters."""
        if self.form == "product":
            return float(np.prod([parameters[name] ** power for name, power in self.terms]))
        return float(sum(factor * parameters[name] for name, factor in self.terms))

    def excludes(self, parameters: Mapping[str, float]) -> bool:
        """Whether the quantity of these parameters is outside the interval, if there is one."""
        if self.low is None or self.high is None:
            return False
        return not self.low <= self.at(parameters) <= self.high


def fraction(powers: Iterable[tuple[str, float]], times: str, over: str) -> str:
    """A product of powers as text: ``a*b^2/(c*d)`` with ``*`` for times and ``/`` for over."""
    above: list[str] = []
    below: list[str] = []
    for name, power in powers:
        factor = name if abs(power) == 1 else f"{name}^{abs(power):g}"
        (above if power > 0 else below).append(factor)
    bottom = times.join(below) if len(below) < 2 else f"({times.join(below)})"
    return (times.join(above) or "1") + (over + bottom if below else "")


def product_text(terms: Sequence[tuple[str, float]]) -> str:
    """``a b^2 / c`` of exponents 1, 2 and -1."""
    return fraction(terms, " ", " / ")


def sum_text(terms: Sequence[tuple[str, float]]) -> str:
    """``a + 2 b - c`` of factors 1, 2 and -1."""
    parts: list[str] = []
    for name, factor in terms:
        size = name if abs(factor) == 1.0 else f"{abs(factor):.4g} {name}"
        sign = "-" if factor < 0.0 else "+"
        parts.append(f" {sign} {size}" if parts else size if factor > 0.0 else f"-{size}")
    return "".join(parts)
