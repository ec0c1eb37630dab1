"""The host's side of the protocol: sessions, retries, credit, gaps. No I/O, no clock of its own.

A program around it feeds bytes (``feed``), calls ``poll`` every few milliseconds and writes
what ``take`` gives. Times are seconds of the host's monotonic clock.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from daq.errors import DeviceError
from daq.hal import CHANNELS
from daq.serial import codec, messages
from daq.serial.clock import ClockEstimator
from daq.serial.codec import Decoder, Frame
from daq.serial.messages import (
    Block,
    Codes,
    Latch,
    Reply,
    Result,
    Start,
    State,
    Status,
    Type,
    Welcome,
)

RETRY = 0.1  # s until a request is sent again
HELLO_RETRY = 0.2
GIVE_UP = 1.0  # s until a request that nobody answers fails
SILENCE = 1.0  # s without a sample until a run fails
_RESEND = 0.15  # s without progress until commands are sent again
_REWIND = 0.05  # s between two repetitions that a device asked for
_CHUNK = 256  # ticks in a frame of commands at most

_REASONS = {
    Result.WRONG_STATE: "is in a state in which it cannot",
    Result.BAD_VALUE: "finds a value beyond what it can do",
    Result.LATCHED: "holds its outputs at zero since its watchdog tripped",
    Result.UNKNOWN: "does not know the request; its firmware is incomplete",
}


@dataclass
class _Request:
    """One outstanding request."""

    type: Type
    seq: int
    frame: bytes
    interval: float
    give_up: float
    sent: float


@dataclass
class Counters:
    """What went wrong on the line and was noticed, for the record of the run."""

    lost_samples: int = 0
    duplicate_blocks: int = 0
    missing_frames: int = 0
    malformed: int = 0
    retries: int = 0
    resent_commands: int = 0
    longest_pause: float = 0.0
    """Longest time in which the device's watchdog was not fed [s]."""


class HostMachine:
    """One session with a device.

    blocks: samples received, in order, for the program to take. failure: set once, when the
    session cannot go on. welcome: who answered. status: the newest word of the device.
    """

    def __init__(self, session: int, host: str) -> None:
        self.session = session
        self.decoder = Decoder()
        self.clock = ClockEstimator()
        self.counters = Counters()
        self.blocks: deque[Block] = deque()
        self.failure: DeviceError | None = None
        self.welcome: Welcome | None = None
        self.status: Status | None = None
        self.reply: Reply | None = None
        self.other_version: int | None = None
        self._host = host
        self._outbox: deque[bytes] = deque()
        self._request: _Request | None = None
        self._request_seq = 0
        self._seq = 0
        self._heard_seq: int | None = None
        self._run = 0
        self._start: Start | None = None
        self._going = False
        self._expected = 0
        self._ring = np.zeros((1, len(CHANNELS)), dtype=messages.COMMAND_DTYPE)
        self._asked = self._sent = self._taken = self._credit = 0
        self._progress = self._rewound = self._pinged = 0.0
        self._sample_at = self._frame_at = 0.0
        self._rejected = 0  # damaged frames, by the time of the last good one

    # --- the program around it ----------------------------------------------------------------

    def feed(self, data: bytes, now: float) -> None:
        """Take bytes that came from the line."""
        for frame in self.decoder.feed(data):
            if frame.session == self.session:
                self._take(frame, now)

    def poll(self, now: float, keep_alive: bool = True) -> None:
        """Send again what was not answered, keep the device's watchdog fed, notice silence."""
        self._retry(now)
        if self._start is None or self.failure is not None:
            return
        if keep_alive and now - self._pinged >= 0.25e-3 * self._start.watchdog:
            self.ping(now)
        stuck = self._taken < self._sent and now - self._progress > _RESEND
        if self._start.mode is messages.LoopMode.OPEN and stuck:
            self._rewind(now)
        self._pump(now)
        if self._going and now - self._sample_at > SILENCE:
            self._fail(self._silence(now))

    def take(self) -> bytes:
        """All that is to be written now."""
        data = b"".join(self._outbox)
        self._outbox.clear()
        return data

    # --- requests -----------------------------------------------------------------------------

    def hello(self, now: float, give_up: float) -> None:
        """Ask who is there; answered when ``welcome`` is set or ``other_version`` is."""
        payload = messages.Hello(self._host).pack()
        self._ask(Type.HELLO, payload, now, HELLO_RETRY, give_up)

    def ask(self, type_: Type, payload: bytes, now: float, give_up: float = GIVE_UP) -> None:
        """Send a request, in place of any that is outstanding; answered when ``reply`` is set."""
        self._ask(type_, payload, now, RETRY, give_up)

    def _ask(
        self, type_: Type, payload: bytes, now: float, interval: float, give_up: float
    ) -> None:
        self._request_seq = (self._request_seq + 1) & 0xFFFF
        frame = codec.encode(type_, self.session, self._request_seq, payload)
        self.reply = None
        self._request = _Request(type_, self._request_seq, frame, interval, now + give_up, now)
        self._outbox.append(frame)

    @property
    def waiting(self) -> bool:
        """Whether a request is outstanding."""
        return self._request is not None

    def ping(self, now: float) -> None:
        """Feed the watchdog, and learn about the clocks."""
        if self._going:
            pause = now - self._pinged
            self.counters.longest_pause = max(self.counters.longest_pause, pause)
        self._pinged = now
        self._seq = (self._seq + 1) & 0xFFFF
        payload = messages.pack_ping(round(now * 1e9))
        self._outbox.append(codec.encode(Type.PING, self.session, self._seq, payload))

    # --- the run ------------------------------------------------------------------------------

    def start(self, start: Start, now: float) -> None:
        """Arm a run; commands may follow at once."""
        assert self.welcome is not None
        self._run, self._start, self._going = start.run, start, False
        self.blocks.clear()
        self.status = None
        self._expected = 0
        self._ring = np.zeros((2 * self.welcome.queue, len(CHANNELS)), messages.COMMAND_DTYPE)
        self._asked = self._sent = self._taken = 0
        self._credit = 0  # until the device has answered
        self._progress = now
        self.ask(Type.START, start.pack(), now)

    def go(self, now: float) -> None:
        """Start the clock."""
        self._going = True
        self._sample_at = self._pinged = now
        self.ask(Type.GO, messages.pack_run(self._run), now)

    def stop(self, now: float) -> None:
        """End the run; samples still on their way are not wanted."""
        self._start, self._going = None, False
        self.blocks.clear()
        self.ask(Type.STOP, messages.pack_run(self._run), now)

    def send(self, tick: int, codes: Codes, now: float) -> None:
        """Queue commands (n, 2) from ``tick`` on; they go out as the device has room."""
        end = tick + len(codes)
        if end - min(self._taken, tick) > len(self._ring):
            raise DeviceError(
                f"{end - self._asked} more commands than the device takes now; "
                "send no more than room() says"
            )
        self._ring[np.arange(tick, end) % len(self._ring)] = codes
        if self._sent == self._asked:
            self._sent = max(self._sent, tick)
            self._progress = now
        self._asked = max(self._asked, end)
        self._pump(now)

    @property
    def room(self) -> int:
        """Commands that may still be sent."""
        return max(0, self._credit - self._asked)

    @property
    def preloaded(self) -> bool:
        """Whether the device has all that fits it of what was sent."""
        return self._taken >= min(self._asked, self._credit)

    def describe(self) -> dict[str, Any]:
        """The line's record: counts of what was noticed, and the clocks' relation."""
        relation = self.clock.relation()
        status = self.status
        return {
            "line": {
                **vars(self.counters),
                "received_bytes": self.decoder.received,
                "accepted_frames": self.decoder.accepted,
                "rejected_frames": self.decoder.rejected,
                "device_overflow_samples": status.overflow if status else 0,
                "device_late_commands": status.late if status else 0,
            },
            "clock": relation.describe() if relation else None,
        }

    # --- what comes in ------------------------------------------------------------------------

    def _take(self, frame: Frame, now: float) -> None:
        self._frame_at, self._rejected = now, self.decoder.rejected
        if frame.type == Type.SAMPLES:
            understood = self._samples(frame, now)
        elif frame.type == Type.PONG:
            understood = self._pong(frame, now)
        elif frame.type == Type.STATUS:
            self._count(frame.seq)
            status = messages.unpack_status(frame.payload)
            understood = status is not None
            if status is not None:
                self._asked_again(status, now)
                self._learn(status, now)
        elif frame.type == Type.REPLY:
            understood = self._replied(frame, now)
        else:
            understood = frame.type == Type.WELCOME and self._welcomed(frame)
        self.counters.malformed += not understood

    def _samples(self, frame: Frame, now: float) -> bool:
        block = messages.unpack_samples(frame.payload)
        if block is None:
            return False
        if block.status.run != self._run or self._start is None:
            return True  # of a run that was stopped
        if block.first < self._expected:
            self.counters.duplicate_blocks += 1
            return True
        self._count(frame.seq)
        self.counters.lost_samples += block.first - self._expected
        self._expected = block.first + len(block.records)
        self.blocks.append(block)
        self._sample_at = now
        self._learn(block.status, now)
        return True

    def _pong(self, frame: Frame, now: float) -> bool:
        unpacked = messages.unpack_pong(frame.payload)
        if unpacked is None or self.welcome is None:
            return False
        pong, status = unpacked
        middle = 0.5 * (pong.received + pong.answered) / self.welcome.clock
        self.clock.add(pong.stamp * 1e-9, middle, now)
        self._learn(status, now)
        return True

    def _replied(self, frame: Frame, now: float) -> bool:
        unpacked = messages.unpack_reply(frame.payload)
        if unpacked is None:
            return False
        reply, status = unpacked
        if reply.result is Result.NO_SESSION:
            if self.welcome is not None:
                self._fail(
                    "the device has restarted and forgotten the run; its outputs are zero. Look "
                    "for a supply that breaks down, a reset by the port, or firmware that crashed"
                )
            return True
        self._learn(status, now)
        if self._request is not None and frame.seq == self._request.seq:
            self.reply, self._request = reply, None
        return True

    def _welcomed(self, frame: Frame) -> bool:
        version = messages.version_of(frame.payload)
        if version is None:
            return False
        asked = self._request is not None and self._request.type is Type.HELLO
        if version != messages.VERSION:
            self.other_version = version
        else:
            welcome = Welcome.unpack(frame.payload)
            if welcome is None:
                return False
            self.welcome = welcome
        if asked:
            self._request = None
        return True

    def _learn(self, status: Status, now: float) -> None:
        """Take in the device's word about its queue and state, unless it is an old one."""
        old = self.status is not None and status.tick < self.status.tick
        if status.run != self._run or self._start is None or old:
            return
        self.status = status
        if status.queued_until > self._taken:
            self._taken = status.queued_until
            self._progress = now
        self._sent = max(self._sent, min(self._taken, self._asked))
        self._credit = max(self._credit, status.credit_until)
        self._pump(now)
        if self._going and status.latch is Latch.WATCHDOG:
            self._fail(self._why_tripped(now, self._start.watchdog))
        elif self._going and status.state is State.IDLE and self._request is None:
            self._fail("the device has ended the run by itself; its outputs are zero")

    def _asked_again(self, status: Status, now: float) -> None:
        """Without progress a STATUS says that commands before those that came are missing."""
        if self._start is None or status.run != self._run:
            return
        stands = status.queued_until == self._taken and self._taken < self._sent
        opened = self._start.mode is messages.LoopMode.OPEN
        if stands and opened and now - self._rewound > _REWIND:
            self._rewind(now)

    def _rewind(self, now: float) -> None:
        self.counters.resent_commands += self._sent - self._taken
        self._sent = self._taken
        self._rewound = self._progress = now
        self._pump(now)

    def _pump(self, now: float) -> None:
        """Send commands as far as there is credit."""
        if self._start is None or self.welcome is None:
            return
        fit = (self.welcome.max_payload - messages.COMMANDS_OVERHEAD) // (
            len(CHANNELS) * messages.COMMAND_DTYPE.itemsize
        )
        end = min(self._asked, self._credit)
        while self._sent < end:
            until = min(self._sent + min(_CHUNK, fit), end)
            codes = self._ring[np.arange(self._sent, until) % len(self._ring)]
            self._seq = (self._seq + 1) & 0xFFFF
            payload = messages.pack_commands(self._run, self._sent, codes)
            self._outbox.append(codec.encode(Type.COMMANDS, self.session, self._seq, payload))
            self._sent = until
            self._progress = now

    def _count(self, seq: int) -> None:
        """Notice frames that never came by the device's running number."""
        if self._heard_seq is not None:
            missing = (seq - self._heard_seq - 1) & 0xFFFF
            # More than half the circle is a repetition of an old frame.
            if missing >= 0x8000:
                return
            self.counters.missing_frames += missing
        self._heard_seq = seq

    def _retry(self, now: float) -> None:
        request = self._request
        if request is None or self.failure is not None:
            return
        if now >= request.give_up:
            self._request = None
            if request.type is not Type.HELLO:
                self._fail(self._unanswered(request.type.name, now))
        elif now - request.sent >= request.interval:
            request.sent = now
            self.counters.retries += 1
            self._outbox.append(request.frame)

    def _unanswered(self, name: str, now: float) -> str:
        if now - self._frame_at < 0.5 * GIVE_UP:
            return (
                f"the device goes on sending but does not answer {name}: what it sends waits for a "
                "line too slow for this sample_rate, or the line loses what it is told. Raise the "
                "baud rate, here and in the firmware, lower sample_rate, or check the cable"
            )
        return (
            f"the device does not answer {name} any more; check its cable and its supply. It makes "
            "itself safe when it hears nothing"
        )

    def _why_tripped(self, now: float, watchdog: int) -> str:
        tripped = (
            "the device's watchdog has zeroed the outputs: it had heard nothing from this program "
            f"for {watchdog} ms"
        )
        pause = max(self.counters.longest_pause, now - self._pinged)
        if pause < 0.9e-3 * watchdog:
            return (
                f"{tripped}, which has spoken every {1e3 * pause:.0f} ms at least: the line fails "
                "towards the device. Check cable, connectors and baud rate; of an emulator, "
                "whether the computer is too busy to carry it"
            )
        return (
            f"{tripped}, which the computer had held up for {1e3 * pause:.0f} ms. 'rig doctor' "
            "says what keeps it from doing so; options.watchdog in the rig file allows more"
        )

    def _silence(self, now: float) -> str:
        damaged = self.decoder.rejected - self._rejected
        if damaged > 1:
            return (
                f"nothing but damaged frames ({damaged}) has come from the device for {SILENCE:g} "
                "s; check cable, connectors and its supply. It makes itself safe when it hears "
                "nothing"
            )
        if now - self._frame_at > 0.5 * SILENCE:
            return (
                f"nothing has come from the device for {SILENCE:g} s; check its cable and its "
                "supply. It makes itself safe when it hears nothing"
            )
        return (
            f"the device answers but has sent no sample for {SILENCE:g} s; its firmware hangs, or "
            "the line loses every block of samples"
        )

    def _fail(self, reason: str) -> None:
        if self.failure is None:
            self.failure = DeviceError(reason)


def refusal(reply: Reply) -> str:
    """What a device's refusal of a request means."""
    name = Type(reply.request).name if reply.request in list(Type) else f"{reply.request:#x}"
    return f"the device refuses {name}: it {_REASONS.get(reply.result, 'gives no reason')}"
