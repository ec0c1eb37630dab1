"""What holds for every test."""

import os
import shutil
import signal
import tempfile

import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")

_KERNELS = pytest.StashKey[str]()


def pytest_configure(config):
    _hear_signals()
    if not hasattr(config, "workerinput"):
        # Compiled kernels are this session's own, and shared by all its processes: those of
        # pytest-xdist and the programs that tests start find the cache by the environment.
        config.stash[_KERNELS] = os.environ["RIG_CACHE_DIR"] = tempfile.mkdtemp(prefix="kernels-")


def pytest_unconfigure(config):
    if _KERNELS in config.stash:
        shutil.rmtree(config.stash[_KERNELS], ignore_errors=True)


def _hear_signals():
    """Programs that tests start are to meet signals as in a terminal.

    A shell starts what runs behind it with Ctrl-C ignored, and nohup with the terminal's end
    ignored; programs inherit that, but not a handler of ours, in place of which they have the
    default.
    """
    handlers = {
        "SIGINT": signal.default_int_handler,
        "SIGQUIT": signal.default_int_handler,
        "SIGHUP": lambda number, frame: None,
    }
    for name, handler in handlers.items():
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)
