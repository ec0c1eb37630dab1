"""Power series in time as numbers on a tape, of hundreds of digits each with a bound on its error.

Coefficients are balls of FLINT's ``arb``: what is not zero is proven so, whatever was rounded.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

from flint import arb, arb_series, ctx

# A number is a float, an ``arb`` or an ``arb_series``.


@functools.cache
def series_operation(form: str, count: int) -> Callable[..., Any]:
    """The function of ``count`` numbers that a line's form stands for.

    Calling it raises TypeError where no such function of series is known.
    """
    if form in _FORMS:
        return _FORMS[form]
    names = [f"a{i}" for i in range(count)]
    text = f"lambda {', '.join(names)}: {form.format(*names)}"
    function: Callable[..., Any] = eval(text, _SCOPE)
    return function


def coefficients(number: Any) -> list[arb]:
    """The coefficients of a number, as many as series have now."""
    if not isinstance(number, arb_series):
        return [arb(number)] + [arb(0)] * (ctx.cap - 1)
    coeffs: list[arb] = number.coeffs()
    if number.prec < ctx.cap:
        raise ArithmeticError("a series is not known to this order")
    return coeffs[: ctx.cap] + [arb(0)] * (ctx.cap - len(coeffs))


def sign(number: Any) -> int:
    """Sign just after the start: that of the first coefficient that is not zero."""
    parts = number.coeffs() if isinstance(number, arb_series) else [arb(number)]
    for part in parts:
        if part.is_nan():
            raise ArithmeticError("a number is undefined")
        if not part.contains(0):
            return 1 if part > 0 else -1
    return 0


def _lifted(number: Any) -> Any:
    """A float as an ``arb``, which has the functions."""
    return number if isinstance(number, (arb, arb_series)) else arb(number)


def _named(name: str) -> Callable[[Any], Any]:
    return lambda a: getattr(_lifted(a), name)()


def _absolute(a: Any) -> Any:
    return a * sign(a)


def _power(a: Any, b: Any) -> Any:
    if isinstance(b, (int, float)) and float(b).is_integer():
        whole = _lifted(a) ** abs(int(b))
        return whole if b >= 0 else 1 / whole
    return (b * _lifted(a).log()).exp()


def _power_slope(a: Any, b: Any, da: Any) -> Any:
    if not (sign(b) and sign(da)):
        return arb(0)
    whole = isinstance(b, (int, float)) and float(b).is_integer()
    return b * _power(a, b - 1 if whole else _lifted(b) - 1) * da


def _exponent_slope(a: Any, power: Any, db: Any) -> Any:
    return power * _lifted(a).log() * db if sign(a) and sign(db) else arb(0)


def _floor(a: Any) -> Any:
    """The whole number below just after the start."""
    start = coefficients(a)[0]
    below = start.floor()
    return below - 1 if (start - below).contains(0) and sign(a - below) < 0 else below


def _cosh(a: Any) -> Any:
    return (_lifted(a).exp() + (-_lifted(a)).exp()) / 2


def _sinh(a: Any) -> Any:
    return (_lifted(a).exp() - (-_lifted(a)).exp()) / 2


def _tanh(a: Any) -> Any:
    return 1 - 2 / ((2 * _lifted(a)).exp() + 1)


def _hypot(*sides: Any) -> Any:
    return _lifted(sum(a * a for a in sides)).sqrt()


def _atan2(y: Any, x: Any) -> Any:
    if sign(x) > 0:
        return _lifted(y / x).atan()
    quarter = arb.pi() / 2
    return quarter * sign(y) - _lifted(x / y).atan()


def _comparison(holds: Callable[[int], bool]) -> Callable[[Any, Any], bool]:
    return lambda a, b: holds(sign(_lifted(a) - b))


_FORMS: dict[str, Callable[..., Any]] = {
    # Of two literals, too, in all digits: 1 / 0.2 rounded is not what x / 0.2 moves by.
    "{} + {}": lambda a, b: _lifted(a) + b,
    "{} - {}": lambda a, b: _lifted(a) - b,
    "{} * {}": lambda a, b: _lifted(a) * b,
    "{} / {}": lambda a, b: _lifted(a) / b,
    "{} < {}": _comparison(lambda s: s < 0),
    "{} <= {}": _comparison(lambda s: s <= 0),
    "{} > {}": _comparison(lambda s: s > 0),
    "{} >= {}": _comparison(lambda s: s >= 0),
    "{} == {}": _comparison(lambda s: s == 0),
    "{} != {}": _comparison(lambda s: s != 0),
    "{} ** {}": _power,
    "{} // {}": lambda a, b: _floor(a / b),
    "{} % {}": lambda a, b: a - b * _floor(a / b),
    "-({0} // {1})": lambda a, b: -_floor(a / b),
}

_NATIVE = ("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "erf", "erfc")
_MATH: dict[str, Any] = {
    **{name: _named(name) for name in _NATIVE},
    "pow": _power, "fabs": _absolute, "hypot": _hypot, "atan2": _atan2,
    "cosh": _cosh, "sinh": _sinh, "tanh": _tanh,
    "expm1": lambda a: _lifted(a).exp() - 1,
    "log1p": lambda a: _lifted(1 + a).log(),
    "log2": lambda a: _lifted(a).log() / arb(2).log(),
    "log10": lambda a: _lifted(a).log() / arb(10).log(),
    "floor": _floor, "ceil": lambda a: -_floor(-a),
    "copysign": lambda a, b: _absolute(a) * (sign(b) or 1),
    "pi": math.pi, "e": math.e, "tau": math.tau,
}  # fmt: skip


class _Library:
    """What stands for the module ``math``."""

    def __getattr__(self, name: str) -> Any:
        if name not in _MATH:
            raise TypeError(f"math.{name} has no known power series")
        return _MATH[name]


_SCOPE: dict[str, Any] = {
    "math": _Library(),
    "abs": _absolute,
    "sign": sign,
    "select": lambda condition, first, second: first if condition else second,
    "power_slope": _power_slope,
    "exponent_slope": _exponent_slope,
}
