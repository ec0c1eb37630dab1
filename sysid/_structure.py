"""Which parts of a model are linear: found by running its equations on tracing numbers.

The batch simulator integrates the linear parts exactly. Tracing decides from the equations
themselves, not from samples of their values, so a saturation or a dead zone is never mistaken
for a straight line; where the equations branch on a value, nothing is claimed to be linear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sysid._substitute import substituted
from sysid.model import ProcessModel

_NONE: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Structure:
    """What is linear in dx/dt = f(x, u, p).

    constant: entries (i, j) of the Jacobian that depend on the parameters alone and are not
    always zero. driven: rows that need more than the linear part within a sample: a nonlinear
    term, or an input that changes between samples. nonlinear: whether any row has such a term.
    """

    constant: tuple[tuple[int, int], ...]
    driven: tuple[int, ...]
    nonlinear: bool

    def closure(self, n_states: int) -> tuple[tuple[int, int], ...]:
        """Entries of exp(A t) that can differ from zero for this pattern of A."""
        reach = {(i, i) for i in range(n_states)} | set(self.constant)
        for k in range(n_states):
            via = [i for i in range(n_states) if (i, k) in reach]
            to = [j for j in range(n_states) if (k, j) in reach]
            reach |= {(i, j) for i in via for j in to}
        return tuple(sorted(reach))

    def products(self, n_states: int) -> tuple[tuple[int, int, int], ...]:
        """Triples (i, k, j) for which entries (i, k) and (k, j) of the closure both exist."""
        entries = self.closure(n_states)
        return tuple((i, k, j) for i, k in entries for row, j in entries if row == k)


def analyse(model: ProcessModel) -> Structure:
    """Trace a model's derivative; where it cannot be traced every row counts as nonlinear."""
    n = len(model.states)
    x = tuple(_Trace(linear=frozenset((i,))) for i in range(n))
    u = tuple(_Trace(inputs=frozenset((j,))) for j in range(len(model.inputs)))
    p = tuple(_Trace() for _ in model.parameters)
    try:
        rows = [_lift(row) for row in substituted(model.derivative, _function)(x, u, p)]
    except Exception:
        # Whatever the equations do that a tracing number cannot follow, plain Runge-Kutta can.
        return Structure((), tuple(range(n)), True)
    moving = {j for j, signal in enumerate(model.inputs) if signal.hold == "foh"}
    constant = [(i, j) for i, row in enumerate(rows) for j in sorted(row.linear)]
    driven = [i for i, row in enumerate(rows) if row.nonlinear or row.inputs & moving]
    return Structure(tuple(constant), tuple(driven), any(row.nonlinear for row in rows))


class _UntraceableError(Exception):
    """The equations need the value of a number, not just its dependence."""


@dataclass(frozen=True, eq=False)
class _Trace:
    """A number of unknown value: on which states and inputs it depends, and how."""

    linear: frozenset[int] = _NONE
    nonlinear: frozenset[int] = _NONE
    inputs: frozenset[int] = _NONE

    @property
    def varies(self) -> bool:
        return bool(self.linear or self.nonlinear or self.inputs)

    def __add__(self, other: Any) -> _Trace:
        b = _lift(other)
        nonlinear = self.nonlinear | b.nonlinear
        return _Trace((self.linear | b.linear) - nonlinear, nonlinear, self.inputs | b.inputs)

    def __mul__(self, other: Any) -> _Trace:
        b = _lift(other)
        if not b.varies:
            return self
        if not self.varies:
            return b
        return _mix(self, b)

    def __truediv__(self, other: Any) -> _Trace:
        b = _lift(other)
        return _mix(self, b) if b.varies else self

    def __rtruediv__(self, other: Any) -> _Trace:
        return _lift(other) / self

    def __pow__(self, other: Any) -> _Trace:
        return _mix(self, _lift(other))

    def __rpow__(self, other: Any) -> _Trace:
        return _mix(self, _lift(other))

    def __neg__(self) -> _Trace:
        return self

    def __pos__(self) -> _Trace:
        return self

    def __abs__(self) -> _Trace:
        return _mix(self)

    def _value(self, *others: Any) -> Any:
        raise _UntraceableError

    __radd__ = __sub__ = __rsub__ = __add__
    __rmul__ = __mul__
    __lt__ = __le__ = __gt__ = __ge__ = __bool__ = __float__ = __int__ = __index__ = _value
    __mod__ = __rmod__ = __floordiv__ = __rfloordiv__ = __round__ = _value
    __eq__ = __ne__ = _value


def _lift(value: Any) -> _Trace:
    if isinstance(value, _Trace):
        return value
    if isinstance(value, int | float):
        return _Trace()
    raise _UntraceableError


def _mix(*values: Any) -> _Trace:
    """Some function of the values: nonlinear in every state that any of them depends on."""
    traces = [_lift(value) for value in values]
    states = frozenset().union(*(t.linear | t.nonlinear for t in traces))
    return _Trace(_NONE, states, frozenset().union(*(t.inputs for t in traces)))


def _function(function: Callable[..., Any]) -> Callable[..., Any]:
    """A library function that passes plain numbers on and mixes tracing ones."""

    def call(*args: Any) -> Any:
        if any(isinstance(a, _Trace) for a in args):
            return _mix(*args)
        return function(*args)

    return call
