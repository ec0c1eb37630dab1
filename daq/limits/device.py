"""Checks of the device itself: it applies what it is told to, within the rig's limits."""

import math

import numpy as np

from daq.config.rig import LimitSettings
from daq.hal import ANALOG_INPUTS, CHANNELS, Flag, FloatArray, IntArray, Mode, Samples
from daq.limits.base import Limit, Trip, first_row

_ZEROED = int(Flag.INTERLOCK | Flag.UNDERFLOW)


class Obedience(Limit):
    """The voltages applied are those commanded, but where a flag says what they are instead.

    INTERLOCK and UNDERFLOW mean zero, HELD the voltage of the sample before (in closed loop, and
    not for ever), CLAMPED one between zero and the command. No flag excuses one beyond its range.

    step [V]: by which an output may differ from its command. sample_rate in Hz.
    """

    def __init__(self, limits: LimitSettings, step: float, mode: Mode, sample_rate: float) -> None:
        self._ranges = [getattr(limits.command, channel) for channel in CHANNELS]
        self._slewed = [getattr(limits.slew, channel) is not None for channel in CHANNELS]
        self._step = step * (1.0 + 1e-9)
        self._holds = int(Flag.HELD) if mode is Mode.CLOSED_LOOP else 0
        self._longest = max(1, math.ceil(limits.late * sample_rate))  # samples
        self._late = limits.late
        self._tick, self._held = -1, 0
        self._applied = [0.0, 0.0]  # V, in the sample before

    def check(self, samples: Samples) -> Trip | None:
        """Compare every sample; what is no number is no command's."""
        trips = [self._held_too_long(samples)]
        if len(samples) > 1 or not self._obeys(samples):
            trips += [self._compared(place, samples) for place in range(len(CHANNELS))]
        self._tick = samples.tick.item(-1)
        self._applied = [_voltages(samples, channel)[0].item(-1) for channel in CHANNELS]
        return min(filter(None, trips), default=None)

    def _obeys(self, samples: Samples) -> bool:
        """Whether both voltages of a single sample are those commanded, and not to be zero."""
        if samples.flags.item() & _ZEROED:
            return False
        for channel, (low, high) in zip(CHANNELS, self._ranges, strict=True):
            applied, command = (volts.item() for volts in _voltages(samples, channel))
            within = low - self._step <= applied <= high + self._step
            if not (within and abs(applied - command) <= self._step):
                return False
        return True

    def _compared(self, place: int, samples: Samples) -> Trip | None:
        """The first sample in which the voltage of a channel is another."""
        (low, high), step = self._ranges[place], self._step
        applied, command = _voltages(samples, CHANNELS[place])
        flags = samples.flags
        within = (low - step <= applied) & (applied <= high + step)
        if not (flags & _ZEROED).any() and (within & (np.abs(applied - command) <= step)).all():
            return None
        before = np.concatenate([[self._applied[place]], applied[:-1]])
        least, most = command.copy(), command.copy()
        clamped = (flags & int(Flag.CLAMPED)) != 0
        ends = [np.zeros(len(samples)), command, *([before] if self._slewed[place] else [])]
        least[clamped] = np.minimum.reduce(ends)[clamped]
        most[clamped] = np.maximum.reduce(ends)[clamped]
        held = (flags & self._holds) != 0
        # Behind lost samples nobody knows what is held.
        contiguous = np.diff(samples.tick, prepend=self._tick) == 1
        least[held] = np.where(contiguous, before, low)[held]
        most[held] = np.where(contiguous, before, high)[held]
        zeroed = (flags & _ZEROED) != 0
        least[zeroed] = most[zeroed] = 0.0
        least, most = np.maximum(least, low) - step, np.minimum(most, high) + step
        row = first_row(~((least <= applied) & (applied <= most)))
        if row is None:
            return None
        return row, _reason(CHANNELS[place], applied[row], command[row], flags.item(row))

    def _held_too_long(self, samples: Samples) -> Trip | None:
        """Count the samples in which the device has held what is not zero."""
        if not self._holds or not (self._held or (samples.flags & self._holds).any()):
            return None
        pairs = zip(_voltages(samples, "motor")[0], _voltages(samples, "brake")[0], strict=True)
        for row, (flags, volts) in enumerate(zip(samples.flags.tolist(), pairs, strict=True)):
            held = flags & self._holds and any(abs(value) > self._step for value in volts)
            self._held = self._held + 1 if held else 0
            if self._held > self._longest:
                return row, (
                    f"no command has reached the device for {self._late:g} s (limits.late), and it "
                    "holds the one before; look at the line and at what else this computer does"
                )
        return None


def _voltages(samples: Samples, channel: str) -> tuple[FloatArray, FloatArray]:
    """Voltages applied and commanded, (n,) each."""
    applied: FloatArray = getattr(samples, f"applied_voltage_{channel}")
    command: FloatArray = getattr(samples, f"cmd_voltage_{channel}")
    return applied, command


def _reason(channel: str, applied: float, command: float, flags: int) -> str:
    names = " | ".join(flag.name or "" for flag in Flag(flags & ~int(Flag.LOST | Flag.DOUBTFUL)))
    why = f"and {names} does not say why" if names else "and no flag says why"
    return (
        f"the device applies another voltage than commanded: {applied:.4g} V to the {channel}, "
        f"where {command:.4g} V was sent, {why}; mend its firmware or its converter"
    )


def saturation_warnings(counts: IntArray) -> list[str]:
    """What to tell of inputs that stood at the end of their converters, each with its cure."""
    return [
        f"{name} stood at the end of its converter's range in {count} "
        f"sample{'s' * (count > 1)}: the log does not have what was beyond. Command less, or give "
        "it a sensor or a gain with more range"
        for name, count in zip(ANALOG_INPUTS, counts.tolist(), strict=True)
        if count
    ]
