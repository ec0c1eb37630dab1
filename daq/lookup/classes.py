"""Classes by the names that users write: installed ones, or ``FILE.py:CLASS``."""

import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.config.base import Section
from daq.errors import ConfigError
from daq.experiment import Experiment
from daq.hal import Device
from daq.limits import Limit
from daq.lookup.user_code import Kind, from_file, locate
from daq.plugins import Group, load_plugin


def find_protocol(name: str, folder: Path) -> type[Experiment]:
    """An installed protocol, or a class in a file given as ``FILE.py:CLASS``.

    File names are looked up from the working folder, then from ``folder``. Raises ConfigError.
    """
    protocol: type[Experiment] = _find(name, folder, _PROTOCOL)
    return protocol


def find_limit(name: str, folder: Path) -> type[Limit]:
    """The same for a limit."""
    limit: type[Limit] = _find(name, folder, _LIMIT)
    return limit


def find_backend(name: str, folder: Path) -> Any:
    """The same for a backend: a class with ``Options`` that makes devices."""
    return _find(name, folder, _BACKEND)


def file_and_class(name: str) -> tuple[Path, str] | None:
    """The parts of ``FILE.py:CLASS``; None for another name."""
    # Not at the first colon: a Windows path has one behind its drive.
    parts = re.match(r"^(.*\.py):(\w+)$", name)
    return (Path(parts[1]), parts[2]) if parts else None


@dataclass(frozen=True)
class _Role:
    """What a class can be to a rig; cure: for a class that is not fit for it."""

    kind: Kind
    group: Group
    is_fit: Callable[[Any], bool]
    cure: str


def _find(name: str, folder: Path, role: _Role) -> Any:
    parts = file_and_class(name)
    if parts is None:
        candidate = load_plugin(role.group, name)
    else:
        path = locate(parts[0], role.kind, folder)
        candidate = from_file(path, parts[1], role.kind, role.is_fit)
    if not role.is_fit(candidate):
        raise ConfigError(f"{name} is no {role.kind}", cure=role.cure)
    return candidate


def _is_concrete(candidate: Any, base: type) -> bool:
    is_subclass = inspect.isclass(candidate) and issubclass(candidate, base)
    return is_subclass and not inspect.isabstract(candidate)


def _is_backend(candidate: Any) -> bool:
    options = getattr(candidate, "Options", None)
    has_options = inspect.isclass(options) and issubclass(options, Section)
    functions = [name for name, value in vars(Device).items() if inspect.isfunction(value)]
    methods = [name for name in functions if not name.startswith("_")]
    is_device = inspect.isclass(candidate) and all(hasattr(candidate, name) for name in methods)
    return is_device and has_options


_PROTOCOL = _Role(
    "protocol",
    "rig.protocols",
    lambda candidate: _is_concrete(candidate, Experiment),
    "make it a class derived from daq.experiment.Timed, OpenLoop or ClosedLoop, with all of its "
    "methods",
)
_LIMIT = _Role(
    "limit",
    "rig.limits",
    lambda candidate: _is_concrete(candidate, Limit),
    "make it a class derived from daq.limits.Limit with a method check",
)
_BACKEND = _Role(
    "backend",
    "rig.backends",
    _is_backend,
    "make it a class with Options and the methods of daq.hal.Device",
)
