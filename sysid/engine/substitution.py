"""Copies of a model's plain functions, and of all they call, with some names exchanged.

A model's equations call ``math``, ``abs``, ``min``, ``max`` and helper functions of their own,
directly or through a module. To compile, trace or differentiate them, copies are made in which
library functions have stand-ins; the user's functions themselves stay untouched.
"""

import math
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

# Modules that the compiler knows by itself and that do not change between runs.
KNOWN_MODULES = frozenset({"builtins", "cmath", "math", "numba", "numpy", "operator"})


def names_in(code: types.CodeType) -> set[str]:
    """All names that code refers to, including code within it."""
    inner = (item for item in code.co_consts if isinstance(item, types.CodeType))
    return set(code.co_names).union(*map(names_in, inner))


@dataclass
class Copier:
    """Makes finished copies of functions that refer to finished copies of their helpers.

    math: what takes the place of the math module and, by name, of its functions. builtins:
    stand-ins for built-in functions. unwrap: copy what lies under a function that the user has
    already compiled, instead of leaving it as it is.
    """

    math: Any
    finish: Callable[[types.FunctionType], Any]
    builtins: Mapping[str, Any] = field(default_factory=dict)
    unwrap: bool = False
    _done: dict[int, Any] = field(default_factory=dict)

    def copied(self, value: Any) -> Any:
        """The copy of a function; what is none comes back as it is."""
        if self.unwrap:
            value = getattr(value, "py_func", value)
        if isinstance(value, types.BuiltinFunctionType) and value.__module__ == "math":
            return getattr(self.math, value.__name__)
        if not isinstance(value, types.FunctionType):
            return value
        if id(value) not in self._done:
            self._copy(value)
        return self._done[id(value)]

    def _copy(self, function: types.FunctionType) -> None:
        scope = {**function.__globals__, **self.builtins}
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        copy = types.FunctionType(
            function.__code__, scope, function.__name__, function.__defaults__, cells
        )
        copy.__kwdefaults__ = function.__kwdefaults__
        copy.__module__ = __name__  # the user's file may be no importable module
        # Noted before its helpers are looked at, so that functions may refer to each other.
        self._done[id(function)] = self.finish(copy)
        copy.__defaults__ = tuple(map(self.copied, function.__defaults__ or ())) or None
        names = names_in(function.__code__)
        for name in names & function.__globals__.keys():
            scope[name] = self._helper(function.__globals__[name], names)
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self._helper(original.cell_contents, names)

    def _helper(self, module: Any, names: set[str]) -> Any:
        """A function's copy; of a module one in which functions of the given names are copies."""
        if not isinstance(module, types.ModuleType):
            return self.copied(module)
        if module is math:
            return self.math
        if module.__name__.partition(".")[0] in KNOWN_MODULES:
            return module
        copy = types.ModuleType(module.__name__)
        copy.__dict__.update(module.__dict__)
        for name in names & module.__dict__.keys():
            setattr(copy, name, self.copied(getattr(module, name)))
        return copy
