"""From a model's plain Python to machine code, kept on disk between runs.

The compiled kernels live in the user's cache folder under a name that is a fingerprint of the
model's functions, everything they call and the kernel's text. A changed model file therefore
gets a new name, and an old kernel is never used for it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import math
import os
import tempfile
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid import _kernel
from sysid._substitute import KNOWN_MODULES, names_in, rebuilt
from sysid.model import IntArray, ModelError, ProcessModel

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
    triples: IntArray
    work_size: int
    fewest_steps: int


@functools.lru_cache(maxsize=8)
def kernels(model: ProcessModel) -> Kernels:
    """Compile a model's kernels, or load them from the cache folder.

    Compilation itself happens at the first call. Raises ModelError when the model's functions
    use something that cannot be compiled.
    """
    import numba
    import numpy as np

    from sysid._phi import phi_matrices

    shape = _kernel.Shape.of(model)
    text = _kernel.source(shape)
    functions = [model.derivative] + ([model.output] if model.output is not None else [])
    key = hashlib.sha256(f"{numba.__version__}\n{text}".encode())
    for library in ("_phi.py", "_vector_math.py"):
        key.update(Path(__file__).with_name(library).read_bytes())
    for function in functions:
        _fingerprint(function, key, set())
    path = _source_file(f"{_safe(model.name)}_{key.hexdigest()[:24]}.py", text)
    scope: dict[str, Any] = {
        "np": np,
        "math": math,
        "phi_matrices": phi_matrices,
        "derivative": _jit(model.derivative),
        "__name__": __name__,  # a module that exists when Numba loads the kernel from its cache
    }
    if model.output is not None:
        scope["output"] = _jit(model.output)
    exec(compile(text, str(path or "<kernel>"), "exec"), scope)
    scope["prepare"] = numba.njit(**_OPTIONS)(scope["prepare"])

    def decorate(function: Any) -> Any:
        if path is not None:
            # RuntimeError: neither beside the text nor elsewhere can the compiler write.
            with contextlib.suppress(RuntimeError):
                return numba.njit(nogil=True, cache=True, **_OPTIONS)(function)
        return numba.njit(nogil=True, **_OPTIONS)(function)

    return Kernels(
        _guarded(model, decorate(scope["simulate"])),
        _guarded(model, decorate(scope["spectrum"])),
        _guarded(model, decorate(scope["advance"])),
        np.array(shape.structure.products(shape.n_states), dtype=np.int64),
        shape.work_size,
        shape.fewest_steps,
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


def _jit(function: Any) -> Any:
    """Compile a function and every plain function it refers to, also through a module."""
    import numba

    # Imported here because Numba is slow to.
    vector_math = importlib.import_module("sysid._vector_math")
    return rebuilt(function, vector_math, numba.njit(**_OPTIONS))


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
        _fingerprint_names(value.__globals__, names_in(value.__code__), key, seen)
    elif isinstance(value, types.CodeType):
        key.update(value.co_code + repr((value.co_names, value.co_varnames)).encode())
        _fingerprint(value.co_consts, key, seen)
    elif isinstance(value, types.ModuleType):
        key.update(value.__name__.encode())
    elif isinstance(value, tuple | list):
        key.update(f"{type(value).__name__} of {len(value)}:".encode())
        for item in value:
            _fingerprint(item, key, seen)
    elif type(value).__module__ == "numpy" and hasattr(value, "tobytes"):
        # The text of an array is rounded, and abridged when it is long.
        key.update(f"{value.dtype}{value.shape}:".encode() + value.tobytes())
    else:
        key.update(f"{type(value).__name__}:{value!r};".encode())


def _fingerprint_names(scope: dict[str, Any], names: set[str], key: Any, seen: set[int]) -> None:
    for name in sorted(names & scope.keys()):
        item = scope[name]
        key.update(f"{name}=".encode())
        _fingerprint(item, key, seen)
        if (
            isinstance(item, types.ModuleType)
            and item.__name__.partition(".")[0] not in KNOWN_MODULES
        ):
            _fingerprint_names(vars(item), names, key, seen)


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
