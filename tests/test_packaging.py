"""The distribution: all that the commands need is in the wheel, and works from anywhere."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.daq.support import environment

pytestmark = pytest.mark.soak

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("daq", "haptics", "protocols", "sim_rig", "sysid")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Wheel and sdist of the checkout."""
    folder = tmp_path_factory.mktemp("dist")
    result = subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """A folder with nothing but what the wheel installs."""
    folder = tmp_path_factory.mktemp("installed")
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target",
         str(folder), str(built[0])],
        check=True, capture_output=True, timeout=300,
    )  # fmt: skip
    return folder


def test_every_file_of_the_packages_is_in_the_wheel_and_in_the_sdist(built):
    wheel, sdist = built
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = set(archive.namelist())
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    tracked = subprocess.run(
        ["git", "ls-files", *PACKAGES], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if tracked.returncode != 0:
        pytest.skip("not a git checkout")
    wanted = set(tracked.stdout.split())
    assert any(name.endswith(".yaml") for name in wanted)
    assert wanted <= in_wheel
    assert wanted <= in_sdist
    assert not [name for name in in_wheel if name.startswith(("tests/", "benchmarks/"))]


def test_the_installed_command_finds_what_is_shipped_with_it(installed, tmp_path):
    env = environment(PYTHONPATH=os.fspath(installed))
    check = subprocess.run(
        [sys.executable, "-m", "daq.cli", "check", "prbs.yaml"],
        cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert check.returncode == 0, check.stderr
    assert "installed" in check.stdout, "the file shipped in the wheel was meant"
