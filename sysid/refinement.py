"""Local refinement of a chromosome: Levenberg-Marquardt with batched simulations.

Sensitivities come from one batch of perturbed simulations; the candidates of sixteen damping
values from another, so that the lanes of the batch simulator are never idle. Sensitivities that
do not keep what they promise are taken anew from larger perturbations: equations that switch,
such as dry friction, are steps and plateaus to small ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sysid._lanes import LANES
from sysid.constrained import Constraints, shortened
from sysid.model import BoolArray, FloatArray
from sysid.objective import Objective

_DAMPING = 10.0 ** np.linspace(2.0, -8.0, LANES)
# Parts of the ranges by which coordinates are moved to see what that does. The first is for what
# is smooth. Where something switches (dry friction, an overflow) the instant of switching moves in
# steps of the integration, and only a larger move shows what it depends on.
_PERTURBATIONS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
# Sensitivities promise a gain. They are too fine, or too coarse, where less than this share of it
# comes; a promise of less than _NOTHING of the error says that there is nothing to be gained.
_KEPT = 0.02
_NOTHING = 1e-3
_COARSEST = len(_PERTURBATIONS) - 1


@dataclass(frozen=True)
class Refinement:
    """Refined chromosome (n_free,), its error, and the iterations it took."""

    chromosome: FloatArray
    error: float
    iterations: int


def refine(
    objective: Objective,
    chromosome: FloatArray,
    *,
    max_iterations: int = 50,
    tolerance: float = 1e-7,
    on_iteration: Callable[[Refinement], None] | None = None,
) -> Refinement:
    """Minimise the objective from ``chromosome`` within the ranges and constraints.

    Ends when an iteration improves the error by less than ``tolerance`` of it and larger
    perturbations promise no more. The outputs are
    re-weighted by the inverse root of their current error, whose fixed point is the minimum of
    the mean RMSE rather than of the plain sum of squares.
    """
    space = objective.space
    lower, upper = space.coded_bounds()
    width = space.encode(space.upper) - space.encode(space.lower)
    at = np.clip(space.encode(chromosome), lower, upper)
    steps = _steps(objective, at)
    residual = objective.residuals(space.decode(at)[None], steps)[0]
    error = float(objective.error_of(residual[None])[0])
    level, error_of_round = 0, error
    for iteration in range(1, max_iterations + 1):
        if not np.isfinite(error) or error == 0.0:
            return Refinement(space.decode(at), error, iteration - 1)
        jacobian = _sensitivities(
            objective, at, residual, steps, width, upper, _PERTURBATIONS[level]
        )
        candidates, promise = _candidates(at, jacobian, residual, objective, width, lower, upper)
        candidates = candidates[_feasible(objective, candidates)]
        if len(candidates) == 0:
            return Refinement(space.decode(at), error, iteration)
        tried = objective.residuals(space.decode(candidates), steps)
        errors = objective.error_of(tried)
        best = int(np.argmin(errors))
        gain = error - float(errors[best])
        if gain > 0.0:
            at, residual, error = candidates[best], tried[best], float(errors[best])
        if on_iteration is not None:
            on_iteration(Refinement(space.decode(at), error, iteration))
        if promise > _NOTHING and gain < _KEPT * promise * error and level < _COARSEST:
            level += 1
        elif gain <= tolerance * error:
            if error > (1.0 - _NOTHING) * error_of_round:
                return Refinement(space.decode(at), error, iteration)
            # What coarse sensitivities have gained, fine ones may go on from.
            level, error_of_round = 0, error
        needed = _steps(objective, at)
        if needed != steps:
            # Differences between step counts would drown the small ones of the sensitivities.
            steps = needed
            residual = objective.residuals(space.decode(at)[None], steps)[0]
            error = float(objective.error_of(residual[None])[0])
    return Refinement(space.decode(at), error, max_iterations)


def _steps(objective: Objective, at: FloatArray) -> list[int]:
    vector = objective.space.full(objective.space.decode(at)[None])
    return [objective.simulator.steps_needed(vector, record) for record in objective.records]


def _sensitivities(
    objective: Objective,
    at: FloatArray,
    residual: FloatArray,
    steps: list[int],
    width: FloatArray,
    upper: FloatArray,
    perturbation: float,
) -> FloatArray:
    """d residual / d search coordinate in units of the range, (n_residuals, n_outputs, n_free)."""
    # Away from the nearer bound, so that the perturbed chromosome stays in range.
    sign = np.where(at + perturbation * width > upper, -1.0, 1.0)
    moved = at + np.diag(sign * perturbation * width)
    shifted = objective.residuals(objective.space.decode(moved), steps)
    slopes = (shifted - residual) / (sign * perturbation)[:, None, None]
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)
    return np.moveaxis(slopes, 0, 2)


def _candidates(
    at: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    objective: Objective,
    width: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
) -> tuple[FloatArray, float]:
    """Damped Gauss-Newton steps within ranges and constraints, a row for each damping.

    And the part of the error that the longest of them would take away, were all linear.
    """
    weight = np.sqrt(objective.least_squares_weights(residual))
    rows = (jacobian * weight[None, :, None]).reshape(-1, len(at))
    right = (residual * weight).reshape(-1)
    # A direction held by a bound and pushed against it would only shorten the step.
    gradient = rows.T @ right
    held = ((at <= lower) & (gradient > 0.0)) | ((at >= upper) & (gradient < 0.0))
    free = np.flatnonzero(~held)
    moves = np.zeros((LANES, len(at)))
    promise = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        normal = rows[:, free].T @ rows[:, free]
    # Sensitivities may be too large to square at the edge of instability: then stay.
    if len(free) and np.all(np.isfinite(normal)):
        values, vectors = np.linalg.eigh(normal)
        values = np.maximum(values, 0.0)
        projected = vectors.T @ gradient[free]
        damping = _DAMPING * max(values.max(), 1e-300)
        steps = -(projected / (values + damping[:, None])) @ vectors.T
        limits = Constraints.at(objective.space, at, width).among(free)
        for step, extra in zip(steps, damping, strict=True):
            step[:] = limits.nearest(step, (vectors / (values + extra)) @ vectors.T)
        moves[:, free] = steps
        longest = steps[-1]
        less = -2.0 * gradient[free] @ longest - longest @ normal @ longest
        promise = float(less / (2.0 * right @ right))
    reached = np.clip(at + moves * width, lower, upper)
    return shortened(objective.space, at, reached), promise


def _feasible(objective: Objective, candidates: FloatArray) -> BoolArray:
    violations = objective.space.violations(objective.space.decode(candidates))
    kept: BoolArray = np.all(violations <= 0.0, axis=1)
    return kept
