"""What a limit is, and judging a block of samples at little cost."""

import abc
import math

import numpy as np
import numpy.typing as npt

from daq.config.base import Section
from daq.hal import Phase, Samples

Trip = tuple[int, str]
"""Row of a block of samples that is beyond a limit, and the reason in words."""

TURN = 2.0 * math.pi


class Limit(abc.ABC):
    """Something that must hold in every sample of every phase.

    A run makes an object of its own: ``Options`` of the class, checked against the rig's file,
    are given to the constructor; a class without them is made without arguments.
    """

    Options: type[Section] | None = None
    stops: bool = True
    """Whether it ends the run. Else ``check`` looks at all rows of a block all the same, the first
    beyond is flagged, and the record and the end of the run say why."""
    tells_faults: bool = False
    """Whether it tells hardware that fails: what a healthy rig of the file's ratings never shows,
    however it is driven."""

    def begin(self, phase: Phase, sample_rate: float) -> None:  # noqa: B027
        """A phase begins: ticks and time count from zero again. sample_rate in Hz."""

    def window(self) -> tuple[float, float]:
        """Angles [rad] from the first of the phase that has begun which the shaft may not leave.

        The device watches them itself, where it can, beside ``check``.
        """
        return -math.inf, math.inf

    @abc.abstractmethod
    def check(self, samples: Samples) -> Trip | None:
        """The first row of a block (n >= 1) that is beyond the limit, and why; else None.

        Every sample that arrives is shown once and in order. The reason completes the sentence
        "interlock in sample k: ...".
        """


def first_row(beyond: npt.NDArray[np.bool_]) -> int | None:
    """The first row of those that are beyond a limit; None without any."""
    return int(np.argmax(beyond)) if beyond.any() else None
