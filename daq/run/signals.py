"""Signals that end a run: the first by an exception, later ones without disturbing the clean-up."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import CodeType, FrameType
from typing import Any, NoReturn

from daq.errors import Terminated
from daq.process import signal_main_thread

# Ctrl-C; a polite kill; a closed terminal; Ctrl-Break on Windows; Ctrl-\ and Ctrl-Z on a terminal:
# a program that is suspended watches no limits. Where there is such a signal.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK", "SIGQUIT", "SIGTSTP")
_PATIENCE = 2.0  # s after the first signal in which the outputs must have been zeroed
_LATER = 0.02  # s until an error that Python swallowed is raised again
# Of Windows' console: numbers of a closed window, a log-off, a shutdown; and how long [s] it lets a
# program be after the first, which a system may shorten.
_CLOSED = {2: "a closed window", 5: "a log-off", 6: "a shutdown"}
_LAST_SECONDS = 4.5


class SignalHandling:
    """Turns signals into exceptions while a run is on. Use as a context manager.

    Nothing is raised before ``release``, where somebody catches it. The first signal then raises
    KeyboardInterrupt or ``Terminated``. From then on, and from ``shield`` on, nothing is raised, so
    that zeroing the outputs is never cut short, but in ``breakable``: a second Ctrl-C ends what
    hangs there. A process that still does not get on is ended by the next signal, behind a call of
    ``last_act``, whose words are shown, and the device's watchdog zeroes the outputs. What came
    behind the shield without an effect is raised at the end. Signals that the process ignores, as
    under nohup, stay ignored. ``interrupt`` raises an error of another thread's as if a signal had
    brought it. What is raised in a destructor or in a callback of the garbage collector's is
    swallowed by Python; it is raised again once that has returned. Windows has no signal of a
    closed window; it is kept from ending the process until ``__exit__``.
    """

    def __init__(self) -> None:
        self.last_act: Callable[[str, str], str] = lambda status, reason: ""
        self._before: list[tuple[int, Any]] = []
        self._sending = threading.Lock()
        self._first = 0.0  # when the first signal came
        self._pending: BaseException | None = None
        self._interruption: BaseException | None = None
        self._shielded, self._breakable = True, False
        self._raised: tuple[BaseException, bool, bool] | None = None  # by what, and behind what
        self._hook_before: Callable[[sys.UnraisableHookArgs], Any] = sys.unraisablehook
        self._over = threading.Event()
        self._console = contextlib.ExitStack()

    def __enter__(self) -> SignalHandling:
        self._hook_before, sys.unraisablehook = sys.unraisablehook, self._swallowed
        if threading.current_thread() is threading.main_thread():
            numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
            heard = [n for n in numbers if signal.getsignal(n) is not signal.SIG_IGN]
            self._before = [(number, signal.signal(number, self._handle)) for number in heard]
            self._console.enter_context(_console_events(self._closed))
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._sending:
            before, self._before = self._before, []
        for number, handler in reversed(before):  # Ctrl-C last: with its own it raises again
            signal.signal(number, handler)
        sys.unraisablehook = self._hook_before
        self._over.set()
        self._console.close()
        if error is None and self._pending is not None:
            raise self._pending

    def release(self) -> None:
        """From now on signals raise, with one that has come already."""
        self._shielded = False
        if self._pending is not None:
            self.end_by(self._pending)

    def shield(self) -> None:
        """From now on no signal raises."""
        self._shielded = True

    @contextlib.contextmanager
    def breakable(self) -> Iterator[None]:
        """Behind the shield, a passage that a signal may end all the same."""
        self._breakable = True
        try:
            yield
        finally:
            self._breakable = False

    def interrupt(self, error: BaseException) -> None:
        """From another thread: raise an error in the main one, out of the call it waits in."""
        with self._sending:
            if not self._before:
                return  # over, not in the main thread, or all are ignored: it would end all
            number = signal.Signals(self._before[0][0])
            self._interruption = error
            signal_main_thread(number)

    def _closed(self, event: int) -> bool:
        """From a thread of Windows', which ends the process once this has returned true."""
        if event not in _CLOSED:
            return False
        self.interrupt(Terminated(_CLOSED[event]))
        self._over.wait(_LAST_SECONDS)
        return True

    def _swallowed(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Python's hook for errors that it cannot raise: ours are raised later."""
        if self._raised is None or unraisable.exc_value is not self._raised[0]:
            self._hook_before(unraisable)
            return
        error, self._shielded, self._breakable = self._raised
        self._pending = error  # should the run end before
        self._interrupt_later(error)

    def _interrupt_later(self, error: BaseException) -> None:
        timer = threading.Timer(_LATER, self.interrupt, [error])
        timer.daemon = True
        timer.start()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        interruption, self._interruption = self._interruption, None
        if _within(frame, SignalHandling._swallowed.__code__):
            if interruption is not None:  # another: its own error follows
                self._interrupt_later(interruption)
            return
        if interruption is not None:
            self.end_by(interruption)
            return
        name = signal.Signals(number).name
        self.end_by(KeyboardInterrupt() if number == signal.SIGINT else Terminated(name))

    def end_by(self, error: BaseException) -> None:
        """Raise an error that came out of turn, or keep it for later behind the shield."""
        now = time.perf_counter()
        if not self._shielded or self._breakable:
            self._first = self._first or now
            self._raised, self._pending = (error, self._shielded, self._breakable), None
            self._shielded, self._breakable = True, False
            raise error
        if self._first and now - self._first > _PATIENCE:
            self.give_up("stopped", "the clean-up hung and was ended by another signal")
        self._first = self._first or now
        self._pending = error

    def give_up(self, status: str, reason: str) -> NoReturn:
        """End the process, from any thread, behind a call of ``last_act`` with the same."""
        words = reason
        with contextlib.suppress(Exception):
            words = f"{reason}\nrig: {self.last_act(status, reason)}"
        os.write(2, f"rig: {words}\n".encode())
        os._exit(1)


@contextlib.contextmanager
def _console_events(handle: Callable[[int], bool]) -> Iterator[None]:
    """Have Windows tell what happens to the console, by its number, until the end of the block."""
    if sys.platform != "win32":
        yield
        return
    handler = ctypes.WINFUNCTYPE(ctypes.c_int, ctypes.c_uint32)(handle)
    kernel = ctypes.WinDLL("kernel32")
    kernel.SetConsoleCtrlHandler(handler, True)
    try:
        yield
    finally:
        kernel.SetConsoleCtrlHandler(handler, False)


def _within(frame: FrameType | None, code: CodeType) -> bool:
    """Whether a function is being called at a frame of the stack."""
    while frame is not None and frame.f_code is not code:
        frame = frame.f_back
    return frame is not None
