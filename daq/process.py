"""The process that a run is in: who it is, whether it still is that one, and how it is stopped."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

_PROC = Path("/proc")
_BOOT = _PROC / "sys/kernel/random/boot_id"
_STARTED = 19  # place of the start among what stands behind the name in /proc/PID/stat


@dataclass(frozen=True)
class RunProcess:
    """A process as no other has been: number, start in ticks of this boot of the computer.

    stop: the signal by which it ends its run; Ctrl-C, or where it ignores that, a polite kill.
    """

    pid: int
    started: int
    boot: str
    stop: int

    @classmethod
    def this(cls) -> Self | None:
        """This one, where it can be told from others (Linux) and its run hears signals."""
        numbers = (signal.SIGINT, signal.SIGTERM)
        heard = [n for n in numbers if signal.getsignal(n) is not signal.SIG_IGN]
        identity = _identity(os.getpid())
        if (
            identity is None
            or not heard
            or threading.current_thread() is not threading.main_thread()
        ):
            return None
        return cls(os.getpid(), *identity, int(heard[0]))

    @classmethod
    def of(cls, record: Any) -> Self | None:
        """From a record's ``process``; None where that is none."""
        if not isinstance(record, Mapping) or record.keys() != cls.__annotations__.keys():
            return None
        kinds = {"pid": int, "started": int, "boot": str, "stop": int}
        fits = all(type(record[key]) is kind for key, kind in kinds.items())
        is_known = fits and record["stop"] in (signal.SIGINT, signal.SIGTERM)
        return cls(**record) if is_known and record["pid"] > 1 else None

    @property
    def document(self) -> dict[str, Any]:
        """What a record holds of it."""
        return asdict(self)

    def is_alive(self) -> bool:
        """Whether it still is that process, and not another with its number."""
        return _identity(self.pid) == (self.started, self.boot)

    def interrupt(self) -> bool:
        """Send it what Ctrl-C sends; whether it was there and may be sent to.

        A handle on the process is taken before it is looked at, so that no other that gets its
        number in between is hit.
        """
        if sys.platform != "linux":
            return False
        try:
            handle = os.pidfd_open(self.pid)
        except OSError:
            return False
        try:
            if not self.is_alive():
                return False
            signal.pidfd_send_signal(handle, signal.Signals(self.stop))
        except OSError:
            return False
        finally:
            os.close(handle)
        return True


def signal_main_thread(number: signal.Signals) -> None:
    """From another thread: have the main one hear a signal, out of the call it waits in."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:  # Windows: heard once the call is back in Python
        _thread.interrupt_main(number)


def _identity(pid: int) -> tuple[int, str] | None:
    """When a process began, in ticks since the computer did, and which boot that was."""
    try:
        fields = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
        return int(fields[_STARTED]), _BOOT.read_text().strip()
    except (OSError, ValueError, IndexError):
        return None
