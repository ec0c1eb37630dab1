"""What is tried again, and what is not."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.daq.support import environment

ROOT = Path(__file__).parents[2]
_CONFTEST = """
import sys
sys.path.insert(0, {root!r})
from tests.firmware import patience
from tests.firmware.conftest import pytest_runtest_protocol

class Load:
    def __str__(self):
        return {load!r}

patience.Load = Load
"""
_TEST = """
import pytest
from pathlib import Path

@pytest.mark.patient
def test_something():
    tries = Path("tries")
    n = len(tries.read_text()) if tries.exists() else 0
    tries.write_text("x" * (n + 1))
    if {varied} and n % 2:
        assert not "here now and then"
    assert n + 1 >= {good}
"""


@pytest.mark.parametrize(
    ("load", "good", "varied", "tries", "outcome"),
    [
        ("", 2, False, 1, "1 failed"),
        ("a busy core", 3, False, 3, "1 passed"),
        ("a busy core", 9, True, 5, "1 skipped"),
        ("a busy core", 9, False, 5, "1 failed"),
    ],
)
def test_only_what_fails_on_load_is_tried_again(tmp_path, load, good, varied, tries, outcome):
    (tmp_path / "conftest.py").write_text(_CONFTEST.format(root=str(ROOT), load=load))
    (tmp_path / "test_it.py").write_text(_TEST.format(good=good, varied=varied))
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = patient")
    words = [sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider"]
    alone = environment(PYTEST_DISABLE_PLUGIN_AUTOLOAD="1")
    done = subprocess.run(
        words, cwd=tmp_path, env=alone, capture_output=True, text=True, check=False
    )
    assert outcome in done.stdout, done.stdout + done.stderr
    assert len((tmp_path / "tries").read_text()) == tries
    word = "too busy a machine for real time: a busy core"
    assert (word in done.stdout) == (outcome == "1 skipped")
