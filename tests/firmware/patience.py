"""Tests in real time on a busy machine: what fails on load is tried again.

Load is a tick of QEMU's that came late, which the emulator notes in its journal, or more work than
cores: then QEMU lets bytes of the host wait too. A test that fails without load has failed, and so
has one that fails every time.
"""

import os
import time

from _pytest.runner import runtestprotocol

TRIES = 5
LATE = 0.03  # s; open loop has commands for 0.6 s, closed loop is late by a tick of 1.25 ms

_watched = []


def watch(running):
    """Ask this emulator's journal from now on."""
    _watched[:] = [running]


def was_late(since):
    """Whether QEMU was late after ``since`` (``time.perf_counter``)."""
    return any(
        entry["seconds"] >= since and entry["late_seconds"] >= LATE
        for running in _watched
        for entry in running.journal
    )


def is_busy():
    """Whether more is to be done than this computer has cores."""
    return os.getloadavg()[0] > (os.cpu_count() or 1)


def protocol(item, nextitem):
    """``pytest_runtest_protocol`` of a test that is marked ``patient``."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for attempt in range(1, TRIES + 1):
        since = time.perf_counter()
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        failed = any(report.failed for report in reports)
        if not failed or attempt == TRIES or not (was_late(since) or is_busy()):
            break
        item._initrequest()
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
