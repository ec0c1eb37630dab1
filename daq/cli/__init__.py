"""The ``rig`` command."""

import sys
from typing import NoReturn

from daq.errors import RigError, Terminated

_INTERRUPTED = 130  # what Typer makes of Ctrl-C


def main() -> None:
    """Run the command line; expected errors end it with their message and exit status."""
    try:
        # Ctrl-C may come while this is imported, too.
        from daq.cli.app import app

        app()
    except RigError as error:
        _end(error, str(error), error.exit_status)
    except Terminated as signal:
        _end(signal, f"stopped by {signal}")
    except KeyboardInterrupt as interrupt:
        _end(interrupt, "stopped by Ctrl-C")
    except SystemExit as exit:
        if exit.code == _INTERRUPTED:
            _end(exit, "stopped by Ctrl-C")
        raise


def _end(error: BaseException, message: str, status: int = 1) -> NoReturn:
    """Exit with a message, behind the notes of the error and of those that led to it."""
    from daq.cli.terminal import report_error

    cause: BaseException | None = error
    while cause is not None:
        for note in getattr(cause, "__notes__", ()):
            report_error(note)
        cause = cause.__context__
    report_error(message)
    sys.exit(status)
