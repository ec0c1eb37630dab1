"""An identified quantity: a parameter, or a product or sum of several, with its unit."""

from collections.abc import Mapping
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
        """Value of the quantity for other values of the parameters."""
        if self.form == "product":
            return float(np.prod([parameters[name] ** power for name, power in self.terms]))
        return float(sum(factor * parameters[name] for name, factor in self.terms))

    def excludes(self, parameters: Mapping[str, float]) -> bool:
        """Whether the quantity has an interval, and lies outside it for these parameters."""
        if self.low is None or self.high is None:
            return False
        return not self.low <= self.at(parameters) <= self.high
