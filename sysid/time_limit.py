"""An end for code of a user's own that has none."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

AT_A_POINT = 2.0
"""Seconds of computing for equations at one point; honest ones take microseconds."""
AT_LENGTH = 30.0
"""Seconds of computing for what reads whole records, imports or draws."""
_AGAIN = 1.0  # s between alarms, for code that catches the first


class _Overdue(BaseException):
    """No Exception, which the code itself might catch and go on."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Within it, Python code that does not end is stopped: TimeoutError names function and line.

    seconds: of processor time, so that a busy machine is no cause. Only the main thread has a
    limit, and none on Windows, where nothing but Ctrl-C ends such code; compiled code is stopped
    nowhere before it returns.

    >>> with time_limit(0.01):
    ...     while True:
    ...         pass
    Traceback (most recent call last):
    TimeoutError: it has no end within 0.01 s of computing and is at line ... of <doctest ...
    """
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(_: int, frame: FrameType | None) -> None:
        assert frame is not None
        code = frame.f_code
        raise _Overdue(f"line {frame.f_lineno} of {code.co_filename}, in {code.co_name}")

    handler = signal.signal(signal.SIGPROF, stop)
    timer = signal.setitimer(signal.ITIMER_PROF, seconds, _AGAIN)
    try:
        yield
    except _Overdue as overdue:
        raise TimeoutError(
            f"it has no end within {seconds:g} s of computing and is at {overdue}; give every loop "
            "an end, such as 'for _ in range(50)'"
        ).with_traceback(overdue.__traceback__) from None
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, handler)
        signal.setitimer(signal.ITIMER_PROF, *timer)
