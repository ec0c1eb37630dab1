"""What the forms of a tape's lines compute, of floats and of arrays alike."""

import functools
import math
import operator
import types
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

# What a library function of one float is called for arrays.
_SAME_NAMES = (
    "exp expm1 log log1p log2 log10 sqrt fabs hypot copysign sin cos tan sinh cosh tanh floor ceil"
)
_OF_ARRAYS = {
    **{name: getattr(np, name) for name in _SAME_NAMES.split()},
    **{"asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2},
    "pow": np.power,
}


@functools.cache
def operation(form: str, count: int) -> Callable[..., Any]:
    """What a form with places for so many operands computes.

    It raises TypeError for arrays given to a function of which only one for floats is known.
    """
    names = [f"a{i}" for i in range(count)]
    text = "power({}, {})" if form == "{} ** {}" else form
    function: Callable[..., Any] = eval(f"lambda {', '.join(names)}: {text.format(*names)}", _SCOPE)
    return function


@functools.lru_cache(maxsize=4096)
def constant(text: str) -> Any:
    """The number that a literal, or an operation on literals alone, stands for."""
    return eval(text, _SCOPE)


def _of_either(function: Callable[..., Any], of_arrays: np.ufunc | None) -> Callable[..., Any]:
    """A function of floats that does the same with arrays among them."""

    def call(*args: Any) -> Any:
        if not arrays(args):
            return function(*args)
        if of_arrays is None or of_arrays.nin != len(args):
            raise TypeError(f"{function.__name__} of many numbers is not known")
        return of_arrays(*args)

    return call


def arrays(args: Iterable[Any]) -> bool:
    """Whether any of some numbers is an array of many."""
    return any(isinstance(a, np.ndarray) for a in args)


def _select(condition: Any, first: Any, second: Any) -> Any:
    """The first where a condition holds, else the second."""
    if arrays((condition,)):
        return np.where(condition, first, second)
    return first if condition else second


def _extreme(better: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    """The first of several numbers than which none is better."""
    return lambda *args: functools.reduce(lambda a, b: _select(better(b, a), b, a), args)


def _sign(a: Any) -> Any:
    """The slope of |a|: at zero, where there is none, the mean of its two sides."""
    if arrays((a,)):
        return np.sign(a)
    return math.copysign(1.0, a) if a else 0.0


def _power(a: Any, b: Any) -> Any:
    """a^b, of a negative number no number unless b is whole."""
    if arrays((a, b)):
        return np.power(a, b)
    power = a**b
    return math.nan if isinstance(power, complex) else power


def _power_slope(a: Any, b: Any, moved: Any) -> Any:
    """By how much a^b moves with a; a root at zero has no slope, unless nothing moves there."""
    if arrays((a, b, moved)):
        slope = b * _power(a, b - 1.0) * moved
        return np.where((moved != 0.0) & (b != 0.0), slope, 0.0)
    return b * _power(a, b - 1.0) * moved if b and moved else 0.0


def _exponent_slope(a: Any, power: Any, moved: Any) -> Any:
    """By how much a power of a moves with its exponent; 0^b stays 0 for all b > 0."""
    if arrays((a, power, moved)):
        return np.where(moved != 0.0, power * np.log(np.where(a == 0.0, 1.0, a)) * moved, 0.0)
    return (power * math.log(a) if a else 0.0) * moved if moved else 0.0


_SCOPE: dict[str, Any] = {
    "math": types.SimpleNamespace(
        **{
            name: _of_either(item, _OF_ARRAYS.get(name)) if callable(item) else item
            for name, item in vars(math).items()
        }
    ),
    "min": _extreme(operator.lt),
    "max": _extreme(operator.gt),
    "select": _select,
    "sign": _sign,
    "power": _power,
    "power_slope": _power_slope,
    "exponent_slope": _exponent_slope,
}
