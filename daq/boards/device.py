"""A device made of a card: ticks, commands by tick, and what the card cannot watch by itself.

Two ways to put out an open loop. By the card's clock, the waveform being handed on ahead: then
nothing of this computer is in its timing, and what passes a limit is zeroed a block of samples
later. By this computer, a command right after each sample, as every closed loop: then limits act
in the very sample, and the computer's punctuality is in the outputs.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from daq.boards import loopback
from daq.boards.card import (
    NO_PHASE,
    PHASE_CURE,
    ZERO,
    Card,
    CardFacts,
    CardOptions,
    Reading,
    require_phase,
)
from daq.boards.watch import GuardWatch, RateEstimate
from daq.counter import Counter
from daq.errors import DeviceError, Mistake
from daq.hal import CHANNELS, DeviceInfo, Flag, FloatArray, Guard, IntArray, Mode, Phase, RawSamples

_BLOCK = 0.01  # s of samples read at once while the card plays
_MARGIN = 0.05  # s of commands that are to be with the card; less, and it runs dry
_DRIFT = 2e-4  # of the card's clock against this computer's, at most
_SPAN = 2**24  # counts; counters of 24 and of 32 bits agree in these
_SATURATED = 1e-3  # of the range, from its ends
_UNTRIED = "this backend has been tested on a simulated card, never on hardware"
_NO_WATCHDOG = (
    "without a watchdog the outputs may stay at their last volts where this program is killed, "
    "this computer hangs or the card is cut off, until somebody switches the amplifiers off"
)
_JITTER = "commands come when this computer gets to them after each sample: run.json says how late"


class CardDevice:
    """A device (see ``daq.hal.Device`` for the methods) on a card.

    clock: this computer's [s], by which it knows whether it is late.
    """

    def __init__(self, options: CardOptions, card: Card, clock: Callable[[], float]) -> None:
        self._settings = options
        self._clock = clock
        self._card = card
        self._facts: CardFacts | None = None
        self._sampling = self._going = False
        self._unsafe = ""  # why the card could not be told to zero its outputs
        self._record: dict[str, Any] = {}

    def open(self) -> DeviceInfo:
        """Connect; outputs are zero."""
        self.close()
        try:
            facts = self._card.open()
        except BaseException:
            with suppress(DeviceError):
                self._card.close()  # what was opened until then
            raise
        self._facts, self._record = facts, {"card": facts.name}
        queue, step = self._settings.buffer, facts.step_out
        return DeviceInfo(facts.name, facts.max_rate, queue, facts.volts, step_out=step)

    def announce(self, phase: Phase, turns: float = 0.0) -> None:
        """A card has nothing to do here."""

    def start(self, sample_rate: float, mode: Mode, guard: Guard) -> None:
        """Make ready. The card's clock starts with the first ``receive``."""
        self._require_open()
        self._end_sampling()
        self._is_closed_loop = mode is Mode.CLOSED_LOOP
        self._plays = not self._is_closed_loop and self._settings.playback == "board"
        require_phase(self._settings, mode)
        self._rate, self._guard, self._watch = sample_rate, guard, GuardWatch(guard)
        self._counter, self._estimate = Counter(_SPAN), RateEstimate(sample_rate)
        self._queue: dict[int, FloatArray] = {}  # commands by tick, not handed on yet
        self._played: dict[int, FloatArray] = {}  # and handed on ahead
        self._end = 0  # tick behind those
        self._marks: dict[int, Flag] = {}  # flags by tick
        self._tick = -1  # the last read
        self._origin = math.inf  # of this computer's clock at tick 0
        self._last = ZERO
        self._dry: int | None = None  # tick from which nothing was there to play
        self._latched = False
        self._record.pop("command_delay_seconds", None)  # of an earlier sampling
        self._delays: list[float] = []  # s from a sample to its command
        self._sampling = True

    def send(self, tick: int, commands: FloatArray) -> None:
        """Queue commands (n, 2) [V]; those for ticks already past are dropped."""
        self._require_sampling()
        low, high = self._guard.command_low, self._guard.command_high
        limited = np.clip(commands, low, high)
        if not self._latched:
            self._queue.update(zip(range(tick, tick + len(limited)), limited, strict=True))

    def room(self) -> int:
        """Commands that still fit."""
        self._require_sampling()
        waiting = len(self._queue) + len(self._played)
        return max(0, self._settings.buffer - waiting)

    def receive(self) -> RawSamples:
        """The next sample, or a block of them where the card plays."""
        self._require_sampling()
        if not self._going:
            self._go()
        while True:
            samples = self._block() if self._plays else self._single()
            if samples is not None:
                return samples

    def stop(self) -> None:
        """End sampling; outputs are zero."""
        self._require_open()
        self._end_sampling()

    def safe(self) -> None:
        """Zero both outputs now. Where the card cannot be reached, only its watchdog does."""
        if self._facts is None:
            return
        if self._sampling:
            self._latch()
            self._last = ZERO
        try:
            self._card.zero()
        except DeviceError as error:
            self._unsafe = self._unsafe or f"the outputs could not be zeroed: {error}"

    def close(self) -> None:
        """Zero the outputs and disconnect."""
        self.safe()
        self._sampling = self._going = False
        self._facts = None
        self._card.close()

    def report(self) -> dict[str, Any]:
        """Card, playback and delays, for the record of a run."""
        if not self._record:
            return {}
        warnings = [self._unsafe] if self._unsafe else []
        settings = self._settings.model_dump(mode="json")
        promises = [caveat.text for caveat in self.caveats()]
        facts = {"settings": settings, "cannot_promise": promises, "warnings": warnings}
        return {**self._record, **facts}

    def caveats(self) -> list[Mistake]:
        """What it cannot promise, each with what to do about it."""
        settings = self._settings
        caveats = [Mistake(_UNTRIED, "go through docs/boards.md before amplifiers are on")]
        if settings.watchdog is None:
            caveats.append(Mistake(_NO_WATCHDOG, "have a switch in their supply, and a hand at it"))
        if settings.playback == "board":
            later = (
                f"outputs are zero {1e3 * _BLOCK:.0f} ms after a limit was passed in an open loop, "
                "not in the same sample, for the card plays by itself"
            )
            caveats.append(Mistake(later, "write 'playback: host' where that is too late"))
        if settings.playback == "board" and settings.phase is None:
            caveats.append(Mistake(NO_PHASE, PHASE_CURE))
        if settings.playback == "host":
            caveats.append(Mistake(_JITTER, "write 'playback: board' for waveforms to identify by"))
        return caveats

    def measure_phase(self) -> list[float]:
        """Delays [samples] of outputs played by the card behind its inputs, of some starts.

        The motor's output moves by 0.5 V either way; see ``loopback`` for the wiring. Raises
        DeviceError where the input does not show it.
        """
        self._require_open()
        self._end_sampling()
        delays = []
        for seed in range(loopback.STARTS):
            volts = loopback.sequence(seed)
            # A tail keeps the card from running dry before all is read.
            self._card.start(loopback.RATE, np.concatenate([volts, np.zeros_like(volts)]))
            shown = np.zeros(0)
            try:
                while len(shown) < len(volts):
                    shown = np.append(shown, self._next_block(loopback.RATE).analog[:, 0])
            finally:
                self._card.stop()
            delays.append(loopback.delay(volts[:, 0], shown[: len(volts)]))
        return delays

    def _require_open(self) -> None:
        if self._facts is None:
            raise DeviceError("the card is not open; open it before starting")

    def _require_sampling(self) -> None:
        self._require_open()
        if not self._sampling:
            raise DeviceError("the card is not sampling; start it first")

    def _end_sampling(self) -> None:
        self.safe()
        going, self._sampling, self._going = self._going, False, False
        if going and self._delays:
            names = ("median", "99 percent", "largest")
            values = np.quantile(self._delays, [0.5, 0.99, 1.0]).tolist()
            self._record["command_delay_seconds"] = dict(zip(names, values, strict=True))
        if going:
            self._card.stop()

    def _go(self) -> None:
        """Start the card's clock, with what is to be played already there."""
        self._going = True
        if not self._plays:
            self._card.start(self._rate, None)
            return
        phase = self._settings.phase or 0
        # Outputs that come early wait for zeros; of inputs that come early the first are dropped.
        self._tick = -1 - max(0, phase)
        self._card.start(
            self._rate, np.concatenate([np.zeros((max(0, -phase), len(CHANNELS))), self._next()])
        )

    def _single(self) -> RawSamples:
        """A sample, and right after it the command for its tick."""
        reading = self._noted(self._guarded(1))
        tick = self._tick
        counts, rates = self._counted(reading)
        command, flags = self._queue.pop(tick, None), Flag(0)
        if self._latched:
            command = ZERO
        elif self._watch.first_beyond(reading.analog, counts, rates) == 0:
            command, flags = ZERO, Flag.INTERLOCK
            self._latch()
        elif command is None or self._now() > tick:
            command, flags = self._missing()
        if not np.array_equal(command, self._last):
            self._card.write(command)
        self._last = command
        self._delays.append(self._clock() - self._origin - tick / self._rate)
        ticks, flagged = np.array([tick]), np.array([int(flags)])
        return self._samples(ticks, reading, counts, rates, command[np.newaxis], flagged)

    def _missing(self) -> tuple[FloatArray, Flag]:
        """What is put out for a tick without a command in time, and its flag."""
        self._queue = {tick: volts for tick, volts in self._queue.items() if tick > self._tick}
        if self._is_closed_loop:
            return self._last, Flag.HELD
        self._latch()
        return ZERO, Flag.UNDERFLOW

    def _block(self) -> RawSamples | None:
        """Samples while the card plays by itself; None where all came before tick 0."""
        reading = self._noted(self._next_block(self._rate))
        n = len(reading.counts)
        ticks = np.arange(self._tick + 1 - n, self._tick + 1)
        early = max(0, -int(ticks[0]))
        if early >= n:
            return None
        ticks = ticks[early:]
        analog, rates = reading.analog[early:], reading.rates
        reading = Reading(analog, reading.counts[early:], None if rates is None else rates[early:])
        counts, rates = self._counted(reading)
        beyond = not self._latched and self._watch.first_beyond(analog, counts, rates) < len(ticks)
        if beyond:
            self._card.zero()
            self._marks[self._latch()] = Flag.INTERLOCK
        elif not self._latched:
            self._card.play(self._next())
        elif self._dry is not None and self._tick >= self._dry:
            self._dry = None
            self._card.zero()
        applied = np.array([self._played.pop(tick, ZERO) for tick in ticks.tolist()])
        self._played = {k: volts for k, volts in self._played.items() if k > self._tick}
        flags = np.array([int(self._marks.pop(tick, 0)) for tick in ticks.tolist()])
        return self._samples(ticks, reading, counts, rates, applied, flags)

    def _next(self) -> FloatArray:
        """Volts (n, 2) to hand on: what has been sent; too little of it, and zeros for good."""
        begin = self._end
        while self._end in self._queue:
            self._played[self._end] = self._queue.pop(self._end)
            self._end += 1
        rows = [self._played[tick] for tick in range(begin, self._end)]
        margin = math.ceil(_MARGIN * self._rate)
        if not self._latched and self._end - self._tick <= margin:
            self._dry, self._latched = self._end, True
            self._marks[self._dry] = Flag.UNDERFLOW
            rows += [ZERO] * 4 * margin
        return np.array(rows).reshape(-1, len(CHANNELS))

    def _latch(self) -> int:
        """Forget all commands until the next start; the tick from which the outputs are zero.

        That of outputs that the card plays is known as well as this computer's clock tells.
        """
        zero_from = self._now() + 1
        self._queue, self._latched, self._dry = {}, True, None
        self._played = {tick: volts for tick, volts in self._played.items() if tick < zero_from}
        return zero_from

    def _next_block(self, sample_rate: float) -> Reading:
        return self._guarded(max(1, round(_BLOCK * sample_rate)))

    def _guarded(self, n: int) -> Reading:
        """The next n samples, after which the watchdog is fed."""
        reading = self._card.read(n)
        self._card.feed()
        return reading

    def _noted(self, reading: Reading) -> Reading:
        """Count the ticks of what has just been read."""
        arrival = self._clock()
        self._tick += reading.lost + len(reading.counts)
        # Some samples come promptly: the earliest tell when tick 0 was, the clocks' drift aside.
        drifted = self._origin + _DRIFT * len(reading.counts) / self._rate
        self._origin = min(arrival - self._tick / self._rate, drifted)
        return reading

    def _now(self) -> int:
        """The tick that is on, by this computer's clock."""
        if math.isinf(self._origin):
            return self._tick
        return max(self._tick, math.floor((self._clock() - self._origin) * self._rate))

    def _counted(self, reading: Reading) -> tuple[FloatArray, FloatArray]:
        counts = self._counter.unwrapped(reading.counts)
        rates = reading.rates if reading.rates is not None else self._estimate.rates(counts)
        return counts.astype(np.float64), rates

    def _samples(
        self,
        ticks: IntArray,
        reading: Reading,
        counts: FloatArray,
        rates: FloatArray,
        applied: FloatArray,
        flags: IntArray,
    ) -> RawSamples:
        assert self._facts is not None
        low, high = self._facts.volts
        end = _SATURATED * (high - low)
        saturated = ((reading.analog <= low + end) | (reading.analog >= high - end)).any(axis=1)
        flags = flags | saturated * int(Flag.SATURATED)
        return RawSamples(ticks, reading.analog, counts, rates, applied, flags)
