"""``rig run`` over a line and a device that fail: what is logged, what is said, what is applied."""

import itertools
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from daq.errors import ConfigError, DeviceError
from daq.hal import Flag, Guard, Mode
from daq.logs.recording import load
from daq.serial.backend import SerialDevice, SerialOptions
from daq.serial.emulation import faults
from daq.serial.ports import open_link
from tests.daq.serial.support import forked_emulators, write_serial_rig
from tests.daq.support import (
    forked_rig,
    only_capture,
    record_of,
    run_in_progress,
    until,
    write_experiment,
)
from tests.soak import mostly_soak

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="ptys and signals of POSIX")

# As long as a busy machine may hold this process up; the default is tested on its own.
WATCHDOG = 0.5
ANSWERS_WITHIN = 3.0  # s
LOOP = """
from daq.experiment import Answer, ClosedLoop
import numpy as np
from daq.experiment import Plan


class Steady(ClosedLoop):
    duration: float = 0.5

    def plan(self):
        n = self.samples_in(self.duration)
        return Plan(n, np.zeros(2), np.array([0.3, 0.05]))

    def controller(self):
        return self

    def answer(self, sample):
        return Answer(0.2 + 1e-4 * (sample.tick % 500), 0.02)
"""


@pytest.fixture(scope="module")
def emulate():
    with forked_emulators() as start:
        yield start


@pytest.fixture(scope="module")
def rig():
    with forked_rig() as run:
        yield run


def write_run(folder, port, mode="open", seconds=0.5, watchdog=WATCHDOG, homing=False):
    turns = 0.3 if homing else 0
    if mode == "open":
        write_experiment(folder / "e.yaml", duration=seconds, homing={"turns": turns, "timeout": 5})
    else:
        (folder / "loop.py").write_text(LOOP)
        (folder / "e.yaml").write_text(
            f"protocol: loop.py:Steady\nduration: {seconds}\ncalibration: {{samples: 16}}\n"
            f"homing: {{turns: {turns}, timeout: 5}}\n"
        )
    rig_file = write_serial_rig(folder / "rig.yaml", port, watchdog=watchdog)
    with rig_file.open("a") as text:
        text.write("limits: {lost: 0.25}\n")  # what faults take shall not end the run


def assert_consistent(folder, total=400):
    """What was logged stands at its tick, and gaps are flagged."""
    recording = load(folder)
    frame = recording.frame
    ticks, flags = frame["tick"].to_numpy(), frame["flags"].to_numpy()
    assert (np.diff(ticks) > 0).all() and ticks[-1] < total
    np.testing.assert_allclose(frame["t"], ticks / 800)
    gaps = np.flatnonzero(np.diff(ticks, prepend=-1) != 1)
    assert np.array_equal(gaps, np.flatnonzero(flags & int(Flag.LOST)))
    return frame, record_of(folder)


BORNE = [
    "bit-errors=2e-4", "drop=0.03", "duplicate=0.2", "split=9", "merge=0.016", "delay=0.005",
    "jitter=0.01", "stall=0.3", "overflow=40", "stuck-encoder",
]  # fmt: skip
FATAL = {"disconnect=0.2": "the port has gone", "reboot": "has restarted"}
PHASES, MODES = ["calibration", "homing", "run+0.1"], ["open", "closed"]


def cases(whole, chosen, always):
    """A few in every run, and some more with -m soak.

    All of them (ten minutes) with SERIAL_MATRIX=1 in the environment.
    """
    if os.environ.get("SERIAL_MATRIX"):
        return list(itertools.product(*whole))
    return mostly_soak(chosen, always)


@pytest.mark.parametrize(
    ("fault", "phase", "mode"),
    cases(
        (BORNE, PHASES, MODES),
        [
            ("bit-errors=2e-4", "run", "open"),
            ("drop=0.03", "calibration", "closed"),
            ("stall=0.3", "run+0.1", "closed"),
            ("overflow=40", "run+0.1", "open"),
            ("bit-errors=2e-4", "run", "closed"),
            ("duplicate=0.2", "calibration", "open"),
            ("split=9", "run", "closed"),
            ("merge=0.016", "run", "closed"),
            ("stall=0.3", "run+0.1", "open"),
            ("stuck-encoder", "run", "closed"),
        ],
        always=4,
    ),
)
def test_a_run_goes_on_over_what_can_be_borne(tmp_path, emulate, rig, fault, phase, mode):
    with emulate(tmp_path, "--fault", f"{fault}@{phase}") as running:
        write_run(tmp_path, running.port, mode, homing=phase == "homing")
        result = rig(["run", "e.yaml", "--rig", "rig.yaml"], tmp_path)
        until(lambda: running.journal[-1]["outputs"] == [0, 0], "zero outputs")
    name, in_run = fault.split("=")[0], phase.startswith("run")
    if name == "stuck-encoder" and phase == "homing":
        assert result.returncode == 1 and "turns were wound" in result.stderr
        return
    assert result.returncode == 0, result.stderr
    frame, record = assert_consistent(only_capture(tmp_path))
    line, flagged = record["connection"]["line"], record["timing"]["flagged_samples"]
    assert record["status"] == "completed"
    if name == "overflow" and in_run:
        assert line["device_overflow_samples"] == 40 and flagged["lost"] == 1
        assert "40 samples were lost" in result.stderr and "1 lost" in result.stdout
    elif name not in {"bit-errors", "drop", "overflow"}:
        assert len(frame) == 400 and line["lost_samples"] == 0
    if name in {"merge", "stall"} and in_run and mode == "closed":
        assert flagged["held"] > 0 and "held" in result.stdout
    if name == "merge" and in_run and mode == "closed":
        assert "Samples come in blocks" in result.stderr
    if mode == "open":
        assert set(flagged) <= {"lost"}, "what the line does is nothing to a preloaded waveform"
    if name == "stuck-encoder" and phase == "run":
        assert frame["theta"].nunique() == 1


@pytest.mark.parametrize(
    ("fault", "phase", "mode"),
    cases(
        (FATAL, PHASES, MODES),
        [
            ("disconnect=0.2", "run+0.15", "closed"),
            ("reboot", "calibration", "closed"),
            ("disconnect=0.2", "calibration", "open"),
            ("disconnect=0.2", "run+0.15", "open"),
            ("reboot", "run+0.15", "open"),
        ],
        always=2,
    ),
)
def test_a_run_that_cannot_go_on_says_why_and_the_next_one_just_works(
    tmp_path, emulate, rig, fault, phase, mode
):
    with emulate(tmp_path, "--fault", f"{fault}@{phase}") as running:
        write_run(tmp_path, running.port, mode, homing=phase == "homing")
        result = rig(["run", "e.yaml", "--rig", "rig.yaml"], tmp_path)
        assert result.returncode == 1
        assert FATAL[fault] in result.stderr and "Traceback" not in result.stderr
        folder = only_capture(tmp_path)
        record = record_of(folder)
        assert record["status"] == "failed" and FATAL[fault] in record["reason"]
        assert record["phase"] == phase.split("+")[0]
        if record["phase"] == "run":
            frame, _ = assert_consistent(folder)
            assert 20 < len(frame) < 400, "what came before is in the log"
        until(lambda: running.journal[-1]["outputs"] == [0, 0], "zero outputs")
        until((tmp_path / "port").exists, "the port to be back")
        again = rig(["run", "e.yaml", "--rig", "rig.yaml", "--out", "again"], tmp_path)
        assert again.returncode == 0, again.stderr


@pytest.mark.parametrize(
    ("fault", "reason"),
    mostly_soak(
        [
            ("mute", "no answer"),
            ("version=2", "This program is the old one"),
            ("version=0", "The device's firmware is the old one"),
            ("garbage", "no frame of the protocol"),
            ("delay=0.4", "too slow for its watchdog"),
            ("delay=9", "no answer"),
        ],
        always=3,
    ),
)
def test_a_device_that_cannot_be_worked_with_is_refused_within_three_seconds(
    tmp_path, emulate, fault, reason
):
    with emulate(tmp_path, "--fault", fault) as running:
        device = SerialDevice(SerialOptions(port=running.port))
        begun = time.perf_counter()
        with pytest.raises(DeviceError, match=reason):
            device.open()
        assert time.perf_counter() - begun < ANSWERS_WITHIN
        device.close()


def test_a_second_host_is_refused_clearly(tmp_path, emulate):
    with emulate(tmp_path) as running:
        first, second = (SerialDevice(SerialOptions(port=running.port)) for _ in range(2))
        first.open()
        with pytest.raises(DeviceError, match="another program has it open"):
            second.open()
        first.close()
        assert second.open().name
        second.close()


def test_a_port_that_is_not_there_is_named_with_the_cure(tmp_path):
    for port, cure in ((str(tmp_path / "none"), "rig ports"), ("", "--port")):
        with pytest.raises(DeviceError, match=cure):
            SerialDevice(SerialOptions(port=port)).open()


@pytest.mark.parametrize("mode", mostly_soak(["closed", "open"]))
def test_a_killed_host_means_zero_outputs_within_the_watchdogs_time(tmp_path, emulate, rig, mode):
    with emulate(tmp_path) as running:
        write_run(tmp_path, running.port, mode, seconds=60, watchdog=0.2)
        process, _ = run_in_progress(tmp_path, rows=80)
        until(lambda: any(running.journal[-1]["outputs"]), "outputs that are not zero")
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        tripped = until(
            lambda: next((e for e in running.journal if e["latch"] == "WATCHDOG"), None),
            "the watchdog",
        )
        assert tripped["outputs"] == [0, 0] and tripped["silence_seconds"] < 0.3
        assert not any(any(e["outputs"]) for e in running.journal[running.journal.index(tripped) :])
        assert "interrupted" in load(only_capture(tmp_path)).warning
        write_run(tmp_path, running.port, mode)
        again = rig(["run", "e.yaml", "--rig", "rig.yaml", "--out", "again"], tmp_path)
        assert again.returncode == 0, again.stderr


def test_a_program_that_hangs_is_no_better_than_a_dead_one(tmp_path, emulate):
    with emulate(tmp_path) as running:
        device = SerialDevice(SerialOptions(port=running.port, watchdog=WATCHDOG))
        device.open()
        wide = np.full(3, 1e9)
        guard = Guard(np.array([-5.0, 0.0]), np.array([5.0, 0.38]), -wide, wide)
        device.start(800.0, Mode.CLOSED_LOOP, guard)
        device.send(0, np.full((8, 2), 0.1))
        device.receive()
        # Its threads live on, but nobody asks for samples any more.
        until(lambda: running.journal[-1]["latch"] == "WATCHDOG", "the watchdog")
        assert running.journal[-1]["outputs"] == [0, 0]
        with pytest.raises(DeviceError, match="watchdog has tripped"):
            while True:
                device.receive()
        device.close()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("drp=0.1", "did you mean 'drop'"),
        ("drop", "give a value"),
        ("drop=often", "'often' is not a number"),
        ("stall@nowhere", "unknown phase"),
        ("stall@run+x", "'x' is not a number"),
    ],
)
def test_a_fault_that_is_none_is_refused_with_what_was_meant(text, said):
    with pytest.raises(ConfigError, match=said):
        faults.parse(text)


def test_more_than_a_port_takes_at_once_is_written_in_full():
    import pty
    import tty

    ours, theirs = pty.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    link, said = open_link(os.ttyname(theirs), 115_200), os.urandom(100_000)
    writer = threading.Thread(target=link.write, args=(said,))
    writer.start()
    heard = bytearray()
    while len(heard) < len(said):
        heard += os.read(ours, 4096)
    writer.join()
    assert heard == said
    link.close()
    os.close(ours)
    os.close(theirs)


_HOLDER = "import os, sys; os.open(sys.argv[1], os.O_RDWR); print(flush=True); sys.stdin.read()"


def test_another_program_that_has_the_port_open_without_a_lock_is_named():
    import pty
    import tty

    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    name = os.ttyname(theirs)
    words = [sys.executable, "-c", _HOLDER, name]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        link = open_link(name, 115_200)
        other.stdin.close()
    (warning,) = link.warnings
    assert f"another program has it open too (process {other.pid}" in warning
    link.close()
    os.close(ours)
    os.close(theirs)
