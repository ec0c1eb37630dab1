"""The device's side of the protocol: the reference for firmware. No I/O, no clock of its own.

A program around it feeds bytes as they come (``receive``), calls ``poll`` no later than
``next_event`` says, and writes what ``take`` gives. All times are ticks of the device's clock.
``Board`` is what a port to a microcontroller writes anew: converters, counter and timer.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from daq.hal import ANALOG_INPUTS, CHANNELS, Flag
from daq.serial import codec, messages
from daq.serial.codec import Decoder, Frame
from daq.serial.messages import (
    Block,
    Codes,
    Latch,
    LoopMode,
    Pong,
    Records,
    Reply,
    Result,
    Start,
    State,
    Status,
    Type,
    Welcome,
)

BLOCK_SECONDS = 0.02
"""Samples that nobody waits for are sent in blocks of this length."""

LINGER_SECONDS = 2.0
"""Without a frame from the host for so long, a device stops sampling as well."""

TRANSMIT_BUFFER = 65_536
"""Bytes that may wait for the line; samples that would not fit are dropped and counted."""

_LARGEST_BLOCK = (codec.MAX_PAYLOAD - messages.SAMPLES_OVERHEAD) // messages.SAMPLE_DTYPE.itemsize
_NEWER = 0x8000  # half of the sequence numbers are newer than a given one, half older


class Board(Protocol):
    """The hardware below the state machine. Codes are those of its channel table."""

    def connect(self) -> None:
        """A host has opened a session; the outputs are zero."""

    def announce(self, phase: int, turns: float) -> None:
        """Which phase of a run begins (order of ``daq.hal.Phase``); may light a lamp."""

    def start(self, rate: float, limits: Start) -> None:
        """Prepare the timer for ``rate`` [Hz], the clamps and the guard; outputs are zero."""

    def play(self, commands: Codes) -> Records:
        """The next n ticks with commands (n, 2), in the timer's interrupt; n samples.

        In each tick, in this order: latch all inputs and the counter; if one of them is beyond
        the guard, put zero in place of this and every later command until ``start`` and flag
        INTERLOCK, once; apply the command; note what was latched and applied.
        """

    def zero(self) -> None:
        """Both outputs to zero now, until the next ``start``."""


@dataclass
class CommandRing:
    """Commands by tick, in a ring as a microcontroller has it.

    In open loop they arrive in order. In closed loop a tick whose frame was lost is a hole, in
    which the command before is held. A slot belongs to tick t until t has been played.
    """

    size: int

    def __post_init__(self) -> None:
        self._codes = np.zeros((self.size, len(CHANNELS)), dtype=messages.COMMAND_DTYPE)
        self._owner = np.full(self.size, -1, dtype=np.int64)
        self.restart(LoopMode.CLOSED)

    def restart(self, mode: LoopMode) -> None:
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
        if self._mode is LoopMode.OPEN and first > self.until:
            return False
        end = min(first + len(codes), self.credit_until)
        begin = max(first, self.tick)
        if self._mode is LoopMode.CLOSED:
            self.late += min(max(self.tick - first, 0), len(codes))
        if end > begin:
            ticks = np.arange(begin, end)
            self._codes[ticks % self.size] = codes[begin - first : end - first]
            self._owner[ticks % self.size] = ticks
        self.until = max(self.until, end)
        return True

    def take(self, n: int) -> tuple[Codes, int]:
        """Commands (n, 2) of the next n ticks, and how many come before the first that is missing.

        In open loop zero stands from there on; in closed loop the command before is held, and
        ``held`` marks the rows.
        """
        ticks = np.arange(self.tick, self.tick + n)
        slots = ticks % self.size
        there = self._owner[slots] == ticks
        codes = self._codes[slots]
        self.held = ~there
        found = n if there.all() else int(np.argmin(there))
        if found < n and self._mode is LoopMode.OPEN:
            codes[found:] = 0
        elif found < n:
            # Each hole takes the row of the last command before it, or what was held before.
            rows = np.maximum.accumulate(np.where(there, np.arange(n), -1))
            codes = np.where(rows[:, None] < 0, self._last, codes[np.maximum(rows, 0)])
        self._last = codes[-1].copy()
        self.tick += n
        self.until = max(self.until, self.tick)
        return codes, found


class DeviceMachine:
    """A device: sessions, requests, the run, and everything that makes its outputs zero.

    heard: when the last frame of the session came.
    """

    def __init__(self, board: Board, identity: Welcome) -> None:
        self.identity = identity
        self.state = State.IDLE
        self.latch = Latch.NONE
        self.decoder = Decoder()
        self._board = board
        self._ring = CommandRing(identity.queue)
        self._session = 0  # none yet
        self._answered: tuple[int, bytes] | None = None  # last request's seq, and its answer
        self._seq = 0
        self._run = 0
        self._start: Start | None = None
        self._origin = 0
        self.heard = 0
        self._overflow = 0
        self._samples: list[Records] = []
        self._first = 0
        self._to_lose = 0
        self._outbox: deque[bytes] = deque()
        self._backlog = 0

    # --- the program around it ----------------------------------------------------------------

    def receive(self, data: bytes, now: int) -> None:
        """Take bytes from the line that arrived at ``now``."""
        for frame in self.decoder.feed(data):
            self._take(frame, now)

    def poll(self, now: int) -> None:
        """Play the ticks that are due, watch the host, and send what is ready."""
        if self.state is not State.RUNNING or self._start is None:
            return
        deadline = self.heard + self._watchdog
        self._play_until(min(now, deadline))
        if now > deadline and self.latch is not Latch.WATCHDOG:
            self._hold_at_zero(Latch.WATCHDOG)
        self._play_until(now)
        if now > self.heard + round(LINGER_SECONDS * self.identity.clock):
            self._end()

    def next_event(self) -> int | None:
        """When ``poll`` has something to do at the latest; None while nothing runs."""
        if self.state is not State.RUNNING or self._start is None:
            return None
        ticks = max(1, self._wanted() - self._waiting())
        due = self._origin + (self._ring.tick + ticks - 1) * self._start.period
        if self.latch is Latch.WATCHDOG:
            return due
        return min(due, self.heard + self._watchdog + 1)

    def take(self) -> bytes | None:
        """The next frame to write, or None."""
        if not self._outbox:
            return None
        frame = self._outbox.popleft()
        self._backlog -= len(frame)
        return frame

    def lose(self, samples: int) -> None:
        """Drop the next ``samples`` as if the line were full (a fault, to test hosts with)."""
        self._to_lose += samples

    # --- frames -------------------------------------------------------------------------------

    def _take(self, frame: Frame, now: int) -> None:
        if frame.type == Type.HELLO:
            self._hello(frame, now)
        elif frame.session != self._session or self._session == 0:
            # After a restart of the device: the host must hear that its run is gone.
            self._reply(frame, Result.NO_SESSION)
        else:
            self.heard = now
            self._dispatch(frame, now)

    def _dispatch(self, frame: Frame, now: int) -> None:
        if frame.type == Type.COMMANDS:
            self._commands(frame)
        elif frame.type == Type.PING:
            stamp = messages.unpack_ping(frame.payload)
            if stamp is not None:
                self._send(Type.PONG, frame.seq, Pong(stamp, now, now).pack(self._status()))
        else:
            self._request(frame, now)

    def _hello(self, frame: Frame, now: int) -> None:
        version = messages.version_of(frame.payload)
        if version is None or frame.session == 0:
            return
        # A repeated HELLO of the session that is open changes nothing.
        if version == self.identity.version and frame.session != self._session:
            self._end()
            self._session, self._answered, self.heard = frame.session, None, now
            self._outbox.clear()
            self._backlog = 0
            if self.latch is not Latch.WATCHDOG:
                self.latch = Latch.NONE
            self._board.connect()
        welcome = Welcome(**{**vars(self.identity), "latch": self.latch})
        self._write(codec.encode(Type.WELCOME, frame.session, frame.seq, welcome.pack()))

    def _request(self, frame: Frame, now: int) -> None:
        """Carry out a request once, however often it comes."""
        if self._answered is not None:
            ahead = (frame.seq - self._answered[0]) & 0xFFFF
            if ahead == 0:
                self._write(self._answered[1])
            if ahead == 0 or ahead >= _NEWER:
                return  # a repetition, or one that was overtaken
        result = self._carry_out(frame, now)
        self._answered = (frame.seq, self._reply(frame, result))

    def _carry_out(self, frame: Frame, now: int) -> Result:
        if frame.type == Type.START:
            return self._arm(Start.unpack(frame.payload))
        if frame.type in (Type.GO, Type.STOP):
            return self._go_or_stop(frame, now)
        if frame.type == Type.ANNOUNCE:
            return self._announce(messages.unpack_announce(frame.payload))
        if frame.type == Type.SAFE:
            self._hold_at_zero(Latch.SAFE if self.latch is Latch.NONE else self.latch)
        elif frame.type == Type.CLEAR:
            # What clears a latch ends the run as well: nothing plays on from where it stood.
            self._end()
            self.latch = Latch.NONE
        else:
            return Result.UNKNOWN
        return Result.OK

    def _go_or_stop(self, frame: Frame, now: int) -> Result:
        run = messages.unpack_run(frame.payload)
        if run is None:
            return Result.BAD_VALUE
        if frame.type == Type.GO:
            return self._go(run, now)
        if run == self._run:
            self._end()
        return Result.OK

    def _announce(self, announced: tuple[int, float] | None) -> Result:
        if announced is None:
            return Result.BAD_VALUE
        self._board.announce(*announced)
        return Result.OK

    # --- the run ------------------------------------------------------------------------------

    def _arm(self, start: Start | None) -> Result:
        if start is None or not self._possible(start):
            return Result.BAD_VALUE
        if self.latch is Latch.WATCHDOG:
            return Result.LATCHED
        self._end()
        self._run, self._start = start.run, self._within_limits(start)
        self._watchdog = round(
            (start.watchdog or self.identity.watchdog_default) * 1e-3 * self.identity.clock
        )
        self._ring.restart(start.mode)
        self._overflow = self._first = self._to_lose = 0
        rate = self.identity.clock / start.period
        self._block = max(1, min(round(BLOCK_SECONDS * rate), _LARGEST_BLOCK))
        self._board.start(rate, self._start)
        self.latch = Latch.NONE
        self.state = State.ARMED
        return Result.OK

    def _possible(self, start: Start) -> bool:
        zero_inside = all(
            low <= 0 <= high
            for low, high in zip(start.command_low, start.command_high, strict=True)
        )
        return (
            start.period > 0
            and self.identity.clock / start.period <= self.identity.max_rate
            and start.watchdog <= self.identity.watchdog_longest
            and zero_inside
        )

    def _within_limits(self, start: Start) -> Start:
        """The host's clamps, narrowed to what this device ever gives."""
        outputs = self.identity.channels[len(ANALOG_INPUTS) : len(ANALOG_INPUTS) + len(CHANNELS)]
        own_low = [int(np.ceil((item.low - item.offset) / item.scale)) for item in outputs]
        own_high = [int(np.floor((item.high - item.offset) / item.scale)) for item in outputs]
        low = tuple(map(max, start.command_low, own_low))
        high = tuple(map(min, start.command_high, own_high))
        return Start(**{**vars(start), "command_low": low, "command_high": high})

    def _go(self, run: int, now: int) -> Result:
        if run != self._run or self.state is State.IDLE:
            return Result.WRONG_STATE
        if self.state is State.ARMED:
            self._origin = self.heard = now
            self.state = State.RUNNING
        return Result.OK

    def _commands(self, frame: Frame) -> None:
        unpacked = messages.unpack_commands(frame.payload)
        if unpacked is None or unpacked[0] != self._run or self.state is State.IDLE:
            return
        _, first, codes = unpacked
        in_order = self._ring.put(first, codes)
        if self.latch is not Latch.NONE:
            self._ring.forget()
        if self.state is State.ARMED or not in_order:
            # While it runs, the samples carry the same news.
            self._send(Type.STATUS, self._next_seq(), self._status().pack())

    def _play_until(self, now: int) -> None:
        assert self._start is not None
        due = (now - self._origin) // self._start.period + 1 - self._ring.tick
        while due > 0:
            n = min(due, self._block)
            self._play(n)
            due -= n
            if self._waiting() >= self._wanted():
                self._flush()

    def _play(self, n: int) -> None:
        """n ticks: what to apply, what the board makes of it, and what follows from that."""
        assert self._start is not None
        codes, found = self._ring.take(n)
        flags = np.zeros(n, dtype=np.uint32)
        if self.latch is not Latch.NONE:
            codes = np.zeros_like(codes)
            flags[:] = int(Flag.UNDERFLOW) if self.latch is Latch.UNDERFLOW else 0
        else:
            if self._start.mode is LoopMode.CLOSED:
                flags[self._ring.held] = int(Flag.HELD)
            elif found < n:
                flags[found:] = int(Flag.UNDERFLOW)
            clamped = np.clip(codes, self._start.command_low, self._start.command_high)
            flags[(clamped != codes).any(axis=1)] |= np.uint32(Flag.CLAMPED)
            codes = clamped.astype(messages.COMMAND_DTYPE)
        records = self._board.play(codes)
        tripped = (records["flags"] & np.uint32(Flag.INTERLOCK)) != 0
        if tripped.any():
            flags[int(np.argmax(tripped)) :] = 0
        records["flags"] |= flags
        self._samples.append(records)
        if tripped.any():
            self._hold_at_zero(Latch.INTERLOCK)
        elif (flags & np.uint32(Flag.UNDERFLOW)).any() and self.latch is Latch.NONE:
            self._hold_at_zero(Latch.UNDERFLOW)

    def _hold_at_zero(self, why: Latch) -> None:
        self._ring.forget()
        self._board.zero()
        self.latch = why
        if self.state is State.RUNNING:
            self._flush()

    def _end(self) -> None:
        """No run any more; outputs zero."""
        self._board.zero()
        self._ring.forget()
        self._samples = []
        self.state = State.IDLE

    # --- what goes out ------------------------------------------------------------------------

    def _waiting(self) -> int:
        return sum(map(len, self._samples))

    def _wanted(self) -> int:
        """How many samples make a block: one when a host may be waiting to answer it."""
        assert self._start is not None
        ahead = self._ring.until - self._ring.tick
        hurry = self._start.mode is LoopMode.CLOSED and self.latch is Latch.NONE
        return 1 if hurry and ahead < self._block else self._block

    def _flush(self) -> None:
        """Send the samples that wait, or count them as lost when the line is full."""
        if not self._samples:
            return
        joined = np.concatenate(self._samples)
        self._samples = []
        lost = min(self._to_lose, len(joined))
        self._to_lose -= lost
        self._pass_over(lost)
        for at in range(lost, len(joined), _LARGEST_BLOCK):
            part = joined[at : at + _LARGEST_BLOCK]
            if self._backlog > TRANSMIT_BUFFER:
                self._pass_over(len(part))
                continue
            assert self._start is not None
            time = self._origin + self._first * self._start.period
            block = Block(self._status(), self._first, time, part)
            self._send(Type.SAMPLES, self._next_seq(), block.pack())
            self._first += len(part)

    def _pass_over(self, samples: int) -> None:
        self._overflow += samples
        self._first += samples

    def _status(self) -> Status:
        return Status(
            self._run,
            self.state,
            self.latch,
            self._ring.tick,
            self._ring.until,
            self._ring.credit_until,
            self._ring.late,
            self._overflow,
        )

    def _reply(self, frame: Frame, result: Result) -> bytes:
        payload = Reply(frame.type, result).pack() + self._status().pack()
        reply = codec.encode(Type.REPLY, frame.session, frame.seq, payload)
        self._write(reply)
        return reply

    def _next_seq(self) -> int:
        self._seq = (self._seq + 1) & 0xFFFF
        return self._seq

    def _send(self, type_: Type, seq: int, payload: bytes) -> None:
        self._write(codec.encode(type_, self._session, seq, payload))

    def _write(self, frame: bytes) -> None:
        self._outbox.append(frame)
        self._backlog += len(frame)
