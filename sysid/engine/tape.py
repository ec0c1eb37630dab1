"""Straight-line code, written down line by line while a model's equations run.

A tape may stand at a point, with values of states, inputs and parameters. Then every result has
a value too, and conditions in the equations can be decided; the tape keeps their outcomes.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from sysid.engine.arithmetic import arrays, constant, operation


class Line(NamedTuple):
    """``name = text``: ``form`` with its operands filled in; fixed if parameters alone enter it."""

    name: str
    form: str
    operands: tuple[str, ...]
    text: str
    fixed: bool


class UndecidedError(TypeError):
    """A condition needs the value of a number; it says the condition's name on the tape."""

    def __init__(self, name: str) -> None:
        super().__init__("a condition needs the value of a number")
        self.name = name


class Tape:
    """Straight-line code over states x0.., inputs u0.., parameters p0.. and results t0..

    point: values of the states, inputs and parameters by name, floats or arrays of many; without
    it the code knows no values, and conditions raise ``UndecidedError`` unless their outcomes stand
    in ``decisions``. decisions: conditions met on the way and their outcomes.
    arithmetic: the function that a form of so many operands stands for, where values are none of
    these.
    """

    def __init__(
        self,
        point: Mapping[str, Any] | None = None,
        arithmetic: Callable[[str, int], Callable[..., Any]] = operation,
    ) -> None:
        self.decisions: dict[str, bool] = {}
        self._arithmetic = arithmetic
        self._values = None if point is None else dict(point)
        self._lines: dict[str, Line] = {}  # by text: what is computed twice is written once
        self._by_name: dict[str, Line] = {}
        self._literals: dict[str, tuple[str, tuple[str, ...]]] = {}  # form and operands, by text

    @property
    def lines(self) -> list[Line]:
        """All lines, in order."""
        return list(self._by_name.values())

    def emit(self, form: str, *operands: str) -> str:
        """Name of the result of an operation, ``form`` with places for its operands."""
        text = form.format(*operands)
        if not any(map(self.named, operands)):
            self._literals[f"({text})"] = form, operands
            return f"({text})"  # literals alone: the compiler folds them
        if text not in self._lines:
            fixed = all(map(self.fixed, operands))
            line = Line(f"t{len(self._lines)}", form, operands, text, fixed)
            self._lines[text] = self._by_name[line.name] = line
            if self._values is not None:
                compute = self._arithmetic(form, len(operands))
                self._values[line.name] = compute(*map(self.value, operands))
        return self._lines[text].name

    def decide(self, form: str, *operands: str) -> bool:
        """Whether a condition holds at the tape's point; raises UndecidedError without one."""
        name = self.emit(form, *operands)
        if self._values is None:
            if name not in self.decisions:
                raise UndecidedError(name)
            return self.decisions[name]
        self.decisions[name] = bool(self.value(name))
        return self.decisions[name]

    def single(self, operands: Iterable[str]) -> bool:
        """Whether these operands have values, and none of them is an array."""
        return self._values is not None and not arrays(map(self.value, operands))

    def value(self, operand: str) -> Any:
        """What a name or a literal stands for at the tape's point."""
        assert self._values is not None
        if operand in self._values:
            return self._values[operand]
        if operand not in self._literals:
            return constant(operand)
        form, operands = self._literals[operand]
        return self._arithmetic(form, len(operands))(*map(self.value, operands))

    def fixed(self, operand: str) -> bool:
        """Whether a name or a literal depends on the parameters alone."""
        line = self._by_name.get(operand)
        return line.fixed if line else operand[0] not in "xu"

    def named(self, operand: str) -> bool:
        """Whether an operand is a name and not a literal."""
        return operand in self._by_name or operand[0] in "xup"

    def needed(self, names: Iterable[str]) -> list[Line]:
        """Lines that must run to compute the named results, in order."""
        wanted = set(names)
        lines = []
        for line in reversed(self._lines.values()):
            if line.name in wanted:
                wanted.update(line.operands)
                lines.append(line)
        return lines[::-1]

    def join(self, sign: str, a: str | None, b: str | None) -> str | None:
        """``a + b`` or ``a - b``, by the sign; None stands for zero."""
        if b is None:
            return a
        if a is None:
            return b if sign == "+" else self.emit("-{}", b)
        return self.emit(f"{{}} {sign} {{}}", a, b)

    def join_all(self, sign: str, a: Mapping[int, str], b: Mapping[int, str]) -> dict[int, str]:
        """``join`` of the coefficients with equal keys."""
        joined = {k: self.join(sign, a.get(k), b.get(k)) for k in [*a, *b]}
        return {k: c for k, c in joined.items() if c is not None}

    def multiply(self, a: str, b: str) -> str:
        """``a * b``, without multiplying by a literal 1.0."""
        if "1.0" in (a, b):
            return a if b == "1.0" else b
        return self.emit("{} * {}", a, b)
