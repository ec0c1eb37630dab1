"""Hysteresis loops: the shaft swung to and fro at each of several brake commands."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from daq.config.units import RadiansPerSecond, Seconds, Volts
from daq.experiment import Answer, Controller, Family, FreeSetting, Plan, RunFrame, Sample
from daq.findings import Findings
from daq.hal import FloatArray, Samples
from protocols.analysis.hysteresis import Cycles, loop_findings
from protocols.control.loop import BRAKE_SLOPE, VelocityLoop, VelocityServo, command_bounds
from protocols.waveforms import whole_samples

_REST = 0.5  # s before and after the cycles of a level
_OVERSPEED, _SPEED_MARGIN = 2.0, 10.0  # of the amplitude, and rad/s, beyond which a run is ended
# Of a design: share of a run for the brake's ramps at most, the least time for cycles [s] and how
# many there are, the amplitude [rad/s] and in parts of the rig's limit.
_BRAKING, _SWINGING, _CYCLES, _SLOWEST, _FASTEST = 0.4, 0.25, (3, 12), 0.5, 0.4
_THERE = 0.95  # of the samples of a cycle that must have arrived for it to count


class HysteresisLoop(VelocityLoop):
    """Torque over angle and velocity at each brake command, with the loops' energy and shape."""

    columns: ClassVar[Mapping[str, str]] = {
        "omega_ref": "rad/s",
        "omega_tracked": "rad/s",  # from the angle
        "level": "1",  # index of the brake command, -1 between levels
        "cycle": "1",  # of the level, -1 between levels
    }

    brake_commands: list[Volts] = Field(
        min_length=1, max_length=50, description="one after the other, the shaft swung at each"
    )
    amplitude: RadiansPerSecond = Field(
        gt=0.0, le=1000.0, description="of the shaft's velocity, which changes sign"
    )
    shape: Literal["sine", "triangle"] = Field("sine", description="of the velocity over time")
    period: Seconds = Field(gt=0.0, le=600.0, description="of the velocity")
    cycles: int = Field(
        6, ge=3, le=1000, description="at each brake command; the first is not counted"
    )

    @classmethod
    def family(cls, frame: RunFrame) -> Family | None:
        """Any swing at a brake command, with any gains of the loop."""
        shaft, time = cls.driven_shaft(frame), frame.seconds - 2.0 * _REST
        strongest = min(frame.brake[1], 0.5 * _BRAKING * time * BRAKE_SLOPE)
        if shaft is None or (1.0 - _BRAKING) * time < _SWINGING:
            return None
        free = {
            "amplitude": FreeSetting(_SLOWEST, _FASTEST * shaft.speed, log=True),
            "cycles": FreeSetting(*_CYCLES, whole=True),
            "brake": FreeSetting(0.0, strongest, calm=0.0),
            **cls.loop_settings(frame),
        }

        def content(values: Mapping[str, float]) -> dict[str, Any]:
            cycles, swinging = int(values["cycles"]), time - 2.0 * values["brake"] / BRAKE_SLOPE
            # Ramps and rests are rounded to samples, too.
            period = math.floor((swinging * frame.sample_rate - 2.0) / cycles) / frame.sample_rate
            return {
                **cls.loop_keys(values, frame, shaft),
                "brake_commands": [values["brake"]],
                "amplitude": values["amplitude"],
                "period": period,
                "cycles": cycles,
            }

        return Family(free, content)

    def plan(self) -> Plan:
        """How long it takes, what the shaft is asked for, and how far it turns."""
        velocity, brake, *_ = self._schedule()
        self.require_torque_constant()
        self.require_strength(self.brake_commands)
        swing = np.ptp(np.cumsum(velocity)) / self.sample_rate
        bounds = command_bounds(self.motor_limit, self.brake_commands)
        references = {"omega_ref": velocity, "cmd_voltage_brake": brake}
        remark = f"The shaft swings by {swing:.3g} rad, {swing / (2 * math.pi):.2g} turns."
        return Plan(len(velocity), *bounds, references=references, remarks=(remark,))

    def controller(self) -> Controller:
        """The velocity loop along the schedule."""
        cure = (
            ". If it ran away at once, the encoder counts the other way round: turn "
            "sensors.encoder.sign in the rig's file"
        )
        servo = self.servo(_OVERSPEED * self.amplitude + _SPEED_MARGIN, cure)
        return _Swing(servo, self._schedule().T.tolist())

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings:
        """Loops of each brake command, their energy, and what the hysteresis's parameters are."""
        levels = self._counted_cycles(samples)
        if not levels:
            raise ValueError(
                "no level has two cycles behind the first of which nearly all samples were logged"
            )
        missing = len(self.brake_commands) - len(levels)
        return loop_findings(levels, missing, self.ratings.brake_constant, self.torque_sensor)

    @property
    def _period_samples(self) -> int:
        return whole_samples("period", self.period, self.sample_rate)

    def _schedule(self) -> FloatArray:
        """Velocity [rad/s], brake command [V], level and cycle at every tick, (4, n_samples)."""
        n = self._period_samples
        commands = [0.0, *self.brake_commands, 0.0]
        rests = [self._rest(a, b) for a, b in itertools.pairwise(commands)]
        length = len(self.brake_commands) * self.cycles * n
        n_samples = length + sum(rest.shape[1] for rest in rests)
        self.samples_in(n_samples / self.sample_rate, "cycles")
        wave = np.sin(2.0 * np.pi * (np.arange(n) / n))
        if self.shape == "triangle":
            wave = 2.0 / np.pi * np.arcsin(np.clip(wave, -1.0, 1.0))
        swing = self.amplitude * np.tile(wave, self.cycles)
        numbers = np.repeat(np.arange(self.cycles), n)
        parts = [rests[0]]
        for level, (brake, rest) in enumerate(zip(self.brake_commands, rests[1:], strict=True)):
            parts += [np.stack(np.broadcast_arrays(swing, brake, level, numbers)), rest]
        return np.concatenate(parts, axis=1)

    def _rest(self, before: float, brake: float) -> FloatArray:
        """The shaft at rest while the brake goes from one command to another, (4, n)."""
        ramp = round(abs(brake - before) / BRAKE_SLOPE * self.sample_rate)
        rest = round(_REST * self.sample_rate)
        rising = np.linspace(before, brake, ramp, endpoint=False)
        commands = np.concatenate([rising, np.full(rest, brake)])
        return np.stack(np.broadcast_arrays(0.0, commands, -1.0, -1.0))

    def _counted_cycles(self, samples: Samples) -> list[Cycles]:
        """Counted cycles of each level; a few lost samples are filled in by straight lines."""
        n, dt = self._period_samples, 1.0 / self.sample_rate
        level, torque, levels = self._schedule()[2], self._torque(samples), []
        for index, command in enumerate(self.brake_commands):
            first = np.flatnonzero(level == index)[0] + n * np.arange(1, self.cycles)
            ticks = first[:, None] + np.arange(n)
            ticks = ticks[np.isin(ticks, samples.tick).mean(axis=1) >= _THERE]
            if len(ticks) < 2:
                continue
            angle, resisting, current = (
                np.interp(ticks, samples.tick, values)
                for values in (samples.theta, torque, samples.current_brake)
            )
            levels.append(Cycles(command, float(current.mean()), angle, resisting, dt))
        return levels

    def _torque(self, samples: Samples) -> FloatArray:
        """What turns the brake and what is fixed to it, (n,) [N*m]."""
        if self.torque_sensor == "between":
            return samples.torque
        constant = self.ratings.torque_constant or 0.0
        damped = self.ratings.motor_damping * samples.omega
        return constant * samples.current_motor + samples.torque - damped


@dataclass(frozen=True)
class _Swing:
    """Controller: the velocity loop along a schedule, a row for each tick."""

    servo: VelocityServo
    schedule: list[list[float]]

    def answer(self, sample: Sample) -> Answer | None:
        """Commands for the tick's place in the schedule."""
        velocity, brake, level, cycle = self.schedule[sample.tick]
        volts, speed = self.servo.drive(sample, velocity)
        return Answer(volts, brake, (velocity, speed, level, cycle))
