"""Ways to mount a rig, of which a person changes one for another between rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from daq.characterise.rounds import Request
from daq.lookup.rigs import load_rig

Ask = Callable[[str], None]
"""Tells a person what to do, and returns when it is done."""


@dataclass(frozen=True)
class MountedRig:
    """A rig as it is mounted: its file, its plant if that is named, and what to do for it."""

    rig: str
    plant: str | None
    change: str


def mounted_rigs(request: Request) -> list[MountedRig]:
    """All ways in which a request's rig may be mounted, the first as it is now.

    Raises ConfigError for a file of a mounting that is not there, or wrong.
    """
    first = MountedRig(request.rig, request.plant, "mount it as it was at the beginning")
    if not request.ask:
        return [first]
    rigs = [first]
    for change, mounting in load_rig(request.rig)[0].mountings.items():
        beside = Path(request.rig).parent / mounting.rig
        name = str(beside.resolve()) if beside.exists() else mounting.rig
        load_rig(name)
        rigs.append(MountedRig(name, mounting.plant, change))
    return rigs
