"""The host's side of a run's commands: given by the program, sent as the device has room."""

from collections.abc import Iterator

import numpy as np

from daq.errors import DeviceError
from daq.hal import CHANNELS
from daq.serial import messages
from daq.serial.messages import Codes

_RESEND = 0.15  # s without progress until commands are sent again
_REWIND = 0.05  # s between two repetitions that a device asked for


class CommandStream:
    """Commands by tick, from the program to the device's queue, in frames of ``chunk`` at most.

    given, sent: tick after the last command of the program, and on the line. taken: tick after the
    last that the device has received in order. Nothing is sent without credit.
    """

    def __init__(self, queue: int, chunk: int, now: float = 0.0) -> None:
        self._chunk = chunk
        self.given = self.sent = self.taken = 0
        self._credit = 0  # until the device has answered
        self._ring = np.zeros((2 * queue, len(CHANNELS)), messages.COMMAND_DTYPE)
        self._progress, self._rewound = now, 0.0

    @property
    def room(self) -> int:
        """Commands that may still be given."""
        return max(0, self._credit - self.given)

    @property
    def preloaded(self) -> bool:
        """Whether the device has all that fits it of what was given."""
        return self.taken >= min(self.given, self._credit)

    def give(self, tick: int, codes: Codes, now: float) -> None:
        """Queue commands (n, 2) from ``tick`` on; DeviceError for more than there is room."""
        end = tick + len(codes)
        if end - min(self.taken, tick) > len(self._ring):
            raise DeviceError(
                f"{end - self.given} more commands than the device takes now; "
                "send no more than room() says"
            )
        self._ring[np.arange(tick, end) % len(self._ring)] = codes
        if self.sent == self.given:
            self.sent = max(self.sent, tick)
            self._progress = now
        self.given = max(self.given, end)

    def chunks(self, now: float) -> Iterator[tuple[int, Codes]]:
        """First tick and codes of what may be sent now, a frame at a time."""
        end = min(self.given, self._credit)
        while self.sent < end:
            first, self.sent = self.sent, min(self.sent + self._chunk, end)
            self._progress = now
            yield first, self._ring[np.arange(first, self.sent) % len(self._ring)]

    def acknowledge(self, until: int, credit: int, now: float) -> None:
        """Note what the device has, and for which ticks it has room."""
        if until > self.taken:
            self.taken = until
            self._progress = now
        self.sent = max(self.sent, min(self.taken, self.given))
        self._credit = max(self._credit, credit)

    def lags(self, now: float) -> bool:
        """Whether what was sent has not arrived for so long that it must have been lost."""
        return self.taken < self.sent and now - self._progress > _RESEND

    def lacks(self, until: int, now: float) -> bool:
        """Whether a device that has commands until this tick misses those that were sent next."""
        return until == self.taken < self.sent and now - self._rewound > _REWIND

    def rewind(self, now: float) -> int:
        """Go back to what the device lacks; the number of commands to be sent again."""
        resent = self.sent - self.taken
        self.sent = self.taken
        self._rewound = self._progress = now
        return resent
