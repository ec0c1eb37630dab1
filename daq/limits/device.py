"""Checks of the device itself: it applies what it is told to, within the rig's limits."""

import numpy as np

from daq.config.rig import CommandLimits
from daq.hal import ANALOG_INPUTS, CHANNELS, Flag, FloatArray, IntArray, Samples
from daq.limits.base import Limit, Trip, first_row

_EXCUSES = int(Flag.CLAMPED | Flag.HELD | Flag.INTERLOCK | Flag.UNDERFLOW)


class Obedience(Limit):
    """The voltages applied are those commanded, but where a flag says why they are not.

    step [V]: by which an output may differ from its command. No flag excuses one beyond its range.
    """

    def __init__(self, command: CommandLimits, step: float) -> None:
        self._ranges = [getattr(command, channel) for channel in CHANNELS]
        self._step = step * (1.0 + 1e-9)

    def check(self, samples: Samples) -> Trip | None:
        """Compare every sample; what is no number is no command's."""
        if len(samples) == 1 and self._obeys(samples):
            return None
        excused = (samples.flags & _EXCUSES) != 0
        trips = []
        for channel, (low, high) in zip(CHANNELS, self._ranges, strict=True):
            applied, command = _voltages(samples, channel)
            as_told = excused | (np.abs(applied - command) <= self._step)
            within = (low - self._step <= applied) & (applied <= high + self._step)
            row = first_row(~(as_told & within))
            if row is not None:
                trips.append((row, _reason(channel, applied[row], command[row])))
        return min(trips, default=None)

    def _obeys(self, samples: Samples) -> bool:
        pairs = (_voltages(samples, channel) for channel in CHANNELS)
        return all(abs(applied.item() - cmd.item()) <= self._step for applied, cmd in pairs)


def _voltages(samples: Samples, channel: str) -> tuple[FloatArray, FloatArray]:
    """Voltages applied and commanded, (n,) each."""
    applied: FloatArray = getattr(samples, f"applied_voltage_{channel}")
    command: FloatArray = getattr(samples, f"cmd_voltage_{channel}")
    return applied, command


def _reason(channel: str, applied: float, command: float) -> str:
    return (
        f"the device applies another voltage than commanded: {applied:.4g} V to the {channel}, "
        f"where {command:.4g} V was sent, and no flag says why; mend its firmware or its converter"
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
