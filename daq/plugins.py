"""Backends, protocols, models and limits found by name, whichever installed package brings them."""

from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from daq.errors import ConfigError, suggestion

Group = Literal["rig.backends", "rig.protocols", "rig.models", "rig.limits"]


def installed(group: Group) -> dict[str, EntryPoint]:
    """Entry points of a group, by name."""
    return {point.name: point for point in entry_points(group=group)}


def load_plugin(group: Group, name: str) -> Any:
    """The object registered under a name; ConfigError names those that exist."""
    kind = group.removeprefix("rig.").removesuffix("s")
    points = installed(group)
    if name not in points:
        raise ConfigError(f"unknown {kind} {name!r}", cure=suggestion(name, list(points)))
    try:
        return points[name].load()
    except Exception as error:
        raise ConfigError(
            f"{kind} {name!r} ({points[name].value}) does not load: {type(error).__name__}: {error}"
        ) from error
