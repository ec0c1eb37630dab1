"""Findings of a run at constant velocities: torque over velocity, c0, c1, what recurs in a turn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from daq.findings import Axis, Chart, Findings, Number, Series, Table
from daq.hal import FloatArray, Samples
from protocols.analysis.results import table_of_rows
from protocols.analysis.ripple import Ripple, ripple
from protocols.analysis.torque_curve import Level, Line, Motor, fit
from protocols.control.staircase import Plateau

_DRAWN = 4000  # points of a trace in a figure
_SURE = 5.0  # standard errors from which a part of the torque counts as there
_TORQUE = Axis("torque", "N*m")


class PlateauFindings:
    """What follows from the settled plateaus.

    levels: at least one. motor: with the torque sensor at the load, else None. fit_from: speed
    from which plateaus count for the line [rad/s]. extra: the columns of ``Staircase``.
    """

    def __init__(
        self,
        levels: list[Level],
        plateaus: Sequence[Plateau],
        motor: Motor | None,
        fit_from: float,
        samples: Samples,
        extra: Mapping[str, FloatArray],
    ) -> None:
        self._levels, self._plateaus, self._motor = levels, plateaus, motor
        self._samples, self._extra = samples, extra
        self._with_command: dict[float, list[Level]] = {p.brake: [] for p in plateaus}
        for level in levels:
            self._with_command[self._command(level)].append(level)
        self._line: Line | None = None
        self._no_line = ""
        try:
            counting = [level for level in levels if abs(level.omega) >= fit_from]
            self._line = fit(counting, plateaus, motor)
        except ValueError as error:
            self._no_line = f"No c0 and c1: {error}."
        self._rippled = self._most_rippled()
        self._ripple: Ripple | None = None
        if self._rippled is not None:
            self._ripple = ripple(self._rippled.theta, self._brake_torque(self._rippled))

    def findings(self) -> Findings:
        """The brake by command, every plateau, and what was drawn and read of them."""
        tables, figures = [self._plateau_table()], [self._curve(), self._trace()]
        if self._line is not None:
            tables.insert(0, self._brake_table(self._line))
        if self._rippled is not None and self._ripple is not None:
            figures.append(self._turn(self._rippled, self._ripple))
        return Findings(
            self._numbers(), tuple(tables), tuple(figures), self._ranges(), self._remarks()
        )

    def _command(self, level: Level) -> float:
        return self._plateaus[level.index].brake

    def _brake_torque(self, level: Level) -> FloatArray:
        """The brake's torque in every sample of a plateau, (n,) [N*m]."""
        if self._motor is None:
            return level.torque
        return self._motor.constant * level.current_motor - self._motor.damping * level.omega

    def _most_rippled(self) -> Level | None:
        """The plateau that shows best what recurs with every turn: slow and with little brake."""
        turned = [x for x in self._levels if abs(x.theta[-1] - x.theta[0]) > 0.99 * 2.0 * math.pi]
        return min(turned, key=lambda x: (self._command(x), abs(x.omega)), default=None)

    def _numbers(self) -> tuple[Number, ...]:
        numbers, line = [], self._line
        if line is not None:
            of_motor = " and of the motor" if self._with_motor else ""
            for name, estimate, unit, meaning in (
                ("c0", line.c0, "N*m*s/rad", f"viscous damping at zero current{of_motor}"),
                ("c1", line.c1, "N*m*s/(rad*A)", "the same per ampere of brake current"),
                ("K_m", line.constant, "N*m/A", "motor constant"),
                ("B_m", line.damping, "N*m*s/rad", "viscous damping of the motor"),
            ):
                if estimate is not None:
                    numbers.append(estimate.number(name, unit, meaning))
        if self._ripple is not None:
            numbers.append(self._ripple.number(_SURE))
        return tuple(numbers)

    def _brake_table(self, line: Line) -> Table:
        """The line at each brake command, and (4.5) across both directions of motion."""
        across = []
        for command in line.commands:
            levels = self._with_command[command]
            torque = np.array([self._brake_torque(level).mean() for level in levels])
            across.append(np.ptp(torque) / np.ptp([level.omega for level in levels]))
        columns = (line.commands, line.currents, line.kappa, line.kappa_errors, line.slopes, across)
        heading = (
            "brake_command [V], brake_current [A], hysteretic_torque [N*m], "
            "hysteretic_error [N*m], slope [N*m*s/rad], slope_across [N*m*s/rad]"
        )
        return table_of_rows("brake", "Brake by command", heading, list(zip(*columns, strict=True)))

    def _plateau_table(self) -> Table:
        """Every plateau, in order; those that did not settle have no means."""
        settled = {level.index: level for level in self._levels}
        rows = [
            (plateau.brake, plateau.velocity, *self._row(settled.get(index)))
            for index, plateau in enumerate(self._plateaus)
        ]
        heading = (
            "brake_command [V], omega_ref [rad/s], settled, start [s], omega [rad/s], "
            "omega_spread [rad/s], brake_current [A], torque [N*m], torque_spread [N*m], "
            "torque_error [N*m], current_motor [A], samples"
        )
        return table_of_rows("torque_velocity", "Plateaus", heading, rows, printed=False)

    def _row(self, level: Level | None) -> tuple[float, ...]:
        if level is None:
            return (0.0, *(9 * [math.nan]))
        torque, motor = self._brake_torque(level), self._motor
        error = level.torque_error if motor is None else motor.constant * level.current_error
        motion = (level.start, level.omega, level.omega_spread, level.brake_current)
        current = float(level.current_motor.mean())
        spread = (float(torque.mean()), float(torque.std()), error)
        return (1.0, *motion, *spread, current, float(level.samples))

    def _curve(self) -> Chart:
        """Torque against velocity, a series for each brake command, with its line."""
        series = []
        for command, levels in self._with_command.items():
            if levels:
                torques = [self._brake_torque(level) for level in levels]
                omega = np.array([level.omega for level in levels])
                means = np.array([torque.mean() for torque in torques])
                spread = np.array([torque.std() for torque in torques])
                series.append(Series(f"brake at {command:g} V", omega, means, spread))
        if self._line is not None:
            series.append(self._fitted(self._line))
        title, velocity = "Torque at constant velocity", Axis("velocity", "rad/s")
        return Chart("torque_velocity", title, velocity, _TORQUE, tuple(series))

    def _fitted(self, line: Line) -> Series:
        """The fitted line of each brake command in both directions, with gaps between them."""
        x: list[float] = []
        y: list[float] = []
        for place, command in enumerate(line.commands):
            for sign in (-1.0, 1.0):
                fastest = max(sign * level.omega for level in self._with_command[command])
                if fastest > 0.0:
                    ends = sign * np.array([1e-9, fastest])
                    x += [*ends, math.nan]
                    y += [*line.torque(place, ends), math.nan]
        return Series("line by c0 and c1", np.array(x), np.array(y), style="model")

    def _trace(self) -> Chart:
        """The tracked speed beside its reference."""
        shown = slice(None, None, max(1, len(self._samples) // _DRAWN))
        time = self._samples.time[shown]
        series = (
            Series("reference", time, self._extra["omega_ref"][shown]),
            Series("measured", time, self._extra["omega_tracked"][shown]),
        )
        axes = Axis("time", "s"), Axis("velocity", "rad/s")
        return Chart("velocity", "The velocity loop", *axes, series)

    def _turn(self, level: Level, along: Ripple) -> Chart:
        """Torque against the angle."""
        label = f"{level.omega:.3g} rad/s, brake at {self._command(level):g} V"
        series = (Series(label, along.angle, along.torque, along.errors),)
        return Chart("torque_angle", "Torque along a turn", Axis("angle", "rad"), _TORQUE, series)

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Where an identification may search: twice the intervals, and never below zero."""
        line = self._line
        if line is None:
            return {}
        estimates = {"c0": line.c0, "c1": line.c1, "K_m": line.constant, "B_m": line.damping}
        ranges = {
            name: (max(0.5 * estimate.low, 0.1 * estimate.value), 2.0 * estimate.high)
            for name, estimate in estimates.items()
            if estimate is not None and estimate.value > 0.0
        }
        if "c0" in ranges and self._with_motor:
            # Nobody knows how much of it is the brake's.
            ranges["c0"] = (0.1 * line.c0.value, ranges["c0"][1])
        return ranges

    @property
    def _with_motor(self) -> bool:
        """Whether c0 has the motor's damping in it."""
        return self._motor is not None and self._motor.damping == 0.0

    def _remarks(self) -> tuple[str, ...]:
        remarks = [*self._unsettled(), self._no_line]
        if self._line is not None and self._line.misfit > 2.0:
            remarks.append(
                f"The torque is no straight line in the velocity: its residuals are "
                f"{self._line.misfit:.1f} times what noise explains. See torque_velocity, and "
                "leave out slow plateaus by fit_from."
            )
        if self._ripple is not None and self._ripple.exceeds(_SURE):
            remarks.append(
                f"The torque follows the shaft's angle by ±{self._ripple.amplitude:.2g} N*m, "
                f"{self._ripple.periods} times a turn: uneven friction, such as of worn brushes. "
                "See torque_angle."
            )
        if self._motor is not None:
            remarks.append(self._loaded())
        elif self._line is not None and self._line.constant is None:
            remarks.append(
                "The motor's constant and losses are not told apart, so c0 rests on the torque "
                "sensor alone: visit several brake commands to have the motor's current as well."
            )
        return tuple(filter(None, remarks))

    def _unsettled(self) -> list[str]:
        """The plateaus without a result: given up, or not done when the run ended."""
        settled, total = {level.index for level in self._levels}, len(self._plateaus)
        last = int(self._extra["plateau"][-1])
        done = last if last >= 0 else total
        given_up = [
            f"{plateau.velocity:g} rad/s at {plateau.brake:g} V"
            for index, plateau in enumerate(self._plateaus[:done])
            if index not in settled
        ]
        remarks = []
        if given_up:
            remarks.append(f"Not settled, and left out: {', '.join(given_up)}.")
        if done < total:
            remarks.append(
                f"The run ended before the last {total - done} of {total} plateaus were measured."
            )
        return remarks

    def _loaded(self) -> str:
        """What a torque sensor at the load says of a shaft that should be free."""
        worst = max(self._levels, key=lambda x: abs(x.torque.mean()) / max(x.torque_error, 1e-9))
        torque = float(worst.torque.mean())
        if abs(torque) < 2.0 * _SURE * worst.torque_error:
            return ""
        return (
            f"The torque sensor at the load reads {torque:.2g} N*m at {worst.omega:.3g} rad/s: "
            "something hangs on the shaft, and its torque is counted as the brake's. Or the sensor "
            "is between motor and brake: write 'torque_sensor: between'."
        )
