"""``rig emulate`` processes for tests, and rig files that lead to them."""

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from tests.daq.support import RIG, environment, journal_of, until, write_yaml


class Emulated:
    """A running emulator: its process and the port that a host opens."""

    def __init__(self, pid, port, journal):
        self.pid = pid
        self.port = port
        self._journal = journal

    @property
    def journal(self):
        return journal_of(self._journal)


def _arguments(folder, arguments, plant):
    """Command line of an emulator that works in ``folder``, and its journal."""
    folder.mkdir(parents=True, exist_ok=True)
    rig_file = write_yaml(folder / "plant.yaml", {"backend": "simulated", "options": plant or {}})
    tcp = sys.platform == "win32" or "--tcp" in arguments
    where = [] if tcp else ["--link", folder / "port"]
    if tcp and "--tcp" not in arguments:
        where = ["--tcp", "0"]
    journal = folder / "journal.jsonl"
    words = ["emulate", "--json", "--rig", rig_file, "--journal", journal, *where, *arguments]
    return list(map(str, words)), journal


@contextmanager
def emulator(folder, *arguments, plant=None):
    """Start ``rig emulate`` with a stable port name in ``folder``; ends it on leaving."""
    words, journal = _arguments(folder, arguments, plant)
    process = subprocess.Popen(
        [*RIG, *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(),
    )  # fmt: skip
    try:
        said = ""
        while "}" not in said:
            line = process.stdout.readline()
            assert line, process.communicate()[1]
            said += line
        yield Emulated(process.pid, json.loads(said)["port"], journal)
        assert process.poll() is None, "the emulator ended by itself: " + process.communicate()[1]
    finally:
        process.terminate()
        process.communicate(timeout=10)


# Imports and compiles what an emulator needs, then becomes one per line of standard input.
_FORKING = """# rig emulate, a fork a line
import json, os, signal, sys, traceback
import daq.cli, daq.cli.app
from daq.serial.emulation.emulator import warm_up
from sim_rig.backend import SimulatedDevice, Simulation

warm_up(SimulatedDevice(Simulation()))
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
for line in sys.stdin:
    job = json.loads(line)
    child = os.fork()
    if child == 0:
        for number, name in ((0, os.devnull), (1, job["out"]), (2, job["err"])):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        sys.argv = ["rig", *job["args"]]
        try:
            daq.cli.main()
        except SystemExit:
            pass
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    print(child, flush=True)
"""


@contextmanager
def forked_emulators():
    """``rig emulate`` processes without the seconds that each needs to import and compile.

    Gives a context manager like ``emulator``, and that itself where nothing forks.
    """
    if not hasattr(os, "fork"):
        yield emulator
        return
    parent = subprocess.Popen(
        [sys.executable, "-c", _FORKING],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment(),
    )  # fmt: skip

    @contextmanager
    def start(folder, *arguments, plant=None):
        words, journal = _arguments(folder, arguments, plant)
        out, err = folder / "emulator.out", folder / "emulator.err"
        parent.stdin.write(json.dumps({"args": words, "out": str(out), "err": str(err)}) + "\n")
        parent.stdin.flush()
        pid = int(parent.stdout.readline())
        try:
            said = until(lambda: _whole_json(out, err), "the emulator's port")
            yield Emulated(pid, said["port"], journal)
            assert _alive(pid), "the emulator ended by itself: " + err.read_text("utf-8")
        finally:
            if _alive(pid):
                os.kill(pid, signal.SIGTERM)

    with parent:
        yield start
        parent.stdin.close()


def _whole_json(out: Path, err: Path):
    text = out.read_text("utf-8") if out.exists() else ""
    if "}" in text:
        return json.loads(text)
    errors = err.read_text("utf-8") if err.exists() else ""
    assert "Traceback" not in errors and "rig: " not in errors, errors
    return None


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def write_serial_rig(path, port, **options):
    """A rig file for the serial backend."""
    return write_yaml(
        path,
        {"name": "serial test", "backend": "serial", "options": {"port": str(port), **options}},
    )
