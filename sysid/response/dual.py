"""Forward-mode differentiation: numbers that carry their gradient, one or many at once."""

from __future__ import annotations

import math
import types
from collections.abc import Callable
from typing import Any

import numpy as np

from sysid.arrays import FloatArray


class Dual:
    """A value and its derivatives with respect to n seeds, (n,).

    Or many values, (m,), and their derivatives, (n, m) or (n, 1) where they are all alike: those
    of many functions that do the same with other numbers.
    """

    __slots__ = ("slope", "value")
    __array_ufunc__ = None  # an array times a dual number is the dual number's business

    def __init__(self, value: Any, slope: FloatArray) -> None:
        self.value = value
        self.slope = slope

    def __add__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, self.slope + other.slope)
        return Dual(self.value + other, self.slope)

    def __sub__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value - other.value, self.slope - other.slope)
        return Dual(self.value - other, self.slope)

    def __rsub__(self, other: Any) -> Dual:
        return Dual(other - self.value, -self.slope)

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(
                self.value * other.value, self.slope * other.value + self.value * other.slope
            )
        return Dual(self.value * other, self.slope * other)

    def __truediv__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            quotient = self.value / other.value
            return Dual(quotient, (self.slope - quotient * other.slope) / other.value)
        return Dual(self.value / other, self.slope / other)

    def __rtruediv__(self, other: Any) -> Dual:
        quotient = other / self.value
        return Dual(quotient, -quotient / self.value * self.slope)

    def __pow__(self, other: Any) -> Dual:
        b = self._lift(other)
        if _many(self, b):
            return _powers(self, b)
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
        return Dual(abs(self.value), np.sign(self.value) * self.slope)

    # Of many values these are many answers, upon which an ``if`` raises ValueError.
    def __lt__(self, other: Any) -> Any:
        return self.value < _value(other)

    def __le__(self, other: Any) -> Any:
        return self.value <= _value(other)

    def __gt__(self, other: Any) -> Any:
        return self.value > _value(other)

    def __ge__(self, other: Any) -> Any:
        return self.value >= _value(other)

    def __eq__(self, other: object) -> Any:
        return self.value == _value(other)

    def __bool__(self) -> bool:
        return bool(self.value)

    __radd__ = __add__
    __rmul__ = __mul__
    __hash__ = None  # type: ignore[assignment]

    def _lift(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return other
        return Dual(other, np.zeros_like(self.slope))


def _value(number: Any) -> Any:
    return number.value if isinstance(number, Dual) else number


def _many(*numbers: Any) -> bool:
    return any(isinstance(_value(number), np.ndarray) for number in numbers)


def _powers(a: Dual, b: Dual) -> Dual:
    """The same as one power, for many."""
    power = np.power(a.value, b.value)
    by_base = b.value * np.power(a.value, b.value - 1.0) * a.slope
    by_exponent = power * np.log(np.where(a.value == 0.0, 1.0, a.value)) * b.slope
    slope = np.where((a.slope != 0.0) & (b.value != 0.0), by_base, 0.0)
    return Dual(power, slope + np.where(b.slope != 0.0, by_exponent, 0.0))


def on_duals(function: Callable[..., Any]) -> Callable[..., Any]:
    """A library function that passes plain numbers on and differentiates dual ones.

    Raises TypeError for a function whose derivative is not known.
    """

    def call(*args: Any) -> Any:
        if not any(isinstance(a, Dual) for a in args):
            return (_of_many(function) if _many(*args) else function)(*args)
        if function is min or function is max:
            # Comparison of duals picks one of them, slope and all.
            return _picked(function, args) if _many(*args) else function(*args)
        return _differentiate(function, args)

    return call


def _of_many(function: Callable[..., Any]) -> Callable[..., Any]:
    """What a library function is for arrays; raises TypeError where that is not known."""
    found: Callable[..., Any] | None = getattr(_MANY, function.__name__, None)
    if found is None:
        raise TypeError(f"{function.__name__} of many numbers is not known")
    return found


def _picked(function: Callable[..., Any], args: tuple[Any, ...]) -> Dual:
    """The least or the largest of several duals of many values."""
    seed = next(a for a in args if isinstance(a, Dual))
    first, *others = (seed._lift(a) for a in args)
    for other in others:
        better = other.value < first.value if function is min else other.value > first.value
        value = np.where(better, other.value, first.value)
        first = Dual(value, np.where(better, other.slope, first.slope))
    return first


def _differentiate(function: Callable[..., Any], args: tuple[Any, ...]) -> Dual:
    seed = next(a for a in args if isinstance(a, Dual))
    duals = [seed._lift(a) for a in args]
    values = [d.value for d in duals]
    if function is math.pow:
        return duals[0] ** duals[1]
    partials = _PARTIALS.get(function.__name__)
    if partials is None:
        raise TypeError(f"the derivative of {function.__name__} is not known")
    many = _many(*values)
    result = (_of_many(function) if many else function)(*values)
    slopes = partials(_MANY if many else _ONE, *values)
    slope = sum(
        (s * d.slope for s, d in zip(slopes, duals, strict=True)), np.zeros_like(seed.slope)
    )
    return Dual(result, slope)


# The library for one number, and for arrays.
_ONE = types.SimpleNamespace(**vars(math), sign=lambda x: math.copysign(1.0, x) if x else 0.0)
_MANY = types.SimpleNamespace(
    exp=np.exp, expm1=np.expm1, log=np.log, log1p=np.log1p, log2=np.log2, log10=np.log10,
    sqrt=np.sqrt, sin=np.sin, cos=np.cos, tan=np.tan, asin=np.arcsin, acos=np.arccos,
    atan=np.arctan, atan2=np.arctan2, sinh=np.sinh, cosh=np.cosh, tanh=np.tanh, fabs=np.fabs,
    hypot=np.hypot, copysign=np.copysign, floor=np.floor, ceil=np.ceil, pow=np.power,
    sign=np.sign,
)  # fmt: skip
# Derivatives by each argument, with the library m.
_PARTIALS: dict[str, Callable[..., tuple[float, ...]]] = {
    "exp": lambda m, x: (m.exp(x),),
    "expm1": lambda m, x: (m.exp(x),),
    "log": lambda m, x: (1.0 / x,),
    "log1p": lambda m, x: (1.0 / (1.0 + x),),
    "log2": lambda m, x: (1.0 / (x * math.log(2.0)),),
    "log10": lambda m, x: (1.0 / (x * math.log(10.0)),),
    "sqrt": lambda m, x: (0.5 / m.sqrt(x),),
    "sin": lambda m, x: (m.cos(x),),
    "cos": lambda m, x: (-m.sin(x),),
    "tan": lambda m, x: (1.0 + m.tan(x) ** 2,),
    "asin": lambda m, x: (1.0 / m.sqrt(1.0 - x * x),),
    "acos": lambda m, x: (-1.0 / m.sqrt(1.0 - x * x),),
    "atan": lambda m, x: (1.0 / (1.0 + x * x),),
    "atan2": lambda m, y, x: (x / (x * x + y * y), -y / (x * x + y * y)),
    "sinh": lambda m, x: (m.cosh(x),),
    "cosh": lambda m, x: (m.sinh(x),),
    "tanh": lambda m, x: (1.0 - m.tanh(x) ** 2,),
    "fabs": lambda m, x: (m.sign(x),),
    "hypot": lambda m, x, y: (x / m.hypot(x, y), y / m.hypot(x, y)),
    "copysign": lambda m, x, y: (m.copysign(1.0, x) * m.copysign(1.0, y), 0.0),
    "floor": lambda m, x: (0.0,),
    "ceil": lambda m, x: (0.0,),
}
