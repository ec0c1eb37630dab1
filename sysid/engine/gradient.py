"""Derivatives of a model's functions at points, along the way that each takes through them."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.arithmetic import constant, operation
from sysid.engine.tape import Line, Tape
from sysid.engine.trace import followed, operand, traces
from sysid.problem.model import Function

_MOST_BRANCHES = 64

# How a number moves with each variable, by the variable's place; without those it does not.
Tangent = Mapping[int, str]

# Partial derivatives by each operand.
_PARTIALS = {
    "abs({})": ("sign({0})",),
    "math.fabs({})": ("sign({0})",),
    "math.exp({})": ("math.exp({0})",),
    "math.expm1({})": ("math.exp({0})",),
    "math.log({})": ("1.0 / {0}",),
    "math.log1p({})": ("1.0 / (1.0 + {0})",),
    "math.log2({})": ("1.0 / ({0} * math.log(2.0))",),
    "math.log10({})": ("1.0 / ({0} * math.log(10.0))",),
    "math.sqrt({})": ("0.5 / math.sqrt({0})",),
    "math.sin({})": ("math.cos({0})",),
    "math.cos({})": ("-math.sin({0})",),
    "math.tan({})": ("1.0 + math.tan({0}) ** 2",),
    "math.asin({})": ("1.0 / math.sqrt(1.0 - {0} * {0})",),
    "math.acos({})": ("-1.0 / math.sqrt(1.0 - {0} * {0})",),
    "math.atan({})": ("1.0 / (1.0 + {0} * {0})",),
    "math.atan2({}, {})": ("{1} / ({1} * {1} + {0} * {0})", "-{0} / ({1} * {1} + {0} * {0})"),
    "math.sinh({})": ("math.cosh({0})",),
    "math.cosh({})": ("math.sinh({0})",),
    "math.tanh({})": ("1.0 - math.tanh({0}) ** 2",),
    "math.hypot({}, {})": ("{0} / math.hypot({0}, {1})", "{1} / math.hypot({0}, {1})"),
    "math.copysign({}, {})": ("math.copysign(1.0, {0}) * math.copysign(1.0, {1})", "0.0"),
    "math.floor({})": ("0.0",),
    "math.ceil({})": ("0.0",),
    "{} % {}": ("1.0", "-({0} // {1})"),
    "{} // {}": ("0.0", "0.0"),
}


class Branch:
    """One way through a function's conditions, and the derivatives on it.

    names: values that equations left on the tape; variables: what they are differentiated by.
    """

    def __init__(self, tape: Tape, names: Sequence[str], variables: Mapping[str, Tangent]) -> None:
        self._shape = len(names), len(variables)
        self._slopes = differentiate(tape, names, variables)
        self._decisions = tape.decisions
        lines = tape.needed([*self._slopes.values(), *tape.decisions])
        self._steps = [
            (line.name, operation(line.form, len(line.operands)), line.operands) for line in lines
        ]
        used = set(self._slopes.values()).union(*(line.operands for line in lines))
        self._literals = {text: constant(text) for text in used if not tape.named(text)}

    def at(self, point: Mapping[str, Any], many: tuple[int, ...]) -> FloatArray | None:
        """The derivatives at a point, (*shape, *many); None where it goes another way."""
        values = {**self._literals, **point}
        try:
            for name, compute, operands in self._steps:
                values[name] = compute(*[values[operand] for operand in operands])
                if name in self._decisions and bool(values[name]) != self._decisions[name]:
                    return None
        except (ArithmeticError, ValueError):
            return None
        matrix = np.zeros((*self._shape, *many))
        for place, name in self._slopes.items():
            matrix[place] = values[name]
        return matrix


class Gradient:
    """Derivatives of a function (x, u, p) by its first states and inputs.

    The function is followed once for each way through its conditions; further points on that way
    are only worked out. Zeros among them have the sign that a sum or product leaves them with: to
    LAPACK it makes a difference in the last digit.
    """

    def __init__(self, function: Function, n_states: int, n_inputs: int) -> None:
        self._function = followed(function)
        names = [*(f"x{i}" for i in range(n_states)), *(f"u{j}" for j in range(n_inputs))]
        zeros = dict.fromkeys(range(len(names)), "0.0")
        self._variables = {name: {**zeros, k: "1.0"} for k, name in enumerate(names)}
        self._branches: deque[Branch] = deque(maxlen=_MOST_BRANCHES)

    def at(
        self, x: Sequence[float], u: Sequence[float], p: Sequence[Any], many: tuple[int, ...] = ()
    ) -> FloatArray:
        """Derivatives at a point, (n_values, n_variables), or at many (..., m).

        many: (m,) where parameters are arrays of this shape. Raises what the equations raise at
        the point, TypeError where they cannot be differentiated, and ValueError where some of
        many points go another way than the rest.
        """
        sides = zip("xup", (x, u, p), strict=True)
        point = {f"{letter}{i}": v for letter, values in sides for i, v in enumerate(values)}
        for branch in self._branches:
            slopes = branch.at(point, many)
            if slopes is not None:
                return slopes
        try:
            branch = self._follow(point, x, u, None)
            self._branches.append(branch)
        except ArithmeticError:
            raise
        except Exception:
            # With parameters Python may do more than can be followed: count, look up, use NumPy.
            branch = self._follow(point, x, u, p)
        slopes = branch.at(point, many)
        assert slopes is not None
        return slopes

    def _follow(
        self, point: Mapping[str, Any], x: Sequence[Any], u: Sequence[Any], p: Sequence[Any] | None
    ) -> Branch:
        """The way from a point; with parameters given, that under these alone."""
        tape = Tape(point)
        n = sum(name[0] == "p" for name in point)
        parameters = traces(tape, "p", n) if p is None else tuple(p)
        values = self._function(traces(tape, "x", len(x)), traces(tape, "u", len(u)), parameters)
        return Branch(tape, list(map(operand, values)), self._variables)


def differentiate(
    tape: Tape, names: Sequence[str], variables: Mapping[str, Tangent]
) -> dict[tuple[int, int], str]:
    """Derivatives of the named numbers, as names on the tape by the places of both.

    variables: what is differentiated by, and how it moves. Derivatives that are always zero are
    left out, unless the variables' own zeros are told. At a kink, where there is no derivative,
    |x| has the mean of its two sides' and ``min`` and ``max`` have that of the number they give.
    Raises TypeError for a function whose derivative is not known.
    """
    tangents = dict(variables)
    for line in tape.needed(names):
        moved = [tangents.get(operand, {}) for operand in line.operands]
        if any(moved):
            tangents[line.name] = _tangent(tape, line, moved)
    return {
        (i, k): tangent
        for i, name in enumerate(names)
        for k, tangent in tangents.get(name, {}).items()
    }


def _tangent(tape: Tape, line: Line, moved: Sequence[Tangent]) -> Tangent:
    """Of a line's result, from those of its operands."""
    if line.form in _RULES:
        return _RULES[line.form](tape, line, *moved)
    if line.form.startswith(("min(", "max(")):
        return _of_extreme(tape, line, moved)
    if line.form in _CONDITIONS:
        return {}
    if line.form not in _PARTIALS:
        function = line.form.removeprefix("math.").partition("(")[0]
        raise TypeError(f"the derivative of {function} is not known")
    total: dict[int, str] = {}
    for partial, tangent in zip(_PARTIALS[line.form], moved, strict=True):
        if tangent and partial != "0.0":
            factor = tape.emit(partial, *line.operands)
            # From a zero on, so that the sum is no negative one.
            begun = {k: total.get(k, "0.0") for k in tangent}
            total |= tape.join_all("+", begun, _scaled(tape, tangent, factor))
    return total


def _of_sum(tape: Tape, line: Line, first: Tangent, second: Tangent) -> Tangent:
    return tape.join_all(line.form[3], first, second)


def _of_negative(tape: Tape, line: Line, moved: Tangent) -> Tangent:
    return _each(lambda t: tape.emit("-{}", t), moved)


def _of_product(tape: Tape, line: Line, first: Tangent, second: Tangent) -> Tangent:
    a, b = line.operands
    return tape.join_all("+", _scaled(tape, first, b), _scaled(tape, second, a))


def _of_quotient(tape: Tape, line: Line, above: Tangent, below: Tangent) -> Tangent:
    quotient, b = line.name, line.operands[1]
    if not above:
        return _scaled(tape, below, tape.emit("{} / {}", tape.emit("-{}", quotient), b))
    difference = tape.join_all("-", above, _scaled(tape, below, quotient))
    return _each(lambda t: tape.emit("{} / {}", t, b), difference)


def _of_power(tape: Tape, line: Line, of_base: Tangent, of_exponent: Tangent) -> Tangent:
    a, b = line.operands
    by_base = _each(lambda t: tape.emit("power_slope({}, {}, {})", a, b, t), of_base)
    form = "exponent_slope({}, {}, {})"
    by_exponent = _each(lambda t: tape.emit(form, a, line.name, t), of_exponent)
    return tape.join_all("+", by_base, by_exponent)


def _of_extreme(tape: Tape, line: Line, moved: Sequence[Tangent]) -> Tangent:
    """That of the operand which ``min`` or ``max`` gives."""
    function, sign = line.form[:3], "<" if line.form.startswith("min") else ">"
    value, tangent = line.operands[0], moved[0]
    for name, further in zip(line.operands[1:], moved[1:], strict=True):
        better = tape.emit(f"{{}} {sign} {{}}", name, value)
        tangent = {
            k: tape.emit("select({}, {}, {})", better, further.get(k, "0.0"), tangent.get(k, "0.0"))
            for k in [*tangent, *further]
        }
        value = tape.emit(f"{function}({{}}, {{}})", value, name)
    return tangent


def _scaled(tape: Tape, tangent: Tangent, factor: str) -> dict[int, str]:
    return _each(lambda t: tape.multiply(t, factor), tangent)


def _each(operation: Callable[[str], str], tangent: Tangent) -> dict[int, str]:
    return {k: operation(t) for k, t in tangent.items()}


def _of_choice(
    tape: Tape, line: Line, of_condition: Tangent, first: Tangent, second: Tangent
) -> Tangent:
    form, condition = "select({}, {}, {})", line.operands[0]
    return {
        k: tape.emit(form, condition, first.get(k, "0.0"), second.get(k, "0.0"))
        for k in [*first, *second]
    }


_CONDITIONS = tuple(f"{{}} {sign} {{}}" for sign in ("<", "<=", ">", ">=", "==", "!="))
_RULES: dict[str, Callable[..., Tangent]] = {
    "{} + {}": _of_sum,
    "{} - {}": _of_sum,
    "-{}": _of_negative,
    "{} * {}": _of_product,
    "{} / {}": _of_quotient,
    "{} ** {}": _of_power,
    "math.pow({}, {})": _of_power,
    "select({}, {}, {})": _of_choice,
}
