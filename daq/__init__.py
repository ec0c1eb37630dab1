"""Rigs, runs and their logs; what the commands do, as functions for scripts and notebooks.

``record`` runs an experiment, ``load`` reads a log, ``identify`` and ``replay`` do what the
commands of these names do. Each is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from daq.api import Identification, identify, record, replay
    from daq.cli.replay import Replay
    from daq.errors import ConfigError, RigError
    from daq.logs.recording import Recording, load

_HOMES = {
    "ConfigError": "daq.errors",
    "Identification": "daq.api",
    "Recording": "daq.logs.recording",
    "Replay": "daq.cli.replay",
    "RigError": "daq.errors",
    "identify": "daq.api",
    "load": "daq.logs.recording",
    "record": "daq.api",
    "replay": "daq.api",
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
