"""Torque against velocity: a staircase of constant velocities at each of several brake commands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import Field

from daq.config.units import RadiansPerSecond, Seconds, Turns, Unit, Volts
from daq.experiment import Controller, Plan
from daq.findings import Axis, Chart, Findings, Number, Series, Table
from daq.hal import FloatArray, Samples
from protocols import staircase
from protocols.staircase import Drive, Plateau, SettlingTest, Staircase
from protocols.torque_curve import Estimate, Level, Line, Motor, Ripple, fit, levels_of, ripple
from protocols.velocity_loop import VelocityLoop

_OVERSPEED = 1.5  # of the fastest velocity asked for: beyond it something is wrong
_SPEED_MARGIN = 10.0  # rad/s, the same for slow velocities
_DRAWN = 4000  # points of a trace in a figure
_SURE = 5.0  # standard errors from which a part of the torque counts as there


class ConstantVelocity(VelocityLoop):
    """Velocity loop on the motor; torque against velocity at each brake command."""

    columns = staircase.COLUMNS

    velocities: list[RadiansPerSecond] = Field(
        min_length=1, max_length=200, description="visited in this order; negative turns backwards"
    )
    brake_commands: list[Volts] = Field(
        min_length=1, max_length=50, description="at each of which all velocities are visited"
    )
    slope: Annotated[float, Unit("rad/s^2")] = Field(
        200.0, gt=0.0, le=1e5, description="of the ramps from a velocity to the next"
    )
    measure: Seconds = Field(
        4.0, gt=0.0, le=3600.0, description="time at every velocity once it has settled"
    )
    turns: Turns = Field(
        1.0, ge=0.0, le=1000.0, description="turns measured at least, however slow"
    )
    settling: SettlingTest = Field(SettlingTest(), description="when a velocity counts as settled")
    fit_from: RadiansPerSecond = Field(
        0.0, ge=0.0, le=1e4,
        description="speed from which plateaus count for c0 and c1; slower ones are only shown",
    )  # fmt: skip

    @property
    def plateaus(self) -> tuple[Plateau, ...]:
        """All steps of the staircase, in order."""
        return tuple(
            Plateau(v, brake, max(self.measure, self.turns * 2.0 * math.pi / abs(v)))
            for brake in self.brake_commands
            for v in self.velocities
        )

    @property
    def drive(self) -> Drive:
        """Loop and bounds."""
        fastest = max(map(abs, self.velocities))
        return Drive(
            gains=self.loop,
            slope=self.slope,
            limit=self.motor_limit,
            fastest=_OVERSPEED * fastest + _SPEED_MARGIN,
            bandwidth=self.speed_filter,
        )

    def plan(self) -> Plan:
        """The longest that it can take, the bounds of its commands, and how far the shaft turns."""
        self._check()
        longest = staircase.longest(self.plateaus, self.drive, self.settling)
        n_samples = self.samples_in(longest, "measure")
        velocity, brake = staircase.quickest(
            self.plateaus, self.drive, self.settling, self.sample_rate
        )
        return Plan(
            n_samples,
            np.array([-self.motor_limit, min(0.0, *self.brake_commands)]),
            np.array([self.motor_limit, max(0.0, *self.brake_commands)]),
            references={"omega_ref": velocity, "cmd_voltage_brake": brake},
            remarks=(
                f"It takes {len(velocity) / self.sample_rate:.4g} s if every velocity settles at "
                f"once, {longest:.4g} s at most.",
                self._travel(),
                self._needed(),
            ),
        )

    def controller(self) -> Controller:
        """The staircase's loop."""
        return Staircase(self.plateaus, self.drive, self.settling)

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings:
        """The torque on each settled plateau, c0 and c1, and what recurs with every turn."""
        levels = levels_of(samples, extra, self.plateaus)
        if not levels:
            raise ValueError(
                "no plateau has settled: look at omega_tracked beside omega_ref in log.csv. A load "
                "on the shaft ends its travel; a brake stronger than the motor holds it"
            )
        return _Conclusion(self, levels, samples, extra).findings()

    @property
    def motor(self) -> Motor | None:
        """What must be known of the motor, with the torque sensor at the load."""
        if self.torque_sensor == "between" or self.ratings.torque_constant is None:
            return None
        return Motor(self.ratings.torque_constant, self.ratings.motor_damping)

    def _check(self) -> None:
        if self.torque_sensor == "load" and self.ratings.torque_constant is None:
            raise ValueError(
                "ratings.torque_constant: with the torque sensor at the load the brake's torque is "
                "read from the motor's current; give the motor's constant, rated torque by rated "
                "current, such as '0.14 N*m/A'"
            )
        for velocity in self.velocities:
            if velocity == 0.0 or not math.isfinite(velocity):
                raise ValueError(
                    f"velocities: {velocity:g} rad/s is no velocity at which a shaft turns; "
                    "leave it out"
                )
        if self.homing.turns > 0.0:
            raise ValueError(
                "homing.turns: this winds a load, which the staircase would wind off and on again; "
                "take the load off the shaft and leave homing out"
            )
        needed = self._peak()
        if needed is not None and needed > self.motor_limit:
            raise ValueError(
                f"brake_commands: at {max(self.brake_commands):g} V the brake takes about "
                f"{needed:.2g} V of the motor by its ratings, beyond motor_limit, "
                f"{self.motor_limit:g} V; lower the brake command"
            )

    def _peak(self) -> float | None:
        """Motor command that holds the strongest brake, by the ratings; amplifiers are alike."""
        constant, brake = self.ratings.torque_constant, self.ratings.brake_constant
        if constant is None or brake is None:
            return None
        return max(map(abs, self.brake_commands)) * brake / constant

    def _travel(self) -> str:
        """How far the shaft turns at most."""
        most = sum(
            abs(step.velocity) * (step.measure + self.settling.timeout) for step in self.plateaus
        )
        return (
            f"The shaft turns at up to {max(map(abs, self.velocities)):g} rad/s, up to "
            f"{most / (2.0 * math.pi):.0f} turns in all: take the load off, and keep hands away."
        )

    def _needed(self) -> str:
        """What the strongest brake takes of the motor."""
        needed = self._peak()
        if needed is None:
            return (
                "Whether the motor can turn the strongest brake is not known: give "
                "ratings.torque_constant and ratings.brake_constant to have it checked."
            )
        return (
            f"The brake at {max(self.brake_commands):g} V takes about {needed:.2f} V of the motor "
            f"by its ratings; its limit here is {self.motor_limit:g} V."
        )


class _Conclusion:
    """What follows from a run."""

    def __init__(
        self,
        settings: ConstantVelocity,
        levels: list[Level],
        samples: Samples,
        extra: Mapping[str, FloatArray],
    ) -> None:
        self._settings, self._samples, self._extra = settings, samples, extra
        self._levels = levels
        self._plateaus = settings.plateaus
        self._fitted = [level for level in levels if abs(level.omega) >= settings.fit_from]
        self._line, self._no_line = self._fit()
        self._slowest = self._uneven()

    def _fit(self) -> tuple[Line | None, str]:
        try:
            return fit(self._fitted, self._plateaus, self._settings.motor), ""
        except ValueError as error:
            return None, f"No c0 and c1: {error}."

    def findings(self) -> Findings:
        """All of it."""
        figures = [self._curve(), self._trace()]
        if self._slowest is not None:
            figures.append(self._around())
        tables = [self._steps()]
        if self._line is not None:
            tables.insert(0, self._by_brake(self._line))
        return Findings(
            self._numbers(), tuple(tables), tuple(figures), self._ranges(), self._remarks()
        )

    def _brake_torque(self, level: Level) -> FloatArray:
        """The brake's torque in every sample of a plateau, (n,) [N*m]."""
        motor = self._settings.motor
        if motor is None:
            return level.torque
        return motor.constant * level.current_motor - motor.damping * level.omega

    def _uneven(self) -> tuple[Level, Ripple] | None:
        """What recurs with every turn where it is seen best: slow and with little brake."""
        turned = [x for x in self._levels if abs(x.theta[-1] - x.theta[0]) > 0.99 * 2.0 * math.pi]
        if not turned:
            return None
        least = min(self._plateaus[x.index].brake for x in turned)
        level = min(
            (x for x in turned if self._plateaus[x.index].brake == least),
            key=lambda x: abs(x.omega),
        )
        return level, ripple(level.theta, self._brake_torque(level))

    def _numbers(self) -> tuple[Number, ...]:
        line = self._line
        numbers = []
        if line is not None:
            meaning = "viscous damping at zero current" + (
                " and of the motor" if self._with_motor else ""
            )
            numbers.append(_number("c0", line.c0, "N*m*s/rad", meaning))
            if line.c1 is not None:
                meaning = "the same per ampere of brake current"
                numbers.append(_number("c1", line.c1, "N*m*s/(rad*A)", meaning))
            if line.constant is not None:
                numbers.append(_number("K_m", line.constant, "N*m/A", "motor constant"))
            if line.damping is not None:
                meaning = "viscous damping of the motor"
                numbers.append(_number("B_m", line.damping, "N*m*s/rad", meaning))
        if self._slowest is not None:
            numbers.append(_cyclic(self._slowest[1]))
        return tuple(numbers)

    def _by_brake(self, line: Line) -> Table:
        """The line at each brake command, and (4.5) across both directions of motion."""
        across = []
        for command in line.commands:
            own = [x for x in self._levels if self._plateaus[x.index].brake == command]
            torque = np.array([self._brake_torque(x).mean() for x in own])
            omega = np.array([x.omega for x in own])
            across.append(float(np.ptp(torque) / np.ptp(omega)))
        slope = line.c0.value + (line.c1.value if line.c1 else 0.0) * line.currents
        columns = {
            "brake_command": line.commands,
            "brake_current": line.currents,
            "hysteretic_torque": line.kappa,
            "hysteretic_error": line.kappa_errors,
            "slope": slope,
            "slope_across": np.array(across),
        }
        units = dict(zip(columns, ("V", "A", "N*m", "N*m", "N*m*s/rad", "N*m*s/rad"), strict=True))
        return Table("brake", "Brake by command", columns, units)

    def _steps(self) -> Table:
        """Every plateau, in order; those that did not settle have no means."""
        found = {level.index: level for level in self._levels}
        rows = []
        for index, step in enumerate(self._plateaus):
            rows.append((step.brake, step.velocity, *self._row(found.get(index))))
        names = {
            "brake_command": "V", "omega_ref": "rad/s", "settled": "", "start": "s",
            "omega": "rad/s", "omega_spread": "rad/s", "brake_current": "A", "torque": "N*m",
            "torque_spread": "N*m", "torque_error": "N*m", "current_motor": "A", "samples": "",
        }  # fmt: skip
        columns = dict(zip(names, np.array(rows).T, strict=True))
        units = {name: unit for name, unit in names.items() if unit}
        return Table("torque_velocity", "Plateaus", columns, units, printed=False)

    def _row(self, level: Level | None) -> tuple[float, ...]:
        if level is None:
            return (0.0, *(9 * [math.nan]))
        torque, motor = self._brake_torque(level), self._settings.motor
        error = level.torque_error if motor is None else motor.constant * level.current_error
        return (
            1.0, level.start, level.omega, level.omega_spread, level.brake_current,
            float(torque.mean()), float(torque.std()), error, float(level.current_motor.mean()),
            float(level.samples),
        )  # fmt: skip

    def _curve(self) -> Chart:
        """Torque against velocity, a series for each brake command, with its line."""
        series = []
        for command in dict.fromkeys(self._settings.brake_commands):
            own = [x for x in self._levels if self._plateaus[x.index].brake == command]
            if not own:
                continue
            torques = [self._brake_torque(x) for x in own]
            series.append(
                Series(
                    f"brake at {command:g} V",
                    np.array([x.omega for x in own]),
                    np.array([values.mean() for values in torques]),
                    np.array([values.std() for values in torques]),
                )
            )
        if self._line is not None:
            series.append(self._lines(self._line))
        axes = Axis("velocity", "rad/s"), Axis("torque", "N*m")
        return Chart("torque_velocity", "Torque at constant velocity", *axes, tuple(series))

    def _lines(self, line: Line) -> Series:
        """The fitted line of each brake command in both directions, with gaps between them."""
        x: list[float] = []
        y: list[float] = []
        for place, command in enumerate(line.commands):
            omega = [v.omega for v in self._levels if self._plateaus[v.index].brake == command]
            for sign in (-1.0, 1.0):
                fastest = max((sign * v for v in omega), default=0.0)
                if fastest > 0.0:
                    ends = sign * np.array([1e-9, fastest])
                    x += [*ends, math.nan]
                    y += [*line.torque(place, ends), math.nan]
        return Series("line by c0 and c1", np.array(x), np.array(y), style="model")

    def _trace(self) -> Chart:
        """The tracked speed beside its reference."""
        keep = slice(None, None, max(1, len(self._samples) // _DRAWN))
        time = self._samples.time[keep]
        series = (
            Series("reference", time, self._extra["omega_ref"][keep]),
            Series("measured", time, self._extra["omega_tracked"][keep]),
        )
        axes = Axis("time", "s"), Axis("velocity", "rad/s")
        return Chart("velocity", "The velocity loop", *axes, series)

    def _around(self) -> Chart:
        """Torque against the angle where it is seen best."""
        assert self._slowest is not None
        level, found = self._slowest
        label = f"{level.omega:.3g} rad/s, brake at {self._plateaus[level.index].brake:g} V"
        series = (Series(label, found.angle, found.torque, found.errors),)
        axes = Axis("angle", "rad"), Axis("torque", "N*m")
        return Chart("torque_angle", "Torque along a turn", *axes, series)

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Where an identification may search: twice as wide as known, and never below zero."""
        line = self._line
        if line is None:
            return {}
        known = {"c0": line.c0, "c1": line.c1, "K_m": line.constant, "B_m": line.damping}
        ranges = {
            name: (max(0.5 * found.low, 0.1 * found.value), 2.0 * found.high)
            for name, found in known.items()
            if found is not None and found.value > 0.0
        }
        if "c0" in ranges and self._with_motor:
            # Nobody knows how much of it is the brake's.
            ranges["c0"] = (0.1 * line.c0.value, ranges["c0"][1])
        return ranges

    @property
    def _with_motor(self) -> bool:
        """Whether c0 has the motor's damping in it."""
        motor = self._settings.motor
        return motor is not None and motor.damping == 0.0

    def _remarks(self) -> tuple[str, ...]:
        remarks = [*self._unsettled(), self._no_line]
        if self._line is not None and self._line.misfit > 2.0:
            remarks.append(
                f"The torque is no straight line in the velocity: its residuals are "
                f"{self._line.misfit:.1f} times what noise explains. See torque_velocity, and "
                "leave out slow plateaus by fit_from."
            )
        if self._slowest is not None:
            found = self._slowest[1]
            if _is_there(found):
                remarks.append(
                    f"The torque follows the shaft's angle by ±{found.amplitude:.2g} N*m, "
                    f"{found.periods} times a turn: uneven friction, such as of worn brushes. "
                    "See torque_angle."
                )
        if self._settings.torque_sensor == "load":
            remarks += self._loaded()
        elif self._line is not None and self._line.constant is None:
            remarks.append(
                "The motor's constant and losses are not told apart, so c0 rests on the torque "
                "sensor alone: visit several brake commands to have the motor's current as well."
            )
        return tuple(filter(None, remarks))

    def _unsettled(self) -> list[str]:
        """The plateaus without a result: given up, or not done when the run ended."""
        found = {level.index for level in self._levels}
        last = int(self._extra["plateau"][-1])
        done = last if last >= 0 else len(self._plateaus)
        given_up = [
            f"{step.velocity:g} rad/s at {step.brake:g} V"
            for index, step in enumerate(self._plateaus[:done])
            if index not in found
        ]
        remarks = []
        if given_up:
            remarks.append(f"Not settled, and left out: {', '.join(given_up)}.")
        if done < len(self._plateaus):
            total = len(self._plateaus)
            remarks.append(
                f"The run ended before the last {total - done} of {total} plateaus were measured."
            )
        return remarks

    def _loaded(self) -> list[str]:
        """What a torque sensor at the load says of a shaft that should be free."""
        worst = max(self._levels, key=lambda x: abs(x.torque.mean()) / max(x.torque_error, 1e-9))
        torque = float(worst.torque.mean())
        if abs(torque) < 2.0 * _SURE * worst.torque_error:
            return []
        return [
            f"The torque sensor at the load reads {torque:.2g} N*m at {worst.omega:.3g} rad/s: "
            "something hangs on the shaft, and its torque is counted as the brake's. Or the sensor "
            "is between motor and brake: write 'torque_sensor: between'."
        ]


def _number(name: str, found: Estimate, unit: str, meaning: str) -> Number:
    return Number(name, found.value, unit, found.low, found.high, meaning)


def _is_there(found: Ripple) -> bool:
    """Whether a part of the torque recurs beyond doubt; the strongest of many is never zero."""
    return found.amplitude > _SURE * found.error


def _cyclic(found: Ripple) -> Number:
    reach = 1.96 * found.error
    low, high = found.amplitude - reach, found.amplitude + reach
    if not _is_there(found):
        # The strongest of a dozen amplitudes of noise is one of noise: it only bounds what is.
        meaning = "torque that recurs with every turn, amplitude: none seen above the noise"
        return Number("cyclic", 0.0, "N*m", 0.0, high, meaning)
    meaning = f"torque that recurs {found.periods} times a turn, amplitude"
    return Number("cyclic", found.amplitude, "N*m", low, high, meaning)
