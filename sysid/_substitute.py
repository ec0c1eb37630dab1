"""Running a model's plain functions on other things than floats.

A model's equations call ``math``, ``abs``, ``min``, ``max`` and helper functions of their own.
To trace or differentiate them, copies are made in which these names stand for versions that
understand the substitute numbers; the user's functions themselves stay untouched.
"""

from __future__ import annotations

import math
import types
from collections.abc import Callable
from typing import Any

# Makes of a library function one that also takes substitute numbers.
Wrap = Callable[[Callable[..., Any]], Callable[..., Any]]


def substituted(function: Any, wrap: Wrap) -> Any:
    """A copy of a function, and of those it calls, with library functions wrapped."""
    return _copy(function, wrap, {})


class _Math:
    """Stands in for the math module."""

    def __init__(self, wrap: Wrap) -> None:
        self._wrap = wrap

    def __getattr__(self, name: str) -> Any:
        value = getattr(math, name)
        return self._wrap(value) if callable(value) else value


def _copy(function: Any, wrap: Wrap, done: dict[int, Any]) -> Any:
    function = getattr(function, "py_func", function)  # a function the user has jitted
    if function is math:
        return _Math(wrap)
    if isinstance(function, types.BuiltinFunctionType) and function.__module__ == "math":
        return wrap(function)
    if not isinstance(function, types.FunctionType):
        return function
    if id(function) in done:
        return done[id(function)]
    scope = dict(function.__globals__)
    scope.update(min=wrap(min), max=wrap(max))
    cells = tuple(types.CellType(None) for _ in function.__closure__ or ())
    copy = types.FunctionType(
        function.__code__, scope, function.__name__, function.__defaults__, cells
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    done[id(function)] = copy
    for name in function.__code__.co_names:
        if name in function.__globals__:
            scope[name] = _copy(function.__globals__[name], wrap, done)
    for cell, original in zip(cells, function.__closure__ or (), strict=True):
        cell.cell_contents = _copy(original.cell_contents, wrap, done)
    return copy
