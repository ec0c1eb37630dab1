"""The operations that a tape's lines stand for, on floats and on arrays alike."""

import functools
import math
import operator
import types
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

# NumPy's functions by the names that they have in ``math``.
_SAME_NAMES = (
    "exp expm1 log log1p log2 log10 sqrt fabs hypot copysign sin cos tan sinh cosh tanh floor ceil"
)
UFUNCS = {
    **{name: getattr(np, name) for name in _SAME_NAMES.split()},
    **{"asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2},
    "pow": np.power,
}


@functools.cache
def operation(form: str, count: int) -> Callable[..., Any]:
    """The function of ``count`` operands that a form such as ``{} + {}`` stands for.

    Calling it with arrays raises TypeError where NumPy has no such function.
    """
    names = [f"a{i}" for i in range(count)]
    text = "power({}, {})" if form == "{} ** {}" else form
    function: Callable[..., Any] = eval(f"lambda {', '.join(names)}: {text.format(*names)}", _SCOPE)
    return function


@functools.lru_cache(maxsize=4096)
def constant(text: str) -> Any:
    """The number that a literal, or an operation on literals alone, stands for."""
    return eval(text, _SCOPE)


def _elementwise(function: Callable[..., Any], ufunc: np.ufunc | None) -> Callable[..., Any]:
    """A function of floats that applies its NumPy counterpart where an argument is an array."""

    def call(*args: Any) -> Any:
        if not arrays(args):
            return function(*args)
        if ufunc is None or ufunc.nin != len(args):
            raise TypeError(f"{function.__name__} of many numbers is not known")
        return ufunc(*args)

    return call


def arrays(args: Iterable[Any]) -> bool:
    """Whether any of the numbers is an array."""
    return any(isinstance(a, np.ndarray) for a in args)


def _select(condition: Any, first: Any, second: Any) -> Any:
    """``first`` where a condition holds, else ``second``."""
    if arrays((condition,)):
        return np.where(condition, first, second)
    return first if condition else second


def _extreme(better: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    """``min`` or ``max``, by what makes one number better than another; of equals the first."""
    return lambda *args: functools.reduce(lambda a, b: _select(better(b, a), b, a), args)


def _sign(a: Any) -> Any:
    """The derivative of |a|; at zero, where it jumps, the mean of both sides."""
    if arrays((a,)):
        return np.sign(a)
    return math.copysign(1.0, a) if a else 0.0


def _power(a: Any, b: Any) -> Any:
    """a^b; NaN for a negative a unless b is whole."""
    if arrays((a, b)):
        return np.power(a, b)
    power = a**b
    return math.nan if isinstance(power, complex) else power


def _power_slope(a: Any, b: Any, da: Any) -> Any:
    """b a^(b-1) da, the change of a^b with a; 0 where b or da is, even if a^(b-1) is infinite."""
    if arrays((a, b, da)):
        slope = b * _power(a, b - 1.0) * da
        return np.where((da != 0.0) & (b != 0.0), slope, 0.0)
    return b * _power(a, b - 1.0) * da if b and da else 0.0


def _exponent_slope(a: Any, power: Any, db: Any) -> Any:
    """a^b ln(a) db, the change of ``power`` = a^b with b; 0 at a = 0, as 0^b is for all b > 0."""
    if arrays((a, power, db)):
        return np.where(db != 0.0, power * np.log(np.where(a == 0.0, 1.0, a)) * db, 0.0)
    return (power * math.log(a) if a else 0.0) * db if db else 0.0


_SCOPE: dict[str, Any] = {
    "math": types.SimpleNamespace(
        **{
            name: _elementwise(item, UFUNCS.get(name)) if callable(item) else item
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
