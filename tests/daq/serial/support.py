"""A ``rig emulate`` process for tests, and rig files that lead to it."""

import json
import os
import subprocess
import sys
from contextlib import contextmanager

from tests.daq.support import RIG, environment, write_yaml


class Emulated:
    """A running emulator: its process and the port that a host opens."""

    def __init__(self, process, port):
        self.process = process
        self.port = port


@contextmanager
def emulator(folder, *arguments, plant=None):
    """Start ``rig emulate`` with a stable port name in ``folder``; ends it on leaving."""
    folder.mkdir(parents=True, exist_ok=True)
    rig_file = write_yaml(folder / "plant.yaml", {"backend": "simulated", "options": plant or {}})
    where = ["--tcp", "0"] if sys.platform == "win32" else ["--link", str(folder / "port")]
    if "--tcp" in arguments:
        where = []
    process = subprocess.Popen(
        [*RIG, "emulate", "--json", "--rig", str(rig_file), *where, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    try:
        said = ""
        while "}" not in said:
            line = process.stdout.readline()
            assert line, process.communicate()[1]
            said += line
        yield Emulated(process, json.loads(said)["port"])
        assert process.poll() is None, "the emulator ended by itself: " + process.communicate()[1]
    finally:
        process.terminate()
        process.communicate(timeout=10)


def write_serial_rig(path, port, **options):
    """A rig file for the serial backend."""
    return write_yaml(
        path,
        {"name": "serial test", "backend": "serial", "options": {"port": str(port), **options}},
    )


def needs_pty():
    """Whether there are pseudo-terminals here."""
    return hasattr(os, "openpty")
