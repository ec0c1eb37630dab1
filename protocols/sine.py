"""A sine on each channel."""

import math

import numpy as np
from pydantic import Field

from daq.config.units import Hertz, Radians, Seconds
from daq.experiment import Family, FreeSetting, RunFrame
from daq.hal import FloatArray
from protocols.waveforms import Excitation, ExcitedChannel, between_levels


class SineChannel(ExcitedChannel):
    """One channel: offset + amplitude sin(2 pi frequency t + phase)."""

    frequency: Hertz | None = Field(None, gt=0.0, description="of the sine")
    phase: Radians = Field(0.0, ge=-100.0, le=100.0, description="of the sine at the start")


class Sine(Excitation[SineChannel]):
    """Sines, one on each channel, for as long as the file says."""

    duration: Seconds = Field(gt=0.0, le=86400.0, description="of the sines, without the ramps")

    @classmethod
    def family(cls, frame: RunFrame) -> Family:
        """Frequency and phase."""
        free = {
            "frequency": FreeSetting(1.0 / frame.seconds, 0.25 * frame.sample_rate, log=True),
            "phase": FreeSetting(-math.pi, math.pi),
        }
        return between_levels(frame, free, {"duration": frame.seconds})

    def excited_samples(self) -> int:
        """Samples between the ramps."""
        return self.samples_in(self.duration)

    def deviation(self, name: str, channel: SineChannel, time: FloatArray) -> FloatArray:
        """The sine, (n,) [V]."""
        frequency = self.frequency_of(f"{name}.frequency", channel.frequency)
        sine: FloatArray = np.sin(2.0 * np.pi * frequency * time + channel.phase)
        return channel.amplitude * sine

    def remark(self, name: str, channel: SineChannel) -> str:
        """How many periods the channel makes."""
        frequency = self.frequency_of(f"{name}.frequency", channel.frequency)
        return f"{name}: {frequency * self.duration:.4g} periods of {frequency:g} Hz"
