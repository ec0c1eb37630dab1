"""Commands known beforehand: channels around an offset, smooth ends, whole samples."""

import abc
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds, Volts
from daq.experiment import Family, FreeSetting, OpenLoop, Plan, RunFrame
from daq.hal import CHANNELS, FloatArray


class HeldChannel(Section):
    """One channel: held at its offset, if its protocol adds nothing to it."""

    offset: Volts = Field(0.0, ge=-10.0, le=10.0, description="command around which it moves")


class ExcitedChannel(HeldChannel):
    """One channel: its offset plus an excitation, or its offset alone."""

    amplitude: Volts = Field(
        0.0, ge=0.0, le=10.0, description="of the excitation; 0 holds the channel at its offset"
    )


Channel = TypeVar("Channel", bound=ExcitedChannel)


class Excitation(OpenLoop, Generic[Channel]):
    """Both channels excited or held, brought in from zero and out to it."""

    ramp: Seconds = Field(
        0.0,
        ge=0.0,
        le=60.0,
        description="smooth rise from zero before the excitation, and fall to zero after it",
    )
    motor: Channel = Field(description="excitation of the motor's commands")
    brake: Channel = Field(description="excitation of the brake's commands")

    @abc.abstractmethod
    def excited_samples(self) -> int:
        """Samples between the ramps. Raises ValueError, naming the key, for no whole number."""

    @abc.abstractmethod
    def deviation(self, name: str, channel: Channel, time: FloatArray) -> FloatArray:
        """What an excited channel adds to its offset, (n,) [V].

        time: (n,) [s], 0 where the rise has ended; the excitation goes on into both ramps, so
        that nothing jumps where they meet. Raises ValueError, naming the key.
        """

    @abc.abstractmethod
    def remark(self, name: str, channel: Channel) -> str:
        """What a user should know of an excited channel beforehand."""

    @property
    def excited(self) -> dict[str, Channel]:
        """The channels that are excited, by name."""
        channels: dict[str, Channel] = {name: getattr(self, name) for name in CHANNELS}
        return {name: channel for name, channel in channels.items() if channel.amplitude > 0.0}

    def remarks(self) -> tuple[str, ...]:
        """A line for each excited channel."""
        return tuple(self.remark(name, channel) for name, channel in self.excited.items())

    def plan(self) -> Plan:
        """The commands, their peaks, and where the ramps end."""
        lead = self._ramp_samples
        return replace(super().plan(), steady=slice(lead, lead + self.excited_samples()))

    def waveform(self) -> FloatArray:
        """Both channels with their ramps, (n_samples, 2) [V]."""
        excited, lead = self.excited_samples(), self._ramp_samples
        self.samples_in((excited + 2 * lead) / self.sample_rate, "ramp")
        time = np.arange(-lead, excited + lead) / self.sample_rate
        rise = smooth_rise(lead)
        window = np.concatenate([rise, np.ones(excited), rise[::-1]])
        commands: FloatArray = np.tile([self.motor.offset, self.brake.offset], (len(time), 1))
        for name, channel in self.excited.items():
            commands[:, CHANNELS.index(name)] += self.deviation(name, channel, time)
        commands *= window[:, None]
        return commands

    @property
    def _ramp_samples(self) -> int:
        return round(self.ramp * self.sample_rate)

    def frequency_of(self, key: str, frequency: float | None) -> float:
        """A frequency [Hz] that the sample rate can show.

        Raises ValueError, naming the key, for one that is missing or too high.
        """
        if frequency is None:
            raise ValueError(f"{key}: this key is missing; an amplitude above 0 V needs it")
        if frequency >= 0.5 * self.sample_rate:
            raise ValueError(
                f"{key}: {frequency:g} Hz is not below half the sample rate, "
                f"{0.5 * self.sample_rate:g} Hz; lower it or raise sample_rate"
            )
        return frequency


def between_levels(
    frame: RunFrame,
    free: Mapping[str, FreeSetting],
    common: Mapping[str, Any],
    keys: Callable[[dict[str, float]], dict[str, Any]] = dict,
) -> Family:
    """Runs of which each channel moves between two levels, with further free settings.

    common: keys of the file that all have. keys: those of a channel, of its free settings by name.
    """
    levels = ("level", "other_level")

    def content(values: Mapping[str, float]) -> dict[str, Any]:
        file = dict(common)
        for name in CHANNELS:
            first, second = (values[f"{name}_{level}"] for level in levels)
            swing = {"offset": 0.5 * (first + second), "amplitude": 0.5 * abs(first - second)}
            file[name] = {**swing, **keys({key: values[f"{name}_{key}"] for key in free})}
        return file

    settings: dict[str, FreeSetting] = {}
    for name in CHANNELS:
        settings |= {f"{name}_{level}": frame.level(name) for level in levels}
        settings |= {f"{name}_{key}": setting for key, setting in free.items()}
    return Family(settings, content)


def smooth_rise(n: int) -> FloatArray:
    """Raised cosine from 0 to 1 in n samples, both ends left out, (n,)."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(1, n + 1) / (n + 1))


def whole_samples(key: str, seconds: float, sample_rate: float) -> int:
    """Samples in a time [s] that must be a whole number of them, one or more.

    Raises ValueError that names the key and the nearest times that are.
    """
    samples = seconds * sample_rate
    nearest = max(1, round(samples))
    if math.isclose(samples, nearest, rel_tol=1e-9):
        return nearest
    neighbours = sorted({max(1, math.floor(samples)), max(1, math.ceil(samples))})
    near = " or ".join(f"{n / sample_rate:.10g}" for n in neighbours)
    raise ValueError(
        f"{key}: {seconds:g} s is {samples:.6g} samples at {sample_rate:g} Hz, not a whole "
        f"number; the nearest that are: {near} s"
    )
