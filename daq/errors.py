"""Errors that a user can meet, each with the exit status it ends the command with."""

from __future__ import annotations

from pathlib import Path


class RigError(Exception):
    """Base of all expected errors; the message names what is wrong and the cure."""

    exit_status = 1


class ConfigError(RigError):
    """Wrong usage, configuration or input file: nothing was energised (exit status 2)."""

    exit_status = 2


class DeviceError(RigError):
    """The device failed or cannot do what was asked."""


class RunError(RigError):
    """A run ended before its time; the log holds what was measured until then."""


class InterlockError(RunError):
    """A measured quantity passed its limit; the outputs were zeroed."""


class Terminated(BaseException):
    """The process was asked to end by the named signal; raised so that the rig is made safe first.

    ``str`` of it is the signal's name, for example SIGTERM.
    """


def line_in(error: BaseException, file: Path) -> int | None:
    """The last line of a file that an error passed through; None where it did not."""
    line, trace = None, error.__traceback__
    while trace is not None:
        if same_file(trace.tb_frame.f_code.co_filename, file):
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


def same_file(name: str | None, path: Path) -> bool:
    """Whether the name of a file in an error means a path."""
    return name is not None and Path(name).resolve() == path.resolve()
