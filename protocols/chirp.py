"""Sines that sweep through a band, on each channel."""

import math
from typing import Literal

import numpy as np
from pydantic import Field

from daq.config.units import Hertz, Seconds
from daq.experiment import Family, FreeSetting, RunFrame
from daq.hal import FloatArray
from protocols.waveforms import Excitation, ExcitedChannel, between_levels


class ChirpChannel(ExcitedChannel):
    """One channel: a sine around the offset whose frequency goes from one end to the other."""

    start_frequency: Hertz | None = Field(None, gt=0.0, description="at the sweep's start")
    end_frequency: Hertz | None = Field(None, gt=0.0, description="at the sweep's end")


class Chirp(Excitation[ChirpChannel]):
    """Swept sines; while the ramps last, the frequency stays at the sweep's ends."""

    duration: Seconds = Field(gt=0.0, le=86400.0, description="of the sweep, without the ramps")
    sweep: Literal["linear", "logarithmic"] = Field(
        "logarithmic", description="equal time for equal steps in Hz, or for each octave"
    )

    @classmethod
    def family(cls, frame: RunFrame) -> Family:
        """Where the sweep begins and ends."""
        end = FreeSetting(1.0 / frame.seconds, 0.25 * frame.sample_rate, log=True)
        free = {"start_frequency": end, "end_frequency": end}
        return between_levels(frame, free, {"duration": frame.seconds})

    def excited_samples(self) -> int:
        """Samples between the ramps."""
        return self.samples_in(self.duration)

    def deviation(self, name: str, channel: ChirpChannel, time: FloatArray) -> FloatArray:
        """The swept sine, (n,) [V]."""
        start, end = self._band(name, channel)
        duration = self.excited_samples() / self.sample_rate
        swept = _linear if self.sweep == "linear" else _logarithmic
        inside = np.clip(time, 0.0, duration)
        turns = swept(start, end, duration, inside)
        turns += start * np.minimum(time, 0.0) + end * np.maximum(time - duration, 0.0)
        return channel.amplitude * np.sin(2.0 * np.pi * turns)

    def remark(self, name: str, channel: ChirpChannel) -> str:
        """How fast the channel sweeps."""
        start, end = self._band(name, channel)
        if self.sweep == "linear":
            speed = f"{(end - start) / self.duration:.3g} Hz/s"
        else:
            speed = f"{math.log2(end / start) / self.duration:.3g} octaves/s"
        return f"{name}: from {start:g} to {end:g} Hz at {speed}"

    def _band(self, name: str, channel: ChirpChannel) -> tuple[float, float]:
        return (
            self.frequency_of(f"{name}.start_frequency", channel.start_frequency),
            self.frequency_of(f"{name}.end_frequency", channel.end_frequency),
        )


def _linear(start: float, end: float, duration: float, time: FloatArray) -> FloatArray:
    """Turns of a sine whose frequency rises by so much each second, (n,)."""
    return start * time + (end - start) * time**2 / (2.0 * duration)


def _logarithmic(start: float, end: float, duration: float, time: FloatArray) -> FloatArray:
    """Turns of a sine whose frequency is multiplied by so much each second, (n,)."""
    x = math.log(end / start) / duration * time
    # expm1(x) / x is 1 where the frequency stays as it is.
    return start * time * np.divide(np.expm1(x), x, out=np.ones_like(x), where=x != 0.0)
