"""Every way out of a run, at every phase: zero outputs as the last act, and a record that says why.

The faults come from outside the run loop: a backend that fails or misbehaves when told to, which
also sends the process the signals, at a known place; a limit on the size of files; a full disk.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from daq.logs.recording import load
from tests.daq.support import (
    RIG,
    environment,
    forked_rig,
    install,
    journal_of,
    only_capture,
    record_of,
    rig,
    run_in_progress,
    write_experiment,
    write_rig,
)
from tests.soak import mostly_soak

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

_BACKEND = '''
"""The simulated rig that does something bad at a phase, and keeps a journal of its outputs."""
import json
import os
import resource
import signal
import time
from pathlib import Path

import numpy as np

from daq.errors import DeviceError
from daq.hal import Flag, Phase
from sim_rig.backend import SimulatedDevice, Simulation


class Options(Simulation):
    phase: str
    fault: str


class BadDevice(SimulatedDevice):
    Options = Options

    def __init__(self, options):
        super().__init__(options)
        self._phase = Phase.OPEN
        self._blocks = 0
        self._acted = False

    def note(self, what, **facts):
        with Path("journal.jsonl").open("a") as journal:
            journal.write(json.dumps({"what": what, **facts}) + "\\n")

    def open(self):
        info = super().open()
        self.act()
        return info

    def announce(self, phase, turns=0.0):
        self._phase = phase
        super().announce(phase, turns)
        if phase is Phase.SAFE:
            self.act()

    def start(self, sample_rate, mode, guard):
        super().start(sample_rate, mode, guard)
        self._blocks = 0

    def receive(self):
        raw = super().receive()
        if np.any(raw.applied[-1]):
            self.note("energised")
        self._blocks += 1
        if self._blocks == 2:  # some of the phase is over
            self.act(raw)
        return raw

    def act(self, raw=None):
        fault = self.options.fault
        if self.options.phase != self._phase.value:
            return
        self.note("fault")
        self._acted = True
        if fault == "unplugged":
            raise DeviceError("the device no longer answers; check its cable")
        if fault == "bug":
            raise ZeroDivisionError("a mistake in the backend")
        if fault == "interlock":
            raw.flags[-1] |= int(Flag.INTERLOCK)
        if fault == "nan":
            raw.analog[-1, 2] = np.nan
        if fault == "log deleted":
            next(Path("runs").glob("*/log.csv")).unlink()
        if fault == "full":
            resource.setrlimit(resource.RLIMIT_FSIZE, (16_384, resource.RLIM_INFINITY))
        for name in fault.split("+")[:1]:
            if name.startswith("SIG"):
                os.kill(os.getpid(), getattr(signal, name))

    def again(self, where):
        """The second signal of a fault such as SIGINT+SIGINT@safe, in the clean-up."""
        second, _, place = self.options.fault.partition("+")[2].partition("@")
        if second and place == where and self._acted:
            self.note("second signal")
            os.kill(os.getpid(), getattr(signal, second))
            if where == "close":
                time.sleep(60)  # it hangs

    def safe(self):
        self.again("safe")
        super().safe()
        self.note("safe")

    def close(self):
        if self._phase is Phase.SAFE:
            self._phase = Phase.CLOSE
            self.act()
        self.again("close")
        super().close()
        self.note("close")
'''

_PROTOCOL = '''
import numpy as np
from daq.experiment import Answer, ClosedLoop, Plan


class Constant(ClosedLoop):
    """A constant pull, with a mistake in sample 100 if asked for."""

    mistaken: bool = False

    def plan(self):
        return Plan(400, np.zeros(2), np.array([0.5, 0.0]))

    def controller(self):
        return Control(self.mistaken)


class Control:
    def __init__(self, mistaken):
        self.mistaken = mistaken

    def answer(self, sample):
        if self.mistaken and sample.tick == 100:
            raise KeyError("a mistake in the protocol")
        return Answer(0.5, 0.0)
'''
CLOSED_LOOP = """
protocol: constant.py:Constant
sample_rate: 800
calibration: {samples: 100}
"""

# Becomes another program, on the terminal that is its standard input.
_OWN_TERMINAL = """
import fcntl, os, signal, sys, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""

PHASES = ("open", "calibration", "homing", "run", "safe", "close")
METHODS = {"open": "open", "safe": "announce", "close": "close"}  # that act
_BY_HAND = "hand (Ctrl-C, or Stop in the scope)"
SIGNALS = {
    "SIGINT": _BY_HAND, "SIGTERM": "SIGTERM", "SIGHUP": "SIGHUP",
    "SIGINT+SIGINT@safe": _BY_HAND, "SIGINT+SIGINT@close": _BY_HAND,
}  # fmt: skip


@dataclass(frozen=True)
class Exit:
    """A fault in a phase, and what the record must say of it."""

    phase: str
    fault: str
    status: str
    reason: str
    closed_loop: bool = False

    def __str__(self):
        return f"{self.fault} in {self.phase}{', closed loop' if self.closed_loop else ''}"


def exits():
    for phase in PHASES:
        yield Exit(phase, "unplugged", "failed", "the device no longer answers")
        yield Exit(
            phase, "bug", "failed", f"the backend failed in {METHODS.get(phase, 'receive')}()"
        )
        for fault, name in SIGNALS.items():
            if not (phase == "close" and "@" in fault):
                yield Exit(phase, fault, "stopped", f"stopped by {name} during {phase}")
    for phase in ("calibration", "homing"):
        yield Exit(phase, "interlock", "interlock", f"interlock during {phase}: the device found")
        yield Exit(phase, "nan", "interlock", f"interlock during {phase}: torque is nan")
    yield Exit("run", "interlock", "interlock", "interlock in sample")
    yield Exit("run", "nan", "interlock", "torque is nan, which is no measurement")
    yield Exit("run", "SIGQUIT", "stopped", "stopped by SIGQUIT during run")
    yield Exit("run", "SIGTSTP", "stopped", "stopped by SIGTSTP during run")
    yield Exit("run", "SIGTERM+SIGINT@safe", "stopped", "stopped by SIGTERM during run")
    yield Exit("run", "full", "failed", "log.csv: cannot be written: File too large")
    yield Exit("run", "unplugged", "failed", "the device no longer answers", closed_loop=True)
    yield Exit("run", "nan", "interlock", "interlock in sample 1: torque", closed_loop=True)
    yield Exit("run", "SIGINT", "stopped", "stopped by hand", closed_loop=True)
    yield Exit("run", "SIGINT+SIGINT@safe", "stopped", "stopped by hand", closed_loop=True)
    yield Exit("run", "full", "failed", "log.csv: cannot be written", closed_loop=True)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plugin")
    found = install(folder, "bad_backend", _BACKEND, "rig.backends", "bad", "BadDevice")
    with forked_rig(**found) as run:
        yield run


def assert_left_safe(root):
    """The outputs were zeroed after they were last energised, and after a fault that left a way."""
    steps = [entry["what"] for entry in journal_of(root / "journal.jsonl")]
    last = {what: max(i for i, step in enumerate(steps) if step == what) for what in set(steps)}
    assert last["safe"] > last.get("energised", -1)
    assert last["safe"] > last["fault"] or steps[last["fault"] - 1] == "safe"


def assert_consistent(folder, status, reason):
    """The record says how it ended and fits a log that loads as far as it goes."""
    record = record_of(folder)
    assert record["status"] == status and reason in record["reason"]
    assert sorted(path.name for path in folder.iterdir()) == ["log.csv", "run.json"]
    digest = hashlib.sha256((folder / "log.csv").read_bytes()).hexdigest()
    assert record["log"]["sha256"] == digest
    rows = (folder / "log.csv").read_text("utf-8").splitlines()[1:]
    broken = bool(rows) and "nan" in rows[-1]
    if len(rows) - broken > 1:
        loaded = load(folder)
        assert f"ended early: {status}" in loaded.warning
        if broken:
            assert "its last line is incomplete and is left out" in loaded.warning
            assert len(loaded.frame) == len(rows) - 1


def assert_is_document(result):
    """Standard output is the document of what is said on standard error."""
    document = json.loads(result.stdout)
    assert document["exit_status"] == result.returncode
    said = [*document["notes"], *(error["error"] for error in document["errors"])]
    assert document["errors"] and all(text in result.stderr for text in said)


# One of every fault and every phase runs always; all with -m soak.
ALWAYS = {
    "unplugged in open", "bug in open", "SIGHUP in calibration", "interlock in calibration",
    "SIGINT in homing", "nan in homing", "interlock in run", "full in run", "bug in run",
    "SIGTERM+SIGINT@safe in run", "SIGQUIT in run", "SIGTSTP in run", "SIGINT in safe",
    "SIGINT+SIGINT@close in run", "unplugged in close", "unplugged in run, closed loop",
    "nan in run, closed loop",
}  # fmt: skip
EXITS = sorted(exits(), key=lambda exit: str(exit) not in ALWAYS)


def test_every_fault_and_every_phase_is_met_always():
    met = [exit for exit in EXITS if str(exit) in ALWAYS]
    assert len(met) == len(ALWAYS)
    assert {exit.phase for exit in met} == set(PHASES)
    first = {exit.fault.partition("+")[0] for exit in EXITS}
    assert {exit.fault.partition("+")[0] for exit in met} == first


@pytest.mark.parametrize("exit", mostly_soak(EXITS, len(ALWAYS)), ids=str)
def test_outputs_are_zero_and_the_record_says_why(run, tmp_path, exit):
    if exit.closed_loop:
        (tmp_path / "constant.py").write_text(_PROTOCOL)
        (tmp_path / "e.yaml").write_text(CLOSED_LOOP)
    else:
        homing = {"turns": 0.2 * (exit.phase == "homing"), "timeout": 30}
        write_experiment(tmp_path / "e.yaml", homing=homing, calibration={"samples": 100})
    write_rig(
        tmp_path / "rig.yaml", backend="bad", options={"phase": exit.phase, "fault": exit.fault}
    )
    result = run(["run", "e.yaml", "--rig", "rig.yaml", "--json"], tmp_path)
    assert result.returncode == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert_is_document(result)
    assert_left_safe(tmp_path)
    assert_consistent(only_capture(tmp_path), exit.status, exit.reason)


def test_a_mistake_in_a_protocol_leaves_zero_outputs(run, tmp_path):
    (tmp_path / "constant.py").write_text(_PROTOCOL)
    (tmp_path / "e.yaml").write_text(CLOSED_LOOP + "mistaken: true\n")
    write_rig(tmp_path / "rig.yaml", backend="bad", options={"phase": "open", "fault": "none"})
    result = run(["run", "e.yaml", "--rig", "rig.yaml"], tmp_path)
    assert result.returncode == 1 and "a mistake in the protocol" in result.stderr
    assert_left_safe(tmp_path)
    assert_consistent(only_capture(tmp_path), "failed", "failed at sample 100")


def test_a_disk_that_the_log_fills_still_takes_the_reason(tmp_path):
    """A real full disk: a small one in memory, in a name space of its own."""
    alone = ["unshare", "--user", "--map-root-user", "--mount"]
    size = "mount -t tmpfs -o size=256k none full"
    (tmp_path / "full").mkdir()
    if (
        not shutil.which("unshare")
        or subprocess.run(
            [*alone, "sh", "-c", size], cwd=tmp_path, capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("this system lets a user mount nothing")
    write_experiment(tmp_path / "e.yaml", duration=20)
    command = [*RIG, "run", "e.yaml", "--out", "full"]
    inside = f"{size} && {' '.join(command)}; echo status $?; cat full/*/run.json"
    result = subprocess.run(
        [*alone, "sh", "-c", inside], cwd=tmp_path, env=environment(), capture_output=True,
        text=True, timeout=120, check=False,
    )  # fmt: skip
    assert "status 1" in result.stdout and "Traceback" not in result.stderr
    assert '"status": "failed"' in result.stdout
    assert "cannot be written: No space left on device; the first" in result.stdout


@pytest.mark.soak
def test_a_closed_terminal_ends_the_run_and_not_its_record(tmp_path):
    """A real terminal that goes away, with the progress bar still writing to it."""
    import pty

    write_experiment(tmp_path / "e.yaml", duration=60)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    terminals = []

    def start():
        here, there = pty.openpty()
        terminals.append(here)
        process = subprocess.Popen(
            [sys.executable, "-c", _OWN_TERMINAL, *RIG, "run", "e.yaml", "--rig", "rig.yaml"],
            cwd=tmp_path, env=environment(), stdin=there, stdout=there, stderr=there,
        )  # fmt: skip
        os.close(there)
        return process

    process, folder = run_in_progress(tmp_path, start=start)
    for terminal in terminals:
        os.close(terminal)
    process.wait(timeout=60)
    assert_consistent(folder, "stopped", "stopped by SIGHUP during run")
    assert np.all(np.diff(load(folder).frame["tick"]) == 1)


def test_a_log_deleted_during_the_run_is_no_completed_run(run, tmp_path):
    write_experiment(tmp_path / "e.yaml", homing={"turns": 0}, calibration={"samples": 100})
    write_rig(
        tmp_path / "rig.yaml", backend="bad", options={"phase": "run", "fault": "log deleted"}
    )
    result = run(["run", "e.yaml", "--rig", "rig.yaml"], tmp_path)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    assert "log.csv: it was deleted, moved or replaced" in result.stderr
    record = record_of(only_capture(tmp_path))
    assert record["status"] == "failed" and "it was deleted" in record["reason"]


def test_ctrl_c_while_the_program_is_still_being_imported_is_no_traceback():
    code = (
        "import sys\n"
        "class Impatient:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'daq.cli.app':\n"
        "            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Impatient())\n"
        "from daq.cli import main\n"
        "main()\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, "ports", "--json"], capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    assert_is_document(result)
    assert result.stderr.strip() == "rig: stopped by Ctrl-C"


@pytest.mark.parametrize("then", ["raise RuntimeError('no object')", "threading.Event().wait(60)"])
def test_ctrl_c_in_a_callback_of_a_compilers_is_not_lost(then):
    code = (
        "import ctypes, signal, threading\n"
        "import daq.cli.app\n"
        "def compiling():\n"
        "    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()\n"
        f"    {then}\n"
        "daq.cli.app.app = compiling\n"
        "daq.cli.main()\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False
    )
    assert (result.returncode, result.stderr) == (1, "rig: stopped by Ctrl-C\n")


def test_with_json_a_failure_is_a_document_too(tmp_path):
    write_experiment(tmp_path / "bad.yaml", motor={"amplitude": "much"}, sample_rate=-1)
    result = rig("check", "bad.yaml", "--json", cwd=tmp_path)
    document = json.loads(result.stdout)
    assert result.returncode == document["exit_status"] == 2
    lines = (tmp_path / "bad.yaml").read_text("utf-8").splitlines()
    assert [error["key"] for error in document["errors"]] == ["sample_rate", "motor.amplitude"]
    for error in document["errors"]:
        assert error["key"].rpartition(".")[2] in lines[error["line"] - 1]
        assert error["file"] == "bad.yaml"
        assert error["error"] in result.stderr


@pytest.mark.parametrize(
    ("words", "key", "says"),
    [
        (("identify", "log.csv", "--jsn"), "--jsn", "--json"),
        (("identify", "log.csv", "--population", "many"), "population", "'--population'"),
        (("replay",), "log", "RUN_OR_CSV"),
        (("identify",), None, "name the logs"),
        (("identif", "log.csv"), None, "'identify'"),
    ],
)
def test_with_json_a_mistaken_command_line_is_a_document_too(tmp_path, words, key, says):
    result = rig(*words, "--json", cwd=tmp_path)
    document = json.loads(result.stdout)
    assert result.returncode == document["exit_status"] == 2
    (error,) = document["errors"]
    assert error["key"] == key and says in error["error"]
    assert "--help" in error["cure"] and "Usage: " in result.stderr
    assert rig(*words, cwd=tmp_path).stdout == ""


@pytest.mark.parametrize(
    ("words", "place", "cure"),
    [
        (("scope", "nope"), ("nope", None), "name a run's folder"),
        (("init", "--rig", "x"), (None, "--rig"), "known are"),
        (("campaign", "."), (".", None), "name logs"),
        (
            ("identify", "log.csv", "--set", "fixed.K_mm=3"),
            (None, "--set fixed.K_mm"),
            "did you mean",
        ),
        (
            ("identify", "log.csv", "--set", "fixed.R_m=-5"),
            (None, "--set fixed.R_m"),
            "within them",
        ),
    ],
)
def test_file_key_and_cure_stand_in_places_of_their_own(tmp_path, words, place, cure):
    (error,) = json.loads(rig(*words, "--json", cwd=tmp_path).stdout)["errors"]
    assert (error["file"], error["key"]) == place and cure in error["cure"]
    assert not {"nope", "--rig", "did you mean", "--set"} & set(error["error"].split())


def test_a_document_is_printed_once(tmp_path):
    result = rig("ports", "/dev/no-such-port", "--json", cwd=tmp_path)
    assert result.returncode == 2
    assert json.loads(result.stdout)["ports"][0]["name"] == "/dev/no-such-port"
