"""Free motion: the torque that a hand feels with a controller that takes it off, and without."""

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydantic import Field

from daq.config.units import Hertz, Seconds
from daq.experiment import Aboard, Answer, Controller, Plan, Sample, SettingError
from daq.findings import Chart, Findings, Number, Series
from daq.hal import FloatArray, IntArray, Samples
from daq.torque import TorqueLaw
from haptics.evidence import Scene, hand_path
from haptics.experiment import ReferenceExperiment
from protocols.analysis.results import TIME, TORQUE, low_passed

_RAMP = 0.1  # s, in which the controller comes and goes
_SETTLED = 0.3  # s behind the end of a ramp, that do not count
_TRIAL = 2.0  # s
_SCENES = 50
_FASTEST_HAND = 10.0  # rad/s
_MOVING = 0.1  # rad/s rms: below, nothing was moved


class Transparency(ReferenceExperiment):
    """Blocks without commands and with a controller that is to have the hand feel nothing."""

    columns: ClassVar[Mapping[str, str]] = {"controlled": "1"}

    block: Seconds = Field(gt=0.0, le=600.0, description="length of a block")
    pairs: int = Field(
        2, ge=1, le=1000, description="of a block without commands and a controlled one"
    )
    judged_to: Hertz = Field(5.0, gt=0.0, description="frequency up to which the torque counts")

    def plan(self) -> Plan:
        """The longest that it takes, and the bounds of the controller's commands."""
        if not self.judged_to < 0.5 * self.sample_rate:
            raise SettingError("judged_to", "it must be below half the sample rate")
        if not self.block >= _RAMP + _SETTLED + 2.0 / self.judged_to:
            least = _RAMP + _SETTLED + 2.0 / self.judged_to
            raise SettingError(
                "block", f"{self.block:g} s hold no two periods at judged_to; make it {least:.2g} s"
            )
        lowest, highest = self.bounds()
        n_samples = self._n_samples
        remarks = (
            *self.controller_remarks(),
            "Hold the handle, and turn it to and fro alike in all blocks; every "
            f"{self.block:g} s the controller comes or goes. A simulated hand is in "
            "moving_hand.yaml.",
        )
        reference = {"controlled": self.share(n_samples)}
        return Plan(n_samples, lowest, highest, references=reference, remarks=remarks)

    def share(self, n: int) -> FloatArray:
        """By how much the controller's commands are given, (n,): 0 to 1."""
        block, within = self._blocks(np.arange(n))
        rise = np.minimum(within / _RAMP, 1.0)
        shares: FloatArray = np.where(block % 2 == 1, rise, np.where(block > 0, 1.0 - rise, 0.0))
        return shares

    @property
    def _n_samples(self) -> int:
        return 2 * self.pairs * self.samples_in(self.block, "block")

    def _blocks(self, sample: IntArray) -> tuple[IntArray, FloatArray]:
        """Which block samples are in, from 0, and how far in it [s]; of whole samples each."""
        block, within = np.divmod(sample, self.samples_in(self.block, "block"))
        return block, within / self.sample_rate

    def scenes(self) -> list[Scene]:
        """The controller comes while hands move at up to 10 rad/s."""
        time = 1.0 / self.sample_rate
        n = round(_TRIAL * self.sample_rate)
        share = np.clip((np.arange(n) * time - _TRIAL / 8.0) / _RAMP, 0.0, 1.0)
        rng = np.random.default_rng(0)
        return [
            Scene(np.zeros(n), share, hand_path(n, time, rng.uniform(1.0, _FASTEST_HAND), rng))
            for _ in range(_SCENES)
        ]

    def controller(self) -> Controller:
        """The controller's law for no torque, in every second block."""
        return _Alternation(self.tuned_controller.law(), self.share(self._n_samples))

    def aboard(self) -> Aboard | None:
        """No torque, by the controller in every second block."""
        if not self.on_device:
            return None
        length = self.samples_in(self.block, "block")
        switches = range(length, self._n_samples, length)
        share = self.share(self._n_samples)
        return self.asked_of_device(np.zeros(len(share)), switches, _RAMP, [share])

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings:
        """The torque felt with and without the controller, beside the speed of the shaft."""
        passed = np.rint((samples.time - samples.time[0]) * self.sample_rate).astype(np.int64)
        _, within = self._blocks(passed)
        settled = within > _RAMP + _SETTLED
        parts = {
            "free": settled & (extra["controlled"] == 0.0),
            "controlled": settled & (extra["controlled"] == 1.0),
        }
        if len(samples) < 100 or not all(rows.any() for rows in parts.values()):
            raise ValueError("the run ended before a controlled block did")
        felt = low_passed(-samples.torque, self.judged_to, self.sample_rate)
        torque = {name: _rms(felt[rows]) for name, rows in parts.items()}
        speed = {name: _rms(samples.omega[rows]) for name, rows in parts.items()}
        if min(speed.values()) < _MOVING:
            raise ValueError("nobody turned the handle: there is no free motion to judge")
        ratio = (torque["controlled"] / speed["controlled"]) / (torque["free"] / speed["free"])
        numbers = (
            Number("torque_free", torque["free"], "N*m", meaning="felt without commands, rms"),
            Number("torque_controlled", torque["controlled"], "N*m", meaning="felt with them, rms"),
            Number("speed_free", speed["free"], "rad/s", meaning="of the shaft, rms"),
            Number("speed_controlled", speed["controlled"], "rad/s", meaning="of the shaft, rms"),
            Number("torque_left", 100.0 * ratio, "%", meaning="of the torque by speed"),
        )
        series = tuple(
            Series(label, samples.time, np.where(parts[name], felt, math.nan))
            for name, label in (("free", "without commands"), ("controlled", "controlled"))
        )
        chart = Chart("transparency", "Torque on the hand in free motion", TIME, TORQUE, series)
        remark = f"Torques are those up to {self.judged_to:g} Hz."
        return Findings(numbers=numbers, figures=(chart,), remarks=(remark,))


class _Alternation:
    """Answers each sample with the law's commands for no torque, or a share of them."""

    def __init__(self, law: TorqueLaw, shares: FloatArray) -> None:
        self._law, self._shares = law, shares.tolist()
        self._first: int | None = None

    def answer(self, sample: Sample) -> Answer | None:
        """Commands of motor and brake; None behind the last block."""
        if self._first is None:
            self._first = sample.tick
        index = sample.tick - self._first
        if index >= len(self._shares):
            return None
        share = self._shares[index]
        motor, brake = self._law.volts(sample, 0.0)
        return Answer(share * motor, share * brake, (share,))


def _rms(values: FloatArray) -> float:
    return math.sqrt(float(np.mean(values**2)))
