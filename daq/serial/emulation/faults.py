"""Deliberate faults of the line and the device, for ``rig emulate --fault``."""

import math
import random
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from daq.errors import ConfigError, suggestion
from daq.hal import Phase

# name: (default value or None when one must be given, what it does)
KINDS: dict[str, tuple[float | None, str]] = {
    "bit-errors": (None, "probability that a byte on the line has a bit turned"),
    "drop": (None, "probability that a frame is lost"),
    "duplicate": (None, "probability that a frame comes twice"),
    "split": (None, "frames arrive in pieces of so many bytes"),
    "merge": (None, "bytes are handed on only every so many seconds, as by a slow USB adapter"),
    "delay": (None, "every frame arrives so many seconds late"),
    "jitter": (None, "every frame arrives up to so many seconds late"),
    "stall": (0.5, "nothing is sent for so many seconds, while sampling goes on"),
    "disconnect": (0.5, "the cable is pulled, and is back after so many seconds"),
    "reboot": (0.3, "the device restarts, which takes so many seconds"),
    "overflow": (100.0, "so many samples are dropped as if the line were full"),
    "version": (2.0, "the device claims to speak this version of the protocol"),
    "mute": (1.0, "the device never answers"),
    "garbage": (1.0, "the device answers with random bytes"),
    "stuck-encoder": (1.0, "the counter stands still"),
}
EVENTS = frozenset({"stall", "disconnect", "reboot", "overflow"})  # once; others last from then on
_PIECE_SECONDS = 1e-4  # between the pieces of a frame that arrives split


@dataclass(frozen=True)
class Fault:
    """One fault, from the emulator's start or from ``after`` seconds into a phase of a run."""

    name: str
    value: float
    phase: Phase | None = None
    after: float = 0.0


def parse(text: str) -> Fault:
    """``NAME[=VALUE][@PHASE[+SECONDS]]``, such as ``drop=0.01`` or ``disconnect@run+0.5``."""
    setting, _, instant = text.partition("@")
    name, _, value = setting.partition("=")
    if name not in KINDS:
        near = suggestion(name, list(KINDS))
        raise ConfigError(f"--fault {text}: unknown fault {name!r}; {near}")
    default = KINDS[name][0]
    if not value and default is None:
        raise ConfigError(f"--fault {text}: give a value, {name}=NUMBER: {KINDS[name][1]}")
    phase_name, _, after = instant.partition("+")
    phases = {phase.value: phase for phase in Phase}
    if instant and phase_name not in phases:
        near = suggestion(phase_name, list(phases))
        raise ConfigError(f"--fault {text}: unknown phase {phase_name!r}; {near}")
    size = _number(value, text) if value else default or 0.0
    seconds = _number(after, text) if after else 0.0
    return Fault(name, size, phases.get(phase_name), seconds)


def _number(text: str, option: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise ConfigError(f"--fault {option}: {text!r} is not a number of 0 or more")
    return value


class Line:
    """One direction of a line, on which bytes may arrive late, damaged, or not at all."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._partial = b""
        self._due: deque[tuple[float, bytes]] = deque()
        self._last_arrival = 0.0

    def put(self, data: bytes, now: float, faults: Mapping[str, float]) -> None:
        """Send bytes at ``now`` [s]; faults: values of those that act now, by name."""
        if not faults:
            self._due.append((max(now, self._last_arrival), self._partial + data))
            self._partial = b""
            return
        *pieces, self._partial = (self._partial + data).split(b"\0")
        for piece in pieces:
            if piece and self._random.random() >= faults.get("drop", 0.0):
                is_doubled = self._random.random() < faults.get("duplicate", 0.0)
                for _ in range(2 if is_doubled else 1):
                    self._schedule(self._damaged(b"\0" + piece + b"\0", faults), now, faults)

    def ready(self, now: float) -> bytes:
        """Bytes that have arrived by ``now`` [s]."""
        arrived = []
        while self._due and self._due[0][0] <= now:
            arrived.append(self._due.popleft()[1])
        return b"".join(arrived)

    def next_arrival(self) -> float:
        """When the next bytes arrive; infinity when none are on the way."""
        return self._due[0][0] if self._due else math.inf

    def clear(self) -> None:
        """Lose all bytes on the way."""
        self._due.clear()
        self._partial = b""

    def _damaged(self, frame: bytes, faults: Mapping[str, float]) -> bytes:
        rate = faults.get("bit-errors", 0.0)
        if rate == 0.0:
            return frame
        damaged = bytearray(frame)
        for at in range(len(damaged)):
            if self._random.random() < rate:
                damaged[at] ^= 1 << self._random.randrange(8)
        return bytes(damaged)

    def _schedule(self, frame: bytes, now: float, faults: Mapping[str, float]) -> None:
        arrival = now + faults.get("delay", 0.0) + faults.get("jitter", 0.0) * self._random.random()
        merge = faults.get("merge", 0.0)
        if merge > 0.0:
            arrival = math.ceil(arrival / merge) * merge
        # A serial line keeps the order.
        arrival = max(arrival, self._last_arrival)
        size = int(faults.get("split", 0.0)) or len(frame)
        for index, begin in enumerate(range(0, len(frame), size)):
            self._last_arrival = arrival + index * _PIECE_SECONDS
            self._due.append((self._last_arrival, frame[begin : begin + size]))
