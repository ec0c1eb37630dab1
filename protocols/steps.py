"""Levels held for some time, or staircases up and down."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds, Volts
from daq.experiment import Family, OpenLoop, RunFrame
from daq.hal import CHANNELS, FloatArray, IntArray
from protocols.waveforms import HeldChannel, smooth_rise, whole_samples

_PIECES = 8  # levels of a free waveform


class StaircaseLevels(Section):
    """Equal steps up to the top and down again."""

    lowest: Volts = Field(0.0, ge=-10.0, le=10.0, description="level at both ends")
    highest: Volts = Field(ge=-10.0, le=10.0, description="level at the top")
    steps: int = Field(ge=1, le=10_000, description="number of steps on the way up")

    @property
    def levels(self) -> list[float]:
        """Levels in order; the top stands once."""
        up = np.linspace(self.lowest, self.highest, self.steps + 1).tolist()
        return [*up, *up[-2::-1]]


class StepsChannel(HeldChannel):
    """One channel: levels around the offset, or the offset alone."""

    levels: list[Volts] | None = Field(None, description="levels in order, around the offset")
    staircase: StaircaseLevels | None = Field(
        None, description="levels up and down, in their place"
    )
    hold: Seconds | list[Seconds] | None = Field(
        None, description="time at each level, or a list with a time for every level"
    )


class Steps(OpenLoop):
    """Steps on each channel; the shorter sequence starts again until the longer is through."""

    ramp: Seconds = Field(
        0.0, ge=0.0, le=60.0, description="time taken by each change of level, smoothly"
    )
    motor: StepsChannel = Field(description="levels of the motor's commands")
    brake: StepsChannel = Field(description="levels of the brake's commands")

    @classmethod
    def family(cls, frame: RunFrame) -> Family | None:
        """Any levels of both channels, one after the other, each held alike long."""
        if frame.n_samples < _PIECES:
            return None
        ends = np.round(np.linspace(0, frame.n_samples, _PIECES + 1))
        hold = (np.diff(ends) / frame.sample_rate).tolist()
        free = {f"{name}_{k}": frame.level(name) for name in CHANNELS for k in range(_PIECES)}

        def content(values: Mapping[str, float]) -> dict[str, Any]:
            return {
                name: {"levels": [values[f"{name}_{k}"] for k in range(_PIECES)], "hold": hold}
                for name in CHANNELS
            }

        return Family(free, content)

    def waveform(self) -> FloatArray:
        """Both channels' levels, (n_samples, 2) [V]; with a ramp the last change is to zero."""
        sequences = self._sequences()
        n_samples = max(int(lengths.sum()) for _, lengths in sequences)
        if n_samples == 0:
            raise ValueError(
                "motor.levels: neither channel has levels; give levels or a staircase to one"
            )
        self.samples_in(n_samples / self.sample_rate, "motor.hold")
        change = round(self.ramp * self.sample_rate)
        return np.stack([_played(*sequence, n_samples, change) for sequence in sequences], axis=1)

    def remarks(self) -> tuple[str, ...]:
        """Which channel's sequence is cut, and where."""
        totals = [int(lengths.sum()) for _, lengths in self._sequences()]
        short, long = sorted(totals)
        if not short or long % short == 0:
            return ()
        return (
            f"{CHANNELS[totals.index(short)]}: its sequence of {short / self.sample_rate:g} s does "
            f"not fit a whole number of times into the {long / self.sample_rate:g} s of the other, "
            "and is cut at the end",
        )

    def _sequences(self) -> list[tuple[FloatArray, IntArray]]:
        return [self._sequence(name, getattr(self, name)) for name in CHANNELS]

    def _sequence(self, name: str, channel: StepsChannel) -> tuple[FloatArray, IntArray]:
        """Levels [V] and how many samples each is held, (m,) each."""
        if channel.levels is not None and channel.staircase is not None:
            raise ValueError(f"{name}.staircase: give levels or a staircase, not both")
        levels = channel.staircase.levels if channel.staircase else channel.levels
        if levels is None:
            return np.array([channel.offset]), np.zeros(1, dtype=np.int64)
        if not levels:
            raise ValueError(f"{name}.levels: the list is empty; give at least one level")
        key = f"{name}.hold"
        if channel.hold is None:
            raise ValueError(f"{key}: this key is missing; levels need the time they are held")
        holds = channel.hold if isinstance(channel.hold, list) else [channel.hold] * len(levels)
        if len(holds) != len(levels):
            raise ValueError(
                f"{key}: {len(holds)} times for {len(levels)} levels; give one for each, or one "
                "number for all"
            )
        samples = [self._held(key, seconds) for seconds in holds]
        return channel.offset + np.array(levels), np.array(samples)

    def _held(self, key: str, seconds: float) -> int:
        """Samples that a level is held."""
        if not 0.0 < seconds <= 86400.0:
            raise ValueError(f"{key}: {seconds:g} s; a level is held for above 0 s, up to a day")
        if self.ramp >= seconds:
            raise ValueError(
                f"{key}: {seconds:g} s is not longer than the ramp of {self.ramp:g} s; "
                "hold the level longer or shorten the ramp"
            )
        return whole_samples(key, seconds, self.sample_rate)


def _played(levels: FloatArray, lengths: IntArray, n_samples: int, change: int) -> FloatArray:
    """A sequence again and again for n_samples, then ``change`` samples down to zero."""
    if not lengths.any():  # a held channel has one level for the whole run
        lengths = np.array([n_samples])
    rounds = -(-n_samples // int(lengths.sum()))
    levels, lengths = np.tile(levels, rounds), np.tile(lengths, rounds)
    starts = np.cumsum(lengths) - lengths
    rise = smooth_rise(change)
    commands = np.zeros(n_samples + change)
    before = 0.0
    for level, start, length in zip(levels.tolist(), starts, lengths, strict=True):
        part = commands[start : min(start + length, n_samples)]
        part[:] = level
        part[:change] = before + (level - before) * rise[: len(part)]
        before = level
    commands[n_samples:] = commands[n_samples - 1] * rise[::-1]
    return commands
