"""Local refinement: Levenberg-Marquardt descents, several in one batch of simulations.

Each iteration of all descents under way takes two batches: perturbed chromosomes for the
sensitivities, then candidates of a few damping values. A descent's course depends on nothing
but itself. Sensitivities that do not keep what they promise are taken anew from larger
perturbations: equations that switch, such as dry friction, are steps and plateaus to small ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.fitting.constraints import Constraints
from sysid.fitting.objective import Objective, Responses
from sysid.fitting.quadratic import Quadratic, damped_steps, quadratic_at, slid_within

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
_BATCH_BYTES = 2**28  # residuals held at once, unless one descent needs more


@dataclass(frozen=True)
class Refinement:
    """Refined chromosome (n_free,), its error, each output's, and the iterations it took.

    rms: (n_outputs,), by a simulation with the steps that the chromosome needs; infinite where
    it needs more than it is allowed.
    """

    chromosome: FloatArray
    error: float
    rms: FloatArray
    iterations: int


@dataclass(frozen=True)
class Descent:
    """One descent between two iterations; ``advance`` returns the next.

    at: search coordinates (n_free,). error: the objective there, infinite before the first
    iteration; rms: (n_outputs,), the outputs' errors, by a simulation whose error estimate is
    ``excess`` times what the accuracy allows. gain: part of the error that the last iteration
    took away. steps: integration steps per sample of each record, chosen at ``steps_at``, None
    where they are to be chosen; braced: how often they have been raised since, for the sake of
    the sensitivities. sure, sure_error: where they were last chosen and a simulation succeeded,
    and the error there; further on they may not do, until the descent has finished.
    """

    at: FloatArray
    error: float = np.inf
    rms: FloatArray | None = None
    excess: float = np.inf
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

    @property
    def shown(self) -> FloatArray | None:
        """``rms`` where its simulation had the steps that it needs."""
        return self.rms if self.excess <= 1.0 else None


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
        if on_iteration is not None and descent.rms is not None and np.isfinite(descent.error):
            at = space.decode(descent.at)
            on_iteration(Refinement(at, descent.error, descent.rms, descent.iterations))
    return _refined(objective, [descent])[0]


def refine_each(
    objective: Objective,
    chromosomes: Sequence[FloatArray],
    *,
    max_iterations: int = 50,
    tolerance: float = 1e-7,
    enough: Callable[[FloatArray], bool] = lambda chromosome: False,
) -> list[Refinement]:
    """The same from each of several chromosomes (n_free,), side by side in the same batches.

    enough: of where a descent has come to, (n_free,), whether it need not go on.
    """
    descents = [begin(objective, chromosome) for chromosome in chromosomes]
    for _ in range(max_iterations):
        if all(descent.finished for descent in descents):
            break
        descents = advance(objective, descents, tolerance)
        for i, descent in enumerate(descents):
            if not descent.finished and enough(objective.space.decode(descent.at)):
                descents[i] = replace(descent, finished=True)
    return _refined(objective, descents)


def _refined(objective: Objective, descents: list[Descent]) -> list[Refinement]:
    """Where descents have come to, simulated once more where their steps may not have done."""
    if not descents:
        return []
    chromosomes = objective.space.decode(np.stack([descent.at for descent in descents]))
    unsure = [i for i, descent in enumerate(descents) if descent.shown is None]
    anew = iter(objective.rms(chromosomes[unsure])) if unsure else iter(())
    return [
        Refinement(
            chromosome,
            descent.error,
            next(anew) if descent.shown is None else descent.shown,
            descent.iterations,
        )
        for chromosome, descent in zip(chromosomes, descents, strict=True)
    ]


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
    (around,) = frame.responses(descents, [rows])
    error = float(objective.error_of(around.rms[:1])[0])
    return quadratic_at(objective, around, distance, _SMOOTHING[0] * error).hessian


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

    def responses(
        self, descents: list[Descent], rows: list[FloatArray], *, keep: bool = True
    ) -> list[Responses]:
        """Responses of each descent's rows of coordinates, all in one batch."""
        if not rows:
            return []
        order, chromosomes, steps = self._together(descents, rows)
        found = self.objective.residuals(chromosomes, steps, keep=keep)
        parts: dict[int, Responses] = {}
        first = 0
        for i in order:
            own = slice(first, first + len(rows[i]))
            parts[i] = Responses(found.values[..., own], found.rms[own], found.excess[own])
            first = own.stop
        return [parts[i] for i in range(len(rows))]

    def _together(
        self, descents: list[Descent], rows: list[FloatArray]
    ) -> tuple[list[int], FloatArray, IntArray]:
        """An order in which descents of like steps are neighbours, their chromosomes and steps."""
        order = sorted(range(len(rows)), key=lambda i: descents[i].steps)
        steps = np.repeat(
            np.array([descents[i].steps for i in order]), [len(rows[i]) for i in order], axis=0
        )
        together = np.concatenate([rows[i] for i in order])
        return order, self.objective.space.decode(together), steps

    def perturbed(self, descent: Descent) -> tuple[FloatArray, FloatArray]:
        """The descent's point and its neighbours, (1 + n_free, n_free), and their distances."""
        h = _PERTURBATIONS[descent.level]
        # Away from the nearer bound, so that the perturbed chromosome stays in range.
        distance = np.where(descent.at + h * self.width > self.upper, -h, h)
        return np.vstack([descent.at, descent.at + np.diag(distance * self.width)]), distance

    def infeasible(self, rows: FloatArray) -> BoolArray:
        """Which rows (..., n_free) violate a constraint or a physical limit, (...)."""
        space = self.objective.space
        violations = space.violations(space.decode(rows.reshape(-1, rows.shape[-1])))
        mask: BoolArray = np.any(violations > 0.0, axis=1).reshape(rows.shape[:-1])
        return mask


@dataclass(frozen=True)
class _Candidates:
    """Rows (n, n_free) that may follow, with their damping.

    promise: part of the error that a step without damping would take away, were all linear.
    """

    rows: FloatArray
    damping: FloatArray
    promise: float


@dataclass(frozen=True)
class _Sensed:
    """A descent and the quadratic around it; place: among those that are moved together."""

    place: int
    descent: Descent
    equations: Quadratic


def _iterate(frame: _Frame, descents: list[Descent], tolerance: float) -> list[Descent]:
    result: list[Descent | None] = [None] * len(descents)
    around = [frame.perturbed(descent) for descent in descents]
    responses = frame.responses(descents, [rows for rows, _ in around])
    sensed: list[_Sensed] = []
    for i, descent in enumerate(descents):
        moved = _sensed(frame, i, descent, responses[i], around[i][1])
        if isinstance(moved, Descent):
            result[i] = moved
        else:
            sensed.append(moved)
    tried: list[tuple[_Sensed, _Candidates]] = []
    for one, candidates in zip(sensed, _candidates(frame, sensed), strict=True):
        if len(candidates.rows) == 0 or candidates.promise <= tolerance:
            result[one.place] = _next_round(frame, one.descent)
        else:
            tried.append((one, candidates))
    ends = frame.responses(
        [one.descent for one, _ in tried], [found.rows for _, found in tried], keep=False
    )
    for (one, candidates), found in zip(tried, ends, strict=True):
        result[one.place] = _judged(frame, one.descent, candidates, found, tolerance)
    return [descent for descent in result if descent is not None]


def _sensed(
    frame: _Frame, place: int, descent: Descent, around: Responses, distance: FloatArray
) -> _Sensed | Descent:
    """What the neighbours of a descent tell; or the descent where they do not help it on."""
    errors = frame.objective.error_of(around.rms)
    error = float(errors[0])
    if not np.isfinite(error):
        # With more steps the simulation fails.
        return _back(descent)
    at = replace(
        descent,
        error=error,
        rms=around.rms[0],
        excess=float(around.excess[0]),
        gain=0.0,
        iterations=descent.iterations + 1,
    )
    if at.steps_at is not None and np.array_equal(at.at, at.steps_at):
        at = replace(at, sure=at.at, sure_error=error)
    if error <= ROUNDING:
        return replace(at, finished=True)
    burst = ~(errors[1:] <= _BURST + error)
    if burst.any() and at.braced < _BRACINGS:
        return _steadier(at)
    # Where more steps do not help it is the model that is unbounded there: not that way.
    if burst.any():
        around.values[..., 1:][..., burst] = around.values[..., :1]
    if not np.isfinite(at.error_of_round):
        at = replace(at, error_of_round=error)
    floor = _SMOOTHING[at.smoothing] * error
    equations = quadratic_at(frame.objective, around, distance, floor)
    return _Sensed(place, at, equations)


def _back(descent: Descent) -> Descent:
    """Back from where a simulation fails with the steps it needs, to try more damping."""
    if descent.sure is None:
        return replace(descent, error=np.inf, rms=None, excess=np.inf, finished=True)
    return replace(
        descent,
        at=descent.sure,
        error=descent.sure_error,
        rms=None,
        excess=np.inf,
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
    frame: _Frame, descent: Descent, candidates: _Candidates, found: Responses, tolerance: float
) -> Descent:
    """The descent after its candidates have been simulated."""
    assert descent.rms is not None
    objective, rms = frame.objective, np.stack([descent.rms, *found.rms])
    floor = _SMOOTHING[descent.smoothing] * descent.error
    before, *errors = objective.smoothed_error_of(rms, floor).tolist()
    best = int(np.argmin(errors))
    gain = (before - errors[best]) / before
    moved, damping = descent, descent.damping
    if gain > 0.0:
        at = candidates.rows[best]
        assert descent.steps_at is not None
        far = bool(np.any(np.abs(at - descent.steps_at) > _FAR * frame.width))
        moved = replace(
            descent,
            at=at,
            error=float(objective.error_of(found.rms[best : best + 1])[0]),
            rms=found.rms[best],
            excess=float(found.excess[best]),
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
        return _next_round(frame, moved)
    return moved


def _next_round(frame: _Frame, descent: Descent) -> Descent:
    """Finished; unless what was smoothed is not yet the error, or coarse sensitivities have
    gained, from where fine ones may go on."""
    assert descent.rms is not None
    rms = descent.rms[frame.objective.weights > 0.0]
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


def _candidates(frame: _Frame, sensed: list[_Sensed]) -> list[_Candidates]:
    """Damped Gauss-Newton steps of each that keep to the ranges and constraints."""
    n = len(frame.width)
    found = [_Candidates(np.empty((0, n)), np.empty(0), 0.0)] * len(sensed)
    # Sensitivities may be too large to square at the edge of instability: then stay.
    usable = [k for k, one in enumerate(sensed) if one.equations.leads_somewhere]
    if not usable:
        return found
    equations = [sensed[k].equations for k in usable]
    hessian = np.stack([one.hessian for one in equations])
    gradient = np.stack([one.gradient for one in equations])[:, :, None]
    at = np.stack([sensed[k].descent.at for k in usable])[:, None]
    low, high = (frame.lower - at) / frame.width, (frame.upper - at) / frame.width
    last = np.array([[sensed[k].descent.damping] for k in usable])
    damping = np.clip(last * np.append(_FACTORS, 0.0), _LEAST_DAMPING, _MOST_DAMPING)
    diagonal = np.diagonal(hessian, axis1=1, axis2=2)
    scale = np.maximum(diagonal, 1e-12 * diagonal.max(axis=1, keepdims=True))
    added = damping[:, :, None] * scale[:, None]
    moves = damped_steps(hessian, gradient, added, low, high)
    bad = frame.infeasible(at + moves * frame.width)
    if bad.any() and frame.objective.space.model.constraints:
        for k in np.flatnonzero(bad.any(axis=1)).tolist():
            limits = Constraints.at(frame.objective.space, at[k, 0], frame.width)
            for j in np.flatnonzero(bad[k]).tolist():
                curvature = hessian[k] + np.diag(added[k, j])
                moves[k, j] = slid_within(limits, moves[k, j], curvature, low[k, 0], high[k, 0])
    for _ in range(_RETREATS):
        if not bad.any():
            break
        bad[bad] = frame.infeasible((at + moves * frame.width)[bad])
        moves[bad] *= _RETREAT
    rows = np.clip(at + moves * frame.width, frame.lower, frame.upper)
    gained = -(moves @ gradient)[..., 0] - 0.5 * np.sum((moves @ hessian) * moves, axis=2)
    for place, k in enumerate(usable):
        promise = gained[place] / equations[place].value
        kept = np.flatnonzero(~bad[place, :-1] & (promise[:-1] > 0.0))
        found[k] = _Candidates(rows[place, kept], damping[place, kept], float(promise.max()))
    return found
