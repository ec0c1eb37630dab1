"""The simulated device's queue of commands by tick."""

from collections import deque

import numpy as np

from daq.hal import CHANNELS, Flag, FloatArray, IntArray, Mode

SIZE = 65_536

_HELD, _UNDERFLOW = int(Flag.HELD), int(Flag.UNDERFLOW)


class CommandQueue:
    """Commands by tick, and what stands for a missing one.

    In closed loop the last command is held and flagged; in open loop the outputs are latched at
    zero. ``latched`` outputs stay zero, whatever is queued, until the next ``restart``.
    """

    def __init__(self, mode: Mode = Mode.CLOSED_LOOP) -> None:
        self.restart(mode)

    def restart(self, mode: Mode) -> None:
        """Forget everything; the next tick is 0."""
        self._is_closed_loop = mode is Mode.CLOSED_LOOP
        self.tick = 0
        self.latch()
        self.latched = False

    def latch(self) -> None:
        """Forget all commands; the outputs are zero from the next tick on."""
        self._waiting: deque[FloatArray] = deque()
        self._until = self.tick
        self._last = np.zeros((1, len(CHANNELS)))
        self.latched = True

    @property
    def queued(self) -> int:
        """Ticks for which commands are waiting."""
        return self._until - self.tick

    def put(self, tick: int, commands: FloatArray) -> None:
        """Append commands (n, 2) from ``tick`` on; those for ticks already past are dropped."""
        late = max(0, self.tick - tick)
        if late < len(commands):
            if not self.latched:
                self._waiting.append(commands[late:] if late else commands)
            self._until = tick + len(commands)

    def take(self, n: int) -> tuple[FloatArray, IntArray]:
        """Commands (n, 2) for the next n ticks and their flags; ``advance`` lets the ticks pass."""
        flags = np.zeros(n, dtype=np.int64)
        if self.latched:
            return np.zeros((n, len(CHANNELS))), flags
        if self._waiting and len(self._waiting[0]) == n:
            self._last = self._waiting.popleft()
            return self._last.copy(), flags
        applied = np.zeros((n, len(CHANNELS)))
        filled = 0
        while filled < n and self._waiting:
            head = self._waiting.popleft()
            count = min(n - filled, len(head))
            applied[filled : filled + count] = head[:count]
            if count < len(head):
                self._waiting.appendleft(head[count:])
            filled += count
        if filled:
            self._last = applied[filled - 1 : filled].copy()
        if filled < n and self._is_closed_loop:
            applied[filled:], flags[filled:] = self._last[-1], _HELD
        elif filled < n and self.tick + filled > 0:
            flags[filled:] = _UNDERFLOW
            self.latched = True
        return applied, flags

    def advance(self, n: int) -> None:
        """Let n ticks pass."""
        self.tick += n
        self._until = max(self._until, self.tick)
