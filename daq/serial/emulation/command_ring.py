"""The device's queue of commands."""

import numpy as np
import numpy.typing as npt

from daq.hal import CHANNELS, Flag, Mode
from daq.serial import messages
from daq.serial.messages import Codes


class CommandRing:
    """Commands by tick, in a ring as a microcontroller has it.

    In open loop they arrive in order. In closed loop a tick whose frame was lost is a hole, in
    which the command before is held. A slot belongs to tick t until t has been played.

    tick: the next to be played. until: tick after the last command. late: commands that came after
    their tick.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._codes = np.zeros((size, len(CHANNELS)), dtype=messages.COMMAND_DTYPE)
        self._owner = np.full(size, -1, dtype=np.int64)
        self.restart(Mode.CLOSED_LOOP)

    def restart(self, mode: Mode) -> None:
        """Forget everything; the next tick is 0."""
        self._mode = mode
        self._owner[:] = -1
        self._last = np.zeros(len(CHANNELS), dtype=messages.COMMAND_DTYPE)
        self.tick = self.until = self.late = 0

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

        Where a command is missing, the one before is held in closed loop; in open loop zero stands
        from there on.
        """
        ticks = np.arange(self.tick, self.tick + n)
        slots = ticks % self.size
        queued = self._owner[slots] == ticks
        codes = self._codes[slots]
        flags = np.zeros(n, dtype=np.uint32)
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
        self.until = max(self.until, self.tick)
        return codes, flags
