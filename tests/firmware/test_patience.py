"""What is tried again, and what is not."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.daq.support import environment
from tests.firmware import patience

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
    n = len(tries.read_text("utf-8")) if tries.exists() else 0
    tries.write_text("x" * (n + 1))
    if {varied} and n % 2:
        assert not "here now and then"
    assert n + 1 >= {good}, {word!r}
"""


@pytest.mark.parametrize(
    ("load", "good", "varied", "word", "tries", "outcome"),
    [
        ("", 2, False, "", 1, "1 failed"),
        ("", 3, False, patience.SLOW, 3, "1 passed"),
        ("", 9, False, patience.SLOW, 5, "1 failed"),
        ("a busy core", 3, False, "", 3, "1 passed"),
        ("a busy core", 9, True, "", 5, "1 skipped"),
        ("a busy core", 9, False, "", 5, "1 failed"),
    ],
)
def test_only_what_fails_on_load_is_tried_again(tmp_path, load, good, varied, word, tries, outcome):
    (tmp_path / "conftest.py").write_text(_CONFTEST.format(root=str(ROOT), load=load))
    (tmp_path / "test_it.py").write_text(_TEST.format(good=good, varied=varied, word=word))
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = patient")
    words = [sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider"]
    alone = environment(PYTEST_DISABLE_PLUGIN_AUTOLOAD="1")
    done = subprocess.run(
        words, cwd=tmp_path, env=alone, capture_output=True, text=True, check=False
    )
    assert outcome in done.stdout, done.stdout + done.stderr
    assert len((tmp_path / "tries").read_text("utf-8")) == tries
    skipped = "too busy a machine for real time: a busy core"
    assert (skipped in done.stdout) == (outcome == "1 skipped")


@pytest.mark.parametrize("reason", [patience.SLOW, "something else"])
def test_a_host_that_says_it_was_too_slow_is_tried_again(reason, monkeypatch):
    monkeypatch.setattr(patience, "Load", str)
    tries = []

    def action():
        tries.append(1)
        assert len(tries) == 3, reason
        return "done"

    if reason == patience.SLOW:
        assert patience.on_load(action) == "done"
    else:
        with pytest.raises(AssertionError, match=reason):
            patience.on_load(action)
        assert len(tries) == 1
