"""Pseudo-random binary sequences on both channels."""

import math
from typing import Any

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds, Volts
from daq.experiment import Family, FreeSetting, RunFrame, Timed
from daq.hal import CHANNELS, FloatArray, IntArray
from protocols.waveforms import between_levels, whole_samples

REGISTER_BITS = 16
SEQUENCE_LENGTH = 2**REGISTER_BITS - 1
_TAP_SHIFTS = (0, 2, 3, 5)  # taps 16, 14, 13, 11 of a register whose bit 16 leaves first


class PrbsChannel(Section):
    """One channel: offset plus or minus amplitude, switched by a shift register."""

    amplitude: Volts = Field(ge=0.0, le=10.0, description="half the step between levels")
    offset: Volts = Field(0.0, ge=-10.0, le=10.0, description="mean of the two levels")
    minimum_period: Seconds = Field(gt=0.0, le=3600.0, description="shortest time at a level")
    seed: int = Field(
        ge=1, le=SEQUENCE_LENGTH, description="first content of the register, not zero"
    )


class Prbs(Timed):
    """PRBS from a 16-bit Fibonacci shift register, one for each channel."""

    motor: PrbsChannel = Field(description="sequence of the motor's commands")
    brake: PrbsChannel = Field(description="sequence of the brake's commands")

    def waveform(self) -> FloatArray:
        """Both channels' sequences, (n_samples, 2) [V]."""
        columns = []
        for name in CHANNELS:
            channel: PrbsChannel = getattr(self, name)
            bits, hold = self._bits(name)
            levels = channel.offset + channel.amplitude * (2.0 * bits - 1.0)
            columns.append(np.repeat(levels, hold)[: self.n_samples])
        return np.stack(columns, axis=1)

    @classmethod
    def family(cls, frame: RunFrame) -> Family:
        """How long a bit is held, and the seeds."""
        free = {
            "hold": FreeSetting(1.0 / frame.sample_rate, 0.25 * frame.seconds, log=True),
            "seed": FreeSetting(1, SEQUENCE_LENGTH, whole=True),
        }

        def keys(values: dict[str, float]) -> dict[str, Any]:
            hold = frame.whole(values["hold"])
            return {"minimum_period": hold, "seed": int(values["seed"])}

        return between_levels(frame, free, {"duration": frame.seconds}, keys)

    def remarks(self) -> tuple[str, ...]:
        """How evenly each channel is at its two levels."""
        lines = []
        for name in CHANNELS:
            if getattr(self, name).amplitude:
                bits, hold = self._bits(name)
                ends = np.flatnonzero(np.diff(bits, prepend=-1, append=-1))
                longest = float(np.diff(ends).max()) * hold / self.sample_rate
                lines.append(
                    f"{name}: {len(bits)} bits, {100.0 * bits.mean():.0f} % of them high; at one "
                    f"level for {longest:.3g} s at most"
                )
        return tuple(lines)

    def _bits(self, name: str) -> tuple[IntArray, int]:
        """The bits of a channel, and for how many samples each is held."""
        channel: PrbsChannel = getattr(self, name)
        hold = whole_samples(f"{name}.minimum_period", channel.minimum_period, self.sample_rate)
        return lfsr_bits(channel.seed, math.ceil(self.n_samples / hold)), hold


def lfsr_bits(seed: int, n: int) -> IntArray:
    """First n bits that leave a 16-bit Fibonacci shift register, taps 16, 14, 13, 11.

    The polynomial is primitive: any seed but 0 gives all 65535 states before it repeats.
    """
    state = seed
    bits = np.empty(n, dtype=np.int64)
    for i in range(n):
        bits[i] = state & 1
        feedback = 0
        for shift in _TAP_SHIFTS:
            feedback ^= state >> shift
        state = (state >> 1) | ((feedback & 1) << (REGISTER_BITS - 1))
    return bits
