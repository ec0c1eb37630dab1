"""The device's side of the protocol: the reference for firmware. No I/O, no clock of its own.

A program around it feeds bytes as they come (``receive``), calls ``poll`` no later than
``next_event`` says, and writes what ``take`` gives. All times are ticks of the device's clock.
``Board`` is what a port to a microcontroller writes anew: converters, counter and timer.
"""

import contextlib
import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from daq.hal import ANALOG_INPUTS, CHANNELS, Flag, Mode
from daq.serial import codec, messages
from daq.serial.codec import Decoder, Frame
from daq.serial.commands import CommandRing
from daq.serial.messages import Block, Latch, Pong, Reply, Result, Start, State, Status, Type

BLOCK_SECONDS = 0.02  # length of the blocks in which samples are sent that nobody waits for
LINGER_SECONDS = 2.0  # without a frame from the host for so long, a device stops sampling as well
TRANSMIT_BUFFER = 65_536  # bytes that may wait; samples beyond are dropped and counted
_LARGEST_BLOCK = (codec.MAX_PAYLOAD - messages.SAMPLES_OVERHEAD) // messages.SAMPLE_DTYPE.itemsize
_NEWER = 0x8000  # half of the sequence numbers are newer than a given one, half older


class Board(Protocol):
    """The hardware below the state machine. Codes are those of its channel table."""

    def connect(self) -> None:
        """A host has opened a session; the outputs are zero."""

    def announce(self, phase: int, turns: float) -> None:
        """Which phase of a run begins (order of ``daq.hal.Phase``); may light a lamp."""

    def start(self, rate: float, guard: messages.CodedGuard) -> None:
        """Prepare the timer for ``rate`` [Hz], the clamps and the guard; outputs are zero."""

    def play(self, commands: messages.Codes) -> messages.Records:
        """The next n ticks with commands (n, 2), in the timer's interrupt; n samples.

        In each tick, in this order: latch all inputs and the counter; if one of them is beyond
        the guard, put zero in place of this and every later command until ``start`` and flag
        INTERLOCK, once; apply the command; note what was latched and applied.
        """

    def zero(self) -> None:
        """Both outputs to zero now, until the next ``start``."""


class DeviceMachine:
    """A device: sessions, requests, the run, and everything that makes its outputs zero.

    heard: when the last frame of the session came. to_lose: samples that are dropped next as if the
    line were full (a fault, to test hosts with).
    """

    def __init__(self, board: Board, identity: messages.Welcome) -> None:
        self.identity = identity
        self.state = State.IDLE
        self.latch = Latch.NONE
        self.decoder = Decoder()
        self.heard = self.to_lose = 0
        self._board = board
        self._ring = CommandRing(identity.queue)
        self._session = 0  # none yet
        self._answered: tuple[int, bytes] | None = None  # last request's seq, and its answer
        self._start: Start  # from the first that is carried out
        self._sequence = itertools.count(1)
        self._run = self._origin = self._overflow = self._first = 0
        self._samples: list[messages.Records] = []
        self._outbox: deque[bytes] = deque()
        # How a request's payload is unpacked, and what carries it out.
        self._requests: dict[int, tuple[Callable[[bytes], Any], Callable[..., Result]]] = {
            Type.START: (Start.unpack, self._arm),
            Type.GO: (messages.RUN.unpack, self._go),
            Type.STOP: (messages.RUN.unpack, self._stop),
            Type.ANNOUNCE: (messages.ANNOUNCE.unpack, self._announce),
            Type.SAFE: (messages.NOTHING.unpack, self._safe),
            Type.CLEAR: (messages.NOTHING.unpack, self._clear),
        }

    def receive(self, data: bytes, now: int) -> None:
        """Take bytes from the line that arrived at ``now``."""
        for frame in self.decoder.feed(data):
            if len(frame.payload) > self.identity.max_payload:
                continue  # longer than it takes
            if frame.type == Type.HELLO:
                self._hello(frame, now)
            elif frame.session != self._session or self._session == 0:
                # After a restart of the device: the host must hear that its run is gone.
                self._reply(frame, Result.NO_SESSION)
            else:
                self.heard = now
                self._dispatch(frame, now)

    def poll(self, now: int) -> None:
        """Play the ticks that are due, watch the host, and send what is ready."""
        if self.state is not State.RUNNING:
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
        if self.state is not State.RUNNING:
            return None
        ticks = max(1, self._wanted() - self._waiting())
        due = self._origin + (self._ring.tick + ticks - 1) * self._start.period
        orphaned = self.heard + round(LINGER_SECONDS * self.identity.clock) + 1
        if self.latch is Latch.WATCHDOG:
            return min(due, orphaned)
        return min(due, orphaned, self.heard + self._watchdog + 1)

    def take(self) -> bytes | None:
        """The next frame to write, or None."""
        return self._outbox.popleft() if self._outbox else None

    def _dispatch(self, frame: Frame, now: int) -> None:
        if frame.type == Type.COMMANDS:
            self._commands(frame)
        elif frame.type == Type.PING:
            with contextlib.suppress(*messages.MALFORMED):
                (stamp,) = messages.PING.unpack(frame.payload)
                pong = Pong(stamp, now, now, self._status())
                self._answer(frame, Type.PONG, pong.pack())
        else:
            self._request(frame, now)

    def _hello(self, frame: Frame, now: int) -> None:
        try:
            version = messages.version_of(frame.payload)
        except messages.MALFORMED:
            return
        if frame.session == 0:
            return
        # A repeated HELLO of the session that is open changes nothing.
        if version == self.identity.version:
            self.heard = now
            if frame.session != self._session:
                self._open(frame.session)
        welcome = replace(self.identity, latch=self.latch)
        self._answer(frame, Type.WELCOME, welcome.pack())

    def _open(self, session: int) -> None:
        """A new session, which knows of no run."""
        self._end()
        self._session, self._answered = session, None
        self._run = self._overflow = self._first = 0
        self._ring.restart(Mode.CLOSED_LOOP)
        self._outbox.clear()
        if self.latch is not Latch.WATCHDOG:
            self.latch = Latch.NONE
        self._board.connect()

    def _request(self, frame: Frame, now: int) -> None:
        """Carry out a request once, however often it comes."""
        if self._answered is not None:
            ahead = (frame.seq - self._answered[0]) & 0xFFFF
            if ahead == 0:
                self._outbox.append(self._answered[1])
            if ahead == 0 or ahead >= _NEWER:
                return  # a repetition, or one that was overtaken
        result = self._carry_out(frame, now)
        self._answered = (frame.seq, self._reply(frame, result))

    def _carry_out(self, frame: Frame, now: int) -> Result:
        if frame.type not in self._requests:
            return Result.UNKNOWN
        unpack, carry_out = self._requests[frame.type]
        try:
            payload = unpack(frame.payload)
        except messages.MALFORMED:
            return Result.BAD_VALUE
        return carry_out(payload, now)

    def _announce(self, payload: tuple[int, float], now: int) -> Result:
        self._board.announce(*payload)
        return Result.OK

    def _safe(self, payload: tuple[()], now: int) -> Result:
        self._hold_at_zero(Latch.SAFE if self.latch is Latch.NONE else self.latch)
        return Result.OK

    def _clear(self, payload: tuple[()], now: int) -> Result:
        # What clears a latch ends the run as well: nothing plays on from where it stood.
        self._end()
        self.latch = Latch.NONE
        return Result.OK

    def _arm(self, start: Start, now: int) -> Result:
        if not self._possible(start):
            return Result.BAD_VALUE
        if self.latch is Latch.WATCHDOG:
            return Result.LATCHED
        self._end()
        self._run, self._start = start.run, start._replace(guard=self._narrowed(start.guard))
        watchdog = start.watchdog or self.identity.watchdog_default
        self._watchdog = round(watchdog * 1e-3 * self.identity.clock)
        self._ring.restart(start.mode)
        self._overflow = self._first = self.to_lose = 0
        rate = self.identity.clock / start.period
        self._block = max(1, min(round(BLOCK_SECONDS * rate), _LARGEST_BLOCK))
        self._board.start(rate, self._start.guard)
        self.latch = Latch.NONE
        self.state = State.ARMED
        return Result.OK

    def _possible(self, start: Start) -> bool:
        clamps = zip(start.guard.command_low, start.guard.command_high, strict=True)
        return (
            start.period > 0
            and self.identity.clock / start.period <= self.identity.max_rate
            and start.watchdog <= self.identity.watchdog_longest
            and all(low <= 0 <= high for low, high in clamps)
            and start.guard.count_rate >= 0.0  # which NaN is not
        )

    def _narrowed(self, guard: messages.CodedGuard) -> messages.CodedGuard:
        """The host's guard, its clamps narrowed to what this device ever gives."""
        outputs = self.identity.channels[len(ANALOG_INPUTS) : len(ANALOG_INPUTS) + len(CHANNELS)]
        lowest = [int(np.ceil((item.low - item.offset) / item.scale)) for item in outputs]
        highest = [int(np.floor((item.high - item.offset) / item.scale)) for item in outputs]
        low = tuple(map(max, guard.command_low, lowest))
        high = tuple(map(min, guard.command_high, highest))
        return guard._replace(command_low=low, command_high=high)

    def _go(self, payload: tuple[int], now: int) -> Result:
        if payload != (self._run,) or self.state is State.IDLE:
            return Result.WRONG_STATE
        if self.state is State.ARMED:
            self._origin = self.heard = now
            self.state = State.RUNNING
        return Result.OK

    def _stop(self, payload: tuple[int], now: int) -> Result:
        if payload == (self._run,):
            self._end()
        return Result.OK

    def _commands(self, frame: Frame) -> None:
        try:
            run, first, codes = messages.unpack_commands(frame.payload)
        except messages.MALFORMED:
            return
        if run != self._run or self.state is State.IDLE or len(codes) == 0:
            return
        in_order = self._ring.put(first, codes)
        if self.latch is not Latch.NONE:
            self._ring.forget()
        if self.state is State.ARMED or not in_order:
            # While it runs, the samples carry the same news.
            self._send(Type.STATUS, self._status().pack())

    def _play_until(self, now: int) -> None:
        due = (now - self._origin) // self._start.period + 1 - self._ring.tick
        while due > 0:
            n = min(due, self._block)
            self._play(n)
            due -= n
            if self._waiting() >= self._wanted():
                self._flush()

    def _play(self, n: int) -> None:
        """Play n ticks: commands and flags, the board's samples, and the latches that they set."""
        codes, flags = self._ring.take(n)
        if self.latch is not Latch.NONE:
            codes = np.zeros_like(codes)
            flags[:] = int(Flag.UNDERFLOW) if self.latch is Latch.UNDERFLOW else 0
        else:
            guard = self._start.guard
            clamped = np.clip(codes, guard.command_low, guard.command_high)
            commanded = (flags & np.uint32(Flag.HELD)) == 0
            flags[(clamped != codes).any(axis=1) & commanded] |= np.uint32(Flag.CLAMPED)
            codes = clamped.astype(messages.COMMAND_DTYPE)
        records = self._board.play(codes)
        # One latch at a time: under one, and from a tick without a command on, no limit closes it.
        closed = (flags & np.uint32(Flag.UNDERFLOW)) != 0
        closed |= self.latch is not Latch.NONE
        records["flags"][closed] &= ~np.uint32(Flag.INTERLOCK)
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
        """End the run; outputs are zero."""
        self._board.zero()
        self._ring.forget()
        self._samples = []
        self.state = State.IDLE

    def _waiting(self) -> int:
        return sum(map(len, self._samples))

    def _wanted(self) -> int:
        """How many samples make a block: one when a host may be waiting to answer it."""
        ahead = self._ring.until - self._ring.tick
        hurry = self._start.mode is Mode.CLOSED_LOOP and self.latch is Latch.NONE
        return 1 if hurry and ahead < self._block else self._block

    def _flush(self) -> None:
        """Send the samples that wait, or count them as lost when the line is full."""
        if not self._samples:
            return
        joined = np.concatenate(self._samples)
        self._samples = []
        lost = min(self.to_lose, len(joined))
        self.to_lose -= lost
        self._overflow += lost
        self._first += lost
        for at in range(lost, len(joined), _LARGEST_BLOCK):
            part = joined[at : at + _LARGEST_BLOCK]
            if sum(map(len, self._outbox)) > TRANSMIT_BUFFER:
                self._overflow += len(part)
            else:
                time = self._origin + self._first * self._start.period
                block = Block(self._status(), self._first, time, part)
                self._send(Type.SAMPLES, block.pack())
            self._first += len(part)

    def _status(self) -> Status:
        ring = self._ring
        queue = ring.tick, ring.until, ring.credit_until, ring.late
        return Status(self._run, self.state, self.latch, *queue, self._overflow)

    def _reply(self, frame: Frame, result: Result) -> bytes:
        return self._answer(frame, Type.REPLY, Reply(frame.type, result, self._status()).pack())

    def _answer(self, frame: Frame, type_: Type, payload: bytes) -> bytes:
        answer = codec.encode(type_, frame.session, frame.seq, payload)
        self._outbox.append(answer)
        return answer

    def _send(self, type_: Type, payload: bytes) -> None:
        self._outbox.append(codec.encode(type_, self._session, next(self._sequence), payload))
