"""Objects of a user's own Python files: models, protocols, limits."""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from daq.config.yaml_file import nearest_file
from daq.errors import USER_CODE_ERRORS, ConfigError, line_in, same_file, suggestion
from daq.plugins import Kind
from sysid.problem.model import ModelError
from sysid.time_limit import AT_LENGTH, time_limit


def locate(path: Path, kind: Kind, relative_to: Path | None = None) -> Path:
    """A file looked up from the working folder, then from ``relative_to``; else ConfigError."""
    candidates = [path, *([relative_to / path] if relative_to else [])]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    cure = next(filter(None, map(nearest_file, candidates)), "check its name")
    raise ConfigError(f"there is no such {kind} file", cure=cure, file=path)


def from_file(
    path: Path,
    attribute: str,
    kind: Kind,
    is_valid: Callable[[Any], bool],
    record: Path | None = None,
) -> Any:
    """An object of a user's own Python file, which is run for it.

    is_valid: whether an object is of the kind, for suggestions. record: of a run or a result, where
    only that names the file: whoever sent it is not to choose what runs here. Raises ConfigError
    naming file, line and cause.
    """
    if record is not None:
        raise ConfigError(
            f"this record names {path.resolve()}, which would be run as a program",
            cure="look at that file, then add --trust (in Python trust=True)",
            file=record,
            key=kind,
        )
    module = _import(path, kind)
    if not hasattr(module, attribute):
        names = [key for key, value in vars(module).items() if is_valid(value)]
        cure = f"{suggestion(attribute, names)} (FILE.py:NAME names a {kind} in it)"
        raise ConfigError(f"it defines no {attribute!r}", cure=cure, file=path)
    return getattr(module, attribute)


def _import(path: Path, kind: Kind) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"_rig_{kind}_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Such a file may import its neighbours, as a script in that folder could.
    folder = str(path.resolve().parent)
    sys.path.insert(0, folder)
    # Typed settings look up the module that their annotations are written in.
    sys.modules[spec.name] = module
    try:
        with time_limit(AT_LENGTH):
            spec.loader.exec_module(module)
    except USER_CODE_ERRORS as error:
        del sys.modules[spec.name]
        problem = str(error)
        if not isinstance(error, ModelError):
            problem = f"the {kind} file does not import: {type(error).__name__}: {error}"
        raise ConfigError(problem, file=path, line=_line(path, error)) from None
    finally:
        sys.path.remove(folder)
    return module


def _line(path: Path, error: BaseException) -> int | None:
    """The last line of the user's file that the error passed through."""
    if isinstance(error, SyntaxError) and same_file(error.filename, path):
        return error.lineno
    # What a model's function raised is where to look, not where the model is declared.
    raised = error.__context__ if isinstance(error, ModelError) else None
    return (line_in(raised, path) if raised is not None else None) or line_in(error, path)
