"""Real-time scheduling while a run is on, as far as the operating system grants it."""

import contextlib
import ctypes
import gc
import os
import sys
from typing import Any

from daq.config.rig import Realtime
from daq.errors import ConfigError

_PRIORITY = 40  # of 99: above all ordinary work, below the kernel's own interrupt threads at 50
_LOCK = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT: what is touched stays in memory
_HIGH_PRIORITY_CLASS = 0x80
_NORMAL_PRIORITY_CLASS = 0x20
_CURE = (
    "allow it to this user with two lines in /etc/security/limits.d/rig.conf, "
    "'@GROUP - rtprio 50' and '@GROUP - memlock unlimited', and log in again; or start it by "
    "'sudo chrt --fifo 40 rig run ...'; or write 'realtime: prefer' in the rig's file"
)


class RealTime:
    """Scheduler class, memory and garbage collector of a run; ``undo`` gives all back.

    granted: what was obtained, by name, for run.json; refused: what was not, and why.
    """

    def __init__(self) -> None:
        self.granted: dict[str, Any] = {}
        self.refused: dict[str, str] = {}
        self._undo = contextlib.ExitStack()

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
            problem = f"required, but not granted: {missing}. Cure: {_CURE}"
            raise ConfigError(problem, key="realtime")

    def undo(self) -> None:
        """Back to ordinary scheduling, in reverse order; never raises."""
        with contextlib.suppress(OSError):
            self._undo.close()

    def _quiet_collector(self) -> None:
        """No garbage collection in the middle of a tick; what there is by now is left aside."""
        if gc.isenabled():
            gc.collect()
            gc.freeze()
            gc.disable()
            self._undo.callback(gc.unfreeze)
            self._undo.callback(gc.enable)
        self.granted["garbage_collector"] = "off"

    def _raise_scheduler(self) -> None:
        if sys.platform != "linux":
            self.refused["scheduler"] = f"{sys.platform} has no real-time scheduler for processes"
            return
        import resource

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

    def _lock_memory(self) -> None:
        library = ctypes.CDLL(None, use_errno=True)
        if not hasattr(library, "mlockall") or library.mlockall(_LOCK) != 0:
            self.refused["memory"] = f"mlockall: {os.strerror(ctypes.get_errno())}"
            return
        self._undo.callback(library.munlockall)
        self.granted["memory"] = "locked"

    def _raise_class(self) -> None:
        if sys.platform == "win32":
            kernel = ctypes.windll.kernel32
            process = kernel.GetCurrentProcess()
            if not kernel.SetPriorityClass(process, _HIGH_PRIORITY_CLASS):
                self.refused["scheduler"] = "SetPriorityClass: refused"
                return
            self._undo.callback(kernel.SetPriorityClass, process, _NORMAL_PRIORITY_CLASS)
            self.granted["scheduler"] = "HIGH_PRIORITY_CLASS"
