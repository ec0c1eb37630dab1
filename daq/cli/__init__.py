"""The ``rig`` command."""

import os
import signal
import sys
import threading
from types import FrameType

from daq.errors import RigError, Terminated

_INTERRUPTED = 130  # what Typer makes of Ctrl-C


def main() -> None:
    """Run the command line; expected errors end it with their message and exit status."""
    _hear_signals()
    end: BaseException | None = None
    try:
        # Ctrl-C may come while this is imported, too.
        from daq.cli.app import app

        app()
    except BaseException as error:
        end = error
    # What is left is to say how it ended: another Ctrl-C has nothing to stop there, nor while the
    # interpreter shuts down. ``_interrupt`` keeps the way from above to here free of them.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(_status(end))


def _hear_signals() -> None:
    """Ctrl-C and SIGTERM raise, unless this process was started with them ignored."""
    defaults = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if threading.current_thread() is threading.main_thread():
        for number, handler in defaults.items():
            if signal.getsignal(number) is handler:
                signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if frame is not None and frame.f_code is main.__code__:
        return  # the command has ended, and nothing would catch what is raised here
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise Terminated(signal.Signals(number).name)


def _status(end: BaseException | None) -> int | str | None:
    """Exit status of a command that ended like this, once its message is on standard error."""
    # Whether it was a print that failed shows when another fails likewise.
    unwritten = _finish_output("\n" if isinstance(end, OSError) else "")
    if isinstance(end, OSError) and unwritten is not None and end.errno == unwritten.errno:
        end = None
    if isinstance(end, RigError):
        return _report(end, str(end), end.exit_status)
    if isinstance(end, Terminated):
        return _report(end, f"stopped by {end}")
    if isinstance(end, KeyboardInterrupt):
        return _report(end, "stopped by Ctrl-C")
    if isinstance(end, SystemExit):
        if end.code == _INTERRUPTED:
            return _report(end, "stopped by Ctrl-C")
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


def _report(error: BaseException, message: str, status: int = 1) -> int:
    """Say a message, behind the notes of the error and of those that led to it."""
    from daq.cli.terminal import report_error

    cause: BaseException | None = error
    while cause is not None:
        for note in getattr(cause, "__notes__", ()):
            report_error(note)
        cause = cause.__context__
    report_error(message)
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
