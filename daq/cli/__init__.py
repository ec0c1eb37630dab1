"""The ``rig`` command."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
from collections.abc import Sequence
from io import TextIOWrapper
from types import FrameType

from daq.errors import Mistake, RigError, Terminated
from daq.process import signal_main_thread

_INTERRUPTED = 130  # what Typer makes of Ctrl-C
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # where there is such a signal
# New objects between two searches for what only refers to itself. By Python's 700 there are
# hundreds of searches while modules are loaded and figures drawn, in vain.
_BETWEEN_COLLECTIONS = 50_000
_LATER = 0.02  # s until a signal whose error Python swallowed is sent once more


def main() -> None:
    """Run the command line; expected errors end it with their message and exit status."""
    ended: list[bool] = []
    swallowed: list[BaseException] = []
    heard = _hear_signals(ended, swallowed)
    end: BaseException | None = None
    try:
        gc.set_threshold(_BETWEEN_COLLECTIONS)
        _choose_encodings()
        # Ctrl-C may come while this is imported, too.
        from daq.cli.app import app

        app()
    except BaseException as error:
        end = error
    # What is left is to say how it ended: another signal has nothing to stop there. The way from
    # above to here is kept free of them by their handler, and so is the ignoring itself, which
    # Python does in Python.
    ended.append(True)
    for number in heard:
        signal.signal(number, signal.SIG_IGN)
    # What a compiler says that was interrupted in a callback is no news.
    if swallowed and isinstance(end, Exception):
        end = swallowed[0]
    status = _status(end)
    if _is_stopped(end):
        # The interpreter would wait for threads and, while it winds up, die of the next signal.
        sys.stderr.flush()
        os._exit(1)
    for number in heard:
        if number != signal.SIGINT:
            signal.signal(number, signal.SIG_DFL)
    sys.exit(status)


def _choose_encodings() -> None:
    """Have every sign written: in files and pipes of Windows as UTF-8, where it has none as '?'.

    Python would take the code page of the country there, which has neither rules of tables nor
    most Greek letters, and end with a UnicodeEncodeError; from 3.15 on it takes UTF-8 (PEP 686).
    """
    for stream in (sys.stdout, sys.stderr):
        if not isinstance(stream, TextIOWrapper):
            continue  # closed before this program began
        if sys.platform == "win32" and not stream.isatty():
            stream.reconfigure(encoding="utf-8")
        if stream.errors == "strict":
            stream.reconfigure(errors="replace")


def _hear_signals(ended: Sequence[bool], swallowed: list[BaseException]) -> list[int]:
    """Have signals that end a program raise, but those ignored from its start; which they are.

    ended: not empty once there is nothing left to end. swallowed: what was raised where Python
    cannot raise, as in a callback of compiled code, until the signal is sent once more.
    """
    if threading.current_thread() is not threading.main_thread():
        return []
    numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    defaults = (signal.default_int_handler, signal.SIG_DFL)
    heard = [number for number in numbers if signal.getsignal(number) in defaults]

    raised: dict[int, BaseException] = {}
    hook = sys.unraisablehook

    def interrupt(number: int, frame: FrameType | None) -> None:
        if ended or (frame is not None and frame.f_code is main.__code__):
            return  # the command has ended, and nothing would catch what is raised here
        swallowed.clear()
        name = signal.Signals(number).name
        raised[number] = KeyboardInterrupt() if number == signal.SIGINT else Terminated(name)
        raise raised[number]

    def again(number: int) -> None:
        if not ended:
            signal_main_thread(signal.Signals(number))

    def swallow(unraisable: sys.UnraisableHookArgs) -> None:
        for number, error in raised.items():
            if unraisable.exc_value is error:
                swallowed.append(error)
                timer = threading.Timer(_LATER, again, [number])
                timer.daemon = True
                timer.start()
                return
        hook(unraisable)

    sys.unraisablehook = swallow
    for number in heard:
        signal.signal(number, interrupt)
    return heard


def _status(end: BaseException | None) -> int | str | None:
    """Exit status of a command that ended like this, once its message is on standard error."""
    # Whether it was a print that failed shows when another fails likewise.
    unwritten = _finish_output("\n" if isinstance(end, OSError) else "")
    if isinstance(end, OSError) and unwritten is not None and end.errno == unwritten.errno:
        end = None
    if isinstance(end, RigError):
        return _report(end, str(end), end.exit_status)
    if end is not None and _is_stopped(end):
        return _report(end, f"stopped by {_stopper(end)}")
    if isinstance(end, SystemExit):
        if end.code or unwritten is None:
            return end.code
    elif end is not None:
        raise end
    if unwritten is None:
        return 0
    if isinstance(unwritten, BrokenPipeError):
        return 1  # whoever read it has enough
    message = f"standard output cannot be written: {unwritten.strerror}"
    return _report(unwritten, f"{message}. Files that the command has written are whole")


def _is_stopped(end: BaseException | None) -> bool:
    """Whether a signal ended the command."""
    interrupted = isinstance(end, SystemExit) and end.code == _INTERRUPTED
    return interrupted or isinstance(end, KeyboardInterrupt | Terminated)


def _stopper(end: BaseException | None) -> str:
    """Who ended a command: a signal's name, or what the run that was stopped says."""
    while end is not None:
        if isinstance(end, KeyboardInterrupt | Terminated) and str(end):
            return str(end)
        end = end.__context__
    return "Ctrl-C"


def _report(error: BaseException, message: str, status: int = 1) -> int:
    """Say a message, behind the notes of the error and of those that led to it."""
    from daq.cli.terminal import print_json_error, report_error

    notes: list[str] = []
    cause: BaseException | None = error
    while cause is not None:
        notes += getattr(cause, "__notes__", ())
        cause = cause.__context__
    mistakes = error.mistakes if isinstance(error, RigError) else (Mistake(message),)
    with contextlib.suppress(OSError):  # its reader is gone
        print_json_error(mistakes, notes, status)
    with contextlib.suppress(OSError):  # its terminal is gone
        for line in (*notes, message):
            report_error(line)
    return status


def _finish_output(last: str) -> OSError | None:
    """Have standard output written; why it cannot be. The interpreter then does not try again."""
    if sys.stdout is None:
        return None  # closed before this program began
    try:
        sys.stdout.write(last)
        sys.stdout.flush()
        return None
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return error
