"""A log that somebody truncates, deletes or writes into while it is written.

The truth is the log of the same run that was left alone: the simulated rig repeats itself.
"""

import contextlib
import dataclasses
import dis
import itertools
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import daq.logs
from daq.hal import Samples
from daq.logs.recording import load
from daq.logs.writer import LogWriter
from tests.daq.support import (
    forked_rig,
    only_capture,
    record_of,
    run_in_progress,
    until,
    write_experiment,
    write_rig,
)
from tests.soak import mostly_soak

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="an open file cannot be deleted")

_BACKEND = '''
"""The simulated rig, and somebody who cannot leave the run's folder alone."""
import os
import shutil
from pathlib import Path

from daq.hal import Mode
from sim_rig.backend import SimulatedDevice, Simulation


class Options(Simulation):
    act: str = ""
    block: int = 30


class Disturbed(SimulatedDevice):
    Options = Options

    def start(self, sample_rate, mode, guard):
        super().start(sample_rate, mode, guard)
        self._exciting, self._blocks = mode is Mode.OPEN_LOOP, 0

    def receive(self):
        raw = super().receive()
        self._blocks += 1
        if self._exciting and self._blocks == self.options.block and self.options.act:
            (log,) = Path("runs").glob("*/log.csv")
            getattr(self, self.options.act)(log)
        return raw

    def delete(self, log):
        log.unlink()

    def truncate(self, log):
        os.truncate(log, 400_000)

    def empty(self, log):
        os.truncate(log, 0)

    def replace(self, log):
        copy = log.with_name("copy")
        shutil.copyfile(log, copy)
        copy.replace(log)

    def add(self, log):
        with log.open("a") as file:
            file.write("a line of somebody's own\\n")

    def overwrite(self, log):
        with log.open("r+b") as file:
            file.seek(500_000)
            file.write(b"x")  # whatever stood there

    def remove(self, log):
        shutil.rmtree(log.parent)
'''
DURATION = 20  # s: 16 000 rows, of which a writer holds about half in memory


@pytest.fixture(scope="module")
def run():
    with forked_rig() as start:
        yield start


def record(run, folder, act="", **options):
    (folder / "disturbed.py").write_text(_BACKEND)
    write_experiment(folder / "e.yaml", duration=DURATION)
    backend = "disturbed.py:Disturbed"
    write_rig(folder / "rig.yaml", backend=backend, options={"act": act, **options})
    return run(["run", "e.yaml", "--rig", "rig.yaml"], folder)


@pytest.fixture(scope="module")
def truth(run, tmp_path_factory):
    root = tmp_path_factory.mktemp("alone")
    assert record(run, root).returncode == 0
    return (only_capture(root) / "log.csv").read_text("utf-8").splitlines()


@pytest.mark.parametrize(
    ("act", "what"),
    mostly_soak(
        [
            ("delete", "deleted, moved or replaced"),
            ("replace", "deleted, moved or replaced"),
            ("add", "written into"),
            ("remove", "deleted, moved or replaced"),
        ],
        always=2,
    ),
)
def test_a_log_whose_rows_are_all_there_is_put_together_again(run, tmp_path, truth, act, what):
    result = record(run, tmp_path, act)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    aside = "what stood in its place is now log.csv.stranger; " if act == "replace" else ""
    said = f"log.csv: it was {what} while the run was on; {aside}nothing of it is lost"
    assert said in result.stderr
    folder = only_capture(tmp_path)
    assert (folder / "log.csv").read_text("utf-8").splitlines() == truth
    strangers = ["log.csv.stranger"] if aside else []
    assert sorted(path.name for path in folder.iterdir()) == ["log.csv", *strangers, "run.json"]
    assert record_of(folder)["status"] == "failed"
    assert what in record_of(folder)["reason"] and what in load(folder).warning


@pytest.mark.parametrize("act", mostly_soak(["truncate", "overwrite", "empty"]))
def test_rows_that_nobody_has_are_named_and_all_others_kept(run, tmp_path, truth, act):
    result = record(run, tmp_path, act, block=55)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    reason = record_of(only_capture(tmp_path))["reason"]
    first, last = map(int, reason.partition("rows ")[2].partition(" (")[0].split(" to "))
    log = (only_capture(tmp_path) / "log.csv").read_text("utf-8").splitlines()
    assert log == truth[: first + 1] + truth[last + 2 :]
    ends = {"truncate": 400_000, "empty": 0, "overwrite": 500_000}
    n_whole = len("\n".join(truth)[: ends[act]].splitlines()) - 2
    assert n_whole - 1000 < first <= max(n_whole, 0), "what was left of it is kept"
    ticks = load(only_capture(tmp_path)).frame["tick"].to_numpy()
    expected = np.delete(np.arange(800 * DURATION), np.arange(first, last + 1))
    np.testing.assert_array_equal(ticks, expected)


def test_a_log_deleted_in_a_long_run_is_noticed_at_once(tmp_path):
    write_experiment(tmp_path / "e.yaml", duration=60)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    process, folder = run_in_progress(tmp_path)
    before = (folder / "log.csv").read_text("utf-8").splitlines()
    (folder / "log.csv").unlink()
    until((folder / "log-2.csv").exists, "the run to go on elsewhere")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "rig: warning: log.csv was deleted" in errors and "log-2.csv" in errors
    reason = record_of(folder)["reason"]
    assert reason.startswith("stopped by SIGTERM during run; log.csv: it was deleted")
    assert (folder / "log.csv").read_text("utf-8").startswith("\n".join(before[:-1]))
    assert np.all(np.diff(load(folder).frame["tick"]) == 1)


@pytest.mark.soak
def test_what_is_left_by_kill_behind_a_deleted_log_is_no_whole_log(tmp_path):
    write_experiment(tmp_path / "e.yaml", duration=60)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    process, folder = run_in_progress(tmp_path)
    os.truncate(folder / "log.csv", 4000)
    part = folder / "log-2.csv"
    until(lambda: part.exists() and part.read_bytes().count(b"\n") > 100, "rows in a part")
    process.kill()
    process.communicate(timeout=60)
    assert "was interrupted" in load(folder).warning
    assert "it was disturbed, and went on in log-2.csv" in load(folder).warning
    assert "this part of it begins where log.csv was disturbed" in load(part).warning
    whole = pd.concat([load(folder).frame, load(part).frame]).drop_duplicates("tick")
    assert np.all(np.diff(whole["tick"]) == 1), "held rows stand in front of the part"
    (folder / "log.csv").unlink()
    with pytest.raises(Exception, match=r"deleted while it was written; .* log-2\.csv"):
        load(folder)


class Interrupted(BaseException):
    """What a signal raises."""


# Behind which Python hears signals, and before which its own bookkeeping must not be disturbed.
HEARD = {"RESUME", "JUMP_BACKWARD", "CALL", "CALL_KW", "CALL_FUNCTION_EX"}
BOOKKEEPING = {"PUSH_EXC_INFO", "POP_EXCEPT", "RERAISE"}


class Signal:
    """Raises once, the n-th time that the log's writing hears signals; a context manager."""

    def __init__(self, n):
        self.n = n
        self.before_it = {}

    def __enter__(self):
        self.trace = sys.gettrace()
        sys.settrace(self._trace)

    def __exit__(self, *exception):
        sys.settrace(self.trace)
        self.before_it.clear()

    def _trace(self, frame, event, argument):
        if Path(frame.f_code.co_filename).parent != Path(daq.logs.__file__).parent:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            name = dis.opname[frame.f_code.co_code[frame.f_lasti]]
            last, self.before_it[frame] = self.before_it.get(frame), name
            if last in HEARD and name not in BOOKKEEPING:
                self.n -= 1
                if self.n == 0:
                    raise Interrupted
        return self._trace


def _samples(first):
    ticks = np.arange(first, first + 2)
    values = {field.name: ticks.astype(float) for field in dataclasses.fields(Samples)}
    return Samples(**{**values, "tick": ticks, "flags": ticks * 0})


@pytest.mark.filterwarnings("ignore:.*unclosed file")  # one that was only just opened
@pytest.mark.filterwarnings("ignore:.*FileIO")
@pytest.mark.parametrize("deleted", [False, True])
def test_a_signal_at_any_instant_of_writing_disturbs_no_log(tmp_path, deleted, monkeypatch):
    """One that comes between the system's writing and our counting, too."""
    monkeypatch.setattr(os, "fsync", lambda file: None)  # a thousand of them take their time
    signals = 0
    for n in itertools.count(1):
        path = tmp_path / str(n) / "log.csv"
        path.parent.mkdir()
        with LogWriter(path) as log:
            log.append(_samples(0))
            if deleted:
                path.unlink()
                log._next_look = 0.0
            signal_at = Signal(n)
            with contextlib.suppress(Interrupted), signal_at:
                log.append(_samples(2))
        whole = path.read_text("utf-8")
        header, *rows = whole.splitlines()
        column = header.split(",").index("tick")
        ticks = [int(row.split(",")[column]) for row in rows]
        assert ticks in ([0, 1], [0, 1, 2, 3]), n
        assert whole.endswith("\n") and log.n_samples == len(rows), n
        if deleted:
            assert log.disturbance.startswith("it was deleted"), n
            assert "nothing of it is lost" in log.disturbance, n
        else:
            assert log.disturbance is None, n
        signals += 1
        if signal_at.n > 0:
            break
    assert signals > 50, "it was interrupted wherever it can be"
    assert sys.exc_info() == (None, None, None)
