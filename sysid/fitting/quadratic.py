"""The quadratic around a point of a descent, and the damped steps that lead down it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.fitting.constraints import Constraints
from sysid.fitting.objective import Objective, Responses

_HOLDING_ROUNDS = 4  # in which what a bound stops is held there and the rest goes on


@dataclass(frozen=True)
class Quadratic:
    """The quadratic around a point: Hessian (n_free, n_free), gradient (n_free,), value.

    Coordinates in units of the ranges.
    """

    hessian: FloatArray
    gradient: FloatArray
    value: float

    @property
    def leads_somewhere(self) -> bool:
        """Whether it is one, and not flat."""
        finite = np.isfinite(self.hessian).all() and np.isfinite(self.gradient).all()
        return bool(finite and np.diag(self.hessian).max() > 0.0)


def quadratic_at(
    objective: Objective, around: Responses, distance: FloatArray, floor: float
) -> Quadratic:
    """The quadratic that bounds the smoothed error from above.

    around: responses of the point and its neighbours, at distances (n_free,) from it.
    """
    rms, weights = around.rms[0], objective.weights
    share = weights / (np.maximum(rms, floor) * np.maximum(objective.counts, 1))
    counted = np.flatnonzero(weights > 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        changes = around.values[..., 1:] - around.values[..., :1]
        hessian, gradient = _summed(changes, around.values[..., 0], share, counted)
        if not np.all(np.isfinite(gradient)):
            changes = np.where(np.isfinite(changes), changes, 0.0)
            hessian, gradient = _summed(changes, around.values[..., 0], share, counted)
        hessian, gradient = hessian / np.outer(distance, distance), gradient / distance
    value = float(np.where(rms > floor, rms, 0.5 * (rms**2 / floor + floor)) @ weights)
    return Quadratic(hessian, gradient, value)


def _summed(
    changes: FloatArray, residual: FloatArray, share: FloatArray, counted: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Hessian and gradient of the outputs that count, each by its share."""
    n = changes.shape[2]
    hessian, gradient = np.zeros((n, n)), np.zeros(n)
    for j in counted:
        rows = changes[:, j]
        hessian += share[j] * (rows.T @ rows)
        gradient += share[j] * (residual[:, j] @ rows)
    return hessian, gradient


def damped_steps(
    hessian: FloatArray, gradient: FloatArray, damping: FloatArray, low: FloatArray,
    high: FloatArray,
) -> FloatArray:  # fmt: skip
    """Minima of damped quadratics between bounds on the step, by holding what hits them.

    hessian: (m, n_free, n_free), gradient: (m, n_free, 1); damping: (m, n, n_free), so many steps
    of each; low, high: (m, 1, n_free).
    """
    down = -gradient[:, None, :, 0]
    # A direction held by a bound and pushed against it would only shorten the step.
    pushed = ((low >= 0.0) & (down < 0.0)) | ((high <= 0.0) & (down > 0.0))
    held = np.repeat(pushed, damping.shape[1], axis=1)
    moves = np.zeros(damping.shape)
    diagonal = np.arange(damping.shape[2])
    live = np.arange(len(hessian))
    for _ in range(_HOLDING_ROUNDS):
        if len(live) == 0:
            break
        stay = held[live]
        # A held coordinate's row says that it moves as far as it does.
        systems = np.where(stay[..., None], 0.0, hessian[live, None])
        systems[..., diagonal, diagonal] += np.where(stay, 1.0, damping[live])
        found = _solved(systems, np.where(stay, moves[live], down[live]))
        out = ~stay & ((found < low[live]) | (found > high[live]))
        moves[live] = np.clip(found, low[live], high[live])
        held[live] |= out
        live = live[out.any(axis=(1, 2))]
    return np.where(np.isfinite(moves), moves, 0.0)


def _solved(systems: FloatArray, right: FloatArray) -> FloatArray:
    """Solutions (m, n, n_free) of linear systems, NaN for all of one of the m with a singular."""
    try:
        found: FloatArray = np.linalg.solve(systems, right[..., None])[..., 0].astype(np.float64)
        return found
    except np.linalg.LinAlgError:
        if len(systems) == 1:
            return np.full(right.shape, np.nan)
    pairs = zip(systems[:, None], right[:, None], strict=True)
    return np.concatenate([_solved(system, side) for system, side in pairs])


def slid_within(
    limits: Constraints, move: FloatArray, curvature: FloatArray, low: FloatArray,
    high: FloatArray,
) -> FloatArray:  # fmt: skip
    """A move that slides along the constraints it would cross, bounds kept."""
    between = (move > low) & (move < high)
    free, held = np.flatnonzero(between), ~between
    rest = Constraints(limits.value + limits.slope[:, held] @ move[held], limits.slope)
    inverse: FloatArray = np.linalg.inv(curvature[np.ix_(free, free)]).astype(np.float64)
    slid = move.copy()
    slid[free] = rest.among(free).nearest(move[free], inverse)
    return np.clip(slid, low, high)
