"""Tangents: how numbers on a tape move with its variables, as further lines of the same tape."""

from collections.abc import Callable, Mapping, Sequence

from sysid.engine.tape import Line, Tape

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
    if line.form not in _PARTIALS:
        function = line.form.removeprefix("math.").partition("(")[0]
        raise TypeError(f"the derivative of {function} is not known")
    return _by_partials(tape, line, moved)


def _by_partials(tape: Tape, line: Line, moved: Sequence[Tangent]) -> Tangent:
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
    for operand, further in zip(line.operands[1:], moved[1:], strict=True):
        better = tape.emit(f"{{}} {sign} {{}}", operand, value)
        tangent = {
            k: tape.emit("select({}, {}, {})", better, further.get(k, "0.0"), tangent.get(k, "0.0"))
            for k in [*tangent, *further]
        }
        value = tape.emit(f"{function}({{}}, {{}})", value, operand)
    return tangent


def _scaled(tape: Tape, tangent: Tangent, factor: str) -> dict[int, str]:
    return _each(lambda t: tape.multiply(t, factor), tangent)


def _each(operation: Callable[[str], str], tangent: Tangent) -> dict[int, str]:
    return {k: operation(t) for k, t in tangent.items()}


_RULES: dict[str, Callable[..., Tangent]] = {
    "{} + {}": _of_sum,
    "{} - {}": _of_sum,
    "-{}": _of_negative,
    "{} * {}": _of_product,
    "{} / {}": _of_quotient,
    "{} ** {}": _of_power,
    "math.pow({}, {})": _of_power,
}
