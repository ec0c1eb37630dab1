"""What holds for every test."""

import contextlib
import gc
import importlib
import os
import signal
import sys
import tempfile
import zlib
from pathlib import Path

from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


def pytest_configure(config):
    _hear_signals()
    _keep_bytecode()
    # Tests run beside each other, each with the programs that it starts. Threads that share a small
    # matrix wait for each other, which was a sixth of what tests of linear algebra took.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if not hasattr(config, "workerinput"):
        # Compiled kernels are kept for the next session, as pytest's own cache is, and shared by
        # all processes: those of pytest-xdist and programs that tests start find the folder by
        # the environment. Their names are fingerprints of all that they are made of.
        cache = getattr(config, "cache", None)  # None with -p no:cacheprovider
        folder = cache.mkdir("kernels") if cache else tempfile.mkdtemp(prefix="kernels-")
        Path(folder).chmod(0o700)  # whatever the umask: a folder that others write to is refused
        os.environ["RIG_CACHE_DIR"] = str(folder)
    else:
        _import_from_other_ends(config.workerinput["workerid"])


def pytest_collection_finish():
    # What was collected stays: the garbage collector need not look through it again and again.
    gc.collect()
    gc.freeze()


def pytest_report_header():
    part = os.environ.get("RIG_LONG_TESTS")
    return f"long tests: part {part}" if part else None


def pytest_collection_modifyitems(config, items):
    _leave_out_other_parts(config, items)
    # The longest begin first, so that no process waits for one alone at the end.
    longest = [
        "test_tutorial", "test_missing_physics", "test_characterising", "test_cli",
        "test_scope_page", "test_uncertainty", "test_ends", "test_evidence", "faults/test_analysis",
        "test_docstrings", "boards/test_boards", "firmware/test_core", "faults/test_device",
        "test_friction_identification", "test_hal_boards", "test_combinations", "test_compile",
        "test_campaigns", "test_simulation", "test_structures", "test_constant_velocity",
        "test_innovations", "test_contract", "test_library", "sim_rig/test_device",
        "test_discrimination", "test_site", "test_exits", "test_replay", "test_hysteresis_loop",
        "serial/test_faults", "test_guesses", "test_resuming", "test_real_time",
    ]  # fmt: skip

    def place(item):
        path = item.path.as_posix()
        return next((n for n, name in enumerate(longest) if f"{name}.py" in path), len(longest))

    items.sort(key=place)


def _leave_out_other_parts(config, items):
    """Of the long tests RIG_LONG_TESTS=1/4 keeps the second of four parts, which together are all.

    Cases of a test stay together: they share what they prepare.
    """
    part, of = map(int, os.environ.get("RIG_LONG_TESTS", "0/1").split("/"))

    def elsewhere(item):
        test = item.nodeid.partition("[")[0].encode()
        return item.get_closest_marker("soak") is not None and zlib.crc32(test) % of != part

    config.hook.pytest_deselected(items=[item for item in items if elsewhere(item)])
    items[:] = [item for item in items if not elsewhere(item)]


def _import_from_other_ends(worker):
    """Of what all tests import, processes of pytest-xdist begin with different packages.

    In a new environment nothing has been compiled to bytecode: each then compiles a part, and
    loads what the other has compiled meanwhile, instead of both the whole in the same order.
    """
    packages = ["numba", "pandas", "matplotlib.figure", "bokeh.plotting", "scipy.stats", "sklearn"]
    for package in packages if worker == "gw0" else packages[::-1]:
        with contextlib.suppress(ImportError):
            importlib.import_module(package)


def _keep_bytecode():
    """Hundreds of programs are started; without it each would compile anew all that it imports.

    Where packages were installed without bytecode and PYTHONDONTWRITEBYTECODE is set, as in many
    containers, that is several seconds for each.
    """
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


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
