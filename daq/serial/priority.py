"""Scheduling and memory that a busy computer does not upset, where the system allows it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys

_CURRENT, _FUTURE, _ON_FAULT = 1, 2, 4  # of mlockall(2)
_PRIORITY = 1  # lowest of the real-time ones: enough to go before everything ordinary


def raise_thread() -> bool:
    """Schedule the calling thread before all ordinary ones; whether that was allowed.

    Linux: round robin at the lowest real-time priority, which needs RLIMIT_RTPRIO (``rig
    doctor`` says how). Elsewhere nothing is done.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_PRIORITY))
    except OSError:
        return False
    return True


def lower_thread() -> None:
    """Back to ordinary scheduling."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def may_lock_memory() -> bool:
    """Whether this user may keep as much memory from being swapped out as a run needs."""
    if not sys.platform.startswith("linux"):
        return False
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return os.geteuid() == 0 or soft == resource.RLIM_INFINITY


def lock_memory() -> bool:
    """Keep this process's memory from being swapped out; whether that was allowed.

    Only without a limit: under one, a later allocation could fail.
    """
    if not may_lock_memory():
        return False
    libc = ctypes.CDLL(None)
    return int(libc.mlockall(_CURRENT | _FUTURE | _ON_FAULT)) == 0


def unlock_memory() -> None:
    """Let the system swap again."""
    if may_lock_memory():
        ctypes.CDLL(None).munlockall()


def spare_collector() -> None:
    """Keep the garbage collector from what is loaded by now.

    A full collection walks over every object of every library, 0.1 s with all other threads
    stopped: as long as the watchdog waits. What comes later is collected as ever.
    """
    gc.collect()
    gc.freeze()


def restore_collector() -> None:
    """Let the garbage collector look at everything again."""
    gc.unfreeze()
