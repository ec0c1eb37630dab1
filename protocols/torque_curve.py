"""Torque against velocity from settled plateaus: their means, and the brake behind them.

At a constant velocity nothing accelerates, and the motor's torque is the brake's, but for the
motor's own losses (3.20)-(3.22). On each plateau, with its direction s = sign(omega),

    torque sensor between motor and brake:  tau     = kappa s + c omega + offset
    motor current, wherever the sensor is:  K_m i_m = kappa s + c omega + B_m omega + T_m s + offset

with one kappa = alpha z of the sliding hysteresis per brake command and c = c0 + c1 |i_b| of all.
All of it is linear in the unknowns. Between motor and brake both lines hold together: the sensor
tells K_m and the motor's losses (B_m, T_m), and the current, by far the quieter signal, the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from daq.hal import FloatArray, Samples
from protocols.staircase import Plateau

_BATCHES = 16  # of a plateau, whose means tell how far its mean may be trusted
_LEAST_ERROR = 1e-9  # of a mean, in its unit, where nothing is noisy

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Level:
    """What was measured on one plateau, over whole turns where it has made one.

    index: of the plateau. theta, torque, current_motor: settled samples, (n,). *_error: standard
    errors of the means.
    """

    index: int
    start: float
    omega: float
    omega_spread: float
    brake_current: float
    theta: FloatArray
    torque: FloatArray
    current_motor: FloatArray
    torque_error: float
    current_error: float

    @property
    def samples(self) -> int:
        """Number of settled samples."""
        return len(self.theta)


def levels_of(
    samples: Samples, extra: Mapping[str, FloatArray], plateaus: Sequence[Plateau]
) -> list[Level]:
    """The plateaus that were measured whole after they had settled, in order."""
    settled = extra["settled"] == 1.0
    levels = []
    for index, plateau in enumerate(plateaus):
        counted = _last_stretch(settled & (extra["plateau"] == index))
        rows = np.flatnonzero(counted)
        # A sample short of the time is whole: times are a row's, not a row's end.
        short = 1.5 * float(np.median(np.diff(samples.time[rows]))) if len(rows) > 1 else 0.0
        if (
            len(rows) < 2
            or samples.time[rows[-1]] - samples.time[rows[0]] < plateau.measure - short
        ):
            continue
        levels.append(_level(samples, extra, index, rows[_whole_turns(samples.theta[rows])]))
    return levels


def _last_stretch(counted: BoolArray) -> BoolArray:
    """Only the last of the stretches of true: a departure from the band began the plateau anew."""
    rows = np.flatnonzero(counted)
    if len(rows) == 0:
        return counted
    breaks = np.flatnonzero(np.diff(rows) > 1)
    first = rows[breaks[-1] + 1] if len(breaks) else rows[0]
    last: BoolArray = counted & (np.arange(len(counted)) >= first)
    return last


def _whole_turns(theta: FloatArray) -> slice:
    """The rows of whole turns from the first on; all where there is none."""
    travel = np.abs(theta - theta[0])
    turns = math.floor(travel[-1] / (2.0 * math.pi))
    return slice(int(np.searchsorted(travel, 2.0 * math.pi * turns)) if turns else len(theta))


def _level(
    samples: Samples, extra: Mapping[str, FloatArray], index: int, rows: npt.NDArray[np.intp]
) -> Level:
    time, theta = samples.time[rows], samples.theta[rows]
    torque, current = samples.torque[rows], samples.current_motor[rows]
    return Level(
        index=index,
        start=float(time[0]),
        omega=float((theta[-1] - theta[0]) / (time[-1] - time[0])),
        omega_spread=float(np.std(extra["omega_tracked"][rows])),
        brake_current=float(np.mean(samples.current_brake[rows])),
        theta=theta,
        torque=torque,
        current_motor=current,
        torque_error=_error_of_mean(torque),
        current_error=_error_of_mean(current),
    )


def _error_of_mean(values: FloatArray) -> float:
    """Standard error of the mean, by the means of batches: neighbours need not be independent."""
    batches = min(_BATCHES, len(values))
    means = np.array([part.mean() for part in np.array_split(values, batches)])
    return float(means.std(ddof=1) / math.sqrt(batches))


@dataclass(frozen=True)
class Motor:
    """What is known of the motor: constant [N*m/A] and viscous damping [N*m*s/rad].

    Needed where the torque sensor is at the load; elsewhere the run tells both.
    """

    constant: float
    damping: float


@dataclass(frozen=True)
class Estimate:
    """A value with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Line:
    """The straight line behind the settled plateaus.

    c0 [N*m*s/rad] and c1 [N*m*s/(rad*A)], None with one brake command. commands (m,) [V],
    currents (m,) [A], kappa (m,), the hysteretic torque while sliding [N*m], kappa_errors (m,).
    misfit: of the residuals, in parts of what noise explains. constant, damping: of the motor,
    where the run tells them: with the sensor between, and several brake commands.
    """

    c0: Estimate
    c1: Estimate | None
    commands: FloatArray
    currents: FloatArray
    kappa: FloatArray
    kappa_errors: FloatArray
    misfit: float
    constant: Estimate | None
    damping: Estimate | None

    def torque(self, level: int, omega: FloatArray) -> FloatArray:
        """The brake's torque at a brake command, by its place, and velocities [N*m]."""
        slope = self.c0.value + (self.c1.value * float(self.currents[level]) if self.c1 else 0.0)
        return float(self.kappa[level]) * np.sign(omega) + slope * omega


def fit(levels: Sequence[Level], plateaus: Sequence[Plateau], motor: Motor | None) -> Line:
    """The line through settled plateaus; ``motor`` where the sensor is at the load, else None.

    Raises ValueError where no brake command has two of them in a direction.
    """
    own = np.array([plateaus[level.index].brake for level in levels])
    omega = np.array([level.omega for level in levels])
    if not _has_slope(own, omega):
        raise ValueError(
            "no brake command has two settled velocities in the same direction, which a slope takes"
        )
    commands, place = np.unique(own, return_inverse=True)
    measured = np.array([level.brake_current for level in levels])
    currents = np.array([measured[place == i].mean() for i in range(len(commands))])
    currents *= -1.0 if currents.sum() < 0.0 else 1.0  # the brake cares for its size alone
    brake = np.column_stack([
        np.sign(omega)[:, None] * (place[:, None] == np.arange(len(commands))),
        omega,
        currents[place] * omega,
    ])  # fmt: skip
    torque = np.array([level.torque.mean() for level in levels])
    current = np.array([level.current_motor.mean() for level in levels])
    errors = _pooled(levels, [level.torque_error for level in levels])
    current_errors = _pooled(levels, [level.current_error for level in levels])
    # What the zero of a sensor may still be off is told by the other direction alone.
    ones = np.full((len(levels), 1), float(np.ptp(np.sign(omega)) > 0.0))
    if motor is not None:
        sides = motor.constant * current - motor.damping * omega
        solved = _solve(np.hstack([brake, ones]), sides, motor.constant * current_errors)
    else:
        constant = _constant(torque, current)
        none = np.zeros((len(levels), 4))
        losses = np.column_stack([ones, -current, omega, np.sign(omega)])
        matrix = np.block([[brake, ones, none], [brake, 0.0 * ones, losses]])
        sides = np.concatenate([torque, 0.0 * torque])
        solved = _solve(matrix, sides, np.concatenate([errors, constant * current_errors]))
    m = len(commands)
    return Line(
        c0=solved.estimate(m),
        c1=solved.estimate(m + 1) if m > 1 else None,
        commands=commands,
        currents=currents,
        kappa=solved.values[:m],
        kappa_errors=solved.errors[:m],
        misfit=solved.misfit,
        constant=None if motor else solved.told(m + 4),
        damping=None if motor else solved.told(m + 5),
    )


def _has_slope(commands: FloatArray, omega: FloatArray) -> bool:
    """Whether somewhere two velocities of one direction stand at one brake command."""
    groups = np.column_stack([commands, np.sign(omega)])
    return len(np.unique(groups, axis=0)) < len(groups)


def _pooled(levels: Sequence[Level], errors: Sequence[float]) -> FloatArray:
    """Standard errors of the plateaus' means from the noise that they have in common."""
    counts = np.array([level.samples for level in levels], dtype=np.float64)
    common = math.sqrt(float(np.mean(np.square(errors) * counts)))
    means: FloatArray = common / np.sqrt(counts) + _LEAST_ERROR
    return means


def _constant(torque: FloatArray, current: FloatArray) -> float:
    """The motor's constant by the two signals alone; ValueError where they do not belong together.

    A torque sensor that is at the load reads nothing of the motor.
    """
    related = float(np.corrcoef(torque, current)[0, 1])
    if not related > 0.9:
        raise ValueError(
            f"the torque sensor does not follow the motor's current (correlation {related:.2f}): "
            "if it is at the load write 'torque_sensor: load'; if it is between motor and brake "
            "check the sign of sensors.torque in the rig's file"
        )
    return float(np.polyfit(current, torque, 1)[0])


@dataclass(frozen=True)
class _Solved:
    values: FloatArray
    errors: FloatArray
    misfit: float
    freedom: int

    def estimate(self, place: int) -> Estimate:
        from scipy.stats import t

        reach = float(t.ppf(0.975, self.freedom)) * float(self.errors[place])
        value = float(self.values[place])
        return Estimate(value, value - reach, value + reach)

    def told(self, place: int) -> Estimate | None:
        """The estimate where the rows tell it to a half, None elsewhere."""
        found = self.estimate(place)
        return found if found.high - found.value < 0.5 * found.value else None


def _solve(matrix: FloatArray, sides: FloatArray, errors: FloatArray) -> _Solved:
    """Weighted least squares; what the rows cannot tell apart does not spoil what they can."""
    weighted, target = matrix / errors[:, None], sides / errors
    inverse = np.linalg.pinv(weighted, rcond=1e-10)
    values = inverse @ target
    freedom = max(len(sides) - int(np.linalg.matrix_rank(weighted)), 1)
    misfit = float(np.linalg.norm(weighted @ values - target) / math.sqrt(freedom))
    spread = np.sqrt(np.sum(inverse**2, axis=1)) * max(misfit, 1.0)
    return _Solved(values, spread, misfit, freedom)


@dataclass(frozen=True)
class Ripple:
    """The strongest part of a torque that recurs with every turn.

    amplitude and its standard error [N*m], periods in a turn; angle, torque, errors: means over
    parts of a turn and their standard errors, (n,).
    """

    amplitude: float
    error: float
    periods: int
    angle: FloatArray
    torque: FloatArray
    errors: FloatArray


_HARMONICS = 12  # in a turn
_PARTS = 72  # of a turn


def ripple(theta: FloatArray, torque: FloatArray) -> Ripple:
    """How a torque (n,) [N*m] goes with the angle (n,) [rad] over whole turns."""
    n = np.arange(1, _HARMONICS + 1)
    waves = np.exp(-1j * np.outer(theta, n))
    matrix = np.column_stack([np.ones(len(theta)), waves.real, waves.imag])
    values, *_ = np.linalg.lstsq(matrix, torque, rcond=None)
    sizes = np.hypot(values[1 : _HARMONICS + 1], values[_HARMONICS + 1 :])
    residuals = torque - matrix @ values
    strongest = int(np.argmax(sizes))
    part = np.floor(theta % (2.0 * math.pi) / (2.0 * math.pi) * _PARTS).astype(int) % _PARTS
    counts = np.bincount(part, minlength=_PARTS)
    sums = np.bincount(part, torque, minlength=_PARTS)
    seen = counts > 0
    return Ripple(
        amplitude=float(sizes[strongest]),
        error=float(residuals.std() * math.sqrt(2.0 / len(theta))),
        periods=strongest + 1,
        angle=(np.flatnonzero(seen) + 0.5) * 2.0 * math.pi / _PARTS,
        torque=sums[seen] / counts[seen],
        errors=residuals.std() / np.sqrt(counts[seen]),
    )
