"""Copies of a model's plain functions, and of all they call, with some names exchanged.

A model's equations call ``math``, ``abs``, ``min``, ``max`` and helper functions of their own,
directly or through a module. To compile, trace or differentiate them, copies are made in which
library functions have stand-ins; the user's functions themselves stay untouched.
"""

import math
import types
from collections.abc import Callable, Mapping
from typing import Any

# Modules that the compiler knows by itself and that do not change between runs.
KNOWN_MODULES = frozenset({"builtins", "cmath", "math", "numba", "numpy", "operator"})

# Makes of a library function one that also takes substitute numbers.
Wrap = Callable[[Callable[..., Any]], Callable[..., Any]]


def substituted(function: Any, wrap: Wrap) -> Any:
    """A copy of a function, and of those it calls, with library functions wrapped."""
    library = {name: wrap(f) for name, f in vars(math).items() if callable(f)}
    stand_in = types.SimpleNamespace(**{**vars(math), **library})
    return rebuilt(
        function, stand_in, lambda copy: copy, {"min": wrap(min), "max": wrap(max)}, unwrap=True
    )


def rebuilt(
    function: Any,
    math_stand_in: Any,
    finish: Callable[[types.FunctionType], Any],
    builtins: Mapping[str, Any] | None = None,
    *,
    unwrap: bool = False,
) -> Any:
    """A finished copy of a function in which it refers to finished copies of its helpers.

    math_stand_in: what takes the place of the math module and, by name, of its functions.
    builtins: stand-ins for built-in functions. unwrap: copy what lies under a function that the
    user has already compiled, instead of leaving it as it is.
    """
    return _Rebuilder(math_stand_in, finish, dict(builtins or {}), unwrap).value(function)


def names_in(code: types.CodeType) -> set[str]:
    """All names that code refers to, including code within it."""
    inner = (item for item in code.co_consts if isinstance(item, types.CodeType))
    return set(code.co_names).union(*map(names_in, inner))


class _Rebuilder:
    def __init__(
        self,
        math_stand_in: Any,
        finish: Callable[[types.FunctionType], Any],
        builtins: dict[str, Any],
        unwrap: bool,
    ) -> None:
        self._math = math_stand_in
        self._finish = finish
        self._builtins = builtins
        self._unwrap = unwrap
        self._done: dict[int, Any] = {}

    def value(self, value: Any) -> Any:
        if self._unwrap:
            value = getattr(value, "py_func", value)
        if isinstance(value, types.BuiltinFunctionType) and value.__module__ == "math":
            return getattr(self._math, value.__name__)
        if not isinstance(value, types.FunctionType):
            return value
        if id(value) not in self._done:
            self._copy(value)
        return self._done[id(value)]

    def _copy(self, function: types.FunctionType) -> None:
        scope = {**function.__globals__, **self._builtins}
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        copy = types.FunctionType(
            function.__code__, scope, function.__name__, function.__defaults__, cells
        )
        copy.__kwdefaults__ = function.__kwdefaults__
        copy.__module__ = __name__  # the user's file may be no importable module
        # Noted before its helpers are looked at, so that functions may refer to each other.
        self._done[id(function)] = self._finish(copy)
        copy.__defaults__ = tuple(map(self.value, function.__defaults__ or ())) or None
        names = names_in(function.__code__)
        for name in names & function.__globals__.keys():
            item = function.__globals__[name]
            module = isinstance(item, types.ModuleType)
            scope[name] = self._module(item, names) if module else self.value(item)
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            item = original.cell_contents
            module = isinstance(item, types.ModuleType)
            cell.cell_contents = self._module(item, names) if module else self.value(item)

    def _module(self, module: types.ModuleType, names: set[str]) -> Any:
        """The module, or a copy of it in which the functions of the given names are rebuilt."""
        if module is math:
            return self._math
        if module.__name__.partition(".")[0] in KNOWN_MODULES:
            return module
        copy = types.ModuleType(module.__name__)
        copy.__dict__.update(module.__dict__)
        for name in names & module.__dict__.keys():
            setattr(copy, name, self.value(getattr(module, name)))
        return copy
