"""Steady loops of the Bouc-Wen hysteresis, fitted to torque over one cycle of the angle.

With exponent 1 the model (3.14) depends on the way only, not on time. Scaled to its saturation,
w = z (beta + gamma) / A, it has two parameters: rate = beta + gamma [1/rad] and part =
gamma / (beta + gamma). Along a motion of one direction, with u = w in that direction,

    du/dphi = rate (1 - u)                   where u >= 0,
    du/dphi = rate (1 - (2 part - 1) u)      where u < 0,

both of which have closed solutions. Torque is kappa w + (c0 + c1 i) omega + J domega/dt + offset
with kappa = alpha A / (beta + gamma), so that of z and alpha only their product shows.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from daq.findings import Chart, Findings, Number, Series, Table
from daq.hal import FloatArray
from protocols.analysis import results
from protocols.analysis.results import Estimate

_POINTS = 400  # of a cycle that are fitted
_RATES = (2.0, 2000.0)  # 1/rad, of all brakes that there may be
_PARTS = (0.5, 0.999)  # of Bouc-Wen models of class 1
_STEP = 1e-4  # relative, of numerical derivatives
_LITTLE = 0.8  # of the torque's variance explained, below which a loop is no brake's
_UNLIKE = 1.6  # times a rated value, or a part of it, beyond which something is mixed up
_GUESS = 2.0  # either side of an estimate, where an identification may search
_NEAR_ZERO = 0.05  # of the rate: a share of beta that cannot be told from less


@dataclass(frozen=True)
class Cycles:
    """Counted cycles at one brake level, (n_cycles, n) each; n samples are one period.

    angle [rad] and torque [N*m] as measured; current: mean of the brake's [A].
    """

    brake_command: float
    current: float
    angle: FloatArray
    torque: FloatArray
    dt: float

    @property
    def energy(self) -> FloatArray:
        """Area of the torque-angle loop of each cycle, (n_cycles,) [J]."""
        torque = 0.5 * (self.torque + np.roll(self.torque, -1, axis=1))[:, :-1]
        energy: FloatArray = np.sum(torque * np.diff(self.angle, axis=1), axis=1)
        return energy


@dataclass(frozen=True)
class LoopFit:
    """Parameters of the steady loops; errors by the scatter between cycles.

    kappa: half the height of the loop at each level [N*m]. kappa0, kappa1: their line over the
    current, None with a single level. explained: part of the torque's variance. motions: of each
    level, as of ``motion``. torque: fitted, (n_levels, n) [N*m], at every sample of the period.
    """

    rate: Estimate
    part: Estimate
    kappa: list[Estimate]
    kappa0: Estimate | None
    kappa1: Estimate | None
    explained: float
    motions: list[FloatArray]
    torque: FloatArray

    @property
    def intercept(self) -> float:
        """Way from a reversal to zero hysteretic torque, half the loop's width there [rad]."""
        slope = 2.0 * self.part.value - 1.0
        return math.log1p(slope) / (slope * self.rate.value) if slope > 0 else 1 / self.rate.value

    @property
    def reversal(self) -> float:
        """Slope right behind a reversal, as a part of kappa [1/rad]."""
        return 2.0 * self.part.value * self.rate.value


def motion(cycles: Cycles) -> FloatArray:
    """Angle [rad], speed and acceleration of a level's mean cycle, smoothed and closed, (3, n)."""
    from scipy.signal import savgol_filter

    n = cycles.angle.shape[1]
    angle = (cycles.angle - cycles.angle[:, :1]).mean(axis=0)
    # The derivatives' filter goes on at the other end, where a closed loop meets itself.
    drift = (angle[-1] - angle[0]) / (n - 1)
    angle = angle - drift * np.arange(n)
    window = min(max(5, 2 * round(0.008 / cycles.dt) + 1), n - 1 + n % 2)

    smooth = [savgol_filter(angle, window, 3, k, cycles.dt, mode="wrap") for k in range(3)]
    smooth[1] = smooth[1] + drift / cycles.dt
    return np.stack(smooth)


def hysteresis(angle: FloatArray, rate: float, part: float) -> FloatArray:
    """w along periodic angles, (n_levels, n) [rad]; settled, as after many periods."""
    ways = rate * np.diff(angle, axis=1, append=angle[:, :1])
    slope = max(2.0 * part - 1.0, 1e-6)
    return np.array([_settled(row, slope) for row in ways.tolist()])


def _settled(ways: list[float], slope: float) -> list[float]:
    """w along periodic ways in units of 1/rate, signed by their direction.

    Numbers one by one: of so few levels arrays take ten times as long.
    """
    w, along = 0.0, []
    for way in (*ways, *ways):  # the first period forgets where it began, and is left out
        along.append(w)
        if way != 0.0:
            sign = math.copysign(1.0, way)
            w = sign * _along(sign * w, abs(way), slope)
    return along[len(ways) :]


def _along(u: float, way: float, slope: float) -> float:
    """u after a way, in units of 1/rate, in its direction; slope: 2 part - 1."""
    if u < 0.0:
        left = way - math.log1p(-slope * u) / slope  # of it, once u has come up to zero
        if left <= 0.0:
            return (1.0 - (1.0 - slope * u) * math.exp(-slope * way)) / slope
        u, way = 0.0, left
    return 1.0 - (1.0 - u) * math.exp(-way)


def fit(levels: list[Cycles]) -> LoopFit:
    """Loop parameters by least squares over the mean cycles of all levels together.

    levels: as many cycles of each. rate and part are searched, everything else enters linearly
    (variable projection, Golub and Pereyra 1973). Raises ValueError where the shaft has hardly
    moved.
    """
    from scipy.optimize import least_squares

    problem = _Problem(levels)

    def residual(x: FloatArray) -> FloatArray:
        columns = problem.columns(math.exp(x[0]), float(x[1]))
        misfit: FloatArray = columns @ problem.weights(columns) - problem.torque
        return misfit

    starts = [np.array([math.log(rate), 0.7]) for rate in np.geomspace(8.0, 500.0, 7)]
    best = min(starts, key=lambda x: float(np.sum(residual(x) ** 2)))
    low, high = (np.array([math.log(_RATES[k]), _PARTS[k]]) for k in range(2))
    solution = least_squares(residual, best, bounds=(low, high), diff_step=[_STEP, _STEP])
    return problem.result(math.exp(solution.x[0]), float(solution.x[1]))


class _Problem:
    """Mean torque (n_levels * points,) [N*m] and motion of all levels at the fitted points."""

    def __init__(self, levels: list[Cycles]) -> None:
        self._motions = [motion(level) for level in levels]
        if any(np.ptp(angle) < 0.02 for angle, *_ in self._motions):
            raise ValueError(
                "the shaft has hardly moved: raise the amplitude or lower brake_commands; a brake "
                "stronger than the motor holds it"
            )
        self._levels, self._stride = levels, max(1, levels[0].angle.shape[1] // _POINTS)
        self._currents = np.array([level.current for level in levels])
        self.torque = np.stack([x.torque.mean(axis=0)[:: self._stride] for x in levels]).ravel()

    def columns(self, rate: float, part: float, stride: int | None = None) -> FloatArray:
        """What enters linearly, (n_levels * points, n_columns); stride: from point to point."""
        n = len(self._levels)
        motions = np.stack(self._motions, axis=1)[:, :, :: stride or self._stride]
        angle, speed, acceleration = motions
        w = hysteresis(angle, rate, part)
        of_level = np.eye(n)[:, :, None]
        columns = [*(of_level * w[:, None, :]).swapaxes(0, 1), speed, acceleration]
        if n > 1:
            columns.append(self._currents[:, None] * speed)
        columns += list(np.broadcast_to(of_level, (n, n, w.shape[1])).swapaxes(0, 1))
        return np.stack([column.ravel() for column in columns], axis=1)

    def weights(self, columns: FloatArray) -> FloatArray:
        """Least-squares weights of the columns."""
        weights: FloatArray = np.linalg.lstsq(columns, self.torque, rcond=None)[0]
        return weights

    def result(self, rate: float, part: float) -> LoopFit:
        """All parameters, with errors by what each cycle alone would have changed."""
        n, torque = len(self._levels), self.torque
        columns = self.columns(rate, part)
        weights = self.weights(columns)
        by_rate = (self.columns(rate * (1.0 + _STEP), part) - columns) @ weights / _STEP
        by_part = (self.columns(rate, part - _STEP) - columns) @ weights / -_STEP
        jacobian = np.column_stack([by_rate / rate, by_part, columns])
        cycles = [level.torque[:, :: self._stride] for level in self._levels]
        deviations = np.concatenate([x - x.mean(axis=0) for x in cycles], axis=1)
        changes = deviations @ np.linalg.pinv(jacobian).T
        of_rate, of_part, *kappa = _estimates([rate, part, *weights[:n]], changes[:, : 2 + n])
        # kappa0 + kappa1 |i| through the levels.
        sizes = np.abs(self._currents)
        inverse = np.linalg.pinv(np.column_stack([np.ones_like(sizes), sizes]))
        line = _estimates(inverse @ np.asarray(weights[:n]), changes[:, 2 : 2 + n] @ inverse.T)
        kappa0, kappa1 = line if n > 1 else (None, None)
        misfit = np.sum((columns @ weights - torque) ** 2)
        return LoopFit(
            rate=of_rate,
            part=of_part,
            kappa=kappa,
            kappa0=kappa0,
            kappa1=kappa1,
            explained=float(1.0 - misfit / np.sum((torque - torque.mean()) ** 2)),
            motions=self._motions,
            torque=(self.columns(rate, part, stride=1) @ weights).reshape(n, -1),
        )


def _estimates(values: Sequence[float] | FloatArray, changes: FloatArray) -> list[Estimate]:
    """Estimates of m values by what each cycle alone changes in them, (n_cycles, m)."""
    n = len(changes)
    errors = np.sqrt(np.sum(changes**2, axis=0) / (n * (n - 1)))
    return results.estimates(values, errors, n - 1)


def loop_findings(
    levels: list[Cycles], missing: int, brake_constant: float | None, torque_sensor: str
) -> Findings:
    """Parameters, a row for each level, loops over angle and velocity, ranges.

    levels: their counted cycles. missing: how many brake commands have none. brake_constant: by
    the brake's ratings [N*m/A], if given. torque_sensor: where the settings say that it is.
    """
    # One matrix of cycles: of a run with losses as many of each level as all have.
    n = min(len(level.angle) for level in levels)
    levels = [replace(x, angle=x.angle[:n], torque=x.torque[:n]) for x in levels]
    loop = fit(levels)
    numbers, table = _numbers(loop), _table(levels, loop)
    remarks = tuple(_remarks(loop, missing, brake_constant, torque_sensor))
    return Findings(numbers, (table,), _charts(levels, loop), _ranges(loop), remarks)


def _numbers(loop: LoopFit) -> tuple[Number, ...]:
    at_zero = "hysteretic torque at zero current"
    back = "way from a reversal to zero hysteretic torque"
    return (
        *results.estimated(
            ("rate", loop.rate, "1/rad", "beta + gamma: how fast it turns over"),
            ("part", loop.part, "1", "gamma / (beta + gamma): shape at the reversal"),
            ("kappa0", loop.kappa0, "N*m", f"{at_zero}, alpha0 A / (beta + gamma)"),
            ("kappa1", loop.kappa1, "N*m/A", "the same per ampere of brake current"),
        ),
        Number("intercept", loop.intercept, "rad", meaning=back),
    )


def _table(levels: list[Cycles], loop: LoopFit) -> Table:
    rows = []
    for level, kappa in zip(levels, loop.kappa, strict=True):
        energy = level.energy
        loss = energy.mean(), energy.std(ddof=1) / math.sqrt(len(energy))
        height = kappa.value, kappa.error, kappa.value * loop.reversal
        rows.append((level.brake_command, level.current, *loss, *height))
    heading = (
        "brake_command [V], brake_current [A], energy [J], energy_error [J], "
        "hysteretic_torque [N*m], hysteretic_error [N*m], reversal_slope [N*m/rad]"
    )
    return results.table_of_rows("loops", "Loops, energy for each cycle", heading, rows)


def _charts(levels: list[Cycles], loop: LoopFit) -> tuple[Chart, ...]:
    """Measured means over angle and velocity, and the fitted loops over the angle."""
    over_angle, over_speed, fitted = [], [], []
    for level, (angle, speed, _), torque in zip(levels, loop.motions, loop.torque, strict=True):
        label, measured = f"{level.brake_command:g} V", _closed(level.torque.mean(axis=0))
        over_angle.append(Series(label, _closed(angle), measured))
        over_speed.append(Series(label, _closed(speed), measured))
        fitted.append((_closed(angle), _closed(torque)))
    over_angle.append(results.model_line("fitted", fitted))
    title = "Torque over the {} at each brake command, mean of cycles"
    return tuple(
        Chart(f"torque_{name}", title.format(name), axis, results.TORQUE, tuple(series))
        for name, axis, series in (
            ("angle", results.ANGLE, over_angle),
            ("velocity", results.VELOCITY, over_speed),
        )
    )


def _ranges(loop: LoopFit) -> dict[str, tuple[float, float]]:
    """Where an identification may search, with z scaled to saturate near 1."""
    if loop.explained < _LITTLE:
        return {}
    rate, part = loop.rate.value, loop.part.value
    guesses = {"gamma": rate * part, "beta": rate * max(1.0 - part, _NEAR_ZERO), "A": rate}
    if loop.kappa0 is not None and loop.kappa1 is not None:
        guesses |= {"alpha0": loop.kappa0.value, "alpha1": loop.kappa1.value}
    return {name: (x / _GUESS, x * _GUESS) for name, x in guesses.items() if x > 0.0}


def _remarks(loop: LoopFit, missing: int, rated: float | None, torque_sensor: str) -> Iterator[str]:
    yield (
        f"The Bouc-Wen loop explains {100.0 * loop.explained:.1f} % of the torque's variance. "
        "Intervals are by the scatter between cycles alone."
    )
    if loop.explained < _LITTLE:
        elsewhere = "load" if torque_sensor == "between" else "between"
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
    if missing:
        yield f"{missing} brake command(s) without two whole cycles are left out."
    if loop.kappa0 is None:
        yield "With a second brake command alpha0 and alpha1 could be told apart."
    swing = min(float(np.ptp(angle)) for angle, *_ in loop.motions)
    if swing < 4.0 * loop.intercept:
        yield (
            f"The shaft swung by {swing:.2g} rad only, less than four times the intercept of "
            f"{loop.intercept:.2g} rad: the loops do not saturate. Raise the amplitude or the "
            "period."
        )


def _closed(values: FloatArray) -> FloatArray:
    return np.append(values, values[0])
