"""What happens, and what does not, while a run is scheduled in real time."""

import json
import subprocess
import sys
import time

import pytest

from daq.run.realtime import RealTime
from tests.daq.support import (
    forked_rig,
    only_capture,
    record_of,
    rig,
    write_experiment,
    write_rig,
)

_GRANTED = """
import os
os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(40))
"""

_WATCHED = '''
import json
import sys
from pathlib import Path

from sim_rig.backend import SimulatedDevice


class Watched(SimulatedDevice):
    """Writes down which modules were imported between its opening and its last act."""

    def open(self):
        info = super().open()
        self.before = set(sys.modules)
        return info

    def safe(self):
        super().safe()
        if hasattr(self, "before"):
            new = sorted(set(sys.modules) - self.before)
            Path("imported.json").write_text(json.dumps(new))
'''

_SPINNING = '''
import numpy as np
from daq.experiment import Answer, ClosedLoop, Plan


class Spinning(ClosedLoop):
    """A controller that never comes to an end with sample 100."""

    deep: bool = False

    def plan(self):
        return Plan(400, np.zeros(2), np.array([0.5, 0.0]))

    def controller(self):
        return Control(self.deep)


class Control:
    def __init__(self, deep):
        self.deep = deep

    def answer(self, sample):
        if sample.tick == 100 and self.deep:
            sum(range(10**12))  # where no handler of signals is called
        while sample.tick == 100:
            pass
        return Answer(0.5, 0.0)
'''


@pytest.fixture(scope="module")
def real_time():
    """Skips where this system schedules nothing of ours in real time."""
    granted = (
        sys.platform == "linux"
        and not subprocess.run(
            [sys.executable, "-c", _GRANTED], capture_output=True, check=False
        ).returncode
    )
    if not granted:
        pytest.skip("this system grants no real-time scheduling")


def test_nothing_is_imported_while_a_run_is_on(tmp_path):
    (tmp_path / "watched.py").write_text(_WATCHED)
    write_experiment(tmp_path / "e.yaml", duration=0.1, homing={"turns": 0})
    write_rig(tmp_path / "rig.yaml", backend="watched.py:Watched", options={"time": "real"})
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path, fresh=True)
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / "imported.json").read_text("utf-8")) == []


def spin(run, folder, **settings):
    (folder / "spinning.py").write_text(_SPINNING)
    experiment = {"protocol": "spinning.py:Spinning", "sample_rate": 800, **settings}
    (folder / "e.yaml").write_text(json.dumps({**experiment, "calibration": {"samples": 100}}))
    write_rig(folder / "rig.yaml", options={"time": "real"})
    return run(["run", "e.yaml", "--rig", "rig.yaml"], folder)


@pytest.mark.soak
def test_a_controller_that_never_ends_does_not_hold_the_computer(tmp_path, real_time):
    with forked_rig() as run:
        result = spin(run, tmp_path)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    assert "the program computed for 1 s without a pause" in result.stderr
    record = record_of(only_capture(tmp_path))
    assert record["status"] == "failed" and record["phase"] == "run"
    assert "given back" in record["realtime"]["refused"]["scheduler"]
    assert "scheduler" not in record["realtime"]["granted"]


@pytest.mark.soak
def test_a_library_that_never_returns_is_ended_by_the_system(tmp_path, real_time):
    with forked_rig() as run:
        result = spin(run, tmp_path, deep=True)
    assert result.returncode == -9
    assert record_of(only_capture(tmp_path))["status"] == "running"


@pytest.mark.skipif(sys.platform != "linux", reason="the time of a thread is Linux's")
def test_what_a_program_computed_before_a_run_is_no_pause_of_it(monkeypatch):
    monkeypatch.setattr("daq.run.realtime._LONGEST", 0.02)  # s
    realtime = RealTime()
    realtime.granted["scheduler"] = "SCHED_FIFO"
    begun = time.thread_time()
    assert begun > 0.02
    # The device is still being opened: no call of it has ended yet.
    assert realtime.overrun_since(0.0) is None
    while time.thread_time() < begun + 0.03:
        pass
    assert "without a pause" in str(realtime.overrun_since(0.0))
