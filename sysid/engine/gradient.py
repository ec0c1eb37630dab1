"""Derivatives of a model's functions at points, along the way that each takes through them."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.arithmetic import constant, operation
from sysid.engine.tangents import Tangent, differentiate
from sysid.engine.tape import Tape
from sysid.engine.trace import followed, operand, traces
from sysid.problem.model import Function

_MOST_BRANCHES = 64


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
