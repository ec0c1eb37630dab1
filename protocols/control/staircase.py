"""A shaft driven through a staircase of velocities, each held once it has settled."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from daq.config.base import Section
from daq.config.units import Percent, RadiansPerSecond, Seconds
from daq.errors import RunError
from daq.experiment import Answer, Sample
from daq.hal import FloatArray
from protocols.control.loop import BRAKE_SLOPE, Ramp, VelocityServo

_RUNAWAY = 10.0  # rad/s that a shaft may gain while the motor brakes with all its might


class SettlingTest(Section):
    """When a velocity counts as settled: so long within a band around its reference."""

    tolerance: Percent = Field(3.0, ge=0.0, le=50.0, description="half the band, of the reference")
    least: RadiansPerSecond = Field(0.3, gt=0.0, le=100.0, description="half the band at least")
    time: Seconds = Field(0.5, ge=0.0, le=60.0, description="time within the band before it counts")
    timeout: Seconds = Field(
        4.0,
        gt=0.0,
        le=600.0,
        description="time at a velocity beyond what is measured, after which it is given up",
    )

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.timeout < self.time:
            raise ValueError(
                f"timeout of {self.timeout:g} s is shorter than time, {self.time:g} s: no velocity "
                "could settle; make it longer"
            )
        return self

    def band(self, velocity: float) -> float:
        """How far from its reference a settled velocity may be [rad/s]."""
        return max(self.least, self.tolerance / 100.0 * abs(velocity))


@dataclass(frozen=True)
class Plateau:
    """One step of the staircase: velocity [rad/s], brake command [V], time to measure it [s]."""

    velocity: float
    brake: float
    measure: float


class Staircase:
    """Controller of the motor that visits plateaus in order, and ends at rest.

    A plateau begins with a ramp to its velocity. Once the tracked speed has been in its band
    for the settling time, it is measured; a departure from the band starts that anew. What has
    not been measured whole by its timeout is left unsettled. limit: of the servo's command [V].
    slope: of the reference [rad/s^2].
    """

    def __init__(
        self,
        plateaus: tuple[Plateau, ...],
        settling: SettlingTest,
        servo: VelocityServo,
        limit: float,
        slope: float,
    ) -> None:
        self._plateaus, self._settling = plateaus, settling
        self._servo, self._limit = servo, limit
        self._velocity_ramp, self._brake_ramp = Ramp(slope), Ramp(BRAKE_SLOPE)
        self._time, self._braked_from = 0.0, math.inf
        self._plateau, self._index = Plateau(0.0, 0.0, 0.0), -1
        self._next(0.0)

    def answer(self, sample: Sample) -> Answer | None:
        """Commands that drive the shaft to the plateau's velocity."""
        now, elapsed = sample.time, sample.time - self._time
        reference = self._velocity_ramp.towards(self._plateau.velocity, elapsed)
        brake = self._brake_ramp.towards(self._plateau.brake, elapsed)
        self._time = now
        volts, speed = self._servo.drive(sample, reference)
        settled = self._is_settled(now, reference, speed)
        logged = (reference, speed, float(self._index), float(settled))
        self._check_sign(volts, speed)
        return None if self._is_over(now) else Answer(volts, brake, logged)

    def _check_sign(self, volts: float, speed: float) -> None:
        """RunError for a shaft that gains speed against the motor."""
        if volts * speed >= 0.0 or abs(volts) < self._limit:
            self._braked_from = math.inf
            return
        self._braked_from = min(self._braked_from, abs(speed))
        if abs(speed) > self._braked_from + _RUNAWAY:
            raise RunError(
                f"the shaft gains speed, now {speed:.4g} rad/s, against a motor command of "
                f"{volts:.3g} V: a positive command must turn it forwards. Turn "
                "sensors.encoder.sign round in the rig's file, or the motor's leads"
            )

    def _is_settled(self, now: float, reference: float, speed: float) -> bool:
        """Whether the sample is one of those that count."""
        plateau = self._plateau
        underway = reference != plateau.velocity or self._brake_ramp.value != plateau.brake
        if underway:
            self._arrived = now
        if underway or abs(speed - reference) > self._band:
            self._inside = math.inf
            return False
        self._inside = min(self._inside, now)
        return self._index >= 0 and now - self._inside >= self._settling.time

    def _is_over(self, now: float) -> bool:
        """Whether the run is over; goes on to the next plateau once this one is done with."""
        measure = self._plateau.measure
        measured = now - self._inside >= self._settling.time + measure
        done = measured or now - self._arrived > self._settling.timeout + measure
        if done and self._index >= 0:
            self._next(now)
            return False
        return done

    def _next(self, now: float) -> None:
        """To the next plateau; behind the last to rest."""
        self._index += 1
        if self._index < len(self._plateaus):
            self._plateau = self._plateaus[self._index]
        else:
            self._index, self._plateau = -1, Plateau(0.0, self._plateau.brake, 0.0)
        self._band = self._settling.band(self._plateau.velocity)
        self._inside, self._arrived = math.inf, now


def longest(plateaus: Sequence[Plateau], settling: SettlingTest, slope: float) -> float:
    """The longest that a staircase can take [s]."""
    velocities = [0.0, *(plateau.velocity for plateau in plateaus), 0.0]
    pulls = [0.0, *(plateau.brake for plateau in plateaus)]
    ramps = sum(abs(b - a) for a, b in itertools.pairwise(velocities)) / slope
    brakes = sum(abs(b - a) for a, b in itertools.pairwise(pulls)) / BRAKE_SLOPE
    held = sum(plateau.measure + settling.timeout for plateau in plateaus)
    return ramps + brakes + held + settling.timeout


def quickest(
    plateaus: Sequence[Plateau], settling: SettlingTest, slope: float, rate: float
) -> tuple[FloatArray, FloatArray]:
    """Reference [rad/s] and brake command [V], (m,) each, where every velocity settles at once."""
    velocities, brakes, before = [], [], Plateau(0.0, 0.0, 0.0)
    for plateau in (*plateaus, Plateau(0.0, plateaus[-1].brake, 0.0)):
        turn, pull = plateau.velocity - before.velocity, plateau.brake - before.brake
        ramps = max(abs(turn) / slope, abs(pull) / BRAKE_SLOPE)
        time = np.arange(1, round((ramps + settling.time + plateau.measure) * rate) + 1) / rate
        velocities.append(before.velocity + _ramp(turn, slope, time))
        brakes.append(before.brake + _ramp(pull, BRAKE_SLOPE, time))
        before = plateau
    return np.concatenate(velocities), np.concatenate(brakes)


def _ramp(way: float, slope: float, time: FloatArray) -> FloatArray:
    """Changes by ``way`` no faster than by ``slope`` per second, (n,)."""
    return np.clip(math.copysign(slope, way) * time, min(way, 0.0), max(way, 0.0))
