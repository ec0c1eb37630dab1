"""Ends of commands: signals that come late or many, outputs that take nothing, refusals."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.daq.support import (
    RIG,
    environment,
    file_limit,
    only_capture,
    record_of,
    rig,
    run_in_progress,
    start_rig,
    until,
    write_experiment,
    write_rig,
)
from tests.soak import mostly_soak

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

_IMPATIENT = '''
"""The simulated rig, and a user who presses Ctrl-C when the program is all but gone."""
import atexit
import os
import signal

from sim_rig.backend import SimulatedDevice as Impatient

atexit.register(os.kill, os.getpid(), signal.SIGINT)
'''
_SHUT_OUT = (
    _IMPATIENT.partition("atexit.register")[0]
    + """
hear = signal.signal


def late(number, handler):
    if handler == signal.SIG_IGN:
        os.kill(os.getpid(), signal.SIGTERM)
    return hear(number, handler)


signal.signal = late
"""
)

_MODEL = """
import time
from sysid import Input, Output, Parameter, ProcessModel, State


def lag():
    return ProcessModel(
        name="lag", states=(State("y", "m"),), inputs=(Input("u", "m"),),
        outputs=(Output("y", "m"),), parameters=(Parameter("tau", "s", 0.05, 0.01, 0.5, "log"),),
        derivative=lambda x, u, p: ((u[0] - x[0]) / p[0],),
    )
"""


@pytest.mark.parametrize("backend", [_IMPATIENT, _SHUT_OUT], ids=["at exit", "while shut out"])
def test_a_signal_at_the_very_end_leaves_the_status_as_it_is(tmp_path, backend):
    (tmp_path / "impatient.py").write_text(backend)
    write_experiment(tmp_path / "e.yaml")
    write_rig(tmp_path / "rig.yaml", backend="impatient.py:Impatient")
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path, fresh=True)
    assert result.returncode == 0
    assert "Traceback" not in result.stderr and "Exception ignored" not in result.stderr


def hail(process, chance):
    """Send a process signals of all kinds until it is gone, as fast as it goes or slower."""
    while process.poll() is None:
        process.send_signal(chance.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP]))
        time.sleep(chance.choice([0.0, 0.001, 0.02]))


def assert_stopped(process, folder):
    _, errors = process.communicate(timeout=60)
    assert "Traceback" not in errors and process.returncode == 1, (process.returncode, errors)
    assert record_of(folder)["status"] == "stopped"


def test_a_hail_of_signals_ends_a_run_that_says_so(tmp_path):
    write_experiment(tmp_path / "e.yaml", duration=60)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    process, folder = run_in_progress(tmp_path, rows=1)
    hail(process, random.Random(2))
    assert_stopped(process, folder)


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(4))
def test_a_hail_at_any_instant_does_not_leave_a_run_that_goes_on(tmp_path, seed):
    chance = random.Random(seed)
    write_experiment(tmp_path / "e.yaml", duration=60)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    process = start_rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    (folder,) = until(lambda: list((tmp_path / "runs").glob("*")), "a folder")
    time.sleep(chance.choice([0.0, 0.0, chance.uniform(0.0, 0.5)]))
    hail(process, chance)
    assert_stopped(process, folder)


_DESTROYING = '''
"""The simulated rig, stopped while Python destroys something."""
import signal

from daq.hal import Phase
from sim_rig.backend import SimulatedDevice


class Buffer:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)  # Python swallows what that raises here


class Destroying(SimulatedDevice):
    def announce(self, phase, turns=0.0):
        super().announce(phase, turns)
        self.buffer = Buffer() if phase is Phase.RUN else None

    def receive(self):
        self.buffer = None
        return super().receive()
'''


def test_one_ctrl_c_ends_a_run_wherever_it_is(tmp_path):
    (tmp_path / "destroying.py").write_text(_DESTROYING)
    write_experiment(tmp_path / "e.yaml", duration=5)
    write_rig(tmp_path / "rig.yaml", backend="destroying.py:Destroying", options={"time": "real"})
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 1 and "Exception ignored" not in result.stderr
    record = record_of(only_capture(tmp_path))
    assert record["status"] == "stopped" and record["outputs"]["confirmed"] is True


_HANGING = '''
"""The simulated rig whose outputs cannot be zeroed: it hangs, and signals come."""
import os
import signal
import time

from daq.hal import Phase
from sim_rig.backend import SimulatedDevice


class Hanging(SimulatedDevice):
    def announce(self, phase, turns=0.0):
        super().announce(phase, turns)
        if phase is Phase.RUN:
            os.kill(os.getpid(), signal.SIGINT)

    def safe(self):
        time.sleep(2.1)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
'''


@pytest.mark.soak
def test_a_clean_up_that_hangs_is_ended_with_a_record(tmp_path):
    (tmp_path / "hanging.py").write_text(_HANGING)
    write_experiment(tmp_path / "e.yaml")
    write_rig(tmp_path / "rig.yaml", backend="hanging.py:Hanging")
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 1 and "the clean-up hung" in result.stderr
    assert "switch off the amplifier: zero outputs are not confirmed" in result.stderr
    record = record_of(only_capture(tmp_path))
    assert record["outputs"]["confirmed"] is False
    assert record["status"] == "stopped" and "clean-up hung" in record["reason"]


_STUCK = '''
"""Simulated rigs in real time whose receive() does not return in the middle of the run."""
import time

from daq.hal import Phase
from sim_rig.backend import SimulatedDevice


class Waiting(SimulatedDevice):
    stuck = False

    def announce(self, phase, turns=0.0):
        super().announce(phase, turns)
        self.stuck = phase is Phase.RUN

    def receive(self):
        if self.stuck:
            self.wait()
        return super().receive()

    def wait(self):
        time.sleep(60)


class Deaf(Waiting):
    def wait(self):
        end = time.perf_counter() + 60
        while time.perf_counter() < end:
            try:
                time.sleep(1)
            except BaseException:
                pass
'''


@pytest.mark.soak
def test_a_call_that_does_not_return_ends_the_run(tmp_path):
    (tmp_path / "stuck.py").write_text(_STUCK)
    write_experiment(tmp_path / "e.yaml")
    processes = {}
    for name in ("Waiting", "Deaf"):
        folder = tmp_path / name
        folder.mkdir()
        write_rig(folder / "rig.yaml", backend="../stuck.py:" + name, options={"time": "real"})
        processes[name] = start_rig("run", "../e.yaml", "--rig", "rig.yaml", cwd=folder)
    outcomes = {}
    for name, process in processes.items():
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 1 and "Traceback" not in errors
        assert "has not returned from receive() for 5 s" in errors
        outcomes[name] = errors, record_of(only_capture(tmp_path / name))
    errors, record = outcomes["Waiting"]  # hears of it, and all ends in good order
    assert record["status"] == "failed" and "receive()" in record["reason"]
    assert "switch off the amplifier" in errors
    errors, record = outcomes["Deaf"]
    assert "was ended without it" in errors and "zero outputs are not confirmed" in errors
    assert record["status"] == "failed" and "receive()" in record["reason"]
    assert record["outputs"]["confirmed"] is False


@pytest.fixture
def data(tmp_path):
    """A log, a model, and settings with which a search goes on for ever."""
    (tmp_path / "model.py").write_text(_MODEL)
    rows = [f"{0.01 * k},{k // 50 % 2},{k // 25 % 2}" for k in range(400)]
    (tmp_path / "log.csv").write_text("\n".join(["t,u,y", *rows, ""]))
    columns = {
        "time": {"column": "t"}, "inputs": {"u": {"column": "u"}},
        "outputs": {"y": {"column": "y"}},
    }  # fmt: skip
    settings = {"population": 50, "generations": 100000, "columns": columns}
    (tmp_path / "id.yaml").write_text(json.dumps(settings))
    return tmp_path


@pytest.mark.soak
def test_sigterm_while_identifying_says_what_is_kept_and_how_to_go_on(data):
    words = ("identify", "log.csv", "--model", "model.py:lag", "--config", "id.yaml")
    process = start_rig(*words, "--out", "found", cwd=data)
    until((data / "found" / "search.ckpt").exists, "a checkpoint")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.splitlines()[-2:] == [
        "rig: the search so far is kept; go on with: rig identify --resume found --trust",
        "rig: stopped by SIGTERM",
    ]


def children(pid):
    """Processes below this one that are not its helpers."""
    below = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            stat = (path / "stat").read_text("utf-8").rpartition(")")[2].split()
            words = (path / "cmdline").read_bytes()
        except OSError:
            continue
        if int(stat[1]) == pid and stat[0] != "Z" and b"resource_tracker" not in words:
            below.append(int(path.name))
    return below


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc")
@pytest.mark.soak
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_the_program_that_started_them(data, number):
    words = ("campaign", "log.csv", "--model", "model.py:lag", "--config", "id.yaml")
    # An error there, its tracker would swallow.
    tracker = "joblib.externals.loky.backend.resource_tracker"
    warned = {"PYTHONWARNINGS": f"error,default::UserWarning:{tracker}"}
    process = start_rig(*words, "--seeds", "0:4", "--jobs", 2, cwd=data, env=warned)
    ticks = os.sysconf("SC_CLK_TCK")

    def busy():
        workers = children(process.pid)
        times = [Path(f"/proc/{pid}/stat").read_text("utf-8").split()[13] for pid in workers]
        return len(times) == 2 and min(map(int, times)) > 2 * ticks and workers

    workers = until(busy, "two workers that have been busy for a while", 180)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers), "their end", 20)
    assert "resource_tracker" not in errors
    if number == signal.SIGTERM:
        assert process.returncode == 1 and "Traceback" not in errors
        assert "rig: 0 of 4 runs had been finished\nrig: stopped by SIGTERM" in errors


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("unbuffered", mostly_soak(["", "1"]))
def test_results_that_cannot_be_printed_are_one_line(tmp_path, unbuffered):
    write_experiment(tmp_path / "e.yaml")
    with Path("/dev/full").open("w") as full:
        result = subprocess.run(
            [*RIG, "run", "e.yaml", "--quiet"], cwd=tmp_path, stdout=full, stderr=subprocess.PIPE,
            env=environment(PYTHONUNBUFFERED=unbuffered), text=True, timeout=60, check=False,
        )  # fmt: skip
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("rig: standard output cannot be written: No space left on device")
    assert record_of(only_capture(tmp_path))["status"] == "completed"


@pytest.mark.parametrize("unbuffered", mostly_soak(["", "1"]))
def test_a_reader_that_has_enough_is_no_error(tmp_path, unbuffered):
    process = start_rig(
        "models", "actuator", "--json", cwd=tmp_path, env={"PYTHONUNBUFFERED": unbuffered}
    )
    process.stdout.close()
    assert process.stderr.read() == ""
    process.wait(timeout=60)
    process.stderr.close()


def test_a_folder_in_which_nothing_can_be_recorded_does_not_stay(tmp_path):
    write_experiment(tmp_path / "e.yaml")
    result = subprocess.run(
        [*RIG, "run", "e.yaml"], cwd=tmp_path, env=environment(), capture_output=True, text=True,
        preexec_fn=file_limit(30_000),
        timeout=60, check=False,
    )  # fmt: skip
    assert result.returncode == 1 and "cannot be written: File too large" in result.stderr
    assert list((tmp_path / "runs").iterdir()) == []


def test_a_serial_rig_wants_its_port_before_anything_is_recorded_and_not_to_be_checked(tmp_path):
    write_experiment(tmp_path / "e.yaml")
    checked = rig("check", "e.yaml", "--rig", "serial.yaml", cwd=tmp_path)
    assert checked.returncode == 0, checked.stderr
    assert "Next: rig run e.yaml --rig serial.yaml --port PORT" in checked.stdout
    assert "No port is named in the rig's file" in checked.stdout
    result = rig("run", "e.yaml", "--rig", "serial.yaml", cwd=tmp_path)
    assert result.returncode == 2
    assert "options.port: no port is named; give --port PORT" in result.stderr
    assert "'rig ports'" in result.stderr and not (tmp_path / "runs").exists()


@pytest.mark.parametrize("option", [[], ["--list"]])
def test_ports_that_are_not_there_are_a_mistake(tmp_path, option):
    result = rig("ports", "NOPE", *option, cwd=tmp_path)
    assert result.returncode == 2 and "rig: NOPE: there is no such port; " in result.stderr


_CONCLUDING = """
from daq.errors import RunError
from daq.findings import Findings
from protocols.prbs import Prbs


class Concluding(Prbs):
    refuses: bool = False

    def findings(self, samples, extra):
        if self.refuses:
            raise RunError("the handle was not held", cure="hold it", key="hand")
        return Findings(remarks=("all quiet",))
"""


def concluding(folder, **settings):
    (folder / "concluding.py").write_text(_CONCLUDING)
    write_experiment(folder / "e.yaml", protocol="concluding.py:Concluding", **settings)
    result = rig("run", "e.yaml", cwd=folder)
    assert result.returncode == 0, result.stderr
    return result


def test_what_a_protocol_refuses_to_conclude_stands_in_its_own_words(tmp_path):
    result = concluding(tmp_path, refuses=True)
    assert "rig: warning: hand: the handle was not held; hold it\n" in result.stderr
    result = rig("analyse", only_capture(tmp_path), "--trust", cwd=tmp_path)
    assert (result.returncode, result.stderr) == (
        1,
        "rig: hand: the handle was not held; hold it\n",
    )


def test_numbers_do_not_wait_for_the_library_of_figures(tmp_path):
    concluding(tmp_path)
    code = "import sys; sys.modules['matplotlib'] = None; from daq.cli import main; main()"
    words = [sys.executable, "-c", code, "analyse", str(only_capture(tmp_path)), "--trust"]
    result = subprocess.run(
        words, cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=60,
        check=False,
    )  # fmt: skip
    assert result.returncode == 0 and "all quiet" in result.stdout, result.stderr
