"""From a model's plain Python to machine code, kept on disk between runs.

The compiled kernels live in the user's cache folder under a name that is a fingerprint of their
text and of those of the model's functions that it calls, with all that these call in turn. A
changed model file therefore gets a new name, and an old kernel is never used for it.
"""

import contextlib
import functools
import hashlib
import math
import os
import re
import sys
import tempfile
import threading
import types
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from sysid.engine.batch_kernel import BatchKernel
from sysid.engine.filter_kernel import FilterKernel
from sysid.engine.sample_kernel import IntervalKernel, SampleKernel
from sysid.engine.structure import analyse
from sysid.engine.substitution import KNOWN_MODULES, Copier, names_in
from sysid.engine.tangent import TangentKernel
from sysid.engine.trajectory_kernel import TrajectoryKernel
from sysid.engine.variation import variation
from sysid.problem.model import ModelError, ProcessModel

_OPTIONS: dict[str, Any] = {
    # IEEE division instead of exceptions, and none of the flags that would let the compiler
    # assume away the NaN and infinity by which a failed simulation is recognised.
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz"},
    "no_cfunc_wrapper": True,  # for calls from C, of which there are none
}


P = ParamSpec("P")
R = TypeVar("R")
_MAKING = threading.RLock()


def _once(make: Callable[P, R]) -> Callable[P, R]:
    """Keep what was made last, as ``lru_cache``; threads that ask for one thing at once get one."""
    kept = functools.lru_cache(maxsize=8)(make)

    @functools.wraps(make)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        with _MAKING:
            return kept(*args, **kwargs)  # type: ignore[arg-type]  # what cannot be hashed is told

    return called


@dataclass(frozen=True)
class Kernels:
    """A model's compiled functions: two of the batch kernel, then two of the trajectory's."""

    model: ProcessModel
    batch: BatchKernel
    trajectory: TrajectoryKernel
    simulate: Callable[..., None]
    spectrum: Callable[..., None]
    levels: Callable[..., None]
    advance: Callable[..., None]


@_once
def kernels(model: ProcessModel, *, exact: bool = True) -> Kernels:
    """Compile a model's kernels, or load them from the cache folder.

    Compilation itself happens at the first call, which belongs in ``explained_errors``. Without
    ``exact`` nothing is integrated exactly.
    """
    batch, trajectory, text, called = _source(model, exact)
    functions = ("simulate", "spectrum", "levels", "advance")
    return Kernels(model, batch, trajectory, *_compiled(model, text, called, functions))


@dataclass(frozen=True)
class Filter:
    """A model's compiled extended Kalman filter."""

    model: ProcessModel
    kernel: FilterKernel
    innovations: Callable[..., None]


@_once
def kalman_filter(
    model: ProcessModel,
    noisy: tuple[int, ...],
    driven: tuple[int, ...] = (),
    averaged: tuple[int, ...] = (),
    coloured: bool = False,
    jittered: bool = False,
) -> Filter:
    """Compile a model's filter for noise on some inputs and states; as ``kernels``.

    noisy, driven: their places; averaged: places of outputs, as of ``FilterKernel``, whose model
    is ``with_integrals`` of them; coloured: whether the inputs' noise may be; jittered: whether
    how late means were is not known. Raises ModelError for equations that cannot be differentiated.
    """
    varied = variation(model, noisy, driven)
    kernel = FilterKernel(model, varied, averaged, coloured=coloured, jittered=jittered)
    text = f"{kernel.structure.program}\n\n{kernel.text()}"
    return Filter(model, kernel, *_compiled(model, text, {}, ("innovations",)))


@dataclass(frozen=True)
class Tangents:
    """A model's compiled tangents."""

    kernel: TangentKernel
    simulate: Callable[..., None]


@_once
def tangents(model: ProcessModel) -> Tangents:
    """Compile the tangents of a model; as ``kernels``.

    Raises ModelError for equations that cannot be differentiated.
    """
    from sysid.engine.intrinsics import many_registers

    kernel = TangentKernel(model)
    text = f"{kernel.structure.program}\n\n{kernel.text(many_registers=many_registers())}"
    return Tangents(kernel, *_compiled(model, text, {}, ("simulate",)))


@_once
def is_differentiable(model: ProcessModel) -> bool:
    """Whether a model has ``tangents``; nothing is compiled."""
    try:
        TangentKernel(model)
    except ModelError:
        return False
    return True


@dataclass(frozen=True)
class SampleLanes:
    """A model's compiled functions of ``SampleKernel``; key: fingerprint of what they do."""

    kernel: SampleKernel
    key: str
    prepare: Callable[..., None]
    advance: Callable[..., None]


@_once
def sample_lanes(model: ProcessModel) -> SampleLanes:
    """Compile what advances lanes of a model sample by sample; as ``kernels``."""
    return _sample_lanes(model, SampleKernel(model, analyse(model)))


@_once
def interval_lanes(model: ProcessModel) -> SampleLanes:
    """Compile what advances lanes of a model over many samples; as ``kernels``."""
    return _sample_lanes(model, IntervalKernel(model, analyse(model)))


def _sample_lanes(model: ProcessModel, kernel: SampleKernel) -> SampleLanes:
    from sysid.engine.intrinsics import many_registers

    text = f"{kernel.structure.program}\n\n{kernel.text(many_registers=many_registers())}"
    called = {name: getattr(model, name) for name in sorted(kernel.structure.calls)}
    functions = _compiled(model, text, called, ("prepare", "advance"))
    return SampleLanes(kernel, _key(text, called), *functions)


def _compiled(
    model: ProcessModel, text: str, called: Mapping[str, Any], functions: Sequence[str]
) -> list[Any]:
    """Functions of kernels' text, compiled; called: the model's functions that it calls."""
    # Numba is slow to import.
    from sysid.engine import intrinsics, parts, vector_math
    from sysid.engine.phi import scheme_matrices

    name = "".join(c if c.isalnum() else "_" for c in model.name)[:40]
    scope = {
        "math": vector_math,
        **{name: getattr(vector_math, name) for name in vector_math.OF_SLOPES},
        "wide_vectors": intrinsics.wide_vectors,
        "always_inline": intrinsics.always_inline,
        "copy_row": intrinsics.copy_row,
        "__name__": __name__,  # a module that exists when Numba loads the kernel from its cache
        **{name: machine_code(function) for name, function in called.items()},
    }
    path = _define(f"{name}_{_key(text, called)}.py", text, scope)
    scope |= {f.__name__: intrinsics.outside(f) for f in (scheme_matrices, *parts.PARTS)}
    for name in ("constants", "remainder", "observe", "margins", "gains"):
        if name in scope:
            scope[name] = _njit(scope[name], no_cpython_wrapper=True)
    return [_njit(scope[name], nogil=True, cache=path is not None) for name in functions]


def _define(name: str, text: str, scope: dict[str, Any]) -> Path | None:
    """Define the functions of a text in a scope, with its runs of assignments outlined.

    The file of that name in the cache, of what was defined; None when nowhere is writable.
    """
    from sysid.engine.straight_line import intrinsics, outlined

    names = dict(scope)
    path, content = _kept(name, lambda: outlined(text, names))
    exec(compile(content, str(path or "<kernel>"), "exec"), scope)
    scope |= intrinsics(content, names)
    return path


def compiled_text(
    name: str, text: str, functions: Sequence[str], called: Mapping[str, Any] | None = None
) -> list[Any]:
    """Functions of a text of plain scalar Python, compiled; all that they call stands in it.

    name: by which it lies in the cache folder. called: compiled functions that the text calls; it
    has to differ where they do.

    >>> text = "def double(x): return 2.0 * x"
    >>> (double,) = compiled_text("example", text, ["double"])
    >>> double(1.5)
    3.0
    """
    scope: dict[str, Any] = {"math": math, "__name__": __name__}
    path = _define(f"{name}_{_key(text, {})}.py", text, scope)
    for key, item in scope.items():
        if isinstance(item, types.FunctionType) and key not in functions:
            scope[key] = _njit(item, no_cpython_wrapper=True)
    scope |= called or {}
    return [_njit(scope[key], nogil=True, cache=path is not None) for key in functions]


@contextlib.contextmanager
def explained_errors(model: ProcessModel) -> Iterator[None]:
    """Make ModelErrors of the compiler's complaints about a model."""
    from numba.core.errors import NumbaError

    try:
        yield
    except NumbaError as error:
        text = str(error)
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        causes = (s for s in lines if not _ABOUT_KERNELS.search(s))
        cause = next(causes, "unknown cause")
        if refused := _REFUSED.search(text):
            cause = f"{refused[1]} is not understood with what it is given"
        cure = " (use min and max)" if refused and refused[1] == "clip" else ""
        raise ModelError(
            f"model {model.name}: its functions cannot be compiled: {_place_in(model, text)}{cause}"
            f"{cure}\n"
            "  They may use floats, tuples, math functions, conditions and helper functions of the "
            "same kind; not lists, dictionaries, strings or objects."
        ) from None


# Of the compiler's complaints: a function that has no such arguments, and lines that led there.
_REFUSED = re.compile(r"Function\(<function (\w+) at 0x")
_LINE = re.compile(r" at (.+) \((\d+)\)$|File \"(.+)\", line (\d+)", re.MULTILINE)
_ABOUT_KERNELS = re.compile(
    "File|pipeline|<intrinsic|^>>>|^There are|^- Of which|^Intrinsic|^With|^Rej"
)


def _place_in(model: ProcessModel, text: str) -> str:
    """``FILE:LINE: `` of the first line of a model's own file in a complaint; empty for none."""
    sources = {
        Path(function.__code__.co_filename).resolve()
        for function in (model.derivative, model.output)
        if isinstance(function, types.FunctionType)
    }
    for match in _LINE.finditer(text):
        file, line = filter(None, match.group(1, 2, 3, 4))
        if (whole := Path(file).resolve()) in sources:
            return f"{str(whole).removeprefix(f'{Path.cwd()}{os.sep}')}:{line}: "
    return ""


def fingerprint(model: ProcessModel) -> str:
    """Hash of what decides every digit: equations, constraints, the use of this processor."""
    _, _, text, called = _source(model)
    key = hashlib.sha256(_key(text, called).encode())
    for constraint in model.constraints:
        _fingerprint(constraint.function, key, set())
    return key.hexdigest()


def _source(
    model: ProcessModel, exact: bool = True
) -> tuple[BatchKernel, TrajectoryKernel, str, dict[str, Any]]:
    """A model's kernels, their text, and the model's functions that it calls."""
    from sysid.engine.intrinsics import many_registers

    structure = analyse(model, exact=exact)
    batch, trajectory = BatchKernel(model, structure), TrajectoryKernel(model, structure)
    texts = structure.program, batch.text(many_registers=many_registers()), trajectory.text()
    called = {name: getattr(model, name) for name in sorted(structure.calls)}
    return batch, trajectory, "\n\n".join(texts), called


def _key(text: str, called: Mapping[str, Any]) -> str:
    """Fingerprint of all that decides what the kernels do."""
    import numba

    key = hashlib.sha256(f"{numba.__version__}\n{sorted(_OPTIONS['fastmath'])}\n{text}".encode())
    for library in ("intrinsics.py", "parts.py", "phi.py", "straight_line.py", "vector_math.py"):
        key.update(Path(__file__).with_name(library).read_bytes())
    for function in called.values():
        _fingerprint(function, key, set())
    return key.hexdigest()[:24]


def _njit(function: Any, *, cache: bool = False, **options: Any) -> Any:
    import numba

    dispatcher = numba.njit(**_OPTIONS, **options)(function)
    if cache:
        # RuntimeError: neither beside the text nor elsewhere can the compiler write.
        with contextlib.suppress(RuntimeError):
            dispatcher._cache = _cache_of(function)
    return dispatcher


def _cache_of(function: Any) -> Any:
    from numba.core.caching import FunctionCache

    class Cache(FunctionCache):
        """Machine code on disk; where the disk is full, it is compiled again the next time."""

        def save_overload(self, sig: Any, data: Any) -> None:
            with contextlib.suppress(OSError):
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    return Cache(function)  # type: ignore[no-untyped-call]


def machine_code(function: Any) -> Any:
    """A function compiled, with all plain functions that it refers to, also through a module."""
    from sysid.engine import vector_math

    return Copier(vector_math, _njit).copied(function)


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
        module = isinstance(item, types.ModuleType)
        if module and item.__name__.partition(".")[0] not in KNOWN_MODULES:
            _fingerprint_names(vars(item), names, key, seen)


def cache_folder() -> Path | None:
    """Where kernels are kept, by default in the user's cache; None, with a warning, for nowhere.

    What lies there is run as machine code, so the folder is the user's and written to by nobody
    else. Raises ModelError for one in ``RIG_CACHE_DIR`` that is not.
    """
    import platformdirs

    chosen = os.environ.get("RIG_CACHE_DIR")
    folder = Path(chosen or platformdirs.user_cache_dir("hybrid-rig", False)).absolute()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        problem = _intrusion(folder)
    except OSError:
        return None
    if problem is None:
        return folder
    cure = "remove it, and it is made anew for you alone; or name another in RIG_CACHE_DIR"
    danger = f"{problem}, and compiled kernels in it are run as they are"
    if chosen:
        raise ModelError(f"RIG_CACHE_DIR: {folder}: {danger}; {cure}")
    warnings.warn(f"{folder}: {danger}. None is kept now; {cure}", stacklevel=2)
    return None


def _intrusion(folder: Path) -> str | None:
    """How another user could put something into a folder; None where none can."""
    if sys.platform == "win32":
        return None  # it has no such bits; a folder in a user's profile is that user's
    status = folder.stat()
    if status.st_uid != os.geteuid():
        return "it belongs to another user"
    return "others may write to it" if status.st_mode & 0o022 else None


def _kept(name: str, write: Callable[[], str]) -> tuple[Path | None, str]:
    """A text by its name in the cache, written where it is not there whole; its file, and the text.

    Numba caches beside the file; there is none where nothing can be written.
    """
    folder = cache_folder()
    path = folder and folder / name
    if path is not None:
        with contextlib.suppress(OSError, ValueError):
            content = path.read_text("utf-8")
            head, _, text = content.partition("\n")
            if head == _digest(text):
                return path, content
    text = write()
    content = f"{_digest(text)}\n{text}"
    if path is not None:
        with contextlib.suppress(OSError):
            write_cached(path, content.encode())
            return path, content
    return None, content


def _digest(text: str) -> str:
    """A comment of Python by which a text is known to be whole."""
    return f"# {hashlib.sha256(text.encode()).hexdigest()}"


def write_cached(path: Path, content: bytes) -> None:
    """Write a file of the cache whole or not at all. Raises OSError."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    with os.fdopen(handle, "wb") as file:
        file.write(content)
    # Two processes may race to here; either's file is the right one.
    Path(temporary).replace(path)
