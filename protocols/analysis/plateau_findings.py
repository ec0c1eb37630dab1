"""Findings of a run at constant velocities: torque over velocity, c0, c1, what recurs in a turn."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from daq.findings import Chart, Findings, Number, Series, Table
from daq.hal import FloatArray, Samples
from protocols.analysis import results
from protocols.analysis.torque_curve import Level, Line, Motor, fit
from protocols.control.staircase import Plateau

_DRAWN = 4000  # points of a trace in a figure
_SURE = 5.0  # standard errors from which a part of the torque counts as there
_HARMONICS = 12  # in a turn
_PARTS = 72  # of a turn
_TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Ripple:
    """The strongest harmonic of a torque along a turn.

    amplitude and its standard error [N*m], periods in a turn; angle, torque, errors: means over
    parts of a turn and their standard errors, (n,).
    """

    amplitude: float
    error: float
    periods: int
    angle: FloatArray
    torque: FloatArray
    errors: FloatArray

    @property
    def is_seen(self) -> bool:
        """Whether it is above the noise; the strongest of a dozen harmonics is never zero."""
        return self.amplitude > _SURE * self.error

    def number(self) -> Number:
        """The amplitude as a result; one within the noise only bounds what there may be."""
        reach = 1.96 * self.error
        if not self.is_seen:
            meaning = "torque that recurs with every turn, amplitude: none seen above the noise"
            return Number("cyclic", 0.0, "N*m", 0.0, self.amplitude + reach, meaning)
        ends = self.amplitude - reach, self.amplitude + reach
        meaning = f"torque that recurs {self.periods} times a turn, amplitude"
        return Number("cyclic", self.amplitude, "N*m", *ends, meaning)


def ripple(theta: FloatArray, torque: FloatArray) -> Ripple:
    """How a torque (n,) [N*m] goes with the angle (n,) [rad] over whole turns."""
    waves = np.exp(-1j * np.outer(theta, np.arange(1, _HARMONICS + 1)))
    matrix = np.column_stack([np.ones(len(theta)), waves.real, waves.imag])
    weights, *_ = np.linalg.lstsq(matrix, torque, rcond=None)
    amplitudes = np.hypot(weights[1 : _HARMONICS + 1], weights[_HARMONICS + 1 :])
    noise = (torque - matrix @ weights).std()
    strongest = int(np.argmax(amplitudes))
    part = np.floor(theta % _TURN / _TURN * _PARTS).astype(int) % _PARTS
    counts = np.bincount(part, minlength=_PARTS)
    sums = np.bincount(part, torque, minlength=_PARTS)
    seen = counts > 0
    return Ripple(
        amplitude=float(amplitudes[strongest]),
        error=float(noise * math.sqrt(2.0 / len(theta))),
        periods=strongest + 1,
        angle=(np.flatnonzero(seen) + 0.5) * 2.0 * math.pi / _PARTS,
        torque=sums[seen] / counts[seen],
        errors=noise / np.sqrt(counts[seen]),
    )


def _slope(omega: FloatArray, torque: FloatArray) -> float:
    """From the slowest to the fastest; NaN of a single plateau."""
    if len(omega) < 2:
        return math.nan
    slowest, fastest = np.argmin(omega), np.argmax(omega)
    return float((torque[fastest] - torque[slowest]) / (omega[fastest] - omega[slowest]))


@dataclass(frozen=True)
class PlateauFindings:
    """What follows from the settled plateaus.

    levels: at least one. motor: with the torque sensor at the load, else None. fit_from: speed
    from which plateaus count for the line [rad/s]. extra: the columns of ``Staircase``.
    """

    levels: list[Level]
    plateaus: Sequence[Plateau]
    motor: Motor | None
    fit_from: float
    samples: Samples
    extra: Mapping[str, FloatArray]

    def findings(self) -> Findings:
        """The brake by command, every plateau, and what was drawn and read of them."""
        tables, figures = [self._plateau_table()], [self._curve(), self._trace()]
        numbers, (line, _) = list(self._numbers()), self._fit
        if line is not None:
            tables.insert(0, self._brake_table(line))
        if self._ripple is not None:
            level, along = self._ripple
            numbers.append(along.number())
            label = f"{level.omega:.3g} rad/s, brake at {level.brake:g} V"
            series = (Series(label, along.angle, along.torque, along.errors),)
            title = "Torque along a turn"
            figures.append(Chart("torque_angle", title, results.ANGLE, results.TORQUE, series))
        remarks = tuple(filter(None, self._remarks()))
        return Findings(tuple(numbers), tuple(tables), tuple(figures), self._ranges(), remarks)

    @cached_property
    def _fit(self) -> tuple[Line | None, str]:
        """The line through the plateaus, or why there is none."""
        counting = [level for level in self.levels if abs(level.omega) >= self.fit_from]
        try:
            return fit(counting, self.motor), ""
        except ValueError as error:
            return None, f"No c0 and c1: {error}."

    @cached_property
    def _ripple(self) -> tuple[Level, Ripple] | None:
        """What recurs with every turn where it is seen best: slow and with little brake."""
        turned = [x for x in self.levels if abs(x.theta[-1] - x.theta[0]) > 0.99 * _TURN]
        if not turned:
            return None
        level = min(turned, key=lambda x: (x.brake, abs(x.omega)))
        return level, ripple(level.theta, self._brake_torque(level))

    @cached_property
    def _points(self) -> FloatArray:
        """Brake command, velocity, and mean and spread of the torque of each level, (4, n)."""
        pairs = [(level, self._brake_torque(level)) for level in self.levels]
        return np.array([(x.brake, x.omega, y.mean(), y.std()) for x, y in pairs]).T

    @property
    def _with_motor(self) -> bool:
        """Whether c0 has the motor's damping in it."""
        return self.motor is not None and self.motor.damping == 0.0

    def _brake_torque(self, level: Level) -> FloatArray:
        """The brake's torque in every sample of a plateau, (n,) [N*m]."""
        if self.motor is None:
            return level.torque
        return self.motor.constant * level.current_motor - self.motor.damping * level.omega

    def _numbers(self) -> Iterator[Number]:
        line, _ = self._fit
        if line is None:
            return iter(())
        of_motor = " and of the motor" if self._with_motor else ""
        return results.estimated(
            ("c0", line.c0, "N*m*s/rad", f"viscous damping at zero current{of_motor}"),
            ("c1", line.c1, "N*m*s/(rad*A)", "the same per ampere of brake current"),
            ("K_m", line.constant, "N*m/A", "motor constant"),
            ("B_m", line.damping, "N*m*s/rad", "viscous damping of the motor"),
        )

    def _brake_table(self, line: Line) -> Table:
        """The line at each brake command, and (4.5) across both directions of motion."""
        brake, omega, torque, _ = self._points
        across = [_slope(omega[brake == x], torque[brake == x]) for x in line.commands]
        columns = (line.commands, line.currents, line.kappa, line.kappa_errors, line.slopes, across)
        rows = list(zip(*columns, strict=True))
        heading = (
            "brake_command [V], brake_current [A], hysteretic_torque [N*m], "
            "hysteretic_error [N*m], slope [N*m*s/rad], slope_across [N*m*s/rad]"
        )
        return results.table_of_rows("brake", "Brake by command", heading, rows)

    def _plateau_table(self) -> Table:
        """Every plateau, in order; those that did not settle have no means."""
        settled = {level.index: level for level in self.levels}
        rows = [
            (plateau.brake, plateau.velocity, *self._row(settled.get(index)))
            for index, plateau in enumerate(self.plateaus)
        ]
        heading = (
            "brake_command [V], omega_ref [rad/s], settled, start [s], omega [rad/s], "
            "omega_spread [rad/s], brake_current [A], torque [N*m], torque_spread [N*m], "
            "torque_error [N*m], current_motor [A], samples"
        )
        return results.table_of_rows("torque_velocity", "Plateaus", heading, rows, printed=False)

    def _row(self, level: Level | None) -> tuple[float, ...]:
        if level is None:
            return (0.0, *(9 * [math.nan]))
        torque, motor = self._brake_torque(level), self.motor
        error = level.torque_error if motor is None else motor.constant * level.current_error
        motion = (level.start, level.omega, level.omega_spread, level.brake_current)
        means = (torque.mean(), torque.std(), error, level.current_motor.mean())
        return (1.0, *motion, *means, level.samples)

    def _curve(self) -> Chart:
        """Torque against velocity, a series for each brake command, with its line."""
        brake, *rest = self._points
        commands = dict.fromkeys(plateau.brake for plateau in self.plateaus)
        series = [
            Series(f"brake at {command:g} V", *(values[brake == command] for values in rest))
            for command in commands
            if command in brake
        ]
        line, _ = self._fit
        if line is not None:
            series.append(self._fitted(line))
        title = "Torque at constant velocity"
        return Chart("torque_velocity", title, results.VELOCITY, results.TORQUE, tuple(series))

    def _fitted(self, line: Line) -> Series:
        """The fitted line of each brake command in both directions of motion."""
        parts, (brake, velocity, *_) = [], self._points
        for place, command in enumerate(line.commands):
            for sign in (-1.0, 1.0):
                fastest = max(sign * velocity[brake == command])
                if fastest > 0.0:
                    omega = sign * np.array([1e-9, fastest])
                    parts.append((omega, line.torque(place, omega)))
        return results.model_line("line by c0 and c1", parts)

    def _trace(self) -> Chart:
        """The tracked speed beside its reference."""
        shown = slice(None, None, max(1, len(self.samples) // _DRAWN))
        series = tuple(
            Series(label, self.samples.time[shown], self.extra[column][shown])
            for label, column in (("reference", "omega_ref"), ("measured", "omega_tracked"))
        )
        return Chart("velocity", "The velocity loop", results.TIME, results.VELOCITY, series)

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Where an identification may search: twice the intervals, and never below zero."""
        line, _ = self._fit
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

    def _remarks(self) -> Iterator[str]:
        yield from self._unsettled()
        line, problem = self._fit
        yield problem
        if line is not None and line.misfit > 2.0:
            yield (
                f"The torque is no straight line in the velocity: its residuals are "
                f"{line.misfit:.1f} times what noise explains. See torque_velocity, and "
                "leave out slow plateaus by fit_from."
            )
        if self._ripple is not None and self._ripple[1].is_seen:
            along = self._ripple[1]
            yield (
                f"The torque follows the shaft's angle by ±{along.amplitude:.2g} N*m, "
                f"{along.periods} times a turn: uneven friction, such as of worn brushes. "
                "See torque_angle."
            )
        if self.motor is not None:
            yield self._loaded()
        elif line is not None and line.constant is None:
            yield (
                "The motor's constant and losses are not told apart, so c0 rests on the torque "
                "sensor alone: visit several brake commands to have the motor's current as well."
            )

    def _unsettled(self) -> Iterator[str]:
        """The plateaus without a result: given up, or not done when the run ended."""
        settled, total = {level.index for level in self.levels}, len(self.plateaus)
        last = int(self.extra["plateau"][-1])
        done = last if last >= 0 else total
        given_up = [
            f"{plateau.velocity:g} rad/s at {plateau.brake:g} V"
            for index, plateau in enumerate(self.plateaus[:done])
            if index not in settled
        ]
        if given_up:
            yield f"Not settled, and left out: {', '.join(given_up)}."
        if done < total:
            yield f"The run ended before the last {total - done} of {total} plateaus were measured."

    def _loaded(self) -> str:
        """What a torque sensor at the load says of a shaft that should be free."""
        worst = max(self.levels, key=lambda x: abs(x.torque.mean()) / max(x.torque_error, 1e-9))
        torque = float(worst.torque.mean())
        if abs(torque) < 2.0 * _SURE * worst.torque_error:
            return ""
        return (
            f"The torque sensor at the load reads {torque:.2g} N*m at {worst.omega:.3g} rad/s: "
            "something hangs on the shaft, and its torque is counted as the brake's. Or the sensor "
            "is between motor and brake: write 'torque_sensor: between'."
        )
