"""Hysteresis loops: the shaft swung to and fro at each of several brake commands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from daq.config.units import RadiansPerSecond, Seconds, Volts
from daq.errors import RunError
from daq.experiment import Answer, Controller, Plan, Sample
from daq.findings import Axis, Chart, Findings, Number, Series, Table
from daq.hal import FloatArray, IntArray, Samples
from protocols.bouc_wen_loop import Cycles, Estimate, fit, motion
from protocols.excitation import whole_samples
from protocols.pid import Pid, SpeedTracker
from protocols.velocity_loop import VelocityLoop

_REST = 0.5  # s before and after the cycles of a level
_BRAKE_SLOPE = 0.5  # V/s
_OVERSPEED, _SPEED_MARGIN = 2.0, 10.0  # of the amplitude, and rad/s, beyond which a run is ended
_THERE = 0.95  # of the samples of a cycle that must have arrived for it to count
_LITTLE = 0.8  # of the torque's variance explained, below which a loop is no brake's
_UNLIKE = 1.6  # times a rated value, or a part of it, beyond which something is mixed up
_GUESS = 2.0  # either side of what was found, where an identification may search

COLUMNS = {"omega_ref": "rad/s", "omega_tracked": "rad/s", "level": "1", "cycle": "1"}
"""What is logged: reference, speed from the angle, index of the brake command and number of its
cycle, both -1 between levels."""


class _Schedule(NamedTuple):
    """What is asked for at every tick, (n,) each.

    level: index of the brake command, -1 between levels. cycle: of that level, from 0.
    """

    velocity: FloatArray
    brake: FloatArray
    level: IntArray
    cycle: IntArray


class HysteresisLoop(VelocityLoop):
    """Torque over angle and velocity at each brake command, with the loops' energy and shape."""

    columns = COLUMNS

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

    def plan(self) -> Plan:
        """How long it takes, what the shaft is asked for, and how far it turns."""
        schedule = self._schedule()
        self._check()
        bounds = [min(0.0, *self.brake_commands), max(0.0, *self.brake_commands)]
        swing = np.ptp(np.cumsum(schedule.velocity)) / self.sample_rate
        return Plan(
            len(schedule.velocity),
            np.array([-self.motor_limit, bounds[0]]),
            np.array([self.motor_limit, bounds[1]]),
            references={"omega_ref": schedule.velocity, "cmd_voltage_brake": schedule.brake},
            remarks=(f"The shaft swings by {swing:.3g} rad, {swing / (2 * math.pi):.2g} turns.",),
        )

    def controller(self) -> Controller:
        """The velocity loop along the schedule."""
        return _Swing(self, self._schedule())

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings:
        """Loops of each brake command, their energy, and what the hysteresis's parameters are."""
        levels = self._cycles(samples)
        if not levels:
            raise ValueError(
                "no level has two cycles behind the first of which nearly all samples were logged"
            )
        return _Conclusion(self, levels).findings()

    def _check(self) -> None:
        constant = self.ratings.torque_constant
        if self.torque_sensor == "load" and constant is None:
            raise ValueError(
                "ratings.torque_constant: with the torque sensor at the load the brake's torque is "
                "read from the motor's current; give the motor's constant, rated torque by rated "
                "current, such as '0.14 N*m/A'"
            )
        if constant is None or self.ratings.brake_constant is None:
            return
        needed = max(map(abs, self.brake_commands)) * self.ratings.brake_constant / constant
        if needed > self.motor_limit:
            raise ValueError(
                f"brake_commands: at {max(self.brake_commands):g} V the brake takes about "
                f"{needed:.2g} V of the motor by its ratings, beyond motor_limit, "
                f"{self.motor_limit:g} V; lower the brake command"
            )

    def _schedule(self) -> _Schedule:
        """Rest, brake ramp and cycles of each level, and the brake's way back to zero."""
        n = whole_samples("period", self.period, self.sample_rate)
        phase = np.arange(n) / n
        wave = np.sin(2.0 * np.pi * phase)
        if self.shape == "triangle":
            wave = 2.0 / np.pi * np.arcsin(np.clip(wave, -1.0, 1.0))
        swing = self.amplitude * np.tile(wave, self.cycles)
        numbers = np.repeat(np.arange(self.cycles), n)
        parts: list[_Schedule] = []
        before = 0.0
        for index, brake in enumerate(self.brake_commands):
            parts.append(self._rest(before, brake))
            held = np.full(len(swing), brake)
            parts.append(_Schedule(swing, held, np.full(len(swing), index), numbers))
            before = brake
        parts.append(self._rest(before, 0.0))
        found = _Schedule(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        self.samples_in(len(found.velocity) / self.sample_rate, "cycles")
        return found

    def _rest(self, before: float, brake: float) -> _Schedule:
        """The shaft at rest while the brake goes from one command to another."""
        ramp = round(abs(brake - before) / _BRAKE_SLOPE * self.sample_rate)
        still = round(_REST * self.sample_rate)
        commands = np.concatenate([np.linspace(before, brake, ramp), np.full(still, brake)])
        nothing = np.full(len(commands), -1)
        return _Schedule(np.zeros(len(commands)), commands, nothing, nothing)

    def _cycles(self, samples: Samples) -> list[Cycles]:
        """Counted cycles of each level; a few lost samples are filled in by straight lines."""
        n = whole_samples("period", self.period, self.sample_rate)
        schedule, torque, found = self._schedule(), self._torque(samples), []
        for index, command in enumerate(self.brake_commands):
            first = np.flatnonzero(schedule.level == index)[0] + n * np.arange(1, self.cycles)
            ticks = first[:, None] + np.arange(n)
            there = np.isin(ticks, samples.tick).mean(axis=1)
            ticks = ticks[there >= _THERE]
            if len(ticks) < 2:
                continue
            angle, moved, current = (
                np.interp(ticks, samples.tick, values)
                for values in (samples.theta, torque, samples.current_brake)
            )
            found.append(
                Cycles(command, float(current.mean()), angle, moved, 1.0 / self.sample_rate)
            )
        return found

    def _torque(self, samples: Samples) -> FloatArray:
        """What turns the brake and what is fixed to it, (n,) [N*m]."""
        if self.torque_sensor == "between":
            return samples.torque
        constant = self.ratings.torque_constant or 0.0
        damped = self.ratings.motor_damping * samples.omega
        return constant * samples.current_motor + samples.torque - damped


class _Swing:
    """Controller: the velocity loop along a schedule."""

    def __init__(self, settings: HysteresisLoop, schedule: _Schedule) -> None:
        self._schedule = [column.tolist() for column in schedule]
        self._tracker = SpeedTracker(settings.speed_filter)
        self._pid = Pid(settings.loop, -settings.motor_limit, settings.motor_limit)
        self._fastest = _OVERSPEED * settings.amplitude + _SPEED_MARGIN

    def answer(self, sample: Sample) -> Answer | None:
        """Commands for the tick's place in the schedule."""
        velocity, brake, level, cycle = (column[sample.tick] for column in self._schedule)
        speed = self._tracker.update(sample.time, sample.theta)
        if abs(speed) > self._fastest:
            raise RunError(
                f"the shaft turns at {speed:.4g} rad/s, beyond {self._fastest:.4g} rad/s, while "
                f"{velocity:.4g} rad/s were asked for; lower the gains under 'loop' if it rings. "
                "If it ran away at once, the encoder counts the other way round: turn "
                "sensors.encoder.sign in the rig's file"
            )
        volts = self._pid.output(sample.time, velocity, speed)
        return Answer(volts, brake, (velocity, speed, float(level), float(cycle)))


class _Conclusion:
    """What follows from the counted cycles."""

    def __init__(self, settings: HysteresisLoop, levels: list[Cycles]) -> None:
        self._settings, self._levels = settings, levels
        n_cycles = min(len(level.angle) for level in levels)
        # One matrix of cycles: of a run with losses as many of each level as all have.
        self._even = [
            Cycles(x.brake_command, x.current, x.angle[:n_cycles], x.torque[:n_cycles], x.dt)
            for x in levels
        ]
        self._fit = fit(self._even)
        self._sure = _quantile(n_cycles)

    def findings(self) -> Findings:
        """All of it."""
        return Findings(
            self._numbers(), (self._table(),), self._charts(), self._ranges(), self._remarks()
        )

    def _number(self, name: str, found: Estimate, unit: str, meaning: str) -> Number:
        reach = self._sure * found.error
        low, high = found.value - reach, found.value + reach
        return Number(name, found.value, unit, low, high, meaning)

    def _numbers(self) -> tuple[Number, ...]:
        found = self._fit
        numbers = [
            self._number("rate", found.rate, "1/rad", "beta + gamma: how fast it turns over"),
            self._number("part", found.part, "1", "gamma / (beta + gamma): shape at the reversal"),
        ]
        if found.kappa0 is not None and found.kappa1 is not None:
            meaning = "hysteretic torque at zero current, alpha0 A / (beta + gamma)"
            numbers.append(self._number("kappa0", found.kappa0, "N*m", meaning))
            meaning = "the same per ampere of brake current"
            numbers.append(self._number("kappa1", found.kappa1, "N*m/A", meaning))
        meaning = "way from a reversal to zero hysteretic torque"
        numbers.append(Number("intercept", found.intercept, "rad", meaning=meaning))
        return tuple(numbers)

    def _table(self) -> Table:
        """A row for each level."""
        energies = [level.energy for level in self._even]
        kappa = np.array([k.value for k in self._fit.kappa])
        columns = {
            "brake_command": np.array([x.brake_command for x in self._even]),
            "brake_current": np.array([x.current for x in self._even]),
            "energy": np.array([e.mean() for e in energies]),
            "energy_error": np.array([e.std(ddof=1) / math.sqrt(len(e)) for e in energies]),
            "hysteretic_torque": kappa,
            "hysteretic_error": np.array([k.error for k in self._fit.kappa]),
            "reversal_slope": kappa * self._fit.reversal,
        }
        units = ("V", "A", "J", "J", "N*m", "N*m", "N*m/rad")
        named = dict(zip(columns, units, strict=True))
        return Table("loops", "Loops, energy for each cycle", columns, named)

    def _charts(self) -> tuple[Chart, Chart]:
        """Measured means over angle and velocity, and the fitted loops over the angle."""
        angle, speed, fitted = [], [], []
        for index, level in enumerate(self._even):
            mean = motion(level)
            label = f"{level.brake_command:g} V"
            torque = level.torque.mean(axis=0)
            angle.append(Series(label, _closed(mean.angle), _closed(torque)))
            speed.append(Series(label, _closed(mean.speed), _closed(torque)))
            fitted.append((_closed(mean.angle), _closed(self._fit.torque[index])))
        # One line with gaps between the loops.
        ways, torques = (
            np.concatenate([np.append(values, math.nan) for values in column])
            for column in zip(*fitted, strict=True)
        )
        angle.append(Series("fitted", ways, torques, style="model"))
        torque_axis, of = Axis("torque", "N*m"), "at each brake command, mean of cycles"
        return (
            Chart("torque_angle", f"Torque over the angle {of}", Axis("angle", "rad"),
                  torque_axis, tuple(angle)),
            Chart("torque_velocity", f"Torque over the velocity {of}", Axis("velocity", "rad/s"),
                  torque_axis, tuple(speed)),
        )  # fmt: skip

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Where an identification may search, with z scaled to saturate near 1."""
        if self._fit.explained < _LITTLE:
            return {}
        found, rate, part = self._fit, self._fit.rate, self._fit.part
        guesses = {
            "gamma": rate.value * part.value,
            # Close to nothing it cannot be told from less.
            "beta": rate.value * max(1.0 - part.value, 0.05),
            "A": rate.value,
        }
        if found.kappa0 is not None and found.kappa1 is not None:
            guesses |= {"alpha0": found.kappa0.value, "alpha1": found.kappa1.value}
        return {name: (x / _GUESS, x * _GUESS) for name, x in guesses.items() if x > 0.0}

    def _remarks(self) -> tuple[str, ...]:
        found = self._fit
        remarks = [
            f"The Bouc-Wen loop explains {100.0 * found.explained:.1f} % of the torque's variance. "
            "Intervals are by the scatter between cycles alone."
        ]
        if found.explained < _LITTLE:
            other = "load" if self._settings.torque_sensor == "between" else "between"
            remarks.append(
                "That is too little for ranges. Is the torque sensor where 'torque_sensor' says? "
                f"Else write 'torque_sensor: {other}'. With the brake off little else than noise "
                "may be left."
            )
        rated = self._settings.ratings.brake_constant
        if rated and found.kappa1 and not rated / _UNLIKE < found.kappa1.value < _UNLIKE * rated:
            remarks.append(
                f"kappa1 is {found.kappa1.value:.3g} N*m/A where ratings.brake_constant says "
                f"{rated:g}: look at 'torque_sensor', ratings.torque_constant and the scales in "
                "the rig's file."
            )
        missing = len(self._settings.brake_commands) - len(self._even)
        if missing:
            remarks.append(f"{missing} brake command(s) without two whole cycles are left out.")
        if found.kappa0 is None:
            remarks.append("With a second brake command alpha0 and alpha1 could be told apart.")
        swing = min(float(np.ptp(motion(level).angle)) for level in self._even)
        if swing < 4.0 * found.intercept:
            remarks.append(
                f"The shaft swung by {swing:.2g} rad only, less than four times the intercept of "
                f"{found.intercept:.2g} rad: the loops do not saturate. Raise the amplitude or the "
                "period."
            )
        return tuple(remarks)


def _quantile(n_cycles: int) -> float:
    """Half the 95 % interval of a mean of so many cycles, in standard errors (Student)."""
    from scipy.stats import t

    return float(t.ppf(0.975, n_cycles - 1))


def _closed(values: FloatArray) -> FloatArray:
    return np.append(values, values[0])
