"""The YAML files that come with the program."""

from __future__ import annotations

import importlib.resources
from collections.abc import Iterable
from pathlib import Path

# Packages that ship files.
EXPERIMENTS = ("protocols",)
RIGS = ("sim_rig", "daq.serial")


def shipped_files(packages: Iterable[str]) -> list[Path]:
    """The YAML files that packages ship, by name."""
    folders = [importlib.resources.files(package) for package in packages]
    found = [Path(str(item)) for folder in folders for item in folder.iterdir()]
    return sorted((p for p in found if p.suffix == ".yaml"), key=lambda path: path.name)
