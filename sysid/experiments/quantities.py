"""What an experiment is to tell: parameters, and combinations of those that act only together."""

from collections.abc import Sequence

import numpy as np

from sysid.arrays import FloatArray
from sysid.identifiability import Combination, Identifiability, Term
from sysid.problem.model import ModelError
from sysid.problem.space import SearchSpace
from sysid.uncertainty.ties import coded_gradient, named_values


def determined(structure: Identifiability, space: SearchSpace) -> tuple[Combination, ...]:
    """All parameters and combinations of parameters that the equations let experiments tell."""
    n_free = len(space.index)
    units = {parameter.name: parameter.unit for parameter in space.parameters[:n_free]}
    alone = [
        Combination((Term(((name, 1.0),)),), units[name])
        for name in structure.identifiable
        if name in units
    ]
    together = [
        combination
        for group in structure.tied
        for combination in group.combinations
        if set(combination.names) <= units.keys()
    ]
    return (*alone, *together)


def chosen(
    names: Sequence[str], structure: Identifiability, space: SearchSpace
) -> tuple[Combination, ...]:
    """Quantities by name, or by text such as ``J_m + J_b``; no names: all that are determined.

    Raises ModelError for what is unknown, or what no experiment can tell.
    """
    quantities = {quantity.text: quantity for quantity in determined(structure, space)}
    for name in names:
        for group in structure.tied:
            if name in group.parameters:
                possible = ", ".join(c.text for c in group.combinations) or "none of them"
                raise ModelError(
                    f"{name}: no experiment tells it, for {', '.join(group.parameters)} act only "
                    f"together; ask for {possible}, or fix {' and '.join(group.fix)}"
                )
        if name in structure.unseen:
            raise ModelError(f"{name}: no experiment tells it, for it acts on no output")
        if name not in quantities:
            raise ModelError(
                f"{name}: there is no such quantity; there are {', '.join(quantities)}"
            )
    return tuple(quantities[name] for name in names or quantities)


def relative_gradients(
    quantities: Sequence[Combination], space: SearchSpace, chromosomes: FloatArray
) -> FloatArray:
    """Derivatives by the search coordinates in parts of the values, (n, n_quantities, n_free).

    Raises ModelError where a value is zero, of which there are no parts.
    """
    return np.array([[_relative(q, space, row) for q in quantities] for row in chromosomes])


def _relative(quantity: Combination, space: SearchSpace, chromosome: FloatArray) -> FloatArray:
    value = quantity.value(named_values(space, chromosome))
    if value == 0.0:
        raise ModelError(
            f"{quantity.text}: a design tells intervals in parts of values, and this one is 0; "
            "give it a nominal value of the size that it may have, or fix it"
        )
    return coded_gradient(quantity, space, chromosome) / value
