"""A device with its calibration: SI units and clamps in one place."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, TypeVarTuple

import numpy as np

from daq.config.rig import COUNT_GRAIN, RigConfig
from daq.contract import call, checked_info, checked_report, checked_room, checked_samples
from daq.errors import DeviceError, RigError
from daq.hal import (
    ANALOG_INPUTS,
    CHANNELS,
    DEVICE_FLAGS,
    Answering,
    Device,
    DeviceInfo,
    Flag,
    FloatArray,
    Guard,
    IntArray,
    LawScales,
    Mode,
    Phase,
    RawSamples,
    Reporting,
    Samples,
)

_Arguments = TypeVarTuple("_Arguments")
_Result = TypeVar("_Result")


class Rig:
    """A rig to command and sample in SI units.

    offsets: volts that each analog input reads at zero, (3,) in ``ANALOG_INPUTS`` order.
    saturated: samples in which each stood at the end of its converter, (3,). sampling: between
    ``start`` and ``stop``, after ``safe`` as well. call: the method of an open device that has not
    returned yet, and since when [s] by ``time.perf_counter``. Use as a context manager: leaving it,
    by whatever way, zeroes the outputs and closes the device.
    """

    def __init__(self, device: Device, config: RigConfig) -> None:
        self.config = config
        self.offsets = np.zeros(len(ANALOG_INPUTS))
        self.saturated: IntArray = np.zeros(len(ANALOG_INPUTS), dtype=np.int64)
        inputs = [getattr(config.sensors, name) for name in ANALOG_INPUTS]
        self._scale = np.array([item.sign * item.scale for item in inputs])
        self.sampling = False
        self.call: tuple[str, float] | None = None
        self.returned = 0.0  # when the last call of the backend ended, by ``time.perf_counter``
        self._unsafe = ""  # why the device could not be told to zero its outputs
        self._device = device
        self._info: DeviceInfo | None = None
        self._radians = 0.0  # per count
        self._reset(1.0, 1)

    def _reset(self, sample_rate: float, n_commands: int) -> None:
        """Forget all ticks; n_commands: how many commands may be on their way."""
        self._rate = sample_rate
        # Commands before clamping, and whether they were clamped, by tick modulo the length.
        self._commands = np.zeros((n_commands, len(CHANNELS)))
        self._clamped = np.zeros(n_commands, dtype=bool)
        self._next_command = 0  # tick
        self._last_tick = -1
        limits = [getattr(self.config.limits.command, name) for name in CHANNELS]
        self._low, self._high = np.array(limits).T.copy()
        self._step = self._largest_step()  # V from tick to tick
        self._last_command = np.zeros(len(CHANNELS))  # V

    def __enter__(self) -> Rig:
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def info(self) -> DeviceInfo:
        """What the open device says of itself."""
        if self._info is None:
            raise DeviceError("the rig is not open", cure="call open() first")
        return self._info

    def open(self) -> DeviceInfo:
        """Connect to the device, outputs at zero."""
        self._info = checked_info(call(self._device.open))
        return self._info

    def announce(self, phase: Phase, turns: float = 0.0) -> None:
        """Tell the device which phase of the run begins."""
        call(self._device.announce, phase, turns)

    def start(
        self, sample_rate: float, mode: Mode, window: tuple[float, float] = (-math.inf, math.inf)
    ) -> None:
        """Begin sampling at ``sample_rate`` [Hz]; tick 0 is the first sample.

        window: angles [rad] from the first sample's which the device shall not let the shaft
        leave under power.
        """
        if sample_rate > self.info.max_rate:
            raise DeviceError(
                f"{self.info.name} samples at up to {self.info.max_rate:g} Hz; "
                f"sample_rate {sample_rate:g} Hz is too fast for it"
            )
        # Twice what the device can hold ahead: as much may be on its way back.
        self._reset(sample_rate, 2 * self.info.queue)
        self._radians = self.config.sensors.encoder.count
        self._timed(self._device.start, sample_rate, mode, self._guard(window))
        self.sampling = True

    def send(self, tick: int, commands: FloatArray) -> None:
        """Queue commands (n, 2) [V] for consecutive ticks from ``tick``; clamped to the limits.

        Ticks must follow one another without a gap. Where the limits have a slew, a command
        follows the one before no faster than that.
        """
        if tick != self._next_command:
            raise DeviceError(f"commands for tick {tick} follow those until {self._next_command}")
        commands = np.asarray(commands, dtype=np.float64)
        limited = np.minimum(np.maximum(commands, self._low), self._high)
        if self._step is not None:
            limited = self._slewed(limited, self._step)
        changed = limited != commands
        # Whatever is not finite is changed by the limits, or is NaN and differs from itself.
        if changed.any() and not np.isfinite(commands).all():
            raise DeviceError(f"a command from tick {tick} on is not a finite number of volts")
        places = self._places(tick, len(commands))
        self._commands[places] = commands
        self._clamped[places] = changed.any(axis=1) if changed.any() else False
        self._next_command += len(commands)
        self._timed(self._device.send, tick, limited)

    def answer(self, first: int, blend: int, reference: float | None) -> None:
        """From tick ``first`` on the device's own torque controller answers; None: no longer.

        blend: ticks over which the outputs move over. reference: torque on the hand that a volt of
        the motor's command asks for meanwhile [N*m/V]. Raises DeviceError for a device without.
        """
        if not isinstance(self._device, Answering):
            raise DeviceError(f"{self.info.name} has no torque controller aboard")
        scales = None
        if reference is not None:
            zeros = -self._scale * self.offsets
            current, _, torque = zip(self._scale.tolist(), zeros.tolist(), strict=True)
            scales = LawScales(self._radians, current, torque, reference)
        self._timed(self._device.answer, first, blend, scales)

    def take_offsets(self, means: Mapping[str, float]) -> None:
        """Make what the inputs read now, in SI units by name, their zero."""
        read = np.array([means[name] for name in ANALOG_INPUTS])
        self.offsets = self.offsets + read / self._scale

    def room(self) -> int:
        """How many more commands the device can take now."""
        return min(checked_room(self._timed(self._device.room)), self.info.queue)

    def receive(self) -> Samples:
        """Wait for samples; all that have arrived, in SI units, offsets removed."""
        return self._to_si(checked_samples(self._timed(self._device.receive), self._last_tick))

    def stop(self) -> None:
        """End sampling with zero outputs."""
        self.sampling = False
        self._timed(self._device.stop)

    def safe(self) -> None:
        """Zero both outputs now; never raises but for signals. ``report`` says that it failed."""
        try:
            self._timed(self._device.safe)
        except Exception as error:
            # A backend's mistake here must not keep the rest of the way out from being gone.
            self._unsafe = self._unsafe or str(error)

    def report(self) -> dict[str, Any]:
        """What the device has to say for the record of a run; nothing for most, or a warning."""
        report: dict[str, Any] = {}
        try:
            if isinstance(self._device, Reporting):
                report = checked_report(call(self._device.report))
        except RigError as error:
            report = {"warnings": [str(error)]}
        if self._unsafe:
            report["warnings"] = [*report.get("warnings", []), self._unsafe]
        return report

    def close(self) -> None:
        """Zero the outputs and disconnect."""
        self.safe()
        self.sampling = False
        call(self._device.close)

    def _timed(self, method: Callable[[*_Arguments], _Result], *args: *_Arguments) -> _Result:
        """What a method of the open device returns; ``call`` says that it is being waited for."""
        self.call = getattr(method, "__name__", "a method"), time.perf_counter()
        try:
            return call(method, *args)
        finally:
            self.call, self.returned = None, time.perf_counter()

    def _largest_step(self) -> FloatArray | None:
        """Largest change of each command from tick to tick, (2,) [V]; None without a slew limit."""
        slew = [getattr(self.config.limits.slew, name) for name in CHANNELS]
        if all(limit is None for limit in slew):
            return None
        return np.array(
            [math.inf if limit is None else limit / self._rate * (1 + 1e-9) for limit in slew]
        )

    def _slewed(self, commands: FloatArray, step: FloatArray) -> FloatArray:
        """The commands (n, 2) [V], each no further than ``step`` from the one applied before."""
        changes = np.abs(np.diff(commands, axis=0, prepend=[self._last_command]))
        if not (changes <= step).all():
            commands = commands.copy()
            last = self._last_command
            for row in range(len(commands)):
                last = np.minimum(np.maximum(commands[row], last - step), last + step)
                commands[row] = last
        if len(commands):
            self._last_command = commands[-1]
        return commands

    def _guard(self, window: tuple[float, float]) -> Guard:
        """Limits in volts and counts, so that the device can watch them itself."""
        limits = self.config.limits
        torque = math.inf if limits.torque is None else limits.torque
        bounds = np.array([limits.current.motor, limits.current.brake, torque])
        volts = bounds / np.abs(self._scale)
        counts_low, counts_high = sorted(angle / self._radians for angle in window)
        speed = math.inf if limits.speed is None else limits.speed
        per_tick = np.array([limits.encoder.fastest, speed]) / self._rate / abs(self._radians)
        return Guard(
            self._low,
            self._high,
            self.offsets - volts,
            self.offsets + volts,
            counts_low,
            counts_high,
            speed / abs(self._radians),
            # A count that is about to come may come early or late.
            min(per_tick[0], per_tick[1] + COUNT_GRAIN),
        )

    def _places(self, tick: int, n: int) -> slice | IntArray:
        """Where the commands of n ticks are kept."""
        start = tick % len(self._commands)
        if start + n <= len(self._commands):
            return slice(start, start + n)
        return np.arange(tick, tick + n) % len(self._commands)

    def _to_si(self, raw: RawSamples) -> Samples:
        analog = (raw.analog - self.offsets) * self._scale
        first, last, n = int(raw.tick[0]), int(raw.tick[-1]), len(raw.tick)
        if last - first == n - 1 and last < self._next_command:
            places = self._places(first, n)
        else:
            # A tick without a command counts as the one before.
            places = np.minimum(raw.tick, max(self._next_command - 1, 0)) % len(self._commands)
        commands, flags = self._commands[places].copy(), raw.flags.copy()
        if flags.any():
            flags &= DEVICE_FLAGS
            self._count_saturated(raw)
            answered = (flags & int(Flag.LAW)) != 0
            commands[answered] = raw.applied[answered]  # what was sent were references
        if self._clamped[places].any():
            flags |= self._clamped[places] * int(Flag.CLAMPED)
        if first != self._last_tick + 1:
            flags[0] |= int(Flag.LOST)
        if last - first != n - 1:
            flags[1:][np.diff(raw.tick) != 1] |= int(Flag.LOST)
        self._last_tick = last
        return Samples(
            tick=raw.tick,
            time=raw.tick / self._rate,
            cmd_voltage_motor=commands[:, 0],
            cmd_voltage_brake=commands[:, 1],
            applied_voltage_motor=raw.applied[:, 0],
            applied_voltage_brake=raw.applied[:, 1],
            current_motor=analog[:, 0],
            current_brake=analog[:, 1],
            torque=analog[:, 2],
            theta=raw.counts * self._radians,
            omega=raw.count_rate * self._radians,
            flags=flags,
        )

    def _count_saturated(self, raw: RawSamples) -> None:
        low, high = self.info.volts_in
        end = 1e-3 * (high - low)  # V, of a converter whose last codes are not all used
        at_end = (raw.analog <= low + end) | (raw.analog >= high - end)
        marked = (raw.flags & int(Flag.SATURATED)) != 0
        self.saturated += np.count_nonzero(at_end & marked[:, None], axis=0)
