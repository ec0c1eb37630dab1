"""A determined quantity: a parameter, or a product or sum of several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Z95 = 1.959963984540054  # of a normal distribution, two-sided 95 %

Why = Literal["", "tied", "vague", "bound", "rival"]


@dataclass(frozen=True)
class Estimate:
    """A value with its standard deviation and 95 % interval, or without where there is none.

    terms: (parameter, exponent) of a product, (parameter, factor) of a sum. why: empty, ``tied``
    (it acts only together with others), ``vague`` (the data hardly feel it), ``bound`` (it
    stands on an end of its range), or ``rival`` (it is another in a rival minimum).
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
        """The same quantity of other parameters."""
        if self.form == "product":
            return float(np.prod([parameters[name] ** power for name, power in self.terms]))
        return float(sum(factor * parameters[name] for name, factor in self.terms))


def product_text(terms: Sequence[tuple[str, float]]) -> str:
    """``a b^2 / c`` of exponents 1, 2 and -1."""
    above = [_power(name, exponent) for name, exponent in terms if exponent > 0.0]
    below = [_power(name, -exponent) for name, exponent in terms if exponent < 0.0]
    text = " ".join(above) or "1"
    if below:
        bottom = " ".join(below)
        text += " / " + (f"({bottom})" if len(below) > 1 else bottom)
    return text


def sum_text(terms: Sequence[tuple[str, float]]) -> str:
    """``a + 2 b - c`` of factors 1, 2 and -1."""
    parts: list[str] = []
    for name, factor in terms:
        size = name if abs(factor) == 1.0 else f"{abs(factor):.4g} {name}"
        sign = "-" if factor < 0.0 else "+"
        parts.append(f" {sign} {size}" if parts else size if factor > 0.0 else f"-{size}")
    return "".join(parts)


def _power(name: str, exponent: float) -> str:
    return name if exponent == 1.0 else f"{name}^{exponent:g}"
