"""Local refinement: Levenberg-Marquardt descents, several in one batch of simulations.

Each iteration of all descents under way takes two batches: perturbed chromosomes for the
sensitivities, then candidates of a few damping values. A descent's course depends on nothing
but itself. Sensitivities that do not keep what they promise are taken anew from larger
perturbations: equations that switch, such as dry friction, are steps and plateaus to small ones.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.constrained import Constraints
from sysid.model import BoolArray, FloatArray
from sysid.objective import Objective

# Candidates of an iteration: damping values around the last one that served.
_FACTORS = 5.0 ** np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
CANDIDATES = len(_FACTORS)
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-14, 1e6
# Parts of the ranges by which coordinates are moved to see what that does. The first is for what
# is smooth. Where something switches (dry friction, an overflow) the instant of switching moves in
# steps of the integration, and only a larger move shows what it depends on.
_PERTURBATIONS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
_COARSEST = len(_PERTURBATIONS) - 1
# Sensitivities promise a gain. They are too fine, or too coarse, where less than this share of it
# comes; a promise of less than _NOTHING of the error says that there is nothing to be gained.
_KEPT = 0.02
_NOTHING = 1e-3
_PATIENCE = 3  # iterations that do not keep their promise, the later ones with more damping
# An output that is explained better than this share of the error counts by its square, which is
# smooth: the error itself has a crease where an output is explained exactly, and descents would
# stop on it. One that has arrived goes on with the next smaller share.
_SMOOTHING = (1e-1, 1e-2, 1e-3)
ROUNDING = 1e-12  # errors below it are those of the arithmetic
# After moves of more than this part of a range the integration steps are chosen anew.
_FAR = 0.05
_NEAR = 1e-3  # for the last time
# A neighbour whose outputs err by so many times their size more than the descent's has left a
# simulation at the edge of stability: so many times the steps are taken.
_BURST, _STEADIER, _BRACINGS = 10.0, 1.5, 3
_RETREAT, _RETREATS = 0.4, 6
_HOLDING_ROUNDS = 4
_BATCH_BYTES = 2**28  # residuals held at once, unless one descent needs more


@dataclass(frozen=True)
class Refinement:
    """Refined chromosome (n_free,), its error, and the iterations it took."""

    chromosome: FloatArray
    error: float
    iterations: int


@dataclass(frozen=True)
class Descent:
    """One descent between two iterations; ``advance`` returns the next.

    at: search coordinates (n_free,). error: the objective there, infinite before the first
    iteration. gain: part of the error that the last iteration took away. steps: integration
    steps per sample of each record, chosen at ``steps_at``, None where they are to be chosen;
    braced: how often they have been raised since, for the sake of the sensitivities.
    sure, sure_error: where they were last chosen and a simulation succeeded, and the error
    there; further on they may not do, until the descent has finished.
    """

    at: FloatArray
    error: float = np.inf
    gain: float = 0.0
    steps: tuple[int, ...] = ()
    steps_at: FloatArray | None = None
    damping: float = _FIRST_DAMPING
    level: int = 0
    braced: int = 0
    error_of_round: float = np.inf
    smoothing: int = 0
    failures: int = 0
    iterations: int = 0
    finished: bool = False
    sure: FloatArray | None = None
    sure_error: float = np.inf


def refine(
    objective: Objective,
    chromosome: FloatArray,
    *,
    max_iterations: int = 50,
    tolerance: float = 1e-7,
    on_iteration: Callable[[Refinement], None] | None = None,
) -> Refinement:
    """Minimise the objective from ``chromosome`` within the ranges and constraints.

    Ends when an iteration improves the error by less than ``tolerance`` of it, or could not,
    and larger perturbations promise no more. The outputs are re-weighted by the inverse root of
    their current error, whose fixed point is the minimum of the mean RMSE rather than of the
    plain sum of squares.
    """
    space = objective.space
    descent = begin(objective, chromosome)
    while not descent.finished and descent.iterations < max_iterations:
        (descent,) = advance(objective, [descent], tolerance)
        if on_iteration is not None and np.isfinite(descent.error):
            on_iteration(Refinement(space.decode(descent.at), descent.error, descent.iterations))
    return Refinement(space.decode(descent.at), descent.error, descent.iterations)


def refine_each(
    objective: Objective,
    chromosomes: Sequence[FloatArray],
    *,
    max_iterations: int = 50,
    tolerance: float = 1e-7,
) -> list[Refinement]:
    """The same from each of several chromosomes (n_free,), side by side in the same batches."""
    descents = [begin(objective, chromosome) for chromosome in chromosomes]
    for _ in range(max_iterations):
        if all(descent.finished for descent in descents):
            break
        descents = advance(objective, descents, tolerance)
    decode = objective.space.decode
    return [Refinement(decode(d.at), d.error, d.iterations) for d in descents]


def begin(objective: Objective, chromosome: FloatArray) -> Descent:
    """A descent from a chromosome (n_free,), moved to the nearest point within the ranges."""
    return Descent(np.clip(objective.space.encode(chromosome), *objective.space.coded_bounds))


def simulations_per_iteration(objective: Objective) -> int:
    """Most simulations that an iteration of one descent takes."""
    return 3 + len(objective.space.parameters) + CANDIDATES


def curvature(objective: Objective, at: FloatArray) -> FloatArray:
    """Gauss-Newton Hessian of the error at search coordinates (n_free,), (n_free, n_free).

    Coordinates in units of the ranges.
    """
    frame = _Frame(objective)
    descents = frame.with_steps([Descent(at)])
    rows, distance = frame.perturbed(descents[0])
    (residuals,) = frame.residuals(descents, [rows])
    error = float(objective.error_of(residuals[:1])[0])
    return _normal_equations(objective, residuals, distance, _SMOOTHING[0] * error)[0]


def advance(
    objective: Objective, descents: Sequence[Descent], tolerance: float = 1e-7
) -> list[Descent]:
    """One iteration of each descent that has not finished."""
    frame = _Frame(objective)
    result = list(descents)
    live = [i for i, descent in enumerate(descents) if not descent.finished]
    started = dict(zip(live, frame.with_steps([result[i] for i in live]), strict=True))
    per_batch = max(1, _BATCH_BYTES // (8 * objective.n_residuals * (len(frame.width) + 1)))
    for first in range(0, len(live), per_batch):
        now = live[first : first + per_batch]
        moved = _iterate(frame, [started[i] for i in now], tolerance)
        for i, descent in zip(now, moved, strict=True):
            result[i] = descent
    return result


class _Frame:
    """The objective in search coordinates, for batches of descents at steps of their own."""

    def __init__(self, objective: Objective) -> None:
        space = objective.space
        self.objective = objective
        self.lower, self.upper = space.coded_bounds
        self.width = space.width

    def with_steps(self, descents: list[Descent]) -> list[Descent]:
        """The descents with integration steps chosen where they lack them."""
        lacking = [i for i, descent in enumerate(descents) if descent.steps_at is None]
        if lacking:
            rows = np.stack([descents[i].at for i in lacking])
            chosen = self.objective.steps_needed(self.objective.space.decode(rows))
            for i, steps in zip(lacking, chosen, strict=True):
                own = tuple(int(n) for n in steps)
                descents[i] = replace(descents[i], steps=own, steps_at=descents[i].at, braced=0)
        return descents

    def finer_steps(self, descent: Descent) -> tuple[int, ...]:
        """The descent's steps, or more of them where it has come to need more."""
        at = descent.steps_at
        if at is not None and np.all(np.abs(descent.at - at) <= _NEAR * self.width):
            return descent.steps
        needed = self.objective.steps_needed(self.objective.space.decode(descent.at[None]))[0]
        return tuple(max(int(n), have) for n, have in zip(needed, descent.steps, strict=True))

    def residuals(self, descents: list[Descent], rows: list[FloatArray]) -> list[FloatArray]:
        """Residuals of each descent's rows of coordinates, those of like steps in one batch."""
        groups: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for i, descent in enumerate(descents):
            groups[descent.steps].append(i)
        found: dict[int, FloatArray] = {}
        for steps, members in groups.items():
            together = np.concatenate([rows[i] for i in members])
            batch = self.objective.residuals(self.objective.space.decode(together), steps)
            ends = np.cumsum([len(rows[i]) for i in members])[:-1]
            found |= dict(zip(members, np.split(batch, ends), strict=True))
        return [found[i] for i in range(len(descents))]

    def perturbed(self, descent: Descent) -> tuple[FloatArray, FloatArray]:
        """The descent's point and its neighbours, (1 + n_free, n_free), and their distances."""
        h = _PERTURBATIONS[descent.level]
        # Away from the nearer bound, so that the perturbed chromosome stays in range.
        distance = np.where(descent.at + h * self.width > self.upper, -h, h)
        return np.vstack([descent.at, descent.at + np.diag(distance * self.width)]), distance

    def infeasible(self, rows: FloatArray) -> BoolArray:
        """Which rows violate a constraint or a physical limit."""
        space = self.objective.space
        mask: BoolArray = np.any(space.violations(space.decode(rows)) > 0.0, axis=1)
        return mask


@dataclass(frozen=True)
class _Candidates:
    """Rows (n, n_free) that may follow, with their damping.

    promise: part of the error that a step without damping would take away, were all linear.
    """

    rows: FloatArray
    damping: FloatArray
    promise: float


def _iterate(frame: _Frame, descents: list[Descent], tolerance: float) -> list[Descent]:
    around = [frame.perturbed(descent) for descent in descents]
    sensed = frame.residuals(descents, [rows for rows, _ in around])
    result: list[Descent | None] = [None] * len(descents)
    open_: list[tuple[int, FloatArray, _Candidates]] = []
    for i, (descent, residuals, (_, distance)) in enumerate(
        zip(descents, sensed, around, strict=True)
    ):
        error = float(frame.objective.error_of(residuals[:1])[0])
        if not np.isfinite(error):
            # With more steps the simulation fails.
            result[i] = _back(descent)
            continue
        at = replace(descent, error=error, gain=0.0, iterations=descent.iterations + 1)
        if at.steps_at is not None and np.array_equal(at.at, at.steps_at):
            at = replace(at, sure=at.at, sure_error=error)
        if error <= ROUNDING:
            result[i] = replace(at, finished=True)
            continue
        burst = ~(frame.objective.error_of(residuals[1:]) <= _BURST + error)
        if burst.any() and at.braced < _BRACINGS:
            result[i] = _steadier(at)
            continue
        # Where more steps do not help it is the model that is unbounded there: not that way.
        residuals[1:][burst] = residuals[0]
        if not np.isfinite(at.error_of_round):
            at = replace(at, error_of_round=error)
        candidates = _candidates(frame, at, residuals, distance)
        descents[i] = at
        if len(candidates.rows) == 0 or candidates.promise <= tolerance:
            result[i] = _next_round(frame, at, residuals[0])
        else:
            open_.append((i, residuals[0], candidates))
    tried = frame.residuals([descents[i] for i, _, _ in open_], [c.rows for _, _, c in open_])
    for (i, residual, candidates), residuals in zip(open_, tried, strict=True):
        result[i] = _judged(frame, descents[i], residual, candidates, residuals, tolerance)
    return [descent for descent in result if descent is not None]


def _back(descent: Descent) -> Descent:
    """Back from where a simulation fails with the steps it needs, to try more damping."""
    if descent.sure is None:
        return replace(descent, error=np.inf, finished=True)
    return replace(
        descent,
        at=descent.sure,
        error=descent.sure_error,
        gain=0.0,
        steps_at=None,
        damping=_limited(descent.damping * _FACTORS[-1] / _FACTORS[0]),
        failures=descent.failures + 1,
        iterations=descent.iterations + 1,
        finished=descent.failures + 1 >= _PATIENCE,
    )


def _steadier(descent: Descent) -> Descent:
    """With more integration steps: those it has serve its simulation, not its neighbours'."""
    more = tuple(math.ceil(_STEADIER * steps) for steps in descent.steps)
    return replace(descent, steps=more, braced=descent.braced + 1)


def _judged(
    frame: _Frame,
    descent: Descent,
    residual: FloatArray,
    candidates: _Candidates,
    tried: FloatArray,
    tolerance: float,
) -> Descent:
    """The descent after its candidates have been simulated."""
    objective = frame.objective
    floor = _SMOOTHING[descent.smoothing] * descent.error
    errors = objective.smoothed_error_of(tried, floor)
    best = int(np.argmin(errors))
    before = float(objective.smoothed_error_of(residual[None], floor)[0])
    gain = (before - float(errors[best])) / before
    moved, damping = descent, descent.damping
    if gain > 0.0:
        at = candidates.rows[best]
        assert descent.steps_at is not None
        far = bool(np.any(np.abs(at - descent.steps_at) > _FAR * frame.width))
        moved = replace(
            descent,
            at=at,
            error=float(objective.error_of(tried[best : best + 1])[0]),
            gain=gain,
            steps_at=None if far else descent.steps_at,
        )
        damping = candidates.damping[best] / np.sqrt(_FACTORS[-1])
    promising = candidates.promise > _NOTHING
    poor = gain <= 0.0 or (promising and gain < _KEPT * candidates.promise)
    if gain <= 0.0:
        damping = descent.damping * _FACTORS[-1] / _FACTORS[0]
    failures = descent.failures + 1 if poor else 0
    moved = replace(moved, damping=_limited(damping), failures=failures)
    if failures >= _PATIENCE and promising and descent.level < _COARSEST:
        # More damping did not help: it is the sensitivities that are wrong.
        return replace(moved, level=descent.level + 1, failures=0, damping=_FIRST_DAMPING)
    if failures >= _PATIENCE or 0.0 < gain <= tolerance:
        return _next_round(frame, moved, tried[best] if gain > 0.0 else residual)
    return moved


def _next_round(frame: _Frame, descent: Descent, residual: FloatArray) -> Descent:
    """Finished; unless what was smoothed is not yet the error, or coarse sensitivities have
    gained, from where fine ones may go on."""
    rms = frame.objective.rms_of(residual[None])[0][frame.objective.weights > 0.0]
    smoothing = descent.smoothing
    if np.any(rms < _SMOOTHING[smoothing] * descent.error) and smoothing + 1 < len(_SMOOTHING):
        return replace(descent, smoothing=smoothing + 1, failures=0)
    finer = frame.finer_steps(descent)
    if finer != descent.steps:
        return replace(descent, steps=finer, steps_at=descent.at, failures=0)
    descent = replace(descent, steps_at=descent.at)
    if descent.level == 0 or descent.error > (1.0 - _NOTHING) * descent.error_of_round:
        return replace(descent, finished=True)
    return replace(descent, level=0, failures=0, error_of_round=descent.error)


def _limited(damping: float) -> float:
    return float(min(max(damping, _LEAST_DAMPING), _MOST_DAMPING))


def _candidates(
    frame: _Frame, descent: Descent, residuals: FloatArray, distance: FloatArray
) -> _Candidates:
    """Damped Gauss-Newton steps that keep to the ranges and constraints."""
    hessian, gradient, size = _normal_equations(
        frame.objective, residuals, distance, _SMOOTHING[descent.smoothing] * descent.error
    )
    n = len(gradient)
    nowhere = _Candidates(np.empty((0, n)), np.empty(0), 0.0)
    # Sensitivities may be too large to square at the edge of instability: then stay.
    if not (np.all(np.isfinite(hessian)) and np.all(np.isfinite(gradient))):
        return nowhere
    diagonal = np.diag(hessian)
    scale = np.maximum(diagonal, 1e-12 * diagonal.max())
    if scale.max() <= 0.0:
        return nowhere
    low = (frame.lower - descent.at) / frame.width
    high = (frame.upper - descent.at) / frame.width
    damping = np.clip(descent.damping * _FACTORS, _LEAST_DAMPING, _MOST_DAMPING)
    damping = np.append(damping, _LEAST_DAMPING)
    moves = _steps(hessian, gradient, damping[:, None] * scale, low, high)
    bad = frame.infeasible(descent.at + moves * frame.width)
    if bad.any() and frame.objective.space.model.constraints:
        limits = Constraints.at(frame.objective.space, descent.at, frame.width)
        for i in np.flatnonzero(bad):
            moves[i] = _within(limits, moves[i], hessian + np.diag(damping[i] * scale), low, high)
    for _ in range(_RETREATS):
        if not bad.any():
            break
        bad[bad] = frame.infeasible(descent.at + moves[bad] * frame.width)
        moves[bad] *= _RETREAT
    promise = -(moves @ gradient + 0.5 * np.sum((moves @ hessian) * moves, axis=1)) / size
    kept = np.flatnonzero(~bad[:-1] & (promise[:-1] > 0.0))
    rows = np.clip(descent.at + moves[kept] * frame.width, frame.lower, frame.upper)
    return _Candidates(rows, damping[kept], float(promise.max()))


def _normal_equations(
    objective: Objective, residuals: FloatArray, distance: FloatArray, floor: float
) -> tuple[FloatArray, FloatArray, float]:
    """Hessian, gradient and value of the quadratic that bounds the smoothed error from above.

    Coordinates in units of the ranges. residuals: of the point and its neighbours.
    """
    rms = objective.rms_of(residuals[:1])[0]
    large = np.maximum(rms, floor)
    share = np.sqrt(objective.weights / (large * np.maximum(objective.counts, 1)))
    with np.errstate(over="ignore", invalid="ignore"):
        slopes = residuals[1:] - residuals[0]
        slopes *= share / distance[:, None, None]
        rows = slopes.reshape(len(distance), -1)
        hessian, gradient = rows @ rows.T, rows @ (residuals[0] * share).ravel()
        if not np.all(np.isfinite(gradient)):
            rows = np.where(np.isfinite(rows), rows, 0.0)
            hessian, gradient = rows @ rows.T, rows @ (residuals[0] * share).ravel()
    value = float(np.where(rms > floor, rms, 0.5 * (rms**2 / floor + floor)) @ objective.weights)
    return hessian, gradient, value


def _steps(
    hessian: FloatArray, gradient: FloatArray, damping: FloatArray, low: FloatArray,
    high: FloatArray,
) -> FloatArray:  # fmt: skip
    """Minima of damped quadratics between bounds on the step, by holding what hits them.

    damping: (n, n_free), one row for each step.
    """
    # A direction held by a bound and pushed against it would only shorten the step.
    pushed = ((low >= 0.0) & (gradient > 0.0)) | ((high <= 0.0) & (gradient < 0.0))
    held = np.repeat(pushed[None], len(damping), axis=0)
    moves = np.zeros(damping.shape)
    n = len(gradient)
    for _ in range(_HOLDING_ROUNDS):
        # A held coordinate's row says that it moves as far as it does.
        systems = np.where(held[:, :, None], 0.0, hessian)
        systems[:, np.arange(n), np.arange(n)] += np.where(held, 1.0, damping)
        right = np.where(held, moves, -gradient)
        try:
            moves = np.linalg.solve(systems, right[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            return np.zeros(damping.shape)
        out = ~held & ((moves < low) | (moves > high))
        moves = np.clip(moves, low, high)
        if not out.any():
            break
        held |= out
    return np.where(np.isfinite(moves), moves, 0.0)


def _within(
    limits: Constraints, move: FloatArray, curvature: FloatArray, low: FloatArray,
    high: FloatArray,
) -> FloatArray:  # fmt: skip
    """A move that slides along the constraints it would cross, bounds kept."""
    free = np.flatnonzero((move > low) & (move < high))
    held = np.setdiff1d(np.arange(len(move)), free)
    rest = Constraints(limits.value + limits.slope[:, held] @ move[held], limits.slope)
    inverse: FloatArray = np.linalg.inv(curvature[np.ix_(free, free)]).astype(np.float64)
    slid = move.copy()
    slid[free] = rest.among(free).nearest(move[free], inverse)
    return np.clip(slid, low, high)
