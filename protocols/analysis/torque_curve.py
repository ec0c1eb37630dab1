"""Torque against velocity from settled plateaus: their means, and the brake behind them.

At a constant velocity nothing accelerates, and the motor's torque is the brake's, but for the
motor's own losses (3.20)-(3.22). On each plateau, with its direction s = sign(omega),

    torque sensor between motor and brake:  tau     = kappa s + c omega + offset
    motor current, wherever the sensor is:  K_m i_m = kappa s + c omega + B_m omega + T_m s + offset

with one kappa = alpha z of the sliding hysteresis per brake command and c = c0 + c1 |i_b| of all.
All of it is linear in the unknowns. Between motor and brake both lines hold together: the sensor
tells K_m and the motor's losses (B_m, T_m), and the current, by far the quieter signal, the rest.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from daq.hal import FloatArray, Samples
from protocols.analysis.results import Estimate, estimates
from protocols.control.staircase import Plateau

_BATCHES = 16  # of a plateau, whose means tell how far its mean may be trusted
_LEAST_ERROR = 1e-9  # of a mean, in its unit, where nothing is noisy

Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Level:
    """What was measured on one plateau, over whole turns where it has made one.

    index, brake: number and brake command [V] of the plateau. theta, torque, current_motor:
    settled samples, (n,). *_error: standard errors of the means.
    """

    index: int
    brake: float
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
        rows = np.flatnonzero(settled & (extra["plateau"] == index))
        # The last rows without a gap: a departure from the band began the plateau anew.
        rows = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)[-1]
        if len(rows) < 2:
            continue
        time = samples.time[rows]
        # A sample short of the time is whole: times are a row's, not a row's end.
        if time[-1] - time[0] >= plateau.measure - 1.5 * float(np.median(np.diff(time))):
            whole = rows[_whole_turns(samples.theta[rows])]
            levels.append(_level(samples, extra, index, plateau.brake, whole))
    return levels


def _whole_turns(theta: FloatArray) -> slice:
    """The rows of whole turns from the first on; all where there is none."""
    travel = np.abs(theta - theta[0])
    turns = math.floor(travel[-1] / (2.0 * math.pi))
    return slice(int(np.searchsorted(travel, 2.0 * math.pi * turns)) if turns else len(theta))


def _level(
    samples: Samples, extra: Mapping[str, FloatArray], index: int, brake: float, rows: Rows
) -> Level:
    time, theta = samples.time[rows], samples.theta[rows]
    torque, current = samples.torque[rows], samples.current_motor[rows]
    return Level(
        index=index,
        brake=brake,
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


class Motor(NamedTuple):
    """Constant [N*m/A] and viscous damping [N*m*s/rad] of the motor, by its ratings."""

    constant: float
    damping: float


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

    @property
    def slopes(self) -> FloatArray:
        """Torque over velocity while sliding, at each brake command, (m,) [N*m*s/rad]."""
        return self.c0.value + (self.c1.value if self.c1 else 0.0) * self.currents

    def torque(self, place: int, omega: FloatArray) -> FloatArray:
        """The brake's torque at a brake command, by its place, and velocities [N*m]."""
        return float(self.kappa[place]) * np.sign(omega) + float(self.slopes[place]) * omega


def fit(levels: Sequence[Level], motor: Motor | None) -> Line:
    """The line through settled plateaus; ``motor`` where the sensor is at the load, else None.

    Raises ValueError where no brake command has two of them in a direction.
    """
    command = np.array([level.brake for level in levels])
    omega = np.array([level.omega for level in levels])
    sign = np.sign(omega)
    if len(np.unique(np.column_stack([command, sign]), axis=0)) == len(levels):
        raise ValueError(
            "no brake command has two settled velocities in the same direction, which a slope takes"
        )
    commands, place = np.unique(command, return_inverse=True)
    m = len(commands)
    measured = np.array([level.brake_current for level in levels])
    currents = np.array([measured[place == i].mean() for i in range(m)])
    currents *= -1.0 if currents.sum() < 0.0 else 1.0  # the brake cares for its size alone
    kappa = sign[:, None] * (place[:, None] == np.arange(m))
    brake = np.column_stack([kappa, omega, currents[place] * omega])
    torque = np.array([level.torque.mean() for level in levels])
    current = np.array([level.current_motor.mean() for level in levels])
    errors = _pooled(levels, [level.torque_error for level in levels])
    current_errors = _pooled(levels, [level.current_error for level in levels])
    # What the zero of a sensor may still be off is told by the other direction alone.
    offset = np.full((len(levels), 1), float(np.ptp(sign) > 0.0))
    if motor is not None:
        matrix, errors = np.hstack([brake, offset]), motor.constant * current_errors
        sides = motor.constant * current - motor.damping * omega
    else:
        constant = _constant(torque, current)
        losses = np.column_stack([offset, -current, omega, sign])
        matrix = np.block([[brake, offset, np.zeros_like(losses)], [brake, 0.0 * offset, losses]])
        sides = np.concatenate([torque, 0.0 * torque])
        errors = np.concatenate([errors, constant * current_errors])
    solution, misfit = _solve(matrix, sides, errors)
    return Line(
        c0=solution[m],
        c1=solution[m + 1] if m > 1 else None,
        commands=commands,
        currents=currents,
        kappa=np.array([estimate.value for estimate in solution[:m]]),
        kappa_errors=np.array([estimate.error for estimate in solution[:m]]),
        misfit=misfit,
        constant=None if motor else _determined(solution[m + 4]),
        damping=None if motor else _determined(solution[m + 5]),
    )


def _pooled(levels: Sequence[Level], errors: Sequence[float]) -> FloatArray:
    """Standard errors of the plateaus' means from the noise that they have in common."""
    counts = np.array([level.samples for level in levels], dtype=np.float64)
    common = math.sqrt(float(np.mean(np.square(errors) * counts)))
    return common / np.sqrt(counts) + _LEAST_ERROR


def _constant(torque: FloatArray, current: FloatArray) -> float:
    """The motor's constant by the two signals; ValueError where the sensor reads none of it."""
    related = float(np.corrcoef(torque, current)[0, 1])
    if not related > 0.9:
        raise ValueError(
            f"the torque sensor does not follow the motor's current (correlation {related:.2f}): "
            "if it is at the load write 'torque_sensor: load'; if it is between motor and brake "
            "check the sign of sensors.torque in the rig's file"
        )
    return float(np.polyfit(current, torque, 1)[0])


def _determined(estimate: Estimate) -> Estimate | None:
    """The estimate where the rows determine it to a half, None elsewhere."""
    return estimate if estimate.high - estimate.value < 0.5 * estimate.value else None


def _solve(
    matrix: FloatArray, sides: FloatArray, errors: FloatArray
) -> tuple[list[Estimate], float]:
    """Least-norm solution of weighted least squares, and its misfit as of ``Line``."""
    weighted, target = matrix / errors[:, None], sides / errors
    inverse = np.linalg.pinv(weighted, rcond=1e-10)
    values = inverse @ target
    freedom = max(len(sides) - int(np.linalg.matrix_rank(weighted)), 1)
    misfit = float(np.linalg.norm(weighted @ values - target) / math.sqrt(freedom))
    spread = np.sqrt(np.sum(inverse**2, axis=1)) * max(misfit, 1.0)
    return estimates(values, spread, freedom), misfit
