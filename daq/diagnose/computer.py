"""Whether a computer suits a rig in real time: its ports, scheduling, memory and disk."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from daq.files import make_folder
from daq.run.realtime import RealTime
from daq.serial.ports import PortFacts, latency_timer, permission_cure

Verdict = Literal["good", "could be better", "bad"]

WAKES, _NAP = 20_000, 0.0002  # wake-ups timed, half of them under load, and each one's sleep [s]
_BUSY = "while True: pass"
_LATE, _TOO_LATE = 0.005, 0.05  # s; the watchdog's default is 0.1 s
_FLUSHES, _FLUSH_BYTES = 20, 512 * 1024
# A log at 4 kHz is half a megabyte a second; a flush that takes longer than the samples that the
# computer keeps meanwhile loses some.
_SLOW_DISK, _SLOWEST_DISK = 10e6, 1e6  # bytes/s
_LONG_FLUSH, _LONGEST_FLUSH = 0.2, 1.0  # s
_TIMER = 2  # ms


@dataclass(frozen=True)
class Check:
    """A verdict on one subject, and what it rests on; cure: what to do, empty where all is well."""

    subject: str
    verdict: Verdict
    observation: str
    cure: str = ""


def diagnose(ports: Sequence[PortFacts] | None, out: Path, wakes: int = WAKES) -> list[Check]:
    """Check these ports, scheduling and memory, and the disk of the folder for logs.

    ports: None where the rig is on none. wakes: times that it wakes from short sleeps.
    """
    checks = [check for port in ports or () for check in _port(port)]
    if ports is not None and not ports:
        cure = "plug the device in, if your rig is on one; a simulated rig needs none"
        checks = [Check("ports", "could be better", "there are none", cure)]
    return [*checks, *_real_time(wakes), _disk(out)]


def _port(port: PortFacts) -> list[Check]:
    if "://" in port.name or os.name == "nt":
        return []
    access = f"access to {port.name}"
    if not Path(port.name).exists():
        return [Check(access, "bad", "there is no such port", "'rig ports' lists those there are")]
    if not os.access(port.name, os.R_OK | os.W_OK):
        return [Check(access, "bad", "no permission", permission_cure(port.name))]
    checks = [Check(access, "good", "may be read and written")]
    timer = latency_timer(port.name)
    if timer is not None:
        file, milliseconds = timer
        cure = (
            f"as root: echo 1 > {file}; for good, a udev rule: "
            'ACTION=="add", SUBSYSTEM=="usb-serial", ATTR{latency_timer}="1"'
        )
        subject, good = f"latency timer of {port.name}", milliseconds <= _TIMER
        checks.append(_graded(subject, f"{milliseconds} ms", cure, good))
    return checks


def _graded(subject: str, observation: str, cure: str, good: bool, bad: bool = False) -> Check:
    if good:
        return Check(subject, "good", observation)
    return Check(subject, "bad" if bad else "could be better", observation, cure)


def _real_time(wakes: int) -> list[Check]:
    """Scheduling and memory that a run is granted, and how late it wakes from short sleeps."""
    words = [sys.executable, "-S", "-c", _BUSY]
    with contextlib.ExitStack() as ending:
        busy_ones = [
            ending.enter_context(subprocess.Popen(words)) for _ in range(os.cpu_count() or 1)
        ]
        for process in busy_ones:
            ending.callback(process.kill)
        run = RealTime()
        run.begin("prefer")
        ending.callback(run.undo)
        busy = _lateness(wakes - wakes // 2)
    run = RealTime()
    run.begin("prefer")
    quiet = _lateness(wakes // 2)
    run.undo()
    worst = max(quiet[-1], busy[-1])
    return [
        _granted(run, "scheduler", "real-time scheduling", "@GROUP - rtprio 50"),
        _granted(run, "memory", "memory lock", "@GROUP - memlock unlimited"),
        _graded(
            "wake-ups",
            f"late by {_late_text(quiet)}; all cores busy, by {_late_text(busy)}; of {wakes}",
            "end other programs; on a laptop, plug in the supply and switch energy saving off",
            good=worst <= _LATE,
            bad=worst > _TOO_LATE,
        ),
    ]


def _lateness(wakes: int) -> list[float]:
    """How late it wakes each time [s], the worst last."""
    late = []
    for _ in range(max(wakes, 1)):
        begun = time.perf_counter()
        time.sleep(_NAP)
        late.append(time.perf_counter() - begun - _NAP)
    return sorted(late)


def _late_text(late: Sequence[float]) -> str:
    most = late[min(int(0.999 * len(late)), len(late) - 1)]
    return f"{1e3 * most:.2f} ms (p99.9), {1e3 * late[-1]:.2f} ms (worst)"


def _granted(run: RealTime, name: str, subject: str, line: str) -> Check:
    if name not in run.refused:
        return Check(subject, "good", str(run.granted.get(name, "left to the system")))
    cure = (
        f"as root, write the line '{line}' with a group of your user to "
        "/etc/security/limits.d/rig.conf, then log in again"
    )
    if not sys.platform.startswith("linux"):
        cure = "this system has none"
    return Check(subject, "could be better", f"not allowed ({run.refused[name]})", cure)


def _disk(out: Path) -> Check:
    """Time of flushes as a fast log makes them, in the folder for logs."""
    subject, made = f"disk of {out}", not out.exists()
    make_folder(out)
    file = out / f".doctor.{os.getpid()}"
    try:
        speed, slowest = _flush(file)
    except OSError as error:
        problem = f"cannot be written: {error.strerror}"
        return Check(subject, "bad", problem, "choose another: --out")
    finally:
        file.unlink(missing_ok=True)
        if made:
            out.rmdir()
    observation = f"{speed / 1e6:.0f} MB/s, {1e3 * slowest:.0f} ms for the slowest flush"
    good = speed >= _SLOW_DISK and slowest <= _LONG_FLUSH
    bad = speed < _SLOWEST_DISK or slowest > _LONGEST_FLUSH
    cure = "write logs to a disk of this computer, not to a stick or the network: rig run --out DIR"
    return _graded(subject, observation, cure, good, bad)


def _flush(file: Path) -> tuple[float, float]:
    """Speed of writing a file [bytes/s], and the time of the slowest flush [s]."""
    block, slowest = bytes(_FLUSH_BYTES), 0.0
    begun = time.perf_counter()
    with file.open("wb") as stream:
        for _ in range(_FLUSHES):
            before = time.perf_counter()
            stream.write(block)
            stream.flush()
            os.fsync(stream.fileno())
            slowest = max(slowest, time.perf_counter() - before)
    return _FLUSHES * _FLUSH_BYTES / (time.perf_counter() - begun), slowest
