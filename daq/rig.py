"""A device with its calibration: SI units, clamps and interlocks in one place."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType

import numpy as np

from daq.config.rig import RigConfig
from daq.errors import DeviceError
from daq.hal import (
    ANALOG_INPUTS,
    CHANNELS,
    Device,
    DeviceInfo,
    Flag,
    FloatArray,
    Guard,
    IntArray,
    Mode,
    Phase,
    RawSamples,
    Samples,
)


@dataclass(frozen=True)
class Offsets:
    """Volts that each analog input reads at zero, (3,) in ``ANALOG_INPUTS`` order."""

    volts: FloatArray

    @classmethod
    def zero(cls) -> Offsets:
        """No offsets."""
        return cls(np.zeros(len(ANALOG_INPUTS)))


class Rig:
    """A rig to command and sample in SI units.

    Use as a context manager: leaving it, by whatever way, zeroes the outputs and closes the
    device.
    """

    def __init__(self, device: Device, config: RigConfig) -> None:
        self.config = config
        self.offsets = Offsets.zero()
        self._device = device
        self._asked: list[FloatArray] = []
        self._asked_until = 0
        self._first_asked = 0
        self._last_tick = -1
        self._rate = 1.0
        self._info: DeviceInfo | None = None

    def __enter__(self) -> Rig:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def info(self) -> DeviceInfo:
        """What the open device says of itself."""
        if self._info is None:
            raise DeviceError("the rig is not open; call open() first")
        return self._info

    def open(self) -> DeviceInfo:
        """Connect to the device, outputs at zero."""
        self._info = self._device.open()
        return self._info

    def announce(self, phase: Phase, turns: float = 0.0) -> None:
        """Tell the device which phase of the run begins."""
        self._device.announce(phase, turns)

    def start(self, sample_rate: float, mode: Mode) -> None:
        """Begin sampling at ``sample_rate`` [Hz]; tick 0 is the first sample."""
        if sample_rate > self.info.max_rate:
            raise DeviceError(
                f"{self.info.name} samples at up to {self.info.max_rate:g} Hz; "
                f"sample_rate {sample_rate:g} Hz is too fast for it"
            )
        self._asked.clear()
        self._asked_until = self._first_asked = 0
        self._last_tick = -1
        self._rate = sample_rate
        self._device.start(sample_rate, mode, self._guard())

    def send(self, tick: int, commands: FloatArray) -> None:
        """Queue commands (n, 2) [V] for consecutive ticks from ``tick``; clamped to the limits.

        Ticks must follow one another without a gap.
        """
        if tick != self._asked_until:
            raise DeviceError(f"commands for tick {tick} follow those until {self._asked_until}")
        commands = np.asarray(commands, dtype=np.float64)
        if not np.all(np.isfinite(commands)):
            raise DeviceError(f"a command from tick {tick} on is not a finite number of volts")
        self._asked.append(commands)
        self._asked_until += len(commands)
        low, high = self._command_limits()
        self._device.send(tick, np.clip(commands, low, high))

    def take_offsets(self, means: Mapping[str, float]) -> None:
        """Make what the inputs read now, in SI units by name, their zero."""
        read = np.array([means[name] for name in ANALOG_INPUTS])
        self.offsets = Offsets(self.offsets.volts + read / self._scales())

    def room(self) -> int:
        """How many more commands the device can take now."""
        return self._device.room()

    def receive(self) -> Samples:
        """Wait for samples; all that have arrived, in SI units, offsets removed."""
        return self._to_si(self._device.receive())

    def stop(self) -> None:
        """End sampling with zero outputs."""
        self._device.stop()

    def safe(self) -> None:
        """Zero both outputs now; never raises."""
        self._device.safe()

    def close(self) -> None:
        """Zero the outputs and disconnect."""
        self._device.safe()
        self._device.close()

    def _command_limits(self) -> tuple[FloatArray, FloatArray]:
        limits = [getattr(self.config.limits.command, name) for name in CHANNELS]
        return np.array([low for low, _ in limits]), np.array([high for _, high in limits])

    def _guard(self) -> Guard:
        """Current limits as volts at the inputs, so that the device can watch them itself."""
        command_low, command_high = self._command_limits()
        limits = self.config.limits.current
        bounds = np.array([limits.motor, limits.brake, np.inf])
        volts = bounds / np.abs(self._scales())
        return Guard(
            command_low, command_high, self.offsets.volts - volts, self.offsets.volts + volts
        )

    def _scales(self) -> FloatArray:
        inputs = [getattr(self.config.sensors, name) for name in ANALOG_INPUTS]
        return np.array([item.sign * item.scale for item in inputs])

    def _to_si(self, raw: RawSamples) -> Samples:
        encoder = self.config.sensors.encoder
        radians = encoder.sign * 2.0 * np.pi / (4.0 * encoder.cycles)
        analog = (raw.analog - self.offsets.volts) * self._scales()
        low, high = self._command_limits()
        asked = self._take_asked(raw.tick)
        flags = raw.flags.copy()
        flags[np.any((asked < low) | (asked > high), axis=1)] |= int(Flag.CLAMPED)
        before = np.concatenate([[self._last_tick], raw.tick[:-1]])
        flags[raw.tick != before + 1] |= int(Flag.LOST)
        self._last_tick = int(raw.tick[-1])
        return Samples(
            tick=raw.tick,
            time=raw.tick / self._rate,
            cmd_voltage_motor=asked[:, 0],
            cmd_voltage_brake=asked[:, 1],
            applied_voltage_motor=raw.applied[:, 0],
            applied_voltage_brake=raw.applied[:, 1],
            current_motor=analog[:, 0],
            current_brake=analog[:, 1],
            torque=analog[:, 2],
            theta=raw.counts * radians,
            omega=raw.count_rate * radians,
            flags=flags,
        )

    def _take_asked(self, ticks: IntArray) -> FloatArray:
        """What was asked for these ticks; a tick never asked for counts as the one before."""
        known = np.concatenate(self._asked) if self._asked else np.zeros((0, 2))
        if len(known) == 0:
            return np.zeros((len(ticks), 2))
        rows = np.clip(ticks - self._first_asked, 0, len(known) - 1)
        asked: FloatArray = known[rows]
        # Keep the last row taken: it is what a held tick refers to.
        keep = max(int(rows[-1]), 0)
        self._first_asked += keep
        self._asked = [known[keep:]]
        return asked


def interlock_reason(samples: Samples, config: RigConfig) -> tuple[int, str] | None:
    """Row and reason of the first sample beyond a current limit, or None.

    A device that found one by its own measure has flagged it, and has zeroed its outputs.
    """
    limits = config.limits.current
    first: tuple[int, str] | None = None
    for name, limit in (("current_motor", limits.motor), ("current_brake", limits.brake)):
        values = getattr(samples, name)
        beyond = ~(np.abs(values) <= limit)
        if beyond.any():
            row = int(np.argmax(beyond))
            if first is None or row < first[0]:
                first = row, f"{name} is {values[row]:.4g} A, beyond its limit of {limit:g} A"
    flagged = (samples.flags & int(Flag.INTERLOCK)) != 0
    if flagged.any():
        row = int(np.argmax(flagged))
        if first is None or row < first[0]:
            first = row, "the device found an input beyond its limit"
    return first


def mark_interlock(samples: Samples, row: int) -> Samples:
    """The samples with the tripping row flagged."""
    flags = samples.flags.copy()
    flags[row] |= int(Flag.INTERLOCK)
    return dataclasses.replace(samples, flags=flags)
