"""The simulated rig: plant, sensing chain and a user at the handle, behind the HAL."""

from __future__ import annotations

import math
import time
from typing import Literal

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.errors import DeviceError
from daq.hal import (
    ANALOG_INPUTS,
    CHANNELS,
    DeviceInfo,
    Flag,
    FloatArray,
    Guard,
    IntArray,
    Mode,
    Phase,
    RawSamples,
)
from sim_rig.encoder import EncoderCounter
from sim_rig.plant import Plant
from sysid import Stepper

_QUEUE = 65_536
_BLOCK = 256  # ticks simulated at once in open loop
_REAL_TIME_BLOCK = 0.02  # s between deliveries of a device in real time
_TURN_TIME = 1.0  # s, the simulated user's pace at the handle
_REST = 0.5  # s, holding still before letting go
_OVERWIND = 0.1  # turns
_CONVERTER_RANGE = 10.0  # V, either side of zero
_THETA = 6  # the plant's state


class Imperfections(Section):
    """The sensing chain's errors; ``ideal`` in the simulation's options turns them all off."""

    noise: float = Field(0.010, ge=0.0, le=1.0, description="rms on every analog input [V]")
    offset: float = Field(
        0.020, ge=0.0, le=1.0, description="largest offset of an analog input, drawn by seed [V]"
    )
    bits: int = Field(16, ge=8, le=24, description="resolution of the converters")


class Simulation(Section):
    """Options of the simulated rig."""

    seed: int = Field(0, ge=0, le=2**32 - 1, description="of noise and offsets")
    ideal: bool = Field(False, description="no noise, offsets or quantisation")
    time: Literal["virtual", "real"] = Field(
        "virtual", description="as fast as it can, or at the pace of the clock"
    )
    plant: Plant = Field(Plant(), description="parts of the actuator and what hangs on it")
    imperfections: Imperfections = Field(Imperfections(), description="of the sensing chain")
    current_sense: float = Field(2.0, gt=0.0, description="of both channels [V/A]")
    torque_sense: float = Field(5.0 / 3.53, gt=0.0, description="torque bridge [V per N*m]")
    encoder_cycles: int = Field(2048, ge=1, description="cycles per revolution")


class SimulatedDevice:
    """A device whose plant is computed (see ``daq.hal.Device`` for the methods).

    The same seed gives the same samples to the bit. In virtual time it runs as fast as it can
    and waits for the host; in real time it keeps pace with the clock and does not wait.
    """

    Options = Simulation

    def __init__(self, options: Simulation) -> None:
        self.options = options
        self._plant = options.plant.build()
        self._held_by_hand = options.plant.load == "hand"
        self._rng = np.random.default_rng(options.seed)
        worst = 0.0 if options.ideal else options.imperfections.offset
        self._offsets = self._rng.uniform(-worst, worst, len(ANALOG_INPUTS))
        self._senses = np.array(
            [options.current_sense, options.current_sense, options.torque_sense]
        )
        self._steppers: dict[float, Stepper] = {}
        self._p = self._plant.nominal
        self._user_turns = 0.0
        self._user_start: float | None = None
        self._user_from = 0.0
        self._rest_angle = 0.0
        self._clock = 0.0  # device time since it was switched on [s], at the next tick
        self._origin = 0.0  # and at tick 0
        self._open = False
        self._running = False
        self._reset_queue()

    def open(self) -> DeviceInfo:
        """Switch on, the load let down since the last time; sampling starts with ``start``."""
        self._open = True
        self._x = self._plant.initial_state
        self._encoder = EncoderCounter(4 * self.options.encoder_cycles)
        return DeviceInfo(
            name="simulated rig",
            max_rate=20_000.0,
            queue=_QUEUE,
            volts_in=(-_CONVERTER_RANGE, _CONVERTER_RANGE),
            virtual_time=self.options.time == "virtual",
        )

    def announce(self, phase: Phase, turns: float = 0.0) -> None:
        """The simulated user winds the handle when asked to, and otherwise keeps off."""
        if self._user_start is not None:
            self._user_start = None
            self._rest_angle = self._user_from + 2.0 * math.pi * (self._user_turns + _OVERWIND)
        if phase is Phase.HOMING and turns > 0.0:
            self._user_turns = turns
            self._user_start = self._clock
            self._user_from = float(self._x[_THETA])

    def start(self, sample_rate: float, mode: Mode, guard: Guard) -> None:
        """Begin with tick 0; in open loop when the first commands are there."""
        if not self._open:
            raise DeviceError("the simulated rig is not open; open it before starting")
        if sample_rate not in self._steppers:
            self._steppers[sample_rate] = Stepper(self._plant, self._p, 1.0 / sample_rate)
        self._stepper = self._steppers[sample_rate]
        self._rate, self._mode, self._guard = sample_rate, mode, guard
        self._origin = self._clock
        self._reset_queue()
        self._running = True
        self._wall_start: float | None = None

    def send(self, tick: int, commands: FloatArray) -> None:
        """Queue commands; those for ticks already past are too late and dropped."""
        self._require_running()
        late = max(0, self._tick - tick)
        if late < len(commands):
            self._queue.append(np.array(commands[late:], dtype=np.float64))
            self._queued_until = tick + len(commands)
        if self._wall_start is None:
            self._wall_start = time.perf_counter()

    def room(self) -> int:
        """Commands that still fit the queue."""
        return _QUEUE - (self._queued_until - self._tick)

    def receive(self) -> RawSamples:
        """Simulate what is queued, or one tick when nothing is."""
        self._require_running()
        n = self._due()
        applied, flags = self._commands(n)
        return self._play(applied, flags)

    def stop(self) -> None:
        """End sampling."""
        self.safe()
        self._running = False

    def safe(self) -> None:
        """Forget all commands; the outputs are zero from the next tick on."""
        self._queue: list[FloatArray] = []
        self._queued_until = self._tick
        self._held = np.zeros(len(CHANNELS))
        self._latched = True

    def close(self) -> None:
        """Switch off."""
        self.safe()
        self._open = self._running = False

    def _require_running(self) -> None:
        if not self._running:
            raise DeviceError("the simulated rig is not sampling; start it first")

    def _reset_queue(self) -> None:
        self._tick = 0
        self.safe()
        self._latched = False

    def _due(self) -> int:
        """How many ticks to play now; waits for them in real time."""
        queued = self._queued_until - self._tick
        open_loop = self._mode is Mode.OPEN_LOOP and not self._latched
        if self.options.time == "virtual":
            return min(max(queued, 1), _BLOCK)
        if self._wall_start is None:
            self._wall_start = time.perf_counter()
        ticks = max(1, round(_REAL_TIME_BLOCK * self._rate)) if open_loop else 1
        # Tick k is latched at k/rate; it can be delivered from then on.
        until = self._wall_start + (self._tick + ticks - 1) / self._rate
        while (wait := until - time.perf_counter()) > 0.0:
            time.sleep(wait)
        elapsed = math.floor((time.perf_counter() - self._wall_start) * self._rate) + 1
        return max(1, min(elapsed - self._tick, _BLOCK))

    def _commands(self, n: int) -> tuple[FloatArray, IntArray]:
        """What will be applied in the next n ticks, before interlocks, and why."""
        applied = np.zeros((n, len(CHANNELS)))
        flags = np.zeros(n, dtype=np.int64)
        filled = 0
        while filled < n and self._queue:
            head = self._queue[0]
            take = min(n - filled, len(head))
            applied[filled : filled + take] = head[:take]
            self._queue[0] = head[take:]
            if take == len(head):
                self._queue.pop(0)
            filled += take
        if self._latched:
            applied[:] = 0.0
            return applied, flags
        if filled:
            self._held = applied[filled - 1].copy()
        if filled < n:
            if self._mode is Mode.CLOSED_LOOP:
                applied[filled:] = self._held
                flags[filled:] |= int(Flag.HELD)
            elif self._tick + filled > 0:
                flags[filled:] |= int(Flag.UNDERFLOW)
                self._latched = True
        if not self.options.ideal:
            resolution = 2.0 * _CONVERTER_RANGE / 2**self.options.imperfections.bits
            applied = np.round(applied / resolution) * resolution
        return np.clip(applied, self._guard.command_low, self._guard.command_high), flags

    def _play(self, applied: FloatArray, flags: IntArray) -> RawSamples:
        """Simulate the ticks; where an input passes its guard, again with zeros from there."""
        n = len(applied)
        noise = self._rng.standard_normal((n, len(ANALOG_INPUTS)))
        before, encoder = self._x.copy(), self._encoder.copy()
        raw = self._simulate(applied, flags, noise)
        beyond = np.any(
            (raw.analog < self._guard.analog_low) | (raw.analog > self._guard.analog_high), axis=1
        )
        if beyond.any() and not self._latched:
            row = int(np.argmax(beyond))
            applied, flags = applied.copy(), flags.copy()
            applied[row:] = 0.0
            flags[row:] = 0
            flags[row] = int(Flag.INTERLOCK)
            self._x, self._encoder = before, encoder
            raw = self._simulate(applied, flags, noise)
            self.safe()
        self._tick += n
        self._queued_until = max(self._queued_until, self._tick)
        # Not summed up tick by tick: rounding would make it depend on the size of the blocks.
        self._clock = self._origin + self._tick / self._rate
        return raw

    def _simulate(self, applied: FloatArray, flags: IntArray, noise: FloatArray) -> RawSamples:
        """Latch, apply, advance: n ticks of plant and sensing chain."""
        n = len(applied)
        u = np.empty((n + 1, len(self._plant.inputs)))
        u[:n, :2], u[n, :2] = applied, applied[-1]
        if u.shape[1] > 2:
            u[:, 2:] = self._hand(self._origin + (self._tick + np.arange(n + 1)) / self._rate)
        per_tick = self._stepper.n_steps
        trace, true = self._stepper.advance(self._x, u)
        angles = np.append(trace[:, _THETA], self._x[_THETA])
        counts, rates = self._encoder.latch(
            angles, self._origin, self._tick * per_tick, 1.0 / (self._rate * per_tick), per_tick
        )
        analog = true[:, :3] * self._senses
        if self.options.ideal:
            per_radian = self._encoder.counts_per_turn / (2.0 * math.pi)
            counts, rates = true[:, 3] * per_radian, true[:, 4] * per_radian
        else:
            analog, flags = self._convert(analog, noise, flags)
        ticks = self._tick + np.arange(n, dtype=np.int64)
        return RawSamples(ticks, analog, counts, rates, applied, flags)

    def _convert(
        self, volts: FloatArray, noise: FloatArray, flags: IntArray
    ) -> tuple[FloatArray, IntArray]:
        """What the converters make of the volts at the analog inputs."""
        flaws = self.options.imperfections
        resolution = 2.0 * _CONVERTER_RANGE / 2**flaws.bits
        volts = volts + self._offsets + flaws.noise * noise
        beyond = np.any(np.abs(volts) >= _CONVERTER_RANGE, axis=1)
        flags = np.where(beyond, flags | int(Flag.SATURATED), flags)
        rounded = np.round(volts / resolution) * resolution
        return np.clip(rounded, -_CONVERTER_RANGE, _CONVERTER_RANGE - resolution), flags

    def _hand(self, times: FloatArray) -> FloatArray:
        """Grip, angle and speed of the simulated user's hand at the given times, (n, 3).

        A hand that is the load never lets go: it stays where it has wound the handle to.
        """
        hand = np.zeros((len(times), 3))
        hand[:, 0] = self._held_by_hand
        hand[:, 1] = self._rest_angle
        if self._user_start is None:
            return hand
        elapsed = times - self._user_start
        length = max(self._user_turns * _TURN_TIME, _TURN_TIME)
        share = np.clip(elapsed / length, 0.0, 1.0)
        # A raised cosine in speed: the hand starts and stops softly. It winds a little
        # further than asked, as one does against a spring.
        angle = 2.0 * math.pi * (self._user_turns + _OVERWIND)
        hand[:, 0] = self._held_by_hand | (elapsed < length + _REST)
        hand[:, 1] = self._user_from + angle * (share - np.sin(2 * math.pi * share) / (2 * math.pi))
        hand[:, 2] = angle / length * (1.0 - np.cos(2.0 * math.pi * share)) * (share < 1.0)
        return hand
