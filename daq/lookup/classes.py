"""Classes by the names that users write: installed ones, or ``FILE.py:CLASS``."""

import inspect
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from daq.config.base import Section
from daq.errors import ConfigError
from daq.experiment import Experiment
from daq.hal import Device
from daq.limits import Limit
from daq.lookup.user_code import from_file, locate
from daq.plugins import Kind, load_plugin
from daq.torque import TorqueControl


def find_class(kind: Kind, name: str, folder: Path, record: Path | None = None) -> Any:
    """A class fit for its kind: an installed one, or in a file given as ``FILE.py:CLASS``.

    File names are looked up from the working folder, then from ``folder``. record: which names it,
    and whose files are not to be run. Raises ConfigError.
    """
    is_fit, cure = _CLASSES[kind]
    parts = file_and_class(name)
    if parts is None:
        candidate = load_plugin(kind, name)
    else:
        path = locate(parts[0], kind, folder)
        candidate = from_file(path, parts[1], kind, is_fit, record)
    if not is_fit(candidate):
        raise ConfigError(f"{name} is no {kind}", cure=cure)
    return candidate


def file_and_class(name: str) -> tuple[Path, str] | None:
    """The parts of ``FILE.py:CLASS``; None for another name."""
    # Not at the first colon: a Windows path has one behind its drive.
    parts = re.match(r"^(.*\.py):(\w+)$", name)
    return (Path(parts[1]), parts[2]) if parts else None


def _is_concrete(base: type, candidate: Any) -> bool:
    is_subclass = inspect.isclass(candidate) and issubclass(candidate, base)
    return is_subclass and not inspect.isabstract(candidate)


def _is_backend(candidate: Any) -> bool:
    options = getattr(candidate, "Options", None)
    has_options = inspect.isclass(options) and issubclass(options, Section)
    functions = [name for name, value in vars(Device).items() if inspect.isfunction(value)]
    methods = [name for name in functions if not name.startswith("_")]
    is_device = inspect.isclass(candidate) and all(hasattr(candidate, name) for name in methods)
    return is_device and has_options


# Whether a class is fit for its kind, and the cure for one that is not.
_CLASSES: dict[Kind, tuple[Callable[[Any], bool], str]] = {
    "protocol": (
        partial(_is_concrete, Experiment),
        "make it a class derived from daq.experiment.Timed, OpenLoop or ClosedLoop, with all of "
        "its methods",
    ),
    "controller": (
        partial(_is_concrete, TorqueControl),
        "make it a class derived from daq.torque.TorqueControl, with all of its methods",
    ),
    "limit": (
        partial(_is_concrete, Limit),
        "make it a class derived from daq.limits.Limit with a method check",
    ),
    "backend": (_is_backend, "make it a class with Options and the methods of daq.hal.Device"),
}
