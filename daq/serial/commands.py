"""A run's commands by tick: the host's queue of those to send, the device's of those to play."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from daq.errors import DeviceError
from daq.hal import CHANNELS, Flag, Mode
from daq.serial import messages
from daq.serial.messages import Codes

_RESEND = 0.15  # s without progress until commands are sent again
_REWIND = 0.05  # s between two repetitions that a device asked for


class CommandStream:
    """The host's commands, from the program to the device's queue, in frames of ``chunk`` at most.

    given, sent, taken: tick after the last command that the program has given, that was sent, and
    that the device has received in order. Nothing is sent without credit from the device.
    """

    def __init__(self, queue: int, chunk: int, now: float = 0.0) -> None:
        self.given = self.sent = self.taken = 0
        self._credit = 0  # until the device has answered
        self._chunk = chunk
        self._ring = np.zeros((2 * queue, len(CHANNELS)), messages.COMMAND_DTYPE)
        self._progress_time, self._rewind_time = now, 0.0

    @property
    def room(self) -> int:
        """Commands that may still be given."""
        return max(0, self._credit - self.given)

    @property
    def preloaded(self) -> bool:
        """Whether the device has all commands given, or as many as it has room for."""
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
            self._progress_time = now
        self.given = max(self.given, end)

    def chunks(self, now: float) -> Iterator[tuple[int, Codes]]:
        """First tick and codes of what may be sent now, a frame at a time."""
        end = min(self.given, self._credit)
        while self.sent < end:
            first, self.sent = self.sent, min(self.sent + self._chunk, end)
            self._progress_time = now
            yield first, self._ring[np.arange(first, self.sent) % len(self._ring)]

    def acknowledge(self, until: int, credit: int, now: float) -> None:
        """Note the ticks before which the device has commands, and before which it has room."""
        if until > self.taken:
            self.taken = until
            self._progress_time = now
        self.sent = max(self.sent, min(self.taken, self.given))
        self._credit = max(self._credit, credit)

    def lags(self, now: float) -> bool:
        """Whether commands sent have been unacknowledged for so long that they must be lost."""
        return self.taken < self.sent and now - self._progress_time > _RESEND

    def lacks(self, until: int, now: float) -> bool:
        """Whether a device with commands up to ``until`` has missed the next ones sent."""
        return until == self.taken < self.sent and now - self._rewind_time > _REWIND

    def rewind(self, now: float) -> int:
        """Send again from the first command that the device lacks; how many that are."""
        resent = self.sent - self.taken
        self.sent = self.taken
        self._rewind_time = self._progress_time = now
        return resent


class CommandRing:
    """The device's commands, in a ring as a microcontroller has it.

    In open loop they arrive in order. In closed loop a tick whose frame was lost is a hole, in
    which the command before is held. A slot belongs to tick t until t has been played.

    tick: the next to be played. until: tick after the last command. late: commands that came after
    their tick.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._codes = np.zeros((size, len(CHANNELS)), dtype=messages.COMMAND_DTYPE)
        self._owner = np.full(size, -1, dtype=np.int64)
        self._last = np.zeros(len(CHANNELS), dtype=messages.COMMAND_DTYPE)
        self.restart(Mode.CLOSED_LOOP)

    def restart(self, mode: Mode) -> None:
        """Forget everything; the next tick is 0."""
        self._mode = mode
        self.tick = self.until = self.late = 0
        self.forget()

    def forget(self) -> None:
        """Drop what is queued; what is held from now on is zero."""
        self._owner[:] = -1
        self._last[:] = 0

    @property
    def credit_until(self) -> int:
        """First tick for which there is no slot yet."""
        return self.tick + self.size

    def put(self, first: int, codes: Codes) -> bool:
        """Queue commands for ticks from ``first`` on; whether they followed without a hole.

        Ticks already past are late: counted, and never applied to another tick. In open loop a
        hole is refused, for the host to send again from ``until``.
        """
        if self._mode is Mode.OPEN_LOOP and first > self.until:
            return False
        if first >= self.credit_until:
            return True  # none is kept
        end = min(first + len(codes), self.credit_until)
        begin = max(first, self.tick)
        if self._mode is Mode.CLOSED_LOOP:
            self.late += min(max(self.tick - first, 0), len(codes))
        if end > begin:
            ticks = np.arange(begin, end)
            self._codes[ticks % self.size] = codes[begin - first : end - first]
            self._owner[ticks % self.size] = ticks
        self.until = max(self.until, end)
        return True

    def take(self, n: int) -> tuple[Codes, npt.NDArray[np.uint32]]:
        """Commands (n, 2) of the next n ticks, and their flags.

        Where one is missing, closed loop holds the command before it; in open loop all commands
        from there on are zero.
        """
        ticks = np.arange(self.tick, self.tick + n)
        slots = ticks % self.size
        queued = self._owner[slots] == ticks
        codes, flags = self._codes[slots], np.zeros(n, dtype=np.uint32)
        if not queued.all() and self._mode is Mode.OPEN_LOOP:
            missing = int(np.argmin(queued))
            codes[missing:], flags[missing:] = 0, int(Flag.UNDERFLOW)
        elif not queued.all():
            flags[~queued] = int(Flag.HELD)
            # Each hole takes the row of the last command before it, or what was held before.
            rows = np.maximum.accumulate(np.where(queued, np.arange(n), -1))
            codes = np.where(rows[:, None] < 0, self._last, codes[np.maximum(rows, 0)])
        self._last = codes[-1].copy()
        self.tick += n
        return codes, flags
