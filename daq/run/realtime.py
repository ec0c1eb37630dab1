"""Real-time scheduling while a run is on, as far as the operating system grants it."""

import contextlib
import ctypes
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

from daq.config.rig import Realtime
from daq.errors import ConfigError, RunError

with contextlib.suppress(ImportError):  # Windows has nothing of the kind
    import resource

_PRIORITY = 40  # of 99: above all ordinary work, below the kernel's own interrupt threads at 50
_LONGEST = 1  # s of computing without a pause, after which real-time scheduling is given back
_END = 4  # s after which the system ends a program that does not hear of that
_LOCK = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT: what is touched stays in memory
_HIGH_PRIORITY_CLASS = 0x80
_NORMAL_PRIORITY_CLASS = 0x20
_MAIN = threading.main_thread()
_ALLOW = (
    "allow it to this user with two lines in /etc/security/limits.d/rig.conf, "
    "'@GROUP - rtprio 50' and '@GROUP - memlock unlimited', and log in again; or start it by "
    "'sudo chrt --fifo 40 rig run ...'"
)
_PREFER = "write 'realtime: prefer' in the rig's file"


class RealTime:
    """Scheduler class, memory and garbage collector of a run; ``undo`` gives all back.

    granted: what was obtained, by name, for run.json; refused: what was not, and why. overrun: is
    called with an error, all having been given back, when the program has kept a core to itself
    for a second, computing without a pause. One that is too busy in a library's own code to hear
    of it is ended by the system after four, rather than hold the computer.
    """

    def __init__(self, overrun: Callable[[RunError], None] = lambda error: None) -> None:
        self.granted: dict[str, Any] = {}
        self.refused: dict[str, str] = {}
        self._overrun = overrun
        self._undo = contextlib.ExitStack()
        self._returned: float | None = None  # before the first look
        self._busy = 0.0

    def begin(self, wanted: Realtime) -> None:
        """Obtain what there is. Raises ConfigError, with the cure, when it is required."""
        if wanted == "off":
            return
        self._quiet_collector()
        if sys.platform == "win32":
            self._raise_class()
        else:
            self._raise_scheduler()
            self._lock_memory()
        if wanted == "require" and self.refused:
            missing = "; ".join(f"{name}: {reason}" for name, reason in self.refused.items())
            cure = _PREFER if sys.platform == "win32" else f"{_ALLOW}; or {_PREFER}"
            problem = f"required, but not granted: {missing}. Cure: {cure}"
            raise ConfigError(problem, key="realtime")

    def overrun_since(self, returned: float) -> RunError | None:
        """From another thread, several times a second: the error of a second without a pause.

        The system counts anew whenever the main thread waits for another one to let it go on, as
        it does many times a second where a terminal shows progress. returned: when the device's
        last call ended, which is what a pause is here.
        """
        if sys.platform != "linux" or "scheduler" not in self.granted:
            return None
        busy = time.clock_gettime(time.pthread_getcpuclockid(_MAIN.ident or 0))
        if returned != self._returned:
            self._returned, self._busy = returned, busy
        return self._give_back() if busy - self._busy > _LONGEST else None

    def undo(self) -> None:
        """Back to ordinary scheduling, in reverse order; never raises."""
        with contextlib.suppress(OSError):
            self._undo.close()

    def _quiet_collector(self) -> None:
        """No garbage collection in the middle of a tick; what there is by now is left aside."""
        if gc.isenabled():
            gc.collect()
            if not gc.get_freeze_count():  # what a host program has left aside stays there
                gc.freeze()
                self._undo.callback(gc.unfreeze)
            gc.disable()
            self._undo.callback(gc.enable)
        self.granted["garbage_collector"] = "off"

    def _raise_scheduler(self) -> None:
        if sys.platform != "linux":
            self.refused["scheduler"] = f"{sys.platform} has no real-time scheduler for processes"
            return
        if threading.current_thread() is not threading.main_thread():
            self.refused["scheduler"] = "the time of a thread that is not the main one has no bound"
            return
        self._bound_time()
        before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        # The limit of this user; a privileged one is not bound by it.
        limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
        priority = limit if 0 < limit < _PRIORITY else _PRIORITY
        try:
            # Threads and processes that this one starts are to be ordinary ones.
            kind = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, kind, os.sched_param(priority))
        except OSError as error:
            self.refused["scheduler"] = f"SCHED_FIFO: {error.strerror}"
            return
        # Only the privileged may take that mark away again, and to an ordinary one it is nothing.
        ordinary = before | os.SCHED_RESET_ON_FORK
        self._undo.callback(os.sched_setscheduler, 0, ordinary, parameters)
        self.granted.update(scheduler="SCHED_FIFO", priority=priority)

    def _bound_time(self) -> None:
        """Have the system say when this program computes in real time without a pause."""
        if sys.platform != "linux":
            return
        kind, unlimited = resource.RLIMIT_RTTIME, resource.RLIM_INFINITY
        before = resource.getrlimit(kind)
        end = _END * 1_000_000 if before[1] == unlimited else min(before[1], _END * 1_000_000)
        self._undo.callback(signal.signal, signal.SIGXCPU, signal.getsignal(signal.SIGXCPU))
        signal.signal(signal.SIGXCPU, self._exceeded)
        resource.setrlimit(kind, (min(_LONGEST * 1_000_000, end), end))

        def lift() -> None:
            try:
                resource.setrlimit(kind, before)
            except ValueError:  # only the privileged may raise the upper one again
                resource.setrlimit(kind, (end, end))

        self._undo.callback(lift)

    def _exceeded(self, number: int, frame: FrameType | None) -> None:
        self.undo()
        self._overrun(self._give_back())

    def _give_back(self) -> RunError:
        problem = f"the program computed for {_LONGEST} s without a pause"
        self.granted.pop("scheduler", None)
        self.refused["scheduler"] = f"given back: {problem}"
        return RunError(f"{problem}, in which no sample was answered")

    def _lock_memory(self) -> None:
        library = ctypes.CDLL(None, use_errno=True)
        if not hasattr(library, "mlockall") or library.mlockall(_LOCK) != 0:
            self.refused["memory"] = f"mlockall: {os.strerror(ctypes.get_errno())}"
            return
        self._undo.callback(library.munlockall)
        self.granted["memory"] = "locked"

    def _raise_class(self) -> None:
        if sys.platform == "win32":
            kernel = ctypes.WinDLL("kernel32")
            # A handle is a pointer, of which an int, ctypes' default, is half.
            kernel.GetCurrentProcess.restype = ctypes.c_void_p
            kernel.SetPriorityClass.argtypes = (ctypes.c_void_p, ctypes.c_uint32)
            process = kernel.GetCurrentProcess()
            if not kernel.SetPriorityClass(process, _HIGH_PRIORITY_CLASS):
                self.refused["scheduler"] = "SetPriorityClass: refused"
                return
            self._undo.callback(kernel.SetPriorityClass, process, _NORMAL_PRIORITY_CLASS)
            self.granted["scheduler"] = "HIGH_PRIORITY_CLASS"
