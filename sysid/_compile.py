"""From a model's plain Python to machine code, kept on disk between runs.

The compiled kernels live in the user's cache folder under a name that is a fingerprint of the
model's functions, everything they call and the kernel's text. A changed model file therefore
gets a new name, and an old kernel is never used for it.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
import tempfile
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid import _kernel
from sysid.model import ModelError, ProcessModel

_OPTIONS: dict[str, Any] = {
    # IEEE division instead of exceptions, and none of the flags that would let the compiler
    # assume away the NaN and infinity by which a failed simulation is recognised.
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz"},
}


@dataclass(frozen=True)
class Kernels:
    """Compiled functions of one model (see ``_kernel`` for their arguments)."""

    simulate: Callable[..., None]
    spectrum: Callable[..., None]
    advance: Callable[..., None]
    work_size: int


@functools.lru_cache(maxsize=8)
def kernels(model: ProcessModel) -> Kernels:
    """Compile a model's kernels, or load them from the cache folder.

    Compilation itself happens at the first call. Raises ModelError when the model's functions
    use something that cannot be compiled.
    """
    import numba
    import numpy as np

    shape = _kernel.Shape.of(model)
    text = _kernel.source(shape)
    functions = [model.derivative] + ([model.output] if model.output is not None else [])
    key = hashlib.sha256(f"{numba.__version__}\n{text}".encode())
    for function in functions:
        _fingerprint(function, key, set())
    path = _source_file(f"{_safe(model.name)}_{key.hexdigest()[:24]}.py", text)
    compiled: dict[int, Any] = {}
    scope: dict[str, Any] = {
        "np": np,
        "math": math,
        "derivative": _jit(model.derivative, compiled),
        "__name__": __name__,  # a module that exists when Numba loads the kernel from its cache
    }
    if model.output is not None:
        scope["output"] = _jit(model.output, compiled)
    exec(compile(text, str(path or "<kernel>"), "exec"), scope)
    decorate = numba.njit(nogil=True, cache=path is not None, **_OPTIONS)
    return Kernels(
        _guarded(model, decorate(scope["simulate"])),
        _guarded(model, decorate(scope["spectrum"])),
        _guarded(model, decorate(scope["advance"])),
        _kernel.work_size(shape),
    )


def cache_folder() -> Path:
    """Where compiled kernels are kept: RIG_CACHE_DIR, or the user's cache folder."""
    import platformdirs

    chosen = os.environ.get("RIG_CACHE_DIR")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("hybrid-rig", False))


def _guarded(model: ProcessModel, function: Any) -> Callable[..., Any]:
    """Turn the compiler's complaint about the user's function into a ModelError."""

    def call(*args: Any) -> Any:
        from numba.core.errors import NumbaError

        try:
            return function(*args)
        except NumbaError as error:
            raise ModelError(_explain(model, error)) from None

    return call


def _explain(model: ProcessModel, error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    cause = next((s for s in lines if "File " not in s and "pipeline" not in s), "unknown cause")
    place = next((s for s in lines if s.startswith('File "') and "<kernel>" not in s), "")
    return (
        f"model {model.name}: its functions cannot be compiled: {cause} {place}\n"
        "  They may use floats, tuples, math functions, conditions and helper functions of the "
        "same kind; not lists, dictionaries, strings or objects."
    )


def _jit(function: Any, done: dict[int, Any]) -> Any:
    """Compile a function and, first, every plain function it refers to."""
    import numba

    if not isinstance(function, types.FunctionType):
        return function
    if id(function) in done:
        return done[id(function)]
    scope = dict(function.__globals__)
    for name, value in _referenced(function).items():
        if isinstance(value, types.FunctionType):
            scope[name] = _jit(value, done)
    cells = tuple(
        types.CellType(_jit(cell.cell_contents, done)) for cell in function.__closure__ or ()
    )
    copy = types.FunctionType(
        function.__code__, scope, function.__name__, function.__defaults__, cells
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    copy.__module__ = __name__  # the user's file may be no importable module
    done[id(function)] = numba.njit(**_OPTIONS)(copy)
    return done[id(function)]


def _referenced(function: types.FunctionType) -> dict[str, Any]:
    scope = function.__globals__
    return {name: scope[name] for name in function.__code__.co_names if name in scope}


def _fingerprint(value: Any, key: Any, seen: set[int]) -> None:
    """Feed all that decides a function's behaviour into a hash."""
    value = getattr(value, "py_func", value)
    if isinstance(value, types.FunctionType):
        if id(value) in seen:
            return
        seen.add(id(value))
        _fingerprint(value.__code__, key, seen)
        _fingerprint((value.__defaults__, value.__kwdefaults__), key, seen)
        for cell in value.__closure__ or ():
            _fingerprint(cell.cell_contents, key, seen)
        for name, item in sorted(_referenced(value).items()):
            key.update(name.encode())
            _fingerprint(item, key, seen)
    elif isinstance(value, types.CodeType):
        key.update(value.co_code + repr((value.co_names, value.co_varnames)).encode())
        for constant in value.co_consts:
            _fingerprint(constant, key, seen)
    elif isinstance(value, types.ModuleType):
        key.update(value.__name__.encode())
    elif isinstance(value, tuple | list):
        for item in value:
            _fingerprint(item, key, seen)
    else:
        key.update(f"{type(value).__name__}:{value!r};".encode())


def _source_file(name: str, text: str) -> Path | None:
    """Write the kernel's text where Numba can cache beside it; None when nowhere is writable."""
    folder = cache_folder()
    path = folder / name
    try:
        if path.exists():
            return path
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder, suffix=".tmp")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        # Two processes may race to here; either's file is the right one.
        Path(temporary).replace(path)
    except OSError:
        return None
    return path


def _safe(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)[:40]
