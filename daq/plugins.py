"""Backends, protocols, models and limits found by name, whichever installed package brings them."""

import functools
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from daq.errors import ConfigError, suggestion

Kind = Literal["backend", "controller", "limit", "model", "protocol"]


def installed(kind: Kind) -> dict[str, EntryPoint]:
    """Entry points of a kind, whichever installed package brings them, by name."""
    return {point.name: point for point in _entry_points().select(group=f"rig.{kind}s")}


@functools.cache
def _entry_points() -> Any:
    """Those of all packages, read once: that takes longer than all else of a lookup."""
    return entry_points()


def load_plugin(kind: Kind, name: str) -> Any:
    """The object registered under a name; ConfigError names those that exist."""
    points = installed(kind)
    if name not in points:
        raise ConfigError(f"unknown {kind} {name!r}", cure=suggestion(name, list(points)))
    try:
        return points[name].load()
    except Exception as error:
        raise ConfigError(
            f"{kind} {name!r} ({points[name].value}) does not load: {type(error).__name__}: {error}"
        ) from error
