"""Numbers that write every operation on them down on a tape."""

from __future__ import annotations

import math
import numbers
import types
from collections.abc import Callable
from typing import Any

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

    # A NumPy number on the left leaves arithmetic to the reflected methods here.
    __array_ufunc__ = None

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

    def __neg__(self) -> Trace:
        return self.result("-{}", self)

    def __pos__(self) -> Trace:
        return self

    def __abs__(self) -> Trace:
        return self.result("abs({})", self)

    def __bool__(self) -> bool:
        return self != 0.0


def followed(function: Any) -> Callable[..., tuple[Any, ...]]:
    """A copy of a model's function that takes traces for numbers."""
    library = {name: _traceable(f) if callable(f) else f for name, f in vars(math).items()}
    builtins = {"min": _traceable(min), "max": _traceable(max)}
    copier = Copier(types.SimpleNamespace(**library), lambda copy: copy, builtins, unwrap=True)
    copy: Callable[..., tuple[Any, ...]] = copier.copied(function)
    return copy


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
