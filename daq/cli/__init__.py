"""The ``rig`` command."""

from __future__ import annotations

import sys


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
    except Terminated:
        report_error("stopped by SIGTERM; outputs are zero")
        sys.exit(1)
    except KeyboardInterrupt:
        report_error("stopped by Ctrl-C")
        sys.exit(1)
    except BrokenPipeError:
        # The reader of our output has gone (``rig models | head``): nothing left to say.
        sys.stderr.close()
        sys.exit(0)
