"""Fake cards for tests: their libraries on the path, a bench behind each."""

import json
import os
import sys
from contextlib import contextmanager
from pathlib import Path

from daq.boards.nidaqmx import NidaqmxDevice, NidaqmxOptions
from daq.boards.quanser import QuanserDevice, QuanserOptions

FAKES = Path(__file__).parent / "fakes"
_LIBRARIES = ("quanser", "nidaqmx", "bench_world")


@contextmanager
def fakes(**settings):
    """The fake libraries, importable; what ``bench_world`` makes benches by the settings."""
    hidden = {name: sys.modules.pop(name) for name in _loaded()}
    sys.path.insert(0, str(FAKES))
    try:
        import bench_world

        bench_world.SETTINGS = bench_world.Settings(**settings)
        yield bench_world
    finally:
        for name in _loaded():
            del sys.modules[name]
        sys.modules.update(hidden)
        sys.path.remove(str(FAKES))


def _loaded():
    return [name for name in sys.modules if name.partition(".")[0] in _LIBRARIES]


def environment(**settings):
    """Of a process whose libraries are the fakes."""
    paths = [str(FAKES), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {"PYTHONPATH": os.pathsep.join(paths), "RIG_FAKE": json.dumps(settings)}


def _clock():
    """That of the bench."""
    return sys.modules["bench_world"].clock()


def quanser(**options):
    """A device on a fake card of Quanser, closed."""
    return QuanserDevice(QuanserOptions(**{"phase": 0, **options}), _clock)


def nidaqmx(**options):
    """A device on a fake card of National Instruments, closed."""
    return NidaqmxDevice(NidaqmxOptions(**{"phase": 0, **options}), _clock)
