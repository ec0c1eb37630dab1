"""Backends, protocols, models and limits found by name, whichever installed package brings them."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from daq.config.yaml_file import suggestion
from daq.errors import ConfigError

Group = Literal["rig.backends", "rig.protocols", "rig.models", "rig.limits"]


def installed(group: Group) -> dict[str, EntryPoint]:
    """Entry points of a group, by name."""
    return {point.name: point for point in entry_points(group=group)}


def load_plugin(group: Group, name: str) -> Any:
    """The object registered under a name; ConfigError names those that exist."""
    kind = group.removeprefix("rig.").removesuffix("s")
    found = installed(group)
    if name not in found:
        raise ConfigError(f"unknown {kind} {name!r}; {suggestion(name, list(found))}")
    try:
        return found[name].load()
    except Exception as error:
        raise ConfigError(
            f"{kind} {name!r} ({found[name].value}) does not load: {type(error).__name__}: {error}"
        ) from error
