"""Numbers that write down what is done to them, and how they depend on a model's states.

A model's equations, run on such numbers, leave a tape: straight-line code of one operation a
line. Beside its value each number knows its straight piece: the states it depends on linearly
and the coefficients, themselves numbers on the tape that depend on the parameters alone.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from sysid.engine.substitution import substituted

_NONE: frozenset[int] = frozenset()
_WHOLE = 64  # whole powers up to this one are products
_BOTH_SIDES = frozenset({"min", "max"})


class UntraceableError(Exception):
    """The equations need the value of a number, not just what is done to it."""


@dataclass(frozen=True)
class Line:
    """``name = text``; fixed when it depends on the parameters alone."""

    name: str
    text: str
    operands: tuple[str, ...]
    fixed: bool


@dataclass(frozen=True)
class Clamp:
    """A number ``base`` that ``max`` and ``min`` (``sides``) keep within fixed limits."""

    base: Trace
    sides: frozenset[str]
    limits: tuple[str, ...]


class Tape:
    """Straight-line code over states x0.., inputs u0.., parameters p0.. and results t0..

    clamps: all numbers that have been limited.
    """

    def __init__(self) -> None:
        self.clamps: list[Clamp] = []
        self._lines: dict[str, Line] = {}  # by text: what is computed twice is written once
        self._by_name: dict[str, Line] = {}

    def emit(self, form: str, *operands: str) -> str:
        """Name of the result of an operation, ``form`` with places for its operands."""
        text = form.format(*operands)
        if not any(map(self.named, operands)):
            return f"({text})"  # literals alone, which the compiler works out
        if text not in self._lines:
            fixed = all(self.fixed(operand) for operand in operands)
            line = Line(f"t{len(self._lines)}", text, operands, fixed)
            self._lines[text] = self._by_name[line.name] = line
        return self._lines[text].name

    def fixed(self, name: str) -> bool:
        """Whether a name or a literal depends on the parameters alone."""
        line = self._by_name.get(name)
        return line.fixed if line else name[0] not in "xu"

    def named(self, operand: str) -> bool:
        """Whether it is a name and not a literal."""
        return operand in self._by_name or operand[0] in "xup"

    def needed(self, names: Iterable[str]) -> list[Line]:
        """Lines that the named numbers need, in order."""
        wanted: set[str] = set(names)
        lines = []
        for line in reversed(self._lines.values()):
            if line.name in wanted:
                wanted.update(line.operands)
                lines.append(line)
        return lines[::-1]

    def join(self, sign: str, a: str | None, b: str | None) -> str | None:
        """``a + b`` or ``a - b``, where None is nothing."""
        if a is None or b is None:
            return a if b is None else b if sign == "+" else self.emit("-{}", b)
        return self.emit(f"{{}} {sign} {{}}", a, b)

    def join_all(self, sign: str, a: Mapping[int, str], b: Mapping[int, str]) -> dict[int, str]:
        """The same of coefficients."""
        joined = {k: self.join(sign, a.get(k), b.get(k)) for k in [*a, *b]}
        return {k: c for k, c in joined.items() if c is not None}

    def multiply(self, a: str, b: str) -> str:
        """Product, without multiplying by a literal one."""
        if "1.0" in (a, b):
            return a if b == "1.0" else b
        return self.emit("{} * {}", a, b)

    def straight(self, linear: Mapping[int, str]) -> str | None:
        """Sum of coefficients times states."""
        total = None
        for j, coefficient in sorted(linear.items()):
            total = self.join("+", total, self.multiply(coefficient, f"x{j}"))
        return total


@dataclass(frozen=True, eq=False)
class Trace:
    """A number on a tape.

    total: its name. linear: coefficients by state of its straight piece; rest: the name of
    what is left of it, None for nothing. nonlinear: states on which it depends in other ways.
    kinks: coefficients of the limited numbers that it is a sum of, by their place among the
    tape's limits. clamp: what has limited it, where nothing has been done to it since.
    """

    tape: Tape
    total: str
    linear: Mapping[int, str] = field(default_factory=dict)
    rest: str | None = None
    nonlinear: frozenset[int] = _NONE
    kinks: Mapping[int, str] = field(default_factory=dict)
    inputs: frozenset[int] = _NONE
    clamp: Clamp | None = None

    # NumPy's own numbers are to leave arithmetic to the methods here.
    __array_ufunc__ = None

    @property
    def fixed(self) -> bool:
        """Whether it depends on the parameters alone."""
        return self.tape.fixed(self.total)

    @property
    def states(self) -> frozenset[int]:
        """States on which it depends in any way."""
        return self.nonlinear | self.linear.keys()

    def lift(self, value: Any) -> Trace:
        """A number as a trace on the same tape."""
        if isinstance(value, Trace):
            return value
        if isinstance(value, numbers.Real):
            text = _literal(value)
            return Trace(self.tape, text, rest=text)
        raise UntraceableError

    def mapped(self, form: str, *others: str) -> Trace:
        """The same linear operation on the value and all its pieces."""

        def one(name: str) -> str:
            if form == "{} * {}":
                return self.tape.multiply(name, others[0])
            return self.tape.emit(form, name, *others)

        return Trace(
            self.tape,
            one(self.total),
            {j: one(c) for j, c in self.linear.items()},
            None if self.rest is None else one(self.rest),
            self.nonlinear,
            {k: one(c) for k, c in self.kinks.items()},
            self.inputs,
        )

    def _join(self, sign: str, b: Trace) -> Trace:
        tape = self.tape
        return Trace(
            tape,
            tape.emit(f"{{}} {sign} {{}}", self.total, b.total),
            tape.join_all(sign, self.linear, b.linear),
            tape.join(sign, self.rest, b.rest),
            self.nonlinear | b.nonlinear,
            tape.join_all(sign, self.kinks, b.kinks),
            self.inputs | b.inputs,
        )

    def __add__(self, other: Any) -> Trace:
        return self._join("+", self.lift(other))

    def __sub__(self, other: Any) -> Trace:
        return self._join("-", self.lift(other))

    def __rsub__(self, other: Any) -> Trace:
        return self.lift(other)._join("-", self)

    def __mul__(self, other: Any) -> Trace:
        b = self.lift(other)
        if b.fixed:
            return self.mapped("{} * {}", b.total)
        return b.mapped("{} * {}", self.total) if self.fixed else mix("{} * {}", self, b)

    def __truediv__(self, other: Any) -> Trace:
        b = self.lift(other)
        if b.fixed and not self.fixed:
            # Dividing once, with the parameters, is cheaper than at every step.
            return self.mapped("{} * {}", self.tape.emit("1.0 / {}", b.total))
        return mix("{} / {}", self, b)

    def __rtruediv__(self, other: Any) -> Trace:
        return self.lift(other) / self

    def __pow__(self, other: Any) -> Trace:
        exponent = float(other) if isinstance(other, numbers.Real) else math.nan
        if exponent.is_integer() and abs(exponent) <= _WHOLE:
            return mix("{} ** {}", self, int(exponent))
        if exponent == 0.5:
            return mix("math.sqrt({})", self)
        return mix("math.pow({}, {})", self, other)

    def __rpow__(self, other: Any) -> Trace:
        return mix("math.pow({}, {})", self.lift(other), self)

    def __mod__(self, other: Any) -> Trace:
        return mix("{} % {}", self, other)

    def __rmod__(self, other: Any) -> Trace:
        return mix("{} % {}", self.lift(other), self)

    def __floordiv__(self, other: Any) -> Trace:
        return mix("{} // {}", self, other)

    def __rfloordiv__(self, other: Any) -> Trace:
        return mix("{} // {}", self.lift(other), self)

    def __neg__(self) -> Trace:
        return self.mapped("-{}")

    def __pos__(self) -> Trace:
        return self

    def __abs__(self) -> Trace:
        return mix("abs({})", self)

    def _value(self, *others: Any) -> Any:
        raise UntraceableError

    __radd__ = __add__
    __rmul__ = __mul__
    __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = _value
    __bool__ = __float__ = __int__ = __index__ = __round__ = __trunc__ = _value
    __hash__ = object.__hash__


def mix(form: str, first: Trace, *others: Any) -> Trace:
    """Some function of numbers: nonlinear in every state that any of them depends on."""
    traces = [first, *map(first.lift, others)]
    total = first.tape.emit(form, *(t.total for t in traces))
    return Trace(
        first.tape,
        total,
        rest=total,
        nonlinear=_NONE.union(*(t.states for t in traces)),
        inputs=_NONE.union(*(t.inputs for t in traces)),
    )


def traced(
    tape: Tape, function: Any, n_states: int, n_inputs: int, n_parameters: int
) -> tuple[Trace, ...]:
    """Values of a model's function (x, u, p), run on traces.

    Raises whatever the equations raise when they cannot be followed.
    """
    x = tuple(Trace(tape, f"x{i}", {i: "1.0"}) for i in range(n_states))
    u = tuple(Trace(tape, f"u{j}", rest=f"u{j}", inputs=frozenset((j,))) for j in range(n_inputs))
    p = tuple(Trace(tape, f"p{i}", rest=f"p{i}") for i in range(n_parameters))
    one = Trace(tape, "1.0")
    return tuple(one.lift(value) for value in substituted(function, _follow)(x, u, p))


def _follow(function: Callable[..., Any]) -> Callable[..., Any]:
    """A library function that passes plain numbers on and follows traces."""

    def call(*args: Any) -> Any:
        first = next((a for a in args if isinstance(a, Trace)), None)
        if first is None:
            return function(*args)
        places = ", ".join("{}" for _ in args)
        if function in (min, max):
            return _limit(f"{function.__name__}({places})", function.__name__, first, args)
        lifted = [first.lift(a) for a in args]
        return mix(f"math.{function.__name__}({places})", *lifted)

    return call


def _limit(form: str, side: str, first: Trace, args: tuple[Any, ...]) -> Trace:
    """A number limited by fixed ones; limited on both sides it keeps its straight piece."""
    traces = [first.lift(a) for a in args]
    limited = mix(form, *traces)
    varying = [t for t in traces if not t.fixed]
    if len(varying) != 1:
        return limited
    before = varying[0].clamp or Clamp(varying[0], frozenset(), ())
    limits = (*before.limits, *(t.total for t in traces if t.fixed))
    clamp = Clamp(before.base, before.sides | {side}, limits)
    tape, base = first.tape, clamp.base
    tape.clamps.append(clamp)
    kink = {len(tape.clamps) - 1: "1.0"}
    straight = tape.straight(base.linear)
    if clamp.sides != _BOTH_SIDES or straight is None:
        return replace(limited, kinks=kink, clamp=clamp)
    return replace(
        limited,
        linear=base.linear,
        rest=tape.emit("{} - {}", limited.total, straight),
        nonlinear=base.nonlinear,
        kinks={**base.kinks, **kink},
        clamp=clamp,
    )


def _literal(value: numbers.Real) -> str:
    """Text of a number; in parentheses where a sign could be misread."""
    if isinstance(value, numbers.Integral):
        text = repr(int(value))
    else:
        number = float(value)
        text = repr(number) if math.isfinite(number) else f"math.{abs(number)}"
        if number == -math.inf:
            text = "-math.inf"
    return f"({text})" if text.startswith("-") else text
