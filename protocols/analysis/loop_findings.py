"""Findings of a run of hysteresis loops: energy, shape and the parameters behind them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from daq.findings import Axis, Chart, Findings, Number, Series, Table
from daq.hal import FloatArray
from protocols.analysis.bouc_wen_loop import Cycles, fit, motion
from protocols.analysis.results import table_of_rows

_LITTLE = 0.8  # of the torque's variance explained, below which a loop is no brake's
_UNLIKE = 1.6  # times a rated value, or a part of it, beyond which something is mixed up
_GUESS = 2.0  # either side of an estimate, where an identification may search
_NEAR_ZERO = 0.05  # of the rate: a share of beta that cannot be told from less


class LoopFindings:
    """What follows from the counted cycles of each level.

    n_commands: brake commands of the run. brake_constant: by the brake's ratings [N*m/A], if
    given. torque_sensor: where the settings say that it is.
    """

    def __init__(
        self,
        levels: list[Cycles],
        n_commands: int,
        brake_constant: float | None,
        torque_sensor: str,
    ) -> None:
        # One matrix of cycles: of a run with losses as many of each level as all have.
        n = min(len(level.angle) for level in levels)
        self._levels = [replace(x, angle=x.angle[:n], torque=x.torque[:n]) for x in levels]
        self._motions = [motion(level) for level in self._levels]
        self._fit = fit(self._levels)
        self._n_missing = n_commands - len(levels)
        self._brake_constant, self._torque_sensor = brake_constant, torque_sensor

    def findings(self) -> Findings:
        """Parameters, a row for each level, loops over angle and velocity, ranges."""
        return Findings(
            self._numbers(), (self._table(),), self._charts(), self._ranges(), self._remarks()
        )

    def _numbers(self) -> tuple[Number, ...]:
        rate, part, kappa0, kappa1 = (
            getattr(self._fit, name) for name in ("rate", "part", "kappa0", "kappa1")
        )
        numbers = [
            rate.number("rate", "1/rad", "beta + gamma: how fast it turns over"),
            part.number("part", "1", "gamma / (beta + gamma): shape at the reversal"),
        ]
        if kappa0 is not None:
            meaning = "hysteretic torque at zero current, alpha0 A / (beta + gamma)"
            numbers += [
                kappa0.number("kappa0", "N*m", meaning),
                kappa1.number("kappa1", "N*m/A", "the same per ampere of brake current"),
            ]
        meaning = "way from a reversal to zero hysteretic torque"
        return (*numbers, Number("intercept", self._fit.intercept, "rad", meaning=meaning))

    def _table(self) -> Table:
        rows = []
        for level, kappa in zip(self._levels, self._fit.kappa, strict=True):
            energy = level.energy
            loss = energy.mean(), energy.std(ddof=1) / math.sqrt(len(energy))
            height = kappa.value, kappa.error, kappa.value * self._fit.reversal
            rows.append((level.brake_command, level.current, *loss, *height))
        heading = (
            "brake_command [V], brake_current [A], energy [J], energy_error [J], "
            "hysteretic_torque [N*m], hysteretic_error [N*m], reversal_slope [N*m/rad]"
        )
        return table_of_rows("loops", "Loops, energy for each cycle", heading, rows)

    def _charts(self) -> tuple[Chart, Chart]:
        """Measured means over angle and velocity, and the fitted loops over the angle."""
        over_angle, over_speed = [], []
        # The fitted loops are one line with gaps between them.
        angles, torques = [], []
        for level, mean, fitted in zip(self._levels, self._motions, self._fit.torque, strict=True):
            label, torque = f"{level.brake_command:g} V", _closed(level.torque.mean(axis=0))
            over_angle.append(Series(label, _closed(mean.angle), torque))
            over_speed.append(Series(label, _closed(mean.speed), torque))
            angles += [*_closed(mean.angle), math.nan]
            torques += [*_closed(fitted), math.nan]
        over_angle.append(Series("fitted", np.array(angles), np.array(torques), style="model"))
        return (
            _chart("torque_angle", "angle", "rad", over_angle),
            _chart("torque_velocity", "velocity", "rad/s", over_speed),
        )

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Where an identification may search, with z scaled to saturate near 1."""
        if self._fit.explained < _LITTLE:
            return {}
        rate, part = self._fit.rate.value, self._fit.part.value
        guesses = {"gamma": rate * part, "beta": rate * max(1.0 - part, _NEAR_ZERO), "A": rate}
        if self._fit.kappa0 is not None and self._fit.kappa1 is not None:
            guesses |= {"alpha0": self._fit.kappa0.value, "alpha1": self._fit.kappa1.value}
        return {name: (x / _GUESS, x * _GUESS) for name, x in guesses.items() if x > 0.0}

    def _remarks(self) -> tuple[str, ...]:
        fitted, rated = self._fit, self._brake_constant
        remarks = [
            f"The Bouc-Wen loop explains {100.0 * fitted.explained:.1f} % of the torque's "
            "variance. Intervals are by the scatter between cycles alone."
        ]
        if fitted.explained < _LITTLE:
            elsewhere = "load" if self._torque_sensor == "between" else "between"
            remarks.append(
                "That is too little for ranges. Is the torque sensor where 'torque_sensor' says? "
                f"Else write 'torque_sensor: {elsewhere}'. With the brake off little else than "
                "noise may be left."
            )
        if rated and fitted.kappa1 and not rated / _UNLIKE < fitted.kappa1.value < _UNLIKE * rated:
            remarks.append(
                f"kappa1 is {fitted.kappa1.value:.3g} N*m/A where ratings.brake_constant says "
                f"{rated:g}: look at 'torque_sensor', ratings.torque_constant and the scales in "
                "the rig's file."
            )
        if self._n_missing:
            remarks.append(
                f"{self._n_missing} brake command(s) without two whole cycles are left out."
            )
        if fitted.kappa0 is None:
            remarks.append("With a second brake command alpha0 and alpha1 could be told apart.")
        swing = min(float(np.ptp(mean.angle)) for mean in self._motions)
        if swing < 4.0 * fitted.intercept:
            remarks.append(
                f"The shaft swung by {swing:.2g} rad only, less than four times the intercept of "
                f"{fitted.intercept:.2g} rad: the loops do not saturate. Raise the amplitude or "
                "the period."
            )
        return tuple(remarks)


def _chart(name: str, label: str, unit: str, series: list[Series]) -> Chart:
    title = f"Torque over the {label} at each brake command, mean of cycles"
    return Chart(name, title, Axis(label, unit), Axis("torque", "N*m"), tuple(series))


def _closed(values: FloatArray) -> FloatArray:
    return np.append(values, values[0])
