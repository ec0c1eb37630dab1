"""Numbers that write every operation on them down on a tape."""

from __future__ import annotations

import math
import numbers
import operator
import types
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.arithmetic import UFUNCS
from sysid.engine.substitution import Copier
from sysid.engine.tape import Tape


def _operation(sign: str) -> tuple[Callable[[Trace, Any], Trace], Callable[[Trace, Any], Trace]]:
    """The methods of an operation for its left and for its right operand."""
    form = f"{{}} {sign} {{}}"
    return lambda a, b: a.result(form, a, b), lambda a, b: a.result(form, b, a)


def _condition(sign: str) -> Callable[[Trace, Any], bool]:
    return lambda a, b: a.tape.decide(f"{{}} {sign} {{}}", a.name, operand(b))


class Trace:
    """A number on a tape, by its name there.

    Conditions on it are decided by its value at the point where the tape stands; on a tape
    without a point they raise TypeError.
    """

    __slots__ = ("name", "tape")

    def __init__(self, tape: Tape, name: str) -> None:
        self.tape = tape
        self.name = name

    def result(self, form: str, *operands: Any) -> Trace:
        """The result of an operation on numbers, traced or not."""
        return Trace(self.tape, self.tape.emit(form, *map(operand, operands)))

    __add__ = __radd__ = _operation("+")[0]
    __mul__ = __rmul__ = _operation("*")[0]
    __sub__, __rsub__ = _operation("-")
    __truediv__, __rtruediv__ = _operation("/")
    __pow__, __rpow__ = _operation("**")
    __mod__, __rmod__ = _operation("%")
    __floordiv__, __rfloordiv__ = _operation("//")
    __lt__, __le__ = _condition("<"), _condition("<=")
    __gt__, __ge__ = _condition(">"), _condition(">=")
    __eq__, __ne__ = _condition("=="), _condition("!=")
    __hash__ = object.__hash__

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        """A NumPy number on the left, or NumPy's function of single numbers."""
        if method != "__call__" or options:
            return NotImplemented
        numbers = [a if isinstance(a, Trace) else float(a) for a in inputs]
        if ufunc in _ARITHMETIC:
            return _ARITHMETIC[ufunc](*numbers)
        if ufunc in _FUNCTIONS:
            return _FUNCTIONS[ufunc](*numbers)
        if ufunc is np.sign and self.tape.single(map(operand, numbers)):
            return float(numbers[0] > 0.0) - float(numbers[0] < 0.0)
        return NotImplemented

    def __neg__(self) -> Trace:
        return self.result("-{}", self)

    def __pos__(self) -> Trace:
        return self

    def __abs__(self) -> Trace:
        return self.result("abs({})", self)

    def __bool__(self) -> bool:
        return self != 0.0


# What the operators of a NumPy number call.
_ARITHMETIC: dict[np.ufunc, Callable[..., Any]] = {
    np.add: operator.add, np.subtract: operator.sub, np.multiply: operator.mul,
    np.divide: operator.truediv, np.floor_divide: operator.floordiv, np.remainder: operator.mod,
    np.power: operator.pow, np.less: operator.lt, np.less_equal: operator.le,
    np.greater: operator.gt, np.greater_equal: operator.ge, np.equal: operator.eq,
    np.not_equal: operator.ne,
}  # fmt: skip


def followed(function: Any) -> Callable[..., tuple[Any, ...]]:
    """A copy of a model's function that takes traces for numbers."""
    library = {name: _traceable(f) if callable(f) else f for name, f in vars(math).items()}
    builtins = {"min": _traceable(min), "max": _traceable(max)}
    copier = Copier(types.SimpleNamespace(**library), lambda copy: copy, builtins, unwrap=True)
    copy: Callable[..., tuple[Any, ...]] = copier.copied(function)
    return copy


def evaluated(function: Any, *sides: FloatArray) -> FloatArray:
    """A model's function (x, u, p) at many points at once, (n_points, n_values).

    sides: values of each, (n_points, ...) or (1, ...). Not finite where the function is not.
    Raises what following it does, ValueError where its conditions part the points.
    """
    letters = dict(zip("xup", sides, strict=True))
    tape = Tape(
        {f"{k}{i}": side[:, i] for k, side in letters.items() for i in range(side.shape[1])}
    )
    arguments = (traces(tape, letter, side.shape[1]) for letter, side in letters.items())
    with np.errstate(all="ignore"):
        values = [tape.value(operand(value)) for value in followed(function)(*arguments)]
    rows = np.zeros(max(map(len, sides)))
    return np.stack([rows + value for value in values], axis=1)


def values_along(
    function: Callable[..., Any],
    n_values: int,
    states: FloatArray,
    inputs: FloatArray,
    parameters: FloatArray,
) -> FloatArray:
    """Values of a model's function along a run, (n_samples, n_values), NaN where it fails.

    states: (n_samples, n_states); inputs: (n_samples, n_inputs); parameters: (n_parameters,).
    """
    with suppress(Exception):  # it may do more than can be followed at many points at once
        return evaluated(function, states, inputs, parameters[None])
    p = tuple(parameters.tolist())
    values = np.full((len(states), n_values), np.nan)
    for row, x, u in zip(values, states.tolist(), inputs.tolist(), strict=True):
        try:
            row[:] = function(tuple(x), tuple(u), p)
        except (ArithmeticError, ValueError):
            continue
    return values


def rates_along(
    derivative: Callable[..., Any], states: FloatArray, inputs: FloatArray, parameters: FloatArray
) -> FloatArray:
    """A model's rates along a run, (n_samples, n_states), as of ``values_along``."""
    return values_along(derivative, states.shape[1], states, inputs, parameters)


def traces(tape: Tape, letter: str, count: int) -> tuple[Trace, ...]:
    """All states (x), inputs (u) or parameters (p) of a tape."""
    return tuple(Trace(tape, f"{letter}{i}") for i in range(count))


def operand(value: Any) -> str:
    """Name of a trace, or text of a number, in parentheses if it is negative."""
    if isinstance(value, Trace):
        return value.name
    if isinstance(value, numbers.Integral):
        text = repr(int(value))
    elif isinstance(value, numbers.Real):
        text = repr(float(value)).replace("inf", "math.inf").replace("nan", "math.nan")
    else:
        raise TypeError(f"{type(value).__name__} is no number that equations can be followed with")
    return f"({text})" if text.startswith("-") else text


def _traceable(function: Callable[..., Any]) -> Callable[..., Any]:
    """A library function that computes plain numbers, and writes itself down for traces."""
    prefix = "" if function in (min, max) else "math."

    def call(*args: Any) -> Any:
        first = next((a for a in args if isinstance(a, Trace)), None)
        # With values at hand, Python's own min and max pick one of the traces, as a branch would.
        if first is None or (function in (min, max) and first.tape.single(map(operand, args))):
            return function(*args)
        places = ", ".join("{}" for _ in args)
        return first.result(f"{prefix}{function.__name__}({places})", *args)

    return call


# NumPy's functions of single numbers.
_FUNCTIONS: dict[np.ufunc, Callable[..., Any]] = {
    **{ufunc: _traceable(getattr(math, name)) for name, ufunc in UFUNCS.items()},
    np.absolute: abs,
    np.square: lambda a: a * a,
    np.minimum: _traceable(min),
    np.maximum: _traceable(max),
}
