"""Multisines: sums of harmonics with random phases.

Random-phase multisines after R. Pintelon and J. Schoukens, System Identification: A Frequency
Domain Approach, 2nd ed., IEEE Press 2012, chapters 2 and 4: flat amplitudes, phases uniform over
the circle; on odd harmonics even nonlinearities show between the lines, and on the odd-random
grid odd ones too, in the harmonic that each group leaves out.
"""

import math
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from daq.config.units import Hertz, Seconds
from daq.experiment import Family, FreeSetting, RunFrame
from daq.hal import FloatArray, IntArray
from protocols.waveforms import Excitation, ExcitedChannel, between_levels, whole_samples

_GROUP = 4  # odd harmonics of which the odd-random grid leaves one out


class MultisineChannel(ExcitedChannel):
    """One channel: harmonics of the period within a band, their sum scaled to the amplitude."""

    band: tuple[Hertz, Hertz] | None = Field(
        None, description="lowest and highest frequency of its harmonics"
    )
    harmonics: Literal["all", "odd", "odd-random"] = Field(
        "all", description="which of the band; odd-random leaves one out of every four odd ones"
    )
    seed: int = Field(1, ge=0, le=2**32 - 1, description="of its phases and left-out harmonics")


class Draw(NamedTuple):
    """What chance decided for one channel.

    harmonics: (m,), numbers of the lines. phases: (m,) [rad], of cosines at the period's start.
    number: which of the draws it was, from 0.
    """

    harmonics: IntArray
    phases: FloatArray
    number: int


class Multisine(Excitation[MultisineChannel]):
    """Random-phase multisines, periodic, one on each channel."""

    period: Seconds = Field(
        gt=0.0, le=3600.0, description="of the multisines; harmonics stand at multiples of 1/period"
    )
    periods: int = Field(1, ge=1, le=100_000, description="how many of them, without the ramps")
    draws: int = Field(
        1, ge=1, le=1000, description="sets of phases tried; the lowest crest factor is taken"
    )

    @classmethod
    def family(cls, frame: RunFrame) -> Family:
        """One period: lines up to a frequency, and the seeds."""
        lowest = 1.0 / frame.seconds
        free = {
            "highest": FreeSetting(2.0 * lowest, 0.45 * frame.sample_rate, log=True),
            "seed": FreeSetting(0, 2**16 - 1, whole=True),
        }

        def keys(values: dict[str, float]) -> dict[str, Any]:
            return {"band": [lowest, values["highest"]], "seed": int(values["seed"])}

        return between_levels(frame, free, {"period": frame.seconds}, keys)

    def excited_samples(self) -> int:
        """Samples between the ramps."""
        return self.periods * self.samples_per_period

    @property
    def samples_per_period(self) -> int:
        """Samples in a period. Raises ValueError, naming the nearest, for no whole number."""
        n = whole_samples("period", self.period, self.sample_rate)
        self.samples_in(self.periods * n / self.sample_rate, "periods")
        return n

    def deviation(self, name: str, channel: MultisineChannel, time: FloatArray) -> FloatArray:
        """The multisine, repeated, (n,) [V]; its largest value is the amplitude."""
        period = self._period(self._draw(name, channel))
        scaled = channel.amplitude * (period / np.max(np.abs(period)))
        ticks = np.round(time * self.sample_rate).astype(np.int64)
        repeated: FloatArray = scaled[ticks % len(scaled)]
        return repeated

    def describe(self) -> dict[str, Any]:
        """The experiment as resolved, and the harmonics and phases drawn."""
        excitation = {}
        for name, channel in self.excited.items():
            draw = self._draw(name, channel)
            excitation[name] = {
                "seed": channel.seed,
                "draw": draw.number,
                "crest_factor": crest_factor(self._period(draw)),
                "harmonics": draw.harmonics.tolist(),
                "phases": draw.phases.tolist(),
            }
        return {**super().describe(), "excitation": excitation}

    def remarks(self) -> tuple[str, ...]:
        """Periods of all, then lines and crest factor of each channel."""
        return (f"{self.periods} periods of {self.period:g} s", *super().remarks())

    def remark(self, name: str, channel: MultisineChannel) -> str:
        """Lines and crest factor of the channel."""
        draw = self._draw(name, channel)
        low, high = draw.harmonics[[0, -1]] / self.period
        best = f", the best of {self.draws} draws" if self.draws > 1 else ""
        return (
            f"{name}: {len(draw.harmonics)} lines ({channel.harmonics}) from {low:.4g} to "
            f"{high:.4g} Hz, {1.0 / self.period:.4g} Hz between harmonics; crest factor "
            f"{crest_factor(self._period(draw)):.3f}{best}; seed {channel.seed}"
        )

    def _period(self, draw: Draw) -> FloatArray:
        """One period with lines of amplitude 1, (samples_per_period,)."""
        n = self.samples_per_period
        lines = np.zeros(n // 2 + 1, dtype=np.complex128)
        lines[draw.harmonics] = 0.5 * n * np.exp(1j * draw.phases)
        return np.fft.irfft(lines, n)

    def _draw(self, name: str, channel: MultisineChannel) -> Draw:
        """Harmonics, and of several draws of their phases the one with the lowest crest factor."""
        rng = np.random.default_rng(channel.seed)
        harmonics = self._harmonics(name, channel, rng)
        draws = (
            Draw(harmonics, rng.uniform(0.0, 2.0 * np.pi, len(harmonics)), number)
            for number in range(self.draws)
        )
        return min(draws, key=lambda draw: crest_factor(self._period(draw)))

    def _harmonics(
        self, name: str, channel: MultisineChannel, rng: np.random.Generator
    ) -> IntArray:
        """Numbers of the lines within the band, (m,)."""
        key = f"{name}.band"
        if channel.band is None:
            raise ValueError(f"{key}: this key is missing; an amplitude above 0 V needs it")
        low, high = channel.band
        if not 0.0 < low <= high:
            raise ValueError(
                f"{key}: [{low:g}, {high:g}] Hz is no band; write [lowest, highest], above 0 Hz"
            )
        self.frequency_of(key, high)
        period = self.samples_per_period / self.sample_rate
        # Ends that are harmonics but for rounding belong to the band.
        first, last = math.ceil(low * period - 1e-6), math.floor(high * period + 1e-6)
        numbers = np.arange(max(first, 1), min(last, (self.samples_per_period - 1) // 2) + 1)
        if channel.harmonics != "all":
            numbers = numbers[numbers % 2 == 1]
        if channel.harmonics == "odd-random":
            groups = len(numbers) // _GROUP
            left_out = _GROUP * np.arange(groups) + rng.integers(0, _GROUP, groups)
            numbers = np.delete(numbers, left_out)
        if len(numbers) == 0:
            raise ValueError(
                f"{key}: no {'' if channel.harmonics == 'all' else 'odd '}harmonic of "
                f"{1.0 / period:.6g} Hz lies from {low:g} to {high:g} Hz; widen the band or "
                "lengthen the period"
            )
        return numbers


def crest_factor(values: FloatArray) -> float:
    """Largest deviation from the mean over its root mean square."""
    deviation = values - values.mean()
    return float(np.max(np.abs(deviation)) / math.sqrt(np.mean(deviation**2)))
