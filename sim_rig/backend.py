"""The simulated rig: plant, sensing chain and a user at the handle, behind the HAL."""

import itertools
import math
import time
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from daq import hal
from daq.config.base import Section
from daq.config.units import Part, Radians, Seconds, Unit, Volts
from daq.errors import DeviceError
from daq.hal import ANALOG_INPUTS, CHANNELS, FloatArray, Guard, IntArray, Mode, Phase, RawSamples
from sim_rig.co_simulation import MOTION, CoSimulation, ForeignStepper
from sim_rig.device import command_queue, converters
from sim_rig.device.command_queue import CommandQueue
from sim_rig.device.converters import Converters, Interlock
from sim_rig.device.encoder import EncoderCounter
from sim_rig.device.user import SimulatedUser
from sim_rig.foreign import ForeignPlant
from sim_rig.plant import Plant, state_sizes
from sysid import ModelError, ProcessModel, Stepper

_BLOCK = 256  # ticks simulated at once in open loop
_REAL_TIME_BLOCK = 0.02  # s between deliveries of a device in real time
_ACCURACY = 1e-4  # of the plant's states in parts of what matters: a tenth of the noise and below
# Of the motion between which edges of the encoder are timed, and at least so many a tick: the
# motor's current settles in few.
_LONGEST_STEP, _FEWEST_STEPS = 8e-5, 4  # s
_INTERLOCK = int(hal.Flag.INTERLOCK)
_OUTPUT_BITS, _IDEAL_BITS = 16, 24  # of the converters that a board would have


class Imperfections(Section):
    """The sensing chain's errors; ``ideal`` in the simulation's options turns them all off."""

    noise: Volts = Field(0.010, ge=0.0, le=1.0, description="rms on every analog input")
    offset: Volts = Field(
        0.020, ge=0.0, le=1.0, description="largest offset of an analog input, drawn by seed"
    )
    bits: int = Field(16, ge=8, le=24, description="resolution of the converters")


class Faults(Section):
    """What goes wrong between host and device; the same seed, the same faults."""

    late: Part = Field(
        0.0,
        ge=0.0,
        le=1.0,
        description="share of closed-loop commands that take a tick more to arrive: too late "
        "where the experiment answers one tick ahead",
    )
    lost: Part = Field(0.0, ge=0.0, lt=1.0, description="share of samples that do not arrive")


class Simulation(Section):
    """Options of the simulated rig."""

    seed: int | None = Field(
        None,
        ge=0,
        le=2**32 - 1,
        description="of noise and offsets; null: another for each run of a folder, written down",
    )
    ideal: bool = Field(False, description="no noise, offsets or quantisation")
    time: Literal["virtual", "real"] = Field(
        "virtual", description="as fast as it can, or at the pace of the clock"
    )
    plant: Plant = Field(Plant(), description="parts of the actuator and what hangs on it")
    fmu: ForeignPlant | None = Field(
        None, description="another program's plant instead: an FMU for co-simulation"
    )
    imperfections: Imperfections = Field(Imperfections(), description="of the sensing chain")
    faults: Faults = Field(Faults(), description="of the connection")
    hand: list[tuple[Seconds, Radians]] = Field(
        default_factory=list,
        description="of load 'hand': [time, angle] from the start of the run and from there on, "
        "through which its wrist moves",
    )
    hand_path: Literal["lines", "smooth"] = Field(
        "lines",
        description="straight lines from point to point, or smoothly, at rest at both ends",
    )
    current_sense: Annotated[float, Unit("V/A")] = Field(
        2.0, gt=0.0, description="gain of both channels' current sensors"
    )
    torque_sense: Annotated[float, Unit("V/(N*m)")] = Field(
        5.0 / 3.53, gt=0.0, description="gain of the torque bridge"
    )
    encoder_cycles: int = Field(2048, ge=1, description="cycles per revolution")

    @property
    def cable(self) -> bool:
        """Whether what hangs on the shaft has a cable that can be wound off."""
        return self.fmu is None and self.plant.load == "pulley"

    @field_validator("hand")
    @classmethod
    def _forwards(cls, path: list[tuple[float, float]]) -> list[tuple[float, float]]:
        for before, after in itertools.pairwise([(0.0, 0.0), *path]):
            if after[0] <= before[0]:
                raise ValueError(
                    f"[{after[0]:g}, {after[1]:g}] does not follow [{before[0]:g}, {before[1]:g}]; "
                    "write [time, angle] with times above 0 that rise"
                )
        return path

    @model_validator(mode="after")
    def _has_one_plant(self) -> Self:
        if self.fmu is not None and {"plant", "hand"} & self.model_fields_set:
            raise ValueError("fmu: it stands instead of plant and hand; leave those out")
        return self

    @model_validator(mode="after")
    def _has_a_hand(self) -> Self:
        if self.hand and self.plant.load != "hand":
            raise ValueError(
                f"hand: moves load 'hand', but the load is {self.plant.load!r}; "
                "write 'load: hand' under plant, or leave it out"
            )
        return self


class SimulatedDevice:
    """A device whose plant is computed (see ``daq.hal.Device`` for the methods).

    The same seed gives the same samples to the bit. In virtual time it runs as fast as it can
    and waits for the host; in real time it keeps pace with the clock and does not wait.
    """

    Options = Simulation

    def __init__(self, options: Simulation) -> None:
        self.options = options
        self._unit = CoSimulation(options.fmu) if options.fmu is not None else None
        self._plant = options.plant.build()
        self._motion = [self._plant.state_names.index(name) for name in ("theta", "omega")]
        self._n_inputs = len(self._plant.inputs)
        holds = options.plant.load == "hand"
        if self._unit is not None:
            self._motion, self._n_inputs = [0, 1], len(CHANNELS)
        self._user = SimulatedUser(holds, options.hand, options.hand_path == "smooth")
        seed = options.seed or 0
        self._rng = np.random.default_rng(seed)
        worst = 0.0 if options.ideal else options.imperfections.offset
        senses = np.array([options.current_sense, options.current_sense, options.torque_sense])
        offsets = self._rng.uniform(-worst, worst, len(ANALOG_INPUTS))
        step = 0.0 if options.ideal else 2.0 * converters.RANGE / 2**options.imperfections.bits
        self._converters = Converters(senses, offsets, options.imperfections.noise, step)
        self._noise, self._noise_used = np.empty((0, len(ANALOG_INPUTS))), 0
        self._single = np.zeros((2, self._n_inputs))
        self._steppers: dict[float, Stepper | ForeignStepper] = {}
        # Draws of their own, so that the noise stays what it is without them.
        self._chance = np.random.default_rng([seed, 1])
        self._encoder_phase = float(np.random.default_rng([seed, 2]).random())
        self._late: list[tuple[int, FloatArray]] = []
        self._queue = CommandQueue()
        self._clock = 0.0  # device time since it was switched on [s], at the next tick
        self._origin = 0.0  # and at tick 0
        self._open = False
        self._running = False

    def open(self) -> hal.DeviceInfo:
        """Switch on, the load let down since the last time; sampling starts with ``start``."""
        self._warm_up()
        self._open = True
        self._x = self._plant.initial_state
        if self._unit is not None:
            self._unit.open()
            self._x = self._unit.values[MOTION]
        self._encoder = EncoderCounter(4 * self.options.encoder_cycles, self._encoder_phase)
        return hal.DeviceInfo(
            name="simulated rig",
            max_rate=20_000.0,
            queue=command_queue.SIZE,
            volts_in=(-converters.RANGE, converters.RANGE),
            virtual_time=self.options.time == "virtual",
            step_out=self._converters.resolution,
        )

    def announce(self, phase: Phase, turns: float = 0.0) -> None:
        """The simulated user winds the handle when asked to, and otherwise keeps off."""
        self._user.stop()
        if phase is Phase.HOMING and turns > 0.0:
            self._user.wind(turns, self._clock, float(self._x[self._motion[0]]))
        if phase is Phase.RUN:
            self._user.move(self._clock)

    def start(self, sample_rate: float, mode: Mode, guard: Guard) -> None:
        """Begin with tick 0; in open loop when the first commands are there."""
        if not self._open:
            raise DeviceError("the simulated rig is not open; open it before starting")
        self._stepper = self._stepper_at(sample_rate)
        self._rate, self._guard, self._interlock = sample_rate, guard, Interlock(guard)
        self._waits_for_commands = mode is Mode.OPEN_LOOP
        self._origin = self._clock
        self._queue.restart(mode)
        self._late = []
        self._running = True
        self._wall_start: float | None = None

    def send(self, tick: int, commands: FloatArray) -> None:
        """Queue commands; those for ticks already past are too late and dropped."""
        self._require_running()
        volts = np.ascontiguousarray(commands, dtype=np.float64)
        limited = self._converters.commands(volts, self._guard)
        if self._delayed(tick):
            self._late.append((tick, limited))
        else:
            self._queue.put(tick, limited)
        if self._wall_start is None:
            self._wall_start = time.perf_counter()

    def room(self) -> int:
        """Commands that still fit the queue."""
        return command_queue.SIZE - self._queue.queued

    def receive(self) -> RawSamples:
        """Simulate what is queued, or one tick when nothing is."""
        self._require_running()
        while True:
            guarded = not self._queue.latched
            applied, flags = self._queue.take(self._due())
            raw = self._play(applied, flags, guarded)
            for tick, commands in self._late:
                self._queue.put(tick, commands)
            self._late = []
            if self.options.faults.lost == 0.0:
                return raw
            kept = self._chance.random(len(raw.tick)) >= self.options.faults.lost
            if kept.any():
                return RawSamples(**{name: values[kept] for name, values in vars(raw).items()})

    def latch(self) -> RawSamples:
        """The inputs at the next tick, which no command of that tick changes; nothing moves on."""
        self._require_running()
        before, memory = self._x.copy(), self._encoder.memory.copy()
        zeros, flags = np.zeros((1, len(CHANNELS))), np.zeros(1, dtype=np.int64)
        raw, _ = self._simulate(zeros, flags, self._unit_noise(1), self._unit is None)
        self._x, self._encoder.memory = before, memory
        self._noise_used -= 1
        return raw

    def stop(self) -> None:
        """End sampling."""
        self.safe()
        self._running = False

    def safe(self) -> None:
        """Forget all commands; the outputs are zero from the next tick on."""
        self._queue.latch()

    def close(self) -> None:
        """Switch off."""
        self.safe()
        self._open = self._running = False
        if self._unit is not None:
            self._unit.close()

    def process_model(self) -> ProcessModel:
        """The plant's process model, with its values as nominal ones; may raise ModelError."""
        self._require_equations()
        return self.options.plant.process_model()

    def plant_model(self, turns: float) -> ProcessModel:
        """The whole plant as commands drive it, so many turns wound up; may raise ModelError."""
        self._require_equations()
        return self.options.plant.driven(turns if self.options.cable else 0.0)

    def board(self) -> hal.Electronics:
        """The same rig anew, in virtual time and without faults of its connection."""
        options = self.options.model_copy(update={"time": "virtual", "faults": Faults()})
        bits = _IDEAL_BITS if options.ideal else options.imperfections.bits
        volts = (-converters.RANGE, converters.RANGE)
        step_in, step_out = (2.0 * converters.RANGE / 2**n for n in (bits, _OUTPUT_BITS))
        device = SimulatedDevice(options)
        return hal.Electronics(device, volts, step_in, step_out, device.latch)

    def _require_equations(self) -> None:
        if self.options.fmu is not None:
            name = Path(self.options.fmu.file).name
            raise ModelError(f"the plant is {name}, whose equations nobody knows; name a model")

    def _warm_up(self) -> None:
        """Import and compile what the plant is computed with, once."""
        if not self._steppers and self._unit is None:
            u = np.zeros((2, self._n_inputs))
            self._stepper_at(1000.0).advance(self._plant.initial_state, u)

    def _stepper_at(self, sample_rate: float) -> Stepper | ForeignStepper:
        if sample_rate not in self._steppers and self._unit is not None:
            self._steppers[sample_rate] = ForeignStepper(self._unit, sample_rate)
        if sample_rate not in self._steppers:
            plant, scale = self._plant, state_sizes(self._plant)
            dt = 1.0 / sample_rate
            n_steps = max(_FEWEST_STEPS, math.ceil(dt / _LONGEST_STEP))
            self._steppers[sample_rate] = Stepper(
                plant, plant.nominal, dt, n_steps=n_steps, scale=scale, accuracy=_ACCURACY
            )
        return self._steppers[sample_rate]

    def _require_running(self) -> None:
        if not self._running:
            raise DeviceError("the simulated rig is not sampling; start it first")

    def _delayed(self, tick: int) -> bool:
        """Whether commands come too late; the first, before the clock runs, never do."""
        share = self.options.faults.late
        if share == 0.0 or self._waits_for_commands or tick == 0:
            return False
        return bool(self._chance.random() < share)

    def _due(self) -> int:
        """How many ticks to play now; waits for them in real time."""
        if self.options.time == "virtual":
            return min(max(self._queue.queued, 1), self._block)
        if self._wall_start is None:
            self._wall_start = time.perf_counter()
        in_blocks = self._waits_for_commands and not self._queue.latched
        ticks = max(1, round(_REAL_TIME_BLOCK * self._rate)) if in_blocks else 1
        # Tick k is latched at k/rate; it can be delivered from then on.
        until = self._wall_start + (self._queue.tick + ticks - 1) / self._rate
        while (wait := until - time.perf_counter()) > 0.0:
            time.sleep(wait)
        elapsed = math.floor((time.perf_counter() - self._wall_start) * self._rate) + 1
        return max(1, min(elapsed - self._queue.tick, self._block))

    @property
    def _block(self) -> int:
        """Ticks simulated at once: a single one of a plant that cannot go back to an interlock."""
        return _BLOCK if self._unit is None else 1

    def _play(self, applied: FloatArray, flags: IntArray, guarded: bool) -> RawSamples:
        """Simulate the ticks; where an input passes its guard, again with zeros from there."""
        n = len(applied)
        noise, memory = self._unit_noise(n), self._encoder.memory.copy()
        moving = self._unit is None or not guarded  # else looked at before it moves on
        raw, trace = self._simulate(applied, flags.copy() if not moving else flags, noise, moving)
        row = self._interlock.first_beyond(raw.analog, raw.counts, raw.count_rate) if guarded else n
        if row < n:
            applied[row:] = 0.0
            flags[row:] = 0
            flags[row] = _INTERLOCK
            # The trace begins with where the ticks began.
            self._x, self._encoder.memory = trace[0].copy(), memory
            raw, _ = self._simulate(applied, flags, noise)
            self._queue.latch()
        elif not moving:
            raw, _ = self._simulate(applied, flags, noise)
        self._queue.advance(n)
        # Not summed up tick by tick: rounding would make it depend on the size of the blocks.
        self._clock = self._origin + self._queue.tick / self._rate
        return raw

    def _simulate(
        self, applied: FloatArray, flags: IntArray, noise: FloatArray, moving: bool = True
    ) -> tuple[RawSamples, FloatArray]:
        """Latch, apply, advance: the samples of n ticks, and the plant's trace.

        moving: False to look at an FMU without advancing it.
        """
        n, tick, per_tick = len(applied), self._queue.tick, self._stepper.n_steps
        if isinstance(self._stepper, ForeignStepper) and not moving:
            trace, true = self._stepper.look()
        else:
            trace, true = self._stepper.advance(self._x, self._inputs(applied))
        times = self._origin, tick * per_tick, 1.0 / (self._rate * per_tick), per_tick
        motion = self._motion
        counts, rates = self._encoder.latch(trace[:, motion], self._x[motion], *times)
        if self.options.ideal:
            per_radian = self._encoder.counts_per_turn / (2.0 * math.pi)
            counts, rates = true[:, 3] * per_radian, true[:, 4] * per_radian
        volts = self._converters.read(true, noise, flags)
        ticks = np.arange(tick, tick + n, dtype=np.int64)
        return RawSamples(ticks, volts, counts, rates, applied, flags), trace

    def _inputs(self, applied: FloatArray) -> FloatArray:
        """The plant's inputs at the ticks and at the one that follows, (n + 1, n_inputs)."""
        n = len(applied)
        if n == 1 and self._user.away:
            u = self._single  # saves a closed loop an allocation every tick
            u[0, 0], u[0, 1] = applied[0, 0], applied[0, 1]
            return u
        u = np.zeros((n + 1, self._n_inputs))
        u[:n, : len(CHANNELS)] = applied
        if self._n_inputs > len(CHANNELS) and not self._user.away:
            times = self._origin + (self._queue.tick + np.arange(n + 1)) / self._rate
            u[:, len(CHANNELS) :] = self._user.motion(times)
        return u

    def _unit_noise(self, n: int) -> FloatArray:
        """The next n rows of the noise, (n, 3); drawn ahead, which does not change them."""
        if self._noise_used + n > len(self._noise):
            left = self._noise[self._noise_used :]
            more = self._rng.standard_normal((max(n, _BLOCK), len(ANALOG_INPUTS)))
            self._noise, self._noise_used = np.concatenate([left, more]), 0
        first = self._noise_used
        self._noise_used += n
        return self._noise[first : self._noise_used]
