"""What the parts of the actuator are made of, and how their numbers find their places.

Each part declares its parameters in the order in which its equations take them apart. The
assembled model keeps one long tuple; a ``Layout`` knows each part's slice of it, so that no
equation ever counts through the parameters of another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sysid import Constraint, Parameter


def log_range(
    name: str, unit: str, nominal: float, lower: float, upper: float, description: str
) -> Parameter:
    """A positive parameter that is searched by logarithm."""
    return Parameter(name, unit, nominal, lower, upper, "log", description=description)


def known(name: str, unit: str, value: float, description: str, minimum: float = 0.0) -> Parameter:
    """A parameter that stays at a value known beforehand."""
    return Parameter(
        name, unit, value, value, value, fixed=True, minimum=minimum, description=description
    )


@dataclass(frozen=True)
class Layout:
    """Parameters of all parts behind one another, and each part's slice of them."""

    parameters: tuple[Parameter, ...]
    slices: dict[str, slice]

    @classmethod
    def of(cls, **parts: tuple[Parameter, ...]) -> Layout:
        """Lay out parts by name, in order."""
        parameters: tuple[Parameter, ...] = ()
        slices = {}
        for name, own in parts.items():
            slices[name] = slice(len(parameters), len(parameters) + len(own))
            parameters += own
        return cls(parameters, slices)

    def constraint(self, part: str, text: str, function: Callable[[Any], Any]) -> Constraint:
        """A constraint g <= 0 on the parameters of one part."""
        own = self.slices[part]
        return Constraint(text, lambda p: function(p[own]))
