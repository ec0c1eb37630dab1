"""Scheduling that a busy computer does not upset, where the system allows it to this user."""

from __future__ import annotations

import contextlib
import os
import sys

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
