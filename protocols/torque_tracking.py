"""A torque for the hand to feel, while the hand moves the shaft: how well it is felt."""

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydantic import Field

from daq.config.units import Hertz, NewtonMetres, Seconds
from daq.experiment import Aboard, Answer, Controller, Plan, Sample, SettingError
from daq.findings import Chart, Findings, Number, Series
from daq.hal import FloatArray, Samples
from daq.torque import TorqueLaw
from haptics.evidence import Scene, fading, hand_path
from haptics.experiment import ReferenceExperiment
from protocols.analysis.results import TIME, TORQUE, low_passed
from protocols.multisine import crest_factor

_DRAWS = 64  # sets of phases, of which the one with the lowest crest factor is taken
_STRETCH = 2.0  # s of a trial beforehand
_SCENES = 50
_FASTEST_HAND = 10.0  # rad/s
_BLEND = 0.05  # s, in which a device's own controller comes and goes
_SHOWN = 2.0  # s of the figure


class TorqueTracking(ReferenceExperiment):
    """A multisine of torque at the hand, given by a controller that rig tune made."""

    columns: ClassVar[Mapping[str, str]] = {"torque_ref": "N*m"}

    duration: Seconds = Field(gt=0.0, le=3600.0, description="length of the run")
    torque: NewtonMetres = Field(ge=0.0, le=10.0, description="largest of the reference")
    band: tuple[Hertz, Hertz] = Field(description="lowest and highest frequency of the reference")
    lines: int = Field(40, ge=1, le=1000, description="number of its frequencies")
    seed: int = Field(1, ge=0, le=2**32 - 1, description="of their phases")
    fade: Seconds = Field(
        0.5, ge=0.0, le=60.0, description="in which the reference rises, and falls at the end"
    )
    judged_to: Hertz = Field(
        50.0, gt=0.0, description="frequency up to which the error counts; above is sensor noise"
    )

    def plan(self) -> Plan:
        """The reference, and the bounds of the controller's commands."""
        low, high = self.band
        if not 0.0 < low <= high < 0.5 * self.sample_rate:
            raise SettingError(
                "band",
                f"[{low:g}, {high:g}] Hz; write [lowest, highest], above 0 Hz and below half the "
                "sample rate",
            )
        if not self.judged_to < 0.5 * self.sample_rate:
            raise SettingError("judged_to", "it must be below half the sample rate")
        if 2.0 * self.fade >= self.duration:
            raise SettingError("fade", f"twice {self.fade:g} s is no less than the duration")
        lowest, highest = self.bounds()
        n_samples = self.samples_in(self.duration)
        reference = {"torque_ref": self.reference(n_samples)}
        remarks = (
            *self.controller_remarks(),
            "Hold the handle, and turn it as you like: the torque is felt against your hand. With "
            "nobody at it the shaft runs away until a limit ends the run; a simulated hand is in "
            "moving_hand.yaml.",
        )
        return Plan(n_samples, lowest, highest, references=reference, remarks=remarks)

    def reference(self, n: int) -> FloatArray:
        """Torque on the hand, (n,) [N*m]: flat within the band, phases of the lowest crest."""
        time = np.arange(n) / self.sample_rate
        frequency = np.linspace(*self.band, self.lines)
        phase_of_line = 2.0 * np.pi * np.outer(frequency, time)
        cosine, sine = np.cos(phase_of_line), np.sin(phase_of_line)
        phases = np.random.default_rng(self.seed).uniform(0.0, 2.0 * np.pi, (_DRAWS, self.lines))
        sums = (np.cos(phase) @ cosine - np.sin(phase) @ sine for phase in phases)
        wave = min(sums, key=crest_factor)
        rise = np.clip(np.minimum(time, time[-1] - time) / max(self.fade, 1e-9), 0.0, 1.0)
        shape = 0.5 - 0.5 * np.cos(np.pi * rise)
        reference: FloatArray = shape * wave * (self.torque / np.max(np.abs(wave)))
        return reference

    def scenes(self) -> list[Scene]:
        """Stretches of the reference, while hands move at up to 10 rad/s."""
        whole, time = self.reference(self.samples_in(self.duration)), 1.0 / self.sample_rate
        n = min(len(whole), round(_STRETCH * self.sample_rate))
        rng = np.random.default_rng(self.seed)
        starts = rng.integers(0, len(whole) - n + 1, _SCENES).tolist()
        return [
            Scene(
                fading(whole[start : start + n], time),
                np.ones(n),
                hand_path(n, time, rng.uniform(1.0, _FASTEST_HAND), rng),
            )
            for start in starts
        ]

    def controller(self) -> Controller:
        """The reference, sample by sample, through the controller's law."""
        law = self.tuned_controller.law()
        return _Tracking(law, self.reference(self.samples_in(self.duration)))

    def aboard(self) -> Aboard | None:
        """The reference, from the first sample until shortly before the last."""
        if not self.on_device:
            return None
        reference = self.reference(self.samples_in(self.duration))
        end = len(reference) - round(_BLEND * self.sample_rate)
        reference[max(end, 0) :] = 0.0  # commands again, of which the last shall be zero
        switches = [0, end] if end > 1 else [0]
        return self.asked_of_device(reference, switches, _BLEND, [reference])

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings:
        """The error of the torque felt, beside the torque asked for."""
        if len(samples) < 2.0 * self.sample_rate / self.judged_to + 30:
            raise ValueError("too few samples were logged to tell an error from noise")
        reference, felt = extra["torque_ref"], -samples.torque
        shown = low_passed(felt, self.judged_to, self.sample_rate)
        error = low_passed(felt - reference, self.judged_to, self.sample_rate)
        size, rms = (math.sqrt(float(np.mean(x**2))) for x in (reference, error))
        fastest = float(np.max(np.abs(samples.omega)))
        numbers = [
            Number("error_rms", rms, "N*m", meaning="of the torque felt"),
            Number("error_peak", float(np.max(np.abs(error))), "N*m", meaning="largest of it"),
            Number("reference_rms", size, "N*m", meaning="of the torque asked for"),
            Number("speed", fastest, "rad/s", meaning="largest of the shaft"),
        ]
        if size > 0.0:
            part = 100.0 * rms / size
            numbers.append(Number("error_part", part, "%", meaning="error by reference, rms"))
        last = samples.time >= samples.time[-1] - self.fade - _SHOWN
        time = samples.time[last]
        series = (
            Series("felt", time, shown[last]),
            Series("asked for", time, reference[last], style="model"),
        )
        chart = Chart("torque", "Torque on the hand", TIME, TORQUE, series)
        remark = f"Errors are those up to {self.judged_to:g} Hz: above it is the sensor's noise."
        return Findings(numbers=tuple(numbers), figures=(chart,), remarks=(remark,))


class _Tracking:
    """Answers each sample with the law's commands for the reference of its tick."""

    def __init__(self, law: TorqueLaw, reference: FloatArray) -> None:
        self._law, self._reference = law, reference.tolist()
        self._first: int | None = None

    def answer(self, sample: Sample) -> Answer | None:
        """Commands of motor and brake; None behind the reference's end."""
        if self._first is None:
            self._first = sample.tick
        index = sample.tick - self._first
        if index >= len(self._reference):
            return None
        torque = self._reference[index]
        return Answer(*self._law.volts(sample, torque), (torque,))
