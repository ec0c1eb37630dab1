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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from daq.hal import FloatArray
from protocols.analysis.results import Estimate, student

_POINTS = 400  # of a cycle that are fitted
_RATES = (2.0, 2000.0)  # 1/rad, of all brakes that there may be
_PARTS = (0.5, 0.999)  # of Bouc-Wen models of class 1
_STEP = 1e-4  # relative, of numerical derivatives


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


class Motion(NamedTuple):
    """Mean motion over a cycle, (n,) each: angle [rad], speed [rad/s], acceleration [rad/s^2]."""

    angle: FloatArray
    speed: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True)
class LoopFit:
    """Parameters of the steady loops; errors by the scatter between cycles.

    kappa: half the height of the loop at each level [N*m]. kappa0, kappa1: their line over the
    current, None with a single level. explained: part of the torque's variance. torque: fitted,
    (n_levels, n) [N*m], at every sample of the period.
    """

    rate: Estimate
    part: Estimate
    kappa: tuple[Estimate, ...]
    kappa0: Estimate | None
    kappa1: Estimate | None
    explained: float
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


def motion(cycles: Cycles) -> Motion:
    """Mean motion of a level's cycles, smoothed over a few samples; no way is left at its end."""
    from scipy.signal import savgol_filter

    n = cycles.angle.shape[1]
    angle = (cycles.angle - cycles.angle[:, :1]).mean(axis=0)
    # The derivatives' filter goes on at the other end, where a closed loop meets itself.
    drift = (angle[-1] - angle[0]) / (n - 1)
    angle = angle - drift * np.arange(n)
    window = min(max(5, 2 * round(0.008 / cycles.dt) + 1), n - 1 + n % 2)

    def smooth(order: int) -> FloatArray:
        smoothed: FloatArray = savgol_filter(angle, window, 3, order, cycles.dt, mode="wrap")
        return smoothed

    return Motion(smooth(0), smooth(1) + drift / cycles.dt, smooth(2))


def hysteresis(angle: FloatArray, rate: float, part: float) -> FloatArray:
    """w along periodic angles, (n_levels, n) [rad]; settled, as after many periods."""
    steps = np.diff(angle, axis=1, append=angle[:, :1])
    sign = np.sign(steps).T
    way = rate * np.abs(steps).T
    w = np.zeros(len(angle))
    settled = np.empty(angle.shape)
    for _cycle in range(2):  # the first one forgets where it began, and is written over
        for k in range(angle.shape[1]):
            settled[:, k] = w
            w = np.where(sign[k] == 0.0, w, sign[k] * _along(sign[k] * w, way[k], part))
    return settled


def _along(u: FloatArray, way: FloatArray, part: float) -> FloatArray:
    """u after a way, in units of 1/rate, in its direction, (n_levels,)."""
    slope = max(2.0 * part - 1.0, 1e-6)
    # Way that is left once u has come up to zero, and u where it has not.
    left = way - np.log1p(slope * np.maximum(-u, 0.0)) / slope
    below = (1.0 - (1.0 - slope * np.minimum(u, 0.0)) * np.exp(-slope * way)) / slope
    above = 1.0 - (1.0 - np.maximum(u, 0.0)) * np.exp(-np.maximum(left, 0.0))
    return np.where(left > 0.0, above, below)


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
    """Mean torque and motion of all levels at the points that are fitted.

    torque: (n_levels * points,) [N*m].
    """

    def __init__(self, levels: list[Cycles]) -> None:
        self._motions = [motion(level) for level in levels]
        if any(np.ptp(m.angle) < 0.02 for m in self._motions):
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
        angle, speed, acceleration = (
            np.stack(column)[:, :: stride or self._stride]
            for column in zip(*self._motions, strict=True)
        )
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
        changes = self._cycle_deviations() @ np.linalg.pinv(jacobian).T
        of_rate, of_part, *kappa = _estimates([rate, part, *weights[:n]], changes[:, : 2 + n])
        # kappa0 + kappa1 |i| through the levels.
        sizes = np.abs(self._currents)
        inverse = np.linalg.pinv(np.column_stack([np.ones_like(sizes), sizes]))
        line = _estimates(inverse @ np.asarray(weights[:n]), changes[:, 2 : 2 + n] @ inverse.T)
        misfit = np.sum((columns @ weights - torque) ** 2)
        return LoopFit(
            rate=of_rate,
            part=of_part,
            kappa=tuple(kappa),
            kappa0=line[0] if n > 1 else None,
            kappa1=line[1] if n > 1 else None,
            explained=float(1.0 - misfit / np.sum((torque - torque.mean()) ** 2)),
            torque=(self.columns(rate, part, stride=1) @ weights).reshape(n, -1),
        )

    def _cycle_deviations(self) -> FloatArray:
        """Torque of each cycle less the mean one, (n_cycles, n_levels * points)."""
        cycles = [level.torque[:, :: self._stride] for level in self._levels]
        return np.concatenate([x - x.mean(axis=0) for x in cycles], axis=1)


def _estimates(values: Sequence[float] | FloatArray, changes: FloatArray) -> list[Estimate]:
    """Estimates of m values by what each cycle alone changes in them, (n_cycles, m)."""
    n = len(changes)
    errors = np.sqrt(np.sum(changes**2, axis=0) / (n * (n - 1)))
    return [
        Estimate(float(v), float(e), student(n - 1)) for v, e in zip(values, errors, strict=True)
    ]
