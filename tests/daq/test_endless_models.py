"""Models of a user's own that do not end: which function, where, and within a bounded time."""

import json
import re
import signal
import subprocess
import sys

import pytest

from daq import ConfigError, identify
from sysid.time_limit import time_limit
from tests.daq.support import environment, rig, start_rig, until
from tests.daq.test_bad_input import COLUMNS, MODEL
from tests.daq.test_log import original_text

DERIVATIVE = "def derivative(x, u, p):\n"
# The loop catches what it can.
LOOP = """\
    while True:
        try:
            u[0] / 0.0
        except Exception:
            pass
"""


def test_equations_without_end_are_refused_by_their_line(tmp_path):
    (tmp_path / "model.py").write_text(MODEL.replace(DERIVATIVE, DERIVATIVE + LOOP))
    done = rig("models", "model.py:model", cwd=tmp_path)
    assert done.returncode == 2
    assert re.match(
        r"rig: model\.py:[5-9]: model lag: derivative\(x, u, p\) fails at the nominal parameters: "
        r"TimeoutError: it has no end within 2 s of computing and is at line [5-9] of \S*model\.py"
        r", in derivative; give every loop an end, such as 'for _ in range\(50\)'\n$",
        done.stderr,
    ), done.stderr


# A loop that ends at the nominal values, but not for whole populations or records.
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            [
                ("model = Process", 'from sysid import Constraint\n\ndef bound(p):\n'
                 '    while getattr(p[0], "size", 1) > 1:\n        pass\n    return -1.0\n\n\n'
                 "model = Process"),
                ("derivative=", 'constraints=(Constraint("tau < 1", bound),),\n    derivative='),
            ],
            "constraint 'tau < 1': it has no end within 0.2 s of computing and is at line",
        ),
        (
            [(DERIVATIVE, f"{DERIVATIVE}    while p[0] < 0.02:\n        pass\n")],
            "model lag at {'tau': 0.01}: it has no end within 0.2 s of computing and is at line",
        ),
        (
            [
                ("model = Process", f"def guesses(records, known):\n{LOOP}\n\nmodel = Process"),
                ("derivative=", "guesses=guesses,\n    derivative="),
            ],
            "guesses(records, known) fails: TimeoutError: it has no end within 0.3 s of computing",
        ),
    ],
    ids=["constraint", "range", "guesses"],
)  # fmt: skip
def test_functions_of_populations_without_end_are_refused(changes, said, tmp_path, monkeypatch):
    # Sooner than a user's are.
    monkeypatch.setattr("sysid.problem.model.AT_A_POINT", 0.2)
    monkeypatch.setattr("sysid.problem.space.AT_A_POINT", 0.2)
    monkeypatch.setattr("sysid.problem.guesses.AT_LENGTH", 0.3)
    text = MODEL
    for old, new in changes:
        text = text.replace(old, new)
    (tmp_path / "model.py").write_text(text)
    (tmp_path / "log.csv").write_text(original_text())
    guess = "guess: true\n" if "guesses" in said else ""
    (tmp_path / "id.yaml").write_text(COLUMNS + guess)
    with pytest.raises(ConfigError, match=re.escape(said)):
        identify(tmp_path / "log.csv", config=tmp_path / "id.yaml")


def test_ctrl_c_ends_a_model_file_without_end(tmp_path):
    text = "from pathlib import Path\nPath('begun').touch()\nwhile True:\n    pass\n"
    (tmp_path / "model.py").write_text(text)
    process = start_rig("models", "model.py:model", cwd=tmp_path)
    until((tmp_path / "begun").exists, "the file is imported")
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (1, "rig: stopped by Ctrl-C\n")


def test_limits_within_limits_leave_signals_and_timers_as_they_were():
    handler, timer = signal.getsignal(signal.SIGPROF), signal.getitimer(signal.ITIMER_PROF)
    with time_limit(30.0):
        with pytest.raises(TimeoutError, match=r"0\.01 s .* in test_limits"), time_limit(0.01):
            while True:
                pass
        left, _ = signal.getitimer(signal.ITIMER_PROF)
        assert 0.0 < left <= 30.1
    assert signal.getsignal(signal.SIGPROF) is handler
    assert signal.getitimer(signal.ITIMER_PROF) == timer


# It interrupts itself once its loop runs, in machine code that holds no lock of Python's.
STUCK = """\
import os, signal, threading, time
import numba, numpy as np
from daq.cli.interrupt import heeded

turns = np.zeros(2)


@numba.njit(nogil=True)
def endless(turns):
    k = 0
    while turns[0] >= 0.0:  # at places in turn, so that every turn is written
        turns[k & 1] += 1e-3
        k += 1


def interrupt():
    while turns[0] < 1.0:
        time.sleep(0.001)
    os.kill(os.getpid(), signal.SIGINT)


threading.Thread(target=interrupt).start()
with heeded():
    endless(turns)
"""


@pytest.mark.soak
def test_ctrl_c_ends_compiled_equations_without_end():
    done = subprocess.run(
        [sys.executable, "-c", STUCK, "--json"], env=environment(), capture_output=True, text=True,
        timeout=120, check=False,
    )  # fmt: skip
    said = "rig: stopped by Ctrl-C, in compiled equations that have no end; give every loop in"
    assert done.returncode == 1
    assert done.stderr.startswith(said)
    assert json.loads(done.stdout)["exit_status"] == 1
