"""Findings of a run of hysteresis loops: energy, shape and the parameters behind them."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from daq.findings import Chart, Findings, Number, Series, Table
from daq.hal import FloatArray
from protocols.analysis.bouc_wen_loop import Cycles, fit, motion
from protocols.analysis.results import ANGLE, TORQUE, VELOCITY, model_line, table_of_rows

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
        tables, remarks = (self._table(),), tuple(self._remarks())
        return Findings(self._numbers(), tables, self._charts(), self._ranges(), remarks)

    def _numbers(self) -> tuple[Number, ...]:
        loop, numbers = self._fit, []
        at_zero = "hysteretic torque at zero current"
        for name, estimate, unit, meaning in (
            ("rate", loop.rate, "1/rad", "beta + gamma: how fast it turns over"),
            ("part", loop.part, "1", "gamma / (beta + gamma): shape at the reversal"),
            ("kappa0", loop.kappa0, "N*m", f"{at_zero}, alpha0 A / (beta + gamma)"),
            ("kappa1", loop.kappa1, "N*m/A", "the same per ampere of brake current"),
        ):
            if estimate is not None:
                numbers.append(estimate.number(name, unit, meaning))
        meaning = "way from a reversal to zero hysteretic torque"
        return (*numbers, Number("intercept", loop.intercept, "rad", meaning=meaning))

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
        over_angle, over_speed, fitted = [], [], []
        for level, mean, torque in zip(self._levels, self._motions, self._fit.torque, strict=True):
            label, measured = f"{level.brake_command:g} V", _closed(level.torque.mean(axis=0))
            over_angle.append(Series(label, _closed(mean.angle), measured))
            over_speed.append(Series(label, _closed(mean.speed), measured))
            fitted.append((_closed(mean.angle), _closed(torque)))
        over_angle.append(model_line("fitted", fitted))
        title = "Torque over the {} at each brake command, mean of cycles"
        return (
            Chart("torque_angle", title.format("angle"), ANGLE, TORQUE, tuple(over_angle)),
            Chart("torque_velocity", title.format("velocity"), VELOCITY, TORQUE, tuple(over_speed)),
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

    def _remarks(self) -> Iterator[str]:
        loop, rated = self._fit, self._brake_constant
        yield (
            f"The Bouc-Wen loop explains {100.0 * loop.explained:.1f} % of the torque's variance. "
            "Intervals are by the scatter between cycles alone."
        )
        if loop.explained < _LITTLE:
            elsewhere = "load" if self._torque_sensor == "between" else "between"
            yield (
                "That is too little for ranges. Is the torque sensor where 'torque_sensor' says? "
                f"Else write 'torque_sensor: {elsewhere}'. With the brake off little else than "
                "noise may be left."
            )
        if rated and loop.kappa1 and not rated / _UNLIKE < loop.kappa1.value < _UNLIKE * rated:
            yield (
                f"kappa1 is {loop.kappa1.value:.3g} N*m/A where ratings.brake_constant says "
                f"{rated:g}: look at 'torque_sensor', ratings.torque_constant and the scales in "
                "the rig's file."
            )
        if self._n_missing:
            yield f"{self._n_missing} brake command(s) without two whole cycles are left out."
        if loop.kappa0 is None:
            yield "With a second brake command alpha0 and alpha1 could be told apart."
        swing = min(float(np.ptp(mean.angle)) for mean in self._motions)
        if swing < 4.0 * loop.intercept:
            yield (
                f"The shaft swung by {swing:.2g} rad only, less than four times the intercept of "
                f"{loop.intercept:.2g} rad: the loops do not saturate. Raise the amplitude or the "
                "period."
            )


def _closed(values: FloatArray) -> FloatArray:
    return np.append(values, values[0])
