"""A bound on the time that a backend may keep a call to itself while outputs may be live."""

import threading
import time
from types import TracebackType

from daq.errors import DeviceError
from daq.rig import Rig
from daq.run.realtime import RealTime
from daq.run.signals import SignalHandling

_LONGEST = 5.0  # s of a call
_PATIENCE = 2.0  # s from then until the run must have begun to end
_LOOK = 0.25  # s between looks


class HangGuard:
    """Ends a run whose device does not return from a call. Use as a context manager.

    So it does one whose program computes in real time without a pause, as ``RealTime`` says.
    DeviceError is raised in the main thread, out of the call. Where that does not hear of it, being
    in a library's own code or in a call that zeroes the outputs, the process is ended, and the
    device's watchdog zeroes the outputs.
    """

    def __init__(
        self, rig: Rig, signals: SignalHandling, realtime: RealTime, sample_rate: float
    ) -> None:
        self._rig, self._signals, self._realtime = rig, signals, realtime
        # The next sample may be a long time away.
        self._longest = max(_LONGEST, 3.0 / sample_rate)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="hang guard", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        interrupted = False
        while not self._ended.wait(_LOOK):
            overrun = self._realtime.overrun_since(self._rig.returned)
            if overrun is not None:
                self._signals.interrupt(overrun)
            call = self._rig.call
            # A computed plant may take its time, and nobody is near it.
            if call is None or self._rig.info.virtual_time:
                continue
            if time.perf_counter() - call[1] < self._longest:
                continue
            problem = f"the device has not returned from {call[0]}() for {self._longest:g} s"
            if interrupted or call[0] in ("safe", "stop"):
                self._signals.give_up("failed", f"{problem}; the program was ended without it")
            interrupted = True
            cure = "switch off the amplifier; then look after its connection, or mend the backend"
            self._signals.interrupt(DeviceError(problem, cure=cure))
            if self._ended.wait(_PATIENCE):
                return
