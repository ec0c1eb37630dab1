"""Models made of another, with one parameter more."""

from collections.abc import Callable
from dataclasses import replace

from sysid.problem.model import Constraint, Function, Parameter, ProcessModel


def extended(
    model: ProcessModel,
    parameter: Parameter,
    derivative: Function,
    output: Function | None,
    equation: str,
    again: Callable[[ProcessModel], ProcessModel],
) -> ProcessModel:
    """The model with a parameter behind its own, of functions that know it.

    equation: says to people what was added. again: does the same to another, a variant.
    """
    n, variants = len(model.parameters), model.variants
    return replace(
        model,
        parameters=(*model.parameters, parameter),
        derivative=derivative,
        output=output,
        constraints=tuple(_of_first(constraint, n) for constraint in model.constraints),
        equations=(*model.equations, equation) if model.equations else (),
        variants=None
        if variants is None
        else lambda: {name: again(variant) for name, variant in variants().items()},
    )


def _of_first(constraint: Constraint, n: int) -> Constraint:
    function = constraint.function
    return replace(constraint, function=lambda p: function(p[:n]))
