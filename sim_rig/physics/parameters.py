"""Parameters of the parts, and where each part finds its own in the assembled model's tuple.

A part declares its parameters in the order in which its equations take them apart. The model
keeps one long tuple; a ``Layout`` has each part's slice of it, so that no equation ever counts
through the parameters of another.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

from sysid import Constraint, Parameter

# Text and function of an inequality g(p) <= 0 on one part's own parameters.
PartConstraint = tuple[str, Callable[[Any], Any]]


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


class Layout:
    """Parameters of all parts behind one another, and each part's slice of them."""

    def __init__(self, **parts: tuple[Parameter, ...]) -> None:
        self.parameters = tuple(itertools.chain(*parts.values()))
        ends = itertools.accumulate(map(len, parts.values()))
        self.slices = {
            name: slice(end - len(part), end)
            for (name, part), end in zip(parts.items(), ends, strict=True)
        }

    def constraints(self, part: str, declared: Sequence[PartConstraint]) -> list[Constraint]:
        """Constraints of the model from those of one part."""
        place = self.slices[part]

        def on_model(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
            return lambda p: function(p[place])

        return [Constraint(text, on_model(function)) for text, function in declared]
