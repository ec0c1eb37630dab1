"""What outputs show of parameters that act only together: ``J_m + J_b``, ``K + R B / K``."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from sysid.problem.expressions import product_text, product_unit, sum_text

_ALIKE = 1e-9  # a coefficient this close to a product of fixed values is that product


def _power(value: float, power: float) -> float:
    try:
        raised: float = value**power
    except ZeroDivisionError:
        return math.inf
    return raised


@dataclass(frozen=True)
class Term:
    """A coefficient times powers of parameters, and of starts such as ``z(0)``.

    factors: parameters with fixed values that the coefficient is the product of, with their
    powers, where it is; they are its text.
    """

    powers: tuple[tuple[str, float], ...]
    coefficient: float = 1.0
    factors: tuple[tuple[str, float], ...] = ()

    def value(self, values: Mapping[str, float]) -> float:
        """Value at parameters by name; infinite where one that divides is zero."""
        product: float = math.prod([_power(values[name], power) for name, power in self.powers])
        return self.coefficient * product

    def named(self, fixed: Mapping[str, float]) -> "Term":
        """The same with the coefficient as a product of one or two of these values, if it is."""
        usable = {name: value for name, value in fixed.items() if abs(value) not in (0.0, 1.0)}
        for size in (1, 2):
            for names in itertools.combinations(usable, size):
                for powers in itertools.product((1.0, -1.0, 2.0, -2.0), repeat=size):
                    factors = tuple(zip(names, powers, strict=True))
                    product = math.prod([abs(usable[name]) ** power for name, power in factors])
                    if math.isclose(product, abs(self.coefficient), rel_tol=_ALIKE):
                        return replace(self, factors=factors)
        return self

    @property
    def text(self) -> str:
        """The powers, without a numeric coefficient."""
        return product_text([*self.factors, *self.powers])


@dataclass(frozen=True)
class Combination:
    """A sum of terms that the outputs determine, with its unit: that of its first term.

    unit: empty where it cannot be written in the parameters' own units.

    >>> feedback = Combination((Term((("K", 1.0),)), Term((("B", 1.0), ("K", -1.0)), 2.0)), "V*s")
    >>> feedback.text, feedback.value({"K": 0.5, "B": 0.25})
    ('K + 2 B / K', 1.5)
    >>> feedback.gradient({"K": 0.5, "B": 0.25})
    {'K': -1.0, 'B': 4.0}
    """

    terms: tuple[Term, ...]
    unit: str

    @classmethod
    def of(
        cls, terms: Sequence[Term], units: Mapping[str, str], fixed: Mapping[str, float]
    ) -> "Combination":
        """With the unit that follows from the parameters' and starts', the first coefficient one.

        fixed: values of parameters that are not free; a coefficient between terms of unlike units
        is named after those that it is the product of.
        """
        first, *others = terms
        unit = _unit(first, units)
        named = [term if _unit(term, units) == unit else term.named(fixed) for term in others]
        return cls((first, *named), unit)

    @property
    def text(self) -> str:
        """As people write it; numbers to four digits."""
        return sum_text(
            [
                (
                    term.text,
                    math.copysign(1.0, term.coefficient) if term.factors else term.coefficient,
                )
                for term in self.terms
            ]
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters and starts in it, each once."""
        return tuple(dict.fromkeys(name for term in self.terms for name, _ in term.powers))

    def value(self, values: Mapping[str, float]) -> float:
        """Value at parameters (and starts) by name, in the model's units."""
        return sum(term.value(values) for term in self.terms)

    def gradient(self, values: Mapping[str, float]) -> dict[str, float]:
        """Derivatives by each of its parameters and starts, at values by name."""
        slopes = dict.fromkeys(self.names, 0.0)
        for term in self.terms:
            for name, power in term.powers:
                rest = [(n, q - 1.0 if n == name else q) for n, q in term.powers]
                slopes[name] += power * Term(tuple(rest), term.coefficient).value(values)
        return slopes


def _unit(term: Term, units: Mapping[str, str]) -> str:
    (name, power), *others = term.powers
    if not others and power == 1.0:
        return units[name]
    return product_unit((units[name], power) for name, power in term.powers)
