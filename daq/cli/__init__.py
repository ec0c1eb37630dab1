"""The ``rig`` command."""

import sys
from typing import NoReturn

from daq.errors import RigError, Terminated

_INTERRUPTED = 130  # what Typer makes of Ctrl-C


def main() -> None:
    """Run the command line; expected errors end it with their message and exit status."""
    try:
        # Ctrl-C may come while these are imported, too.
        from daq.cli.app import app
        from daq.cli.terminal import report_error

        app()
    except RigError as error:
        _report_notes(error)
        report_error(str(error))
        sys.exit(error.exit_status)
    except Terminated as signal:
        _report_notes(signal)
        report_error(f"stopped by {signal}; outputs are zero")
        sys.exit(1)
    except KeyboardInterrupt as interrupt:
        _stopped(interrupt)
    except SystemExit as exit:
        if exit.code == _INTERRUPTED:
            _stopped(exit)
        raise


def _stopped(error: BaseException) -> NoReturn:
    from daq.cli.terminal import report_error

    _report_notes(error)
    report_error("stopped by Ctrl-C")
    sys.exit(1)


def _report_notes(error: BaseException | None) -> None:
    """What an error, or the one behind it, has to say besides."""
    from daq.cli.terminal import report_error

    while error is not None:
        for note in getattr(error, "__notes__", ()):
            report_error(note)
        error = error.__context__
