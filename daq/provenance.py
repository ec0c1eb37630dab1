"""What a result was made with: versions of this program, of Python and of libraries."""

import importlib.metadata
import subprocess
import sys
from pathlib import Path
from typing import Any

_PACKAGES = ("hybrid-rig", "numpy", "scipy", "numba", "pandas")


def software_versions() -> dict[str, Any]:
    """Versions by name; None for a package that is not installed."""
    return {
        "python": sys.version.split()[0],
        **{name: _version(name) for name in _PACKAGES},
        "commit": _git_commit(),
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """Commit of the checkout this program runs from, marked when files differ from it."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(
            command, capture_output=True, text=True, timeout=5, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
