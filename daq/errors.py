"""Errors that a user can meet, each with the exit status it ends the command with."""

from __future__ import annotations


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
