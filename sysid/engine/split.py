"""Numbers split into a straight piece and a rest, as the kernels compute them.

The straight piece is a sum of states times coefficients that the parameters fix; a number that
``min`` and ``max`` keep within fixed limits keeps its straight piece, and the rest is what the
limits take away.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from sysid.engine.arithmetic import constant
from sysid.engine.tape import Tape

_NONE: frozenset[int] = frozenset()
_WHOLE = 64  # whole powers up to this one are products


@dataclass(frozen=True)
class Clamp:
    """A number ``base`` that ``max`` and ``min`` (``sides``) keep within fixed limits."""

    base: Split
    sides: frozenset[str]
    limits: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Split:
    """A number on a tape and the pieces it is the sum of.

    total: its name. linear: coefficients by state of its straight piece; rest: the name of what
    is left of it, None for nothing. nonlinear: states on which it depends in other ways. kinks:
    coefficients of the clamps that it is a sum of, by their place among all. inputs: those on
    which it depends. clamp: what has limited it, where nothing has been done to it since.
    """

    total: str
    linear: Mapping[int, str] = field(default_factory=dict)
    rest: str | None = None
    nonlinear: frozenset[int] = _NONE
    kinks: Mapping[int, str] = field(default_factory=dict)
    inputs: frozenset[int] = _NONE
    clamp: Clamp | None = None

    @property
    def states(self) -> frozenset[int]:
        """States on which it depends in any way."""
        return self.nonlinear | self.linear.keys()


class Splitter:
    """Writes equations anew on a tape, each number split; clamps: all that limited one."""

    def __init__(self) -> None:
        self.tape = Tape()
        self.clamps: list[Clamp] = []

    def split(self, equations: Tape, names: Iterable[str]) -> list[Split]:
        """The named numbers of equations on a tape of their own."""
        splits: dict[str, Split] = {}

        def of(operand: str) -> Split:
            return splits.get(operand) or self._leaf(operand)

        for line in equations.lines:
            splits[line.name] = self._result(line.form, [of(o) for o in line.operands])
        return [of(name) for name in names]

    def straight(self, linear: Mapping[int, str]) -> str | None:
        """Sum of coefficients times states."""
        total = None
        for j, coefficient in sorted(linear.items()):
            total = self.tape.join("+", total, self.tape.multiply(coefficient, f"x{j}"))
        return total

    @staticmethod
    def _leaf(operand: str) -> Split:
        """A state, an input, a parameter or a literal."""
        if operand[0] == "x":
            return Split(operand, {int(operand[1:]): "1.0"})
        if operand[0] == "u":
            return Split(operand, rest=operand, inputs=frozenset((int(operand[1:]),)))
        return Split(operand, rest=operand)

    def _result(self, form: str, operands: Sequence[Split]) -> Split:
        first, second = operands[0], operands[-1]
        fixed = [self.tape.fixed(number.total) for number in operands]
        if form in ("{} + {}", "{} - {}"):
            return self._joined(form[3], first, second)
        if form == "-{}":
            return self._mapped(form, first)
        if form == "{} * {}" and any(fixed):
            scaled, factor = (first, second) if fixed[1] else (second, first)
            return self._mapped(form, scaled, factor.total)
        if form == "{} / {}" and fixed == [False, True]:
            # Dividing once, with the parameters, is cheaper than at each step.
            return self._mapped("{} * {}", first, self.tape.emit("{} / {}", "1.0", second.total))
        if form == "{} ** {}":
            form, operands = self._power(first, second)
        if form.startswith(("min", "max")):
            return self._limited(form, operands)
        return self._mixed(form, operands)

    def _joined(self, sign: str, a: Split, b: Split) -> Split:
        tape = self.tape
        return Split(
            tape.emit(f"{{}} {sign} {{}}", a.total, b.total),
            tape.join_all(sign, a.linear, b.linear),
            tape.join(sign, a.rest, b.rest),
            a.nonlinear | b.nonlinear,
            tape.join_all(sign, a.kinks, b.kinks),
            a.inputs | b.inputs,
        )

    def _mapped(self, form: str, number: Split, *factor: str) -> Split:
        """The same linear operation on a number and all its pieces."""

        def mapped(name: str) -> str:
            return self.tape.multiply(name, *factor) if factor else self.tape.emit(form, name)

        return Split(
            mapped(number.total),
            {j: mapped(c) for j, c in number.linear.items()},
            None if number.rest is None else mapped(number.rest),
            number.nonlinear,
            {k: mapped(c) for k, c in number.kinks.items()},
            number.inputs,
        )

    def _power(self, base: Split, exponent: Split) -> tuple[str, Sequence[Split]]:
        """Form and operands by which the kernels compute a power."""
        power = math.nan if self.tape.named(exponent.total) else float(constant(exponent.total))
        if power.is_integer() and abs(power) <= _WHOLE:
            whole = f"{int(power)}" if power >= 0.0 else f"({int(power)})"
            return "{} ** {}", (base, self._leaf(whole))
        if power == 0.5:
            return "math.sqrt({})", (base,)
        return "math.pow({}, {})", (base, exponent)

    def _mixed(self, form: str, operands: Sequence[Split]) -> Split:
        """A function of numbers: nonlinear in all states that any of them depends on."""
        total = self.tape.emit(form, *(number.total for number in operands))
        return Split(
            total,
            rest=total,
            nonlinear=_NONE.union(*(number.states for number in operands)),
            inputs=_NONE.union(*(number.inputs for number in operands)),
        )

    def _limited(self, form: str, operands: Sequence[Split]) -> Split:
        """A number limited by fixed ones; limited on both sides it keeps its straight piece."""
        limited = self._mixed(form, operands)
        varying = [number for number in operands if not self.tape.fixed(number.total)]
        if len(varying) != 1:
            return limited
        before = varying[0].clamp or Clamp(varying[0], frozenset(), ())
        ends = [number.total for number in operands if self.tape.fixed(number.total)]
        clamp = Clamp(before.base, before.sides | {form[:3]}, (*before.limits, *ends))
        self.clamps.append(clamp)
        kink = {len(self.clamps) - 1: "1.0"}
        base = clamp.base
        straight = self.straight(base.linear)
        if clamp.sides != {"min", "max"} or straight is None:
            return replace(limited, kinks=kink, clamp=clamp)
        return replace(
            limited,
            linear=base.linear,
            rest=self.tape.emit("{} - {}", limited.total, straight),
            nonlinear=base.nonlinear,
            kinks={**base.kinks, **kink},
            clamp=clamp,
        )
