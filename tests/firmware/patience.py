"""Tests in real time on a busy machine: what fails on load is tried again, at last skipped.

Load is a tick of QEMU's that came late, which the emulator notes in its journal, or other programs
that keep a core for a good part of the time. A test that fails without either has failed. So has
one whose every try ends at the same line, which is no accident, unless the host gives up there.
Where the host itself says that it was too slow, that is tried again too, as what kept it waiting
may leave no trace; without one it is never skipped.
"""

import os
import time
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

TRIES = 5
LONGEST = 120.0  # s, after which there is no further try
LATE = 0.03  # s; open loop has commands for 0.6 s, closed loop is late by a tick of 1.25 ms
TAKEN = 0.3  # cores
HOST = "daq.errors.DeviceError"
SLOW = "the host was too slow"
TOO_BUSY = "too busy a machine for real time"

_watched = []


def watch(running):
    """Ask this emulator's journal from now on."""
    _watched[:] = [running]


class Load:
    """What kept the processes of this session waiting since this was made; nothing off Linux."""

    def __init__(self):
        self._began = time.perf_counter()
        self._others = _seconds_of_others()

    def __str__(self):
        """In words; empty where there was none worth mentioning."""
        taken = (_seconds_of_others() - self._others) / (time.perf_counter() - self._began)
        late = max(
            (
                entry["late_seconds"]
                for running in _watched
                for entry in running.journal
                if entry["seconds"] >= self._began
            ),
            default=0.0,
        )
        words = [f"other programs took {taken:.1f} of {os.cpu_count()} cores"] * (taken >= TAKEN)
        words += [f"QEMU was late by {1e3 * late:.0f} ms"] * (late >= LATE)
        return ", ".join(words)


def _seconds_of_others():
    """Seconds of processors that neither this process nor those behind it have had."""
    if not Path("/proc/stat").exists():
        return 0.0
    user, nice, system, _, _, *rest = map(int, Path("/proc/stat").read_text("utf-8").split()[1:9])
    times, parents = {}, {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text("utf-8").rpartition(")")[2].split()
        except OSError:
            continue  # it has just ended
        pid = int(path.parent.name)
        parents[pid] = int(fields[1])
        times[pid] = sum(map(int, fields[11:15]))  # those of children that have ended among them

    def is_ours(pid):
        while pid in parents and pid != os.getpid():
            pid = parents[pid]
        return pid == os.getpid()

    ours = sum(ticks for pid, ticks in times.items() if is_ours(pid))
    return (user + nice + system + sum(rest) - ours) / os.sysconf("SC_CLK_TCK")


def on_load(action):
    """What ``action`` returns; what it asserts in vain is tried again on load, at last skipped."""
    for attempt in range(1, TRIES + 1):
        load = Load()
        try:
            return action()
        except AssertionError as error:
            reason = str(load)
            if not reason and (attempt == TRIES or SLOW not in str(error)):
                raise
    return pytest.skip(f"{TOO_BUSY}: {reason}; {TRIES} tries")


def _place(report):
    """Where a test failed, or that it was the host that gave up."""
    crash = getattr(report.longrepr, "reprcrash", None)
    if crash is None:
        return str(report.longrepr)
    return HOST if crash.message.startswith(HOST) else (crash.path, crash.lineno)


def protocol(item, nextitem):
    """``pytest_runtest_protocol`` of a test that is marked ``patient``."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    began, places = time.perf_counter(), set()
    for attempt in range(1, TRIES + 1):
        load = Load()
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        failed = [report for report in reports if report.failed]
        places |= {_place(report) for report in failed}
        reason = str(load) if failed else ""
        again = reason or any(SLOW in report.longreprtext for report in failed)
        if not again or attempt == TRIES or time.perf_counter() - began > LONGEST:
            break
        item._initrequest()
    is_content = len(places) == 1 and HOST not in places
    for report in reports:
        if report.failed and reason and not is_content:
            path, line, _ = item.location
            word = f"Skipped: {TOO_BUSY}: {reason}; {attempt} tries"
            report.outcome, report.longrepr = "skipped", (path, line, word)
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
