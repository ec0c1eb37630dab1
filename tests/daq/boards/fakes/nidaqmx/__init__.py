"""A fake of the package ``nidaqmx`` and the driver below it, as far as a rig needs them.

Signatures, enumerations and numbers of errors are those of the package, with which a test compares
them where it is installed; arrays are checked as the package hands them to the driver. What the
driver reports as an error raises ``DaqError`` with its number.
"""

from nidaqmx._driver import Task
from nidaqmx.errors import DaqError

__all__ = ["DaqError", "Task"]
