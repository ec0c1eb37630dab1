"""An identified quantity: a parameter, or a combination of several, with its unit."""

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Literal, Protocol

Z95 = 1.959963984540054  # of a normal distribution, two-sided 95 %

Why = Literal["", "tied", "vague", "rival", "end"]


class Invariant(Protocol):
    """An expression of several parameters, which are named as in values."""

    @property
    def text(self) -> str:
        """As people write it."""

    @property
    def unit(self) -> str:
        """Empty where it has no name."""

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters in it."""

    def value(self, values: Mapping[str, float]) -> float:
        """Value at parameters by name."""

    def gradient(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Derivatives by its parameters."""


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval, or the reason why it has none.

    name: of the parameter, or the combination's text. low, high: ends of the interval, None
    on a side where the data set no end within the range searched. std: standard deviation of an
    interval by the curvature at the value, None of one by the profile likelihood. why: empty,
    ``tied`` (it acts only together with other parameters), ``vague`` (the data set no end on
    either side), ``rival`` (it has another value in a rival minimum; the interval is that around
    this one), or ``end`` (a combination that the data want beyond what the ranges allow). on_bound:
    whether the value stands on an end of its range; pushed: whether the data want it beyond;
    harmless: whether beyond it all else would be estimated alike.
    failing: share of the range in which the model cannot be simulated, where that ends the
    interval. combination: None of a parameter.

    >>> inertia = Estimate("J", "kg*m^2", 5.0, std=0.1, low=4.8, high=5.2)
    >>> inertia.excludes({"J": 4.9}), inertia.excludes({"J": 4.7})
    (False, True)
    """

    name: str
    unit: str
    value: float
    std: float | None = None
    low: float | None = None
    high: float | None = None
    why: Why = ""
    on_bound: bool = False
    pushed: bool = False
    harmless: bool = False
    failing: float = 0.0
    combination: Invariant | None = None

    @property
    def deviation(self) -> float | None:
        """Standard deviation, or that of which an interval with two ends would be."""
        if self.std is not None or self.low is None or self.high is None:
            return self.std
        return (self.high - self.low) / (2.0 * Z95)

    def is_of(self, names: AbstractSet[str]) -> bool:
        """Whether it is one of these parameters, or a combination that any of them is in."""
        members = self.combination.names if self.combination else (self.name,)
        return not names.isdisjoint(members)

    def at(self, parameters: Mapping[str, float]) -> float:
        """Value of the quantity for other values of the parameters."""
        combination = self.combination
        return float(combination.value(parameters) if combination else parameters[self.name])

    def excludes(self, parameters: Mapping[str, float]) -> bool:
        """Whether the quantity lies outside its interval for these values of the parameters."""
        value = self.at(parameters)
        below = self.low is not None and value < self.low
        return below or (self.high is not None and value > self.high)
