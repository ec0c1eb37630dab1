"""Errors of the package."""


class Error(Exception):
    """Base of them."""


class DaqNotFoundError(Error):
    """There is no driver."""


class DaqNotSupportedError(Error):
    """There is none for this system."""


class DaqError(Error):
    """An error of the driver."""

    def __init__(self, message, error_code, task_name=""):
        super().__init__(f"{message}\n\nTask Name: {task_name}\n\nStatus Code: {error_code}")
        self._error_code = int(error_code)

    @property
    def error_code(self):
        """Its number."""
        return self._error_code


class DaqReadError(DaqError):
    """Of a read, with what was read."""

    def __init__(self, message, error_code, samps_per_chan_read, task_name=""):
        super().__init__(message, error_code, task_name)
        self.samps_per_chan_read = samps_per_chan_read


class DaqWriteError(DaqError):
    """Of a write, with what was written."""

    def __init__(self, message, error_code, samps_per_chan_written, task_name=""):
        super().__init__(message, error_code, task_name)
        self.samps_per_chan_written = samps_per_chan_written
