"""Ranges of parameters as measured data narrow them."""

import math
from collections.abc import Mapping

from sysid import Guess

Interval = tuple[float, float]


class Ranges:
    """Ranges of all parameters, low = high for one that is fixed, and what narrowed them last."""

    def __init__(self, assumed: Mapping[str, Interval]) -> None:
        self.intervals = dict(assumed)
        self.guesses: dict[str, Guess] = {}

    def narrow(self, name: str, low: float, high: float, source: str) -> None:
        """Keep what lies in [low, high]; all of it where the range assumed lies outside."""
        old = self.intervals[name]
        if old[0] == old[1]:
            return
        new = (max(old[0], low), min(old[1], high))
        if new[0] >= new[1]:
            new = (low or 0.1 * high, high if math.isfinite(high) else 10.0 * low)
        if not 0.0 < new[0] < new[1] < math.inf:
            return
        # A change of less than a hundredth is not worth a word.
        if new[0] > 1.01 * old[0] or new[1] < 0.99 * old[1] or new[0] > old[1]:
            self.intervals[name] = new
            self.guesses[name] = Guess(*new, source)

    def narrow_product(self, product: str, scale: Interval, factor: str, source: str) -> None:
        """product = scale * factor with the scale in an interval: each narrows the other."""
        low, high = self.intervals[factor]
        self.narrow(product, scale[0] * low, scale[1] * high, f"{source}, {self.text(factor)}")
        low, high = self.intervals[product]
        if scale[0] > 0.0:
            below = low / scale[1] if math.isfinite(scale[1]) else 0.0
            self.narrow(factor, below, high / scale[0], f"{source}, {self.text(product)}")

    def add(self, first: str, second: str) -> str:
        """Name of the sum of two parameters, to be narrowed like one."""
        name = f"{first} + {second}"
        ends = zip(self.intervals[first], self.intervals[second], strict=True)
        low, high = (a + b for a, b in ends)
        self.intervals[name] = low, high
        return name

    def resolve(self, first: str, second: str) -> None:
        """Narrow both parameters of a sum by what the sum was narrowed to."""
        total = f"{first} + {second}"
        guess, (lowest, highest) = self.guesses.pop(total, None), self.intervals[total]
        if guess is None:
            return
        for name, partner in ((first, second), (second, first)):
            low, high = self.intervals[partner]
            self.narrow(name, max(lowest - high, 0.0), highest - low, guess.source)

    def text(self, name: str) -> str:
        """A range as part of a guess's source."""
        low, high = self.intervals[name]
        return f"{name} {low:.3g}" if low == high else f"{name} in {low:.3g} .. {high:.3g}"
