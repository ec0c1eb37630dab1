"""Parameters of the parts, and where each part finds its own in the assembled model's tuples.

A part declares its parameters, states and inputs in the order in which its equations take them
apart. The model keeps one long tuple of each kind; a ``Layout`` has each part's slice of it, so
that no equation ever counts through those of another.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from sysid import Constraint, Parameter

# Text and function of an inequality g(p) <= 0 on one part's own parameters.
PartConstraint = tuple[str, Callable[[Any], Any]]

T = TypeVar("T")


def log_range(
    name: str, unit: str, nominal: float, lower: float, upper: float, description: str
) -> Parameter:
    """A positive parameter that is searched by logarithm."""
    return Parameter(name, unit, nominal, lower, upper, "log", description=description)


def fixed(name: str, unit: str, value: float, description: str, minimum: float = 0.0) -> Parameter:
    """A parameter that is not searched unless somebody frees it."""
    return Parameter(
        name, unit, value, value, value, fixed=True, minimum=minimum, description=description
    )


class Layout(Generic[T]):
    """Parameters, states or inputs of all parts behind one another, and each part's slice."""

    def __init__(self, **parts: tuple[T, ...]) -> None:
        self.members = tuple(itertools.chain(*parts.values()))
        ends = itertools.accumulate(map(len, parts.values()))
        self.slices = {
            name: slice(end - len(part), end)
            for (name, part), end in zip(parts.items(), ends, strict=True)
        }


def constraints(place: slice, declared: Sequence[PartConstraint]) -> list[Constraint]:
    """Constraints of the model from those of the part whose parameters are at ``place``."""

    def on_model(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        return lambda p: function(p[place])

    return [Constraint(text, on_model(function)) for text, function in declared]
