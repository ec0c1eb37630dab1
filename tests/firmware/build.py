"""The firmware, built for tests by its own Makefile; skips, with the reason, where tools lack."""

import functools
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "firmware"
PACKAGES = {
    "make": "make",
    "gcc": "gcc",
    "gcov": "gcc",
    "cppcheck": "cppcheck",
    "clang-tidy": "clang-tidy",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
}
"""Debian's package of each tool."""


def needs(*tools):
    """Skip where one of these tools is not installed."""
    for tool in tools:
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed (Debian: apt install {PACKAGES[tool]})")


@functools.cache
def _folder():
    folder = tempfile.TemporaryDirectory(prefix="rig-firmware-")
    return folder, Path(folder.name)


def make(*targets, **variables):
    """Build targets of the Makefile into a folder of this process; the folder."""
    _, folder = _folder()
    words = ["make", "-C", SOURCE, "--no-print-directory", f"-j{os.cpu_count()}", f"BUILD={folder}"]
    words += [f"{name}={value}" for name, value in variables.items()]
    done = subprocess.run([*words, *targets], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder
