"""Forward-mode differentiation: numbers that carry their gradient."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from sysid.model import FloatArray


class Dual:
    """A value and its derivatives with respect to n seeds, (n,)."""

    __slots__ = ("slope", "value")

    def __init__(self, value: float, slope: FloatArray) -> None:
        self.value = value
        self.slope = slope

    def __add__(self, other: Any) -> Dual:
        b = self._lift(other)
        return Dual(self.value + b.value, self.slope + b.slope)

    def __sub__(self, other: Any) -> Dual:
        b = self._lift(other)
        return Dual(self.value - b.value, self.slope - b.slope)

    def __rsub__(self, other: Any) -> Dual:
        return self._lift(other) - self

    def __mul__(self, other: Any) -> Dual:
        b = self._lift(other)
        return Dual(self.value * b.value, self.slope * b.value + self.value * b.slope)

    def __truediv__(self, other: Any) -> Dual:
        b = self._lift(other)
        quotient = self.value / b.value
        return Dual(quotient, (self.slope - quotient * b.slope) / b.value)

    def __rtruediv__(self, other: Any) -> Dual:
        return self._lift(other) / self

    def __pow__(self, other: Any) -> Dual:
        b = self._lift(other)
        power = self.value**b.value
        slope = np.zeros_like(self.slope)
        if b.value != 0.0 and np.any(self.slope):
            slope = slope + b.value * self.value ** (b.value - 1.0) * self.slope
        if np.any(b.slope):
            # d/db a^b = a^b ln a; 0^b stays 0 for every b > 0.
            slope = slope + (power * math.log(self.value) if self.value else 0.0) * b.slope
        return Dual(power, slope)

    def __rpow__(self, other: Any) -> Dual:
        return self._lift(other) ** self

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.slope)

    def __pos__(self) -> Dual:
        return self

    def __abs__(self) -> Dual:
        # At zero, where |x| has no derivative, the mean of its two sides.
        return Dual(abs(self.value), float(np.sign(self.value)) * self.slope)

    def __lt__(self, other: Any) -> bool:
        return self.value < self._lift(other).value

    def __le__(self, other: Any) -> bool:
        return self.value <= self._lift(other).value

    def __gt__(self, other: Any) -> bool:
        return self.value > self._lift(other).value

    def __ge__(self, other: Any) -> bool:
        return self.value >= self._lift(other).value

    def __eq__(self, other: object) -> bool:
        return self.value == self._lift(other).value

    def __bool__(self) -> bool:
        return bool(self.value)

    __radd__ = __add__
    __rmul__ = __mul__
    __hash__ = None  # type: ignore[assignment]

    def _lift(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return other
        return Dual(float(other), np.zeros_like(self.slope))


def on_duals(function: Callable[..., Any]) -> Callable[..., Any]:
    """A library function that passes plain numbers on and differentiates dual ones.

    Raises TypeError for a function whose derivative is not known.
    """

    def call(*args: Any) -> Any:
        if not any(isinstance(a, Dual) for a in args):
            return function(*args)
        if function is min or function is max:
            return function(*args)  # comparison of duals picks one of them, slope and all
        return _differentiate(function, args)

    return call


def _differentiate(function: Callable[..., Any], args: tuple[Any, ...]) -> Dual:
    seed = next(a for a in args if isinstance(a, Dual))
    duals = [seed._lift(a) for a in args]
    values = [d.value for d in duals]
    if function is math.pow:
        return duals[0] ** duals[1]
    partials = _PARTIALS.get(function.__name__)
    if partials is None:
        raise TypeError(f"the derivative of {function.__name__} is not known")
    result = function(*values)
    slopes = partials(*values)
    slope = sum(
        (s * d.slope for s, d in zip(slopes, duals, strict=True)), np.zeros_like(seed.slope)
    )
    return Dual(result, slope)


_PARTIALS: dict[str, Callable[..., tuple[float, ...]]] = {
    "exp": lambda x: (math.exp(x),),
    "expm1": lambda x: (math.exp(x),),
    "log": lambda x: (1.0 / x,),
    "log1p": lambda x: (1.0 / (1.0 + x),),
    "log2": lambda x: (1.0 / (x * math.log(2.0)),),
    "log10": lambda x: (1.0 / (x * math.log(10.0)),),
    "sqrt": lambda x: (0.5 / math.sqrt(x),),
    "sin": lambda x: (math.cos(x),),
    "cos": lambda x: (-math.sin(x),),
    "tan": lambda x: (1.0 + math.tan(x) ** 2,),
    "asin": lambda x: (1.0 / math.sqrt(1.0 - x * x),),
    "acos": lambda x: (-1.0 / math.sqrt(1.0 - x * x),),
    "atan": lambda x: (1.0 / (1.0 + x * x),),
    "atan2": lambda y, x: (x / (x * x + y * y), -y / (x * x + y * y)),
    "sinh": lambda x: (math.cosh(x),),
    "cosh": lambda x: (math.sinh(x),),
    "tanh": lambda x: (1.0 - math.tanh(x) ** 2,),
    "fabs": lambda x: (math.copysign(1.0, x) if x else 0.0,),
    "hypot": lambda x, y: (x / math.hypot(x, y), y / math.hypot(x, y)),
    "copysign": lambda x, y: (math.copysign(1.0, x) * math.copysign(1.0, y), 0.0),
    "floor": lambda x: (0.0,),
    "ceil": lambda x: (0.0,),
}
