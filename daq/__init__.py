"""Rigs, runs and their logs; what the commands do, as functions for scripts and notebooks.

``record`` runs an experiment, ``load`` reads a log, ``identify`` and ``replay`` do what the
commands of these names do. Each is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from daq.capture import Recording, load
    from daq.cli.library import Identification, identify, record, replay
    from daq.cli.replaying import Replay
    from daq.errors import ConfigError, RigError

_HOMES = {
    "ConfigError": "daq.errors",
    "Identification": "daq.cli.library",
    "Recording": "daq.capture",
    "Replay": "daq.cli.replaying",
    "RigError": "daq.errors",
    "identify": "daq.cli.library",
    "load": "daq.capture",
    "record": "daq.cli.library",
    "replay": "daq.cli.library",
}

__all__ = [
    "ConfigError",
    "Identification",
    "Recording",
    "Replay",
    "RigError",
    "identify",
    "load",
    "record",
    "replay",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'daq' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
