"""The ``rig`` command."""

from __future__ import annotations

import sys
from typing import NoReturn

_INTERRUPTED = 130  # what Typer makes of Ctrl-C


def main() -> None:
    """Run the command line; expected errors end it with their message and exit status."""
    from daq.cli.app import app
    from daq.cli.console import report_error
    from daq.errors import RigError, Terminated

    try:
        app()
    except RigError as error:
        report_error(str(error))
        sys.exit(error.exit_status)
    except Terminated as signal:
        report_error(f"stopped by {signal}; outputs are zero")
        sys.exit(1)
    except KeyboardInterrupt:
        _stopped()
    except SystemExit as exit:
        if exit.code == _INTERRUPTED:
            _stopped()
        raise


def _stopped() -> NoReturn:
    from daq.cli.console import report_error

    report_error("stopped by Ctrl-C")
    sys.exit(1)
