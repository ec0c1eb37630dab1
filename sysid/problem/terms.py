"""Terms added to a model's equations, each with a parameter of its own.

Functions of one signal, and parameters that change with the size of what they multiply.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sysid.problem.expressions import product_unit
from sysid.problem.extension import extended
from sysid.problem.model import Function, ModelError, Parameter, ProcessModel
from sysid.problem.shapes import dry_friction

Shape = Literal["sign", "linear", "square", "cube", "abs", "parabola", "sine", "stribeck"]

_PROBE = 1e-3  # part of a parameter by which its part of an equation is told
_LEAST = 1e-3  # of a parameter, to which it may change
_STICKS = 0.01  # of a Stribeck speed, below which it grows from zero


@dataclass(frozen=True)
class AddedTerm:
    """What is added to a state's rate: a parameter times a shape of z = (signal - centre) / scale.

    equation: the state. of: the signal, a state or an input. Or a parameter: of its own part of the
    equation then, and what it is multiplied by, 1 + the term, in all equations. shape: ``sign`` (in
    proportion where abs(z) < 1), ``linear``, ``square`` (z abs(z)), ``cube``, ``abs``, ``parabola``
    (z^2), ``sine`` or ``stribeck`` (sign(z) exp(-z^2)). scale, centre: in the signal's unit. low,
    high: range of the parameter, in the unit of the rate, or a number. unit: the signal's, for
    sentences.

    >>> AddedTerm("omega", of="omega", shape="sign", scale=0.05, low=-500.0, high=500.0).parameter
    'sign_of_omega'
    """

    equation: str
    of: str
    shape: Shape
    scale: float
    low: float
    high: float
    centre: float = 0.0
    unit: str = ""

    @property
    def parameter(self) -> str:
        """Name of its parameter."""
        name = f"{self.shape}_of_{self.of}"
        return name if self.of == self.equation else f"{name}_in_{self.equation}"


def with_terms(model: ProcessModel, terms: Sequence[AddedTerm]) -> ProcessModel:
    """The model with terms added to its equations, and their parameters behind its own.

    Raises ModelError for a state or signal that it has not, a bad scale or range, or a name that
    it has already.

    >>> from sysid.examples import lag
    >>> rubbing = with_terms(lag(), [AddedTerm("y", "y", "sign", 0.01, -5.0, 5.0)])
    >>> rubbing.parameter_names, rubbing.derivative((1.0,), (0.0,), (2.0, 0.5, -3.0))
    (('gain', 'tau', 'sign_of_y'), (-5.0,))
    """
    for term in terms:
        model = _with_term(model, term)
    return model


def rate_unit(unit: str) -> str:
    """Unit of the rate of what has a unit.

    >>> rate_unit("rad/s"), rate_unit("V"), rate_unit("degC (air)")
    ('rad/s^2', 'V/s', 'degC (air)/s')
    """
    return product_unit([(unit, 1), ("s", -1)]) or f"{unit}/s"


def _with_term(model: ProcessModel, term: AddedTerm) -> ProcessModel:
    signals = (*model.state_names, *model.input_names)
    for kind, name, names in (
        ("state", term.equation, model.state_names),
        ("state, input or parameter", term.of, (*signals, *model.parameter_names)),
    ):
        if name not in names:
            there = ", ".join(names)
            raise ModelError(f"model {model.name} has no {kind} {name!r}; it has {there}")
    if not (math.isfinite(term.scale) and term.scale > 0.0):
        raise ModelError(f"the scale of a term in {term.of} is {term.scale:g}; it must be above 0")
    if term.of not in signals:
        return _with_bend(model, term)
    place, n = model.state_names.index(term.equation), len(model.parameters)
    parameter = Parameter(
        term.parameter,
        rate_unit(model.states[place].unit),
        0.5 * (term.low + term.high),
        term.low,
        term.high,
        minimum=-math.inf,
        description=f"added to d{term.equation}/dt: {term.shape} of {term.of}",
    )
    output = model.output
    return extended(
        model,
        parameter,
        _added(model.derivative, n, place, _function(term, signals.index(term.of))),
        None if output is None else lambda x, u, p: output(x, u, p[:n]),
        f"d{term.equation}/dt += {term.parameter} {_text(term)}",
        lambda variant: _with_term(variant, term),
    )


def _with_bend(model: ProcessModel, term: AddedTerm) -> ProcessModel:
    """The model with a parameter that changes with the size of what it multiplies."""
    place, n = model.state_names.index(term.equation), len(model.parameters)
    i = model.parameter_names.index(term.of)
    derivative, output, behind = model.derivative, model.output, i + 1
    shape, centre, scale = _SHAPES[term.shape], term.centre, term.scale
    parameter = Parameter(
        term.parameter,
        "1",
        0.5 * (term.low + term.high),
        term.low,
        term.high,
        minimum=-math.inf,
        description=f"by which {term.of} changes: {term.shape} of its part of d{term.equation}/dt",
    )

    def rates(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        more = derivative(x, u, (*p[:i], (1.0 + _PROBE) * p[i], *p[behind:n]))
        part = (more[place] - derivative(x, u, p[:n])[place]) / _PROBE
        factor = max(1.0 + p[n] * shape((part - centre) / scale), _LEAST)
        return derivative(x, u, (*p[:i], factor * p[i], *p[behind:n]))

    return extended(
        model,
        parameter,
        rates,
        None if output is None else lambda x, u, p: output(x, u, p[:n]),
        f"{term.of} *= 1 + {term.parameter} {term.shape}(its part of d{term.equation}/dt "
        f"/ {scale:g})",
        lambda variant: _with_bend(variant, term),
    )


def _added(derivative: Function, n: int, place: int, function: Callable[..., Any]) -> Function:
    """A derivative of one parameter more, p[n], times a function of (x, u) in one equation."""
    behind = place + 1  # a slice's end that is worked out in the function does not compile

    def rates(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        values = derivative(x, u, p[:n])
        return (
            *values[:place],
            values[place] + p[n] * function(x, u),
            *values[behind:],
        )

    return rates


def _function(term: AddedTerm, place: int) -> Callable[[Any, Any], Any]:
    shape, centre, scale = _SHAPES[term.shape], term.centre, term.scale
    return lambda x, u: shape(((x + u)[place] - centre) / scale)


def _text(term: AddedTerm) -> str:
    signal = term.of if term.centre == 0.0 else f"({term.of} - {term.centre:g})"
    return f"{term.shape}({signal} / {term.scale:g})"


_SHAPES: dict[Shape, Callable[[Any], Any]] = {
    "sign": lambda z: dry_friction(z, 1.0),
    "linear": lambda z: z,
    "square": lambda z: z * abs(z),
    "cube": lambda z: z * z * z,
    "abs": abs,
    "parabola": lambda z: z * z,
    "sine": math.sin,
    "stribeck": lambda z: dry_friction(z, _STICKS) * math.exp(-z * z),
}
