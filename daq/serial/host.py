"""The host's side of the protocol: sessions, retries, credit, gaps. No I/O, no clock of its own.

A program around it feeds bytes (``feed``), calls ``poll`` every few milliseconds and writes
what ``take`` gives. Times are seconds of ``time.perf_counter``.
"""

import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from daq.errors import DeviceError
from daq.hal import CHANNELS, Mode
from daq.serial import codec, messages
from daq.serial.clock import RATE_TOLERANCE, ClockEstimator, RateBounds
from daq.serial.codec import Decoder, Frame
from daq.serial.commands import CommandStream
from daq.serial.messages import (
    WATCHDOG_ZEROES,
    Block,
    Latch,
    Pong,
    Reply,
    Result,
    Start,
    State,
    Status,
    Type,
)

RETRY = 0.1  # s until a request is sent again
HELLO_RETRY = 0.2
GIVE_UP = 1.0  # s until a request that nobody answers fails
SILENCE = 1.0  # s without a sample until a run fails
_CHUNK = 256  # ticks in a frame of commands at most
_TICKS_TO_SPARE = 4096  # by which a device's count may be ahead of the host's clock
_TIME_JITTER = 1e-4  # s by which a device may mistake the time of a sample

_REASONS = {
    Result.WRONG_STATE: "is in a state in which it cannot",
    Result.BAD_VALUE: "finds a value beyond what it can do",
    Result.LATCHED: "holds its outputs at zero since its watchdog tripped",
    Result.UNKNOWN: "does not know the request; its firmware is incomplete",
}
_TOO_LATE = (
    "no longer can: the sample at which its own controller was to come or go has passed, for this "
    "computer was held up, or the run has ended"
)


@dataclass
class PendingRequest:
    """A request that has not been answered yet: its frame, and when it is sent again."""

    type: Type
    seq: int
    frame: bytes
    give_up: float
    sent: float


@dataclass
class Counters:
    """Counts of errors on the line, for the record of the run."""

    lost_samples: int = 0
    duplicate_blocks: int = 0
    missing_frames: int = 0
    malformed: int = 0
    retries: int = 0
    resent_commands: int = 0
    longest_pause: float = 0.0  # s in which the device's watchdog was not fed


class HostMachine:
    """One session with a device.

    blocks: samples received, in order, for the program to take. failure: set once, when the
    session cannot go on. welcome: who answered; other_version: of the protocol, of one that cannot
    be understood. status: the newest state of the device. pending: the request that is outstanding;
    reply: the answer to the last. commands: of the run, on their way to the device.
    """

    def __init__(self, session: int) -> None:
        self.session = session
        self.decoder = Decoder()
        self.clock = ClockEstimator()
        self._clock_rate = RateBounds()
        self.counters = Counters()
        self.blocks: list[Block] = []
        self.failure: DeviceError | None = None
        self.welcome: messages.Welcome | None = None
        self.other_version: int | None = None
        self.status: Status | None = None
        self.pending: PendingRequest | None = None
        self.reply: Reply | None = None
        self.commands = CommandStream(queue=1, chunk=1)
        self._outbox: deque[bytes] = deque()
        self._request_seq = 0
        self._sequence = itertools.count(1)
        self._heard_seq: int | None = None
        self._state = State.IDLE
        self._run = 0
        self._start: Start  # of the run, unless IDLE
        self._expected = 0  # tick of the next sample
        self._first_block: Block | None = None  # of the run
        self._gone = self._sample_at = self._frame_at = self._pinged = 0.0
        self._rejected = 0  # damaged frames, by the time of the last good frame
        self._receivers: dict[int, tuple[Callable[[bytes], Any], Callable[..., None]]] = {
            Type.SAMPLES: (Block.unpack, self._add_samples),
            Type.PONG: (Pong.unpack, self._add_round_trip),
            Type.STATUS: (Status.unpack, self._update),
            Type.REPLY: (Reply.unpack, self._answer),
            Type.WELCOME: (_unpack_welcome, self._greet),
        }

    def feed(self, data: bytes, now: float) -> None:
        """Take bytes that came from the line."""
        for frame in self.decoder.feed(data):
            if frame.session == self.session:
                self._receive(frame, now)

    def poll(self, now: float, keep_alive: bool = True) -> None:
        """Send again what was not answered, keep the device's watchdog fed, notice silence."""
        self._retry(now)
        if self._state is State.IDLE or self.failure is not None:
            return
        if keep_alive and now - self._pinged >= 0.25e-3 * self._start.watchdog:
            self.ping(now)
        if self.commands.lags(now):
            self._rewind(now)
        self._pump(now)
        if self._state is State.RUNNING and now - self._sample_at > SILENCE:
            self._fail(self._why_silent(now))

    def take(self) -> bytes:
        """Frames to be written now, and no more later."""
        data = b"".join(self._outbox)
        self._outbox.clear()
        return data

    def ask(self, type_: Type, payload: bytes, now: float, give_up: float = GIVE_UP) -> None:
        """Send a request, in place of any that is outstanding.

        HELLO is answered when ``welcome`` is set or ``other_version`` is, others when ``reply`` is.
        """
        seq = self._request_seq = (self._request_seq + 1) & 0xFFFF
        frame = codec.encode(type_, self.session, seq, payload)
        self.reply = None
        self.pending = PendingRequest(type_, seq, frame, now + give_up, now)
        self._outbox.append(frame)

    def ping(self, now: float) -> None:
        """Feed the watchdog, and learn about the clocks."""
        if self._state is State.RUNNING:
            pause = now - self._pinged
            self.counters.longest_pause = max(self.counters.longest_pause, pause)
        self._pinged = now
        self._send(Type.PING, messages.PING.pack(round(now * 1e9)))

    def start(self, start: Start, now: float) -> None:
        """Arm a run; commands may follow at once."""
        assert self.welcome is not None
        self._state, self._run, self._start = State.ARMED, start.run, start
        self.blocks.clear()
        self.status = self._first_block = None
        self._expected = 0
        size = len(CHANNELS) * messages.COMMAND_DTYPE.itemsize
        chunk = min(_CHUNK, (self.welcome.max_payload - messages.COMMANDS_OVERHEAD) // size)
        self.commands = CommandStream(self.welcome.queue, chunk, now)
        self.ask(Type.START, start.pack(), now)

    def go(self, now: float) -> None:
        """Start the clock."""
        self._state = State.RUNNING
        self._gone = self._sample_at = self._pinged = now
        self.ask(Type.GO, messages.RUN.pack(self._run), now)

    def stop(self, now: float) -> None:
        """End the run; samples still on their way are not wanted."""
        self._state = State.IDLE
        self.blocks.clear()
        self.ask(Type.STOP, messages.RUN.pack(self._run), now)

    def send(self, tick: int, codes: messages.Codes, now: float) -> None:
        """Queue commands (n, 2) from ``tick`` on; they go out as the device has room."""
        self.commands.give(tick, codes, now)
        self._pump(now)

    def describe(self) -> dict[str, Any]:
        """The line's record: counts of bytes, frames and errors, and the clocks' relation."""
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
            "clock": self.clock.describe(),
        }

    def _receive(self, frame: Frame, now: float) -> None:
        self._frame_at, self._rejected = now, self.decoder.rejected
        try:
            unpack, receive = self._receivers[frame.type]
            message = unpack(frame.payload)
        except (KeyError, *messages.MALFORMED):
            self.counters.malformed += 1
        else:
            receive(message, frame.seq, now)

    def _add_samples(self, block: Block, seq: int, now: float) -> None:
        self._count(seq)
        if self._state is State.IDLE or block.status.run != self._run:
            return  # of a run that was stopped
        if block.status.latch is Latch.WATCHDOG and not block.records["applied"][-1].any():
            # Zeros that no flag explains: what explains them is the latch, which ends the run.
            self._learn(block.status, now)
            return
        if block.first < self._expected:
            self.counters.duplicate_blocks += 1
            return
        if block.first > self._most_ticks(now):
            self._fail(
                f"the device numbers a sample {block.first}, {now - self._gone:.3g} s after the "
                "run began: it has lost count. Mend its firmware, or look for a supply that "
                "breaks down"
            )
            return
        self._check_period(block)
        self.counters.lost_samples += block.first - self._expected
        self._expected = block.first + len(block.records)
        self.blocks.append(block)
        self._sample_at = now
        self._learn(block.status, now)

    def _check_period(self, block: Block) -> None:
        """Fail where the device's clock says that its samples are not as far apart as agreed."""
        assert self.welcome is not None
        first = self._first_block = self._first_block or block
        due = (block.first - first.first) * self._start.period
        passed, clock = block.time - first.time, self.welcome.clock
        jitter = max(2.0, _TIME_JITTER * clock)
        if abs(passed - due) > RATE_TOLERANCE * due + jitter:
            ticks = block.first - first.first
            self._fail(
                f"by its own clock the device took {ticks} samples in {passed / clock:.6g} s; at "
                f"the period of START they take {due / clock:.6g} s. Mend its firmware: its timer "
                "must divide the clock by that period, and SAMPLES must carry that clock"
            )

    def _most_ticks(self, now: float) -> float:
        """Samples that a device whose clock is twice too fast can have taken."""
        assert self.welcome is not None
        rate = self.welcome.clock / self._start.period
        return _TICKS_TO_SPARE + 2.0 * rate * (now - self._gone)

    def _add_round_trip(self, pong: Pong, seq: int, now: float) -> None:
        if self.welcome is None:
            return  # of a ping that nobody has sent
        middle = 0.5 * (pong.received + pong.answered) / self.welcome.clock
        sent, tick = pong.stamp * 1e-9, 1.0 / self.welcome.clock
        self.clock.add(sent, middle, now)
        self._clock_rate.add(sent - tick, middle, now + tick)
        if deviation := self._clock_rate.deviation():
            self._fail(
                f"the device's clock runs {abs(deviation):.1%} or more too "
                f"{'fast' if deviation > 0.0 else 'slow'} by this computer's: it is not the "
                f"{1e-6 * self.welcome.clock:g} MHz that WELCOME says. Mend its "
                "crystal or its clock's set-up, or what its firmware says of it"
            )
        self._learn(pong.status, now)

    def _update(self, status: Status, seq: int, now: float) -> None:
        """Take in a STATUS; without progress it says that commands before the last are missing."""
        self._count(seq)
        if self._state is not State.IDLE and status.run == self._run:
            if self.commands.lacks(status.queued_until, now):
                self._rewind(now)
            self._learn(status, now)

    def _answer(self, reply: Reply, seq: int, now: float) -> None:
        if reply.result is Result.NO_SESSION:
            if self.welcome is not None:
                self._fail(
                    "the device has restarted and forgotten the run. Look for a supply that breaks "
                    "down, a reset by the port, or firmware that crashed"
                )
            return
        self._learn(reply.status, now)
        if self.pending is not None and seq == self.pending.seq:
            self.reply, self.pending = reply, None

    def _greet(self, welcome: messages.Welcome | int, seq: int, now: float) -> None:
        if isinstance(welcome, int):
            self.other_version = welcome
        else:
            self.welcome = welcome
        if self.pending is not None and self.pending.type is Type.HELLO:
            self.pending = None

    def _learn(self, status: Status, now: float) -> None:
        """Take in the state of the device's queue and outputs, unless it is an old one."""
        old = self.status is not None and status.tick < self.status.tick
        if self._state is State.IDLE or status.run != self._run or old:
            return
        self.status = status
        # Commands for ticks that are past are not waited for, whether they came or not.
        taken = max(status.queued_until, status.tick)
        self.commands.acknowledge(taken, status.credit_until, now)
        self._pump(now)
        if self._state is State.RUNNING and status.latch is Latch.WATCHDOG:
            self._fail(self._why_tripped(now, self._start.watchdog))
        elif self._state is State.RUNNING and status.state is State.IDLE and self.pending is None:
            self._fail("the device has ended the run by itself; mend its firmware")

    def _send(self, type_: Type, payload: bytes) -> None:
        self._outbox.append(codec.encode(type_, self.session, next(self._sequence), payload))

    def _rewind(self, now: float) -> None:
        """Send again the commands that an open loop's device lacks; a closed loop holds on."""
        if self._start.mode is Mode.OPEN_LOOP:
            self.counters.resent_commands += self.commands.rewind(now)
            self._pump(now)

    def _pump(self, now: float) -> None:
        """Send commands as far as there is credit."""
        for first, codes in self.commands.chunks(now):
            self._send(Type.COMMANDS, messages.pack_commands(self._run, first, codes))

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
        request = self.pending
        if request is None or self.failure is not None:
            return
        interval = HELLO_RETRY if request.type is Type.HELLO else RETRY
        if now >= request.give_up:
            self.pending = None
            if request.type is not Type.HELLO:
                self._fail(self._why_unanswered(request.type.name, now))
        elif now - request.sent >= interval:
            request.sent = now
            self.counters.retries += 1
            self._outbox.append(request.frame)

    def _why_unanswered(self, name: str, now: float) -> str:
        if now - self._frame_at < 0.5 * GIVE_UP:
            return (
                f"the device goes on sending but does not answer {name}: what it sends waits for a "
                "line too slow for this sample_rate, or the line loses what it is told. Raise the "
                "baud rate, here and in the firmware, lower sample_rate, or check the cable"
            )
        return (
            f"the device does not answer {name} any more; check its cable and its supply. "
            f"{WATCHDOG_ZEROES}"
        )

    def _why_tripped(self, now: float, watchdog: int) -> str:
        tripped = (
            "the device's watchdog has tripped: it had heard nothing from this program "
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

    def _why_silent(self, now: float) -> str:
        damaged = self.decoder.rejected - self._rejected
        if damaged > 1:
            return (
                f"nothing but damaged frames ({damaged}) has come from the device for {SILENCE:g} "
                f"s; check cable, connectors and its supply. {WATCHDOG_ZEROES}"
            )
        if now - self._frame_at > 0.5 * SILENCE:
            return (
                f"nothing has come from the device for {SILENCE:g} s; check its cable and its "
                f"supply. {WATCHDOG_ZEROES}"
            )
        return (
            f"the device answers but has sent no sample for {SILENCE:g} s; its firmware hangs, or "
            "the line loses every block of samples"
        )

    def _fail(self, reason: str) -> None:
        if self.failure is None:
            self.failure = DeviceError(reason)


def _unpack_welcome(payload: bytes) -> messages.Welcome | int:
    """Who answers, or the version of the protocol that it speaks where that is another."""
    version = messages.version_of(payload)
    return messages.Welcome.unpack(payload) if version == messages.VERSION else version


def refusal(reply: Reply) -> str:
    """Text of a device's refusal of a request."""
    name = Type(reply.request).name if reply.request in list(Type) else f"{reply.request:#x}"
    reason = _REASONS.get(reply.result, "gives no reason")
    if reply.request == Type.LAW and reply.result is Result.WRONG_STATE:
        reason = _TOO_LATE
    return f"the device refuses {name}: it {reason}"
