"""Local refinement: Levenberg-Marquardt descents, several in one batch of simulations.

An iteration of a descent at x, in search coordinates, takes two or three batches of simulations:

    1. x and its neighbours x + h_k e_k give the quadratic around x (see ``quadratic``): its
       Hessian H, slope g, and the share of the error that it promises to take away.
    2. Candidates x + d(lambda), (H + lambda D) d = -g, of five values of lambda around the last
       one, some with the same damping of all, and a part of the undamped step. The best is the
       next x if it gains anything; lambda falls to a fifth of its own then, and rises 625-fold if
       none gains.
    3. Where none gains half of what the quadratic promises, the same bent with the valley.

Integration steps are chosen for x, are the same for all that is simulated around it, so that
differences are those of the parameters alone, and are chosen anew when x has moved far. Where an
objective has coarser ones for descents, residuals are corrected by what they err at x then.

A descent has arrived when the quadratic promises no more than a tolerance, or no more is gained;
what it does then, and where it stalls otherwise, are the ``STRATEGIES`` of ``descent``.

The method is Levenberg's ("A method for the solution of certain non-linear problems in least
squares", Quarterly of Applied Mathematics 2, 1944) as scaled by Marquardt (1963). A descent's
course depends on nothing but itself, whatever others share its batches.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.fitting.descent import (
    FREE,
    NOTHING,
    PATIENCE,
    PERTURBATIONS,
    TOLERANCE,
    Descent,
    Point,
    Restriction,
    Shift,
    resumed,
)
from sysid.fitting.neighbours import Neighbours
from sysid.fitting.objective import FLOORS, Linearisation, Objective, Responses
from sysid.fitting.quadratic import (
    CANDIDATES,
    Candidates,
    Quadratic,
    bent,
    candidates,
    heavier,
    restored,
)
from sysid.fitting.slopes import Slopes, joined
from sysid.problem.space import SearchSpace

MOST_ITERATIONS = 50
ROUNDING = 1e-12  # errors below it are those of the arithmetic
_KEPT = 0.02  # share of the promise below which a gain counts as a failure
_CRAWL = 0.2  # and below which it gets nowhere soon
_LAST, _QUICKER = (
    3,
    5.0,
)  # iterations that tell a descent's pace, and times it that it may yet come to
_LITTLE = 0.5  # share of the promise below which the valley bends
_FAR = 0.05  # parts of the ranges; after longer moves the integration steps are chosen anew
_BURST = 10.0  # a neighbour's error that is so much larger has left the edge of stability
_OF_TETHER = 1e-6  # parts of the ranges, of differences that a tether's slopes are by
_LONG = 200_000  # slopes, from where on threads take less time than they lose to each other
_BATCH_BYTES = 2**28  # residuals held at once, unless one descent needs more

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Refinement:
    """Refined chromosome (n_free,), its error, and iterations taken.

    rms: (n_outputs,), the outputs' errors, infinite where it needs more steps than are allowed.
    steps: integration steps per sample, for each record, that the error is by.
    """

    chromosome: FloatArray
    error: float
    rms: FloatArray
    iterations: int
    steps: tuple[int, ...]


def refine(
    objective: Objective,
    chromosome: FloatArray,
    *,
    max_iterations: int = MOST_ITERATIONS,
    tolerance: float = TOLERANCE,
    restriction: Restriction = FREE,
    on_iteration: Callable[[Point], None] | None = None,
) -> Refinement:
    """Minimise the objective from ``chromosome`` (n_free,) within the ranges and constraints.

    tolerance: as of ``Descent``.
    """

    def watch(point: Point) -> bool:
        if on_iteration is not None and point.rms is not None and np.isfinite(point.error):
            on_iteration(point)
        return False

    descent = begin(objective, chromosome, tolerance=tolerance, restriction=restriction)
    return refine_each(objective, [descent], max_iterations, watch)[0]


def refine_each(
    objective: Objective,
    descents: Sequence[Descent],
    max_iterations: int = MOST_ITERATIONS,
    enough: Callable[[Point], bool] = lambda point: False,
    goal: float = math.inf,
) -> list[Refinement]:
    """The same by several descents that begin, side by side in the same batches.

    enough: whether a descent that has come to a point need not go on. goal: an error below which
    ends are of interest: no descent goes on that will not come to it at several times its pace.
    """
    descents, errors = list(descents), [list[float]() for _ in descents]
    for iteration in range(1, max_iterations + 1):
        live = [i for i, descent in enumerate(descents) if not descent.finished]
        if not live:
            break
        descents = advance(objective, descents)
        for i in live:
            errors[i].append(descents[i].point.error)
            slow = _is_too_slow(errors[i], max_iterations - iteration, goal)
            if slow or descents[i].is_given_up or enough(descents[i].point):
                descents[i] = replace(descents[i], finished=True)
    points = [descent.point for descent in descents]
    ends = [objective.space.decode(point.at) for point in points]
    # Simulated once more where their integration steps may not have done.
    lacking = [end for end, point in zip(ends, points, strict=True) if point.accurate_rms is None]
    anew = iter(objective.rms(np.stack(lacking)) if lacking else ())
    rms = [next(anew) if p.accurate_rms is None else p.accurate_rms for p in points]
    return [
        Refinement(end, descent.point.error, errors, descent.iterations, _final_steps(descent))
        for end, descent, errors in zip(ends, descents, rms, strict=True)
    ]


def _is_too_slow(errors: Sequence[float], left: int, goal: float) -> bool:
    """Whether a descent of such errors stays above a goal in the iterations that are left.

    At several times the pace of its last iterations, unless that becomes ever quicker: plateaus
    end, and bent valleys may straighten.
    """
    if len(errors) <= _LAST or not goal < errors[-1] < math.inf:
        return False
    gains = -np.diff(np.log(errors[-1 - _LAST :]))
    lacking = math.log(errors[-1] / goal)
    return bool(gains[-1] <= gains[:-1].max() and lacking > _QUICKER * gains.max() * left)


def _final_steps(descent: Descent) -> tuple[int, ...]:
    return descent.steps if descent.shift is None else descent.shift.steps


def begin(
    objective: Objective,
    chromosome: FloatArray,
    *,
    tolerance: float = TOLERANCE,
    restriction: Restriction = FREE,
) -> Descent:
    """A descent from a chromosome (n_free,), moved to the nearest point that it may come to."""
    space = objective.space
    at = np.clip(space.encode(chromosome), *restriction.bounds(space))
    return Descent(Point(at), tolerance=tolerance, restriction=restriction)


def corrected(objective: Objective, chromosome: FloatArray) -> Descent | None:
    """A descent by coarse simulations where its corrections are known; None by others."""
    if objective.coarse is objective:
        return None
    return _ready(objective, [begin(objective, chromosome)])[0]


def beside(space: SearchSpace, descent: Descent, near: Descent | None) -> Descent:
    """A descent that begins with the steps and corrections of another, if it is not far from it."""
    if near is None or near.steps_at is None or _is_far(space, descent.point.at, near.steps_at):
        return descent
    return replace(descent, steps=near.steps, steps_at=near.steps_at, shift=near.shift)


def errors_of(objective: Objective, descents: Sequence[Descent]) -> FloatArray:
    """Errors (n,) where descents stand, their restrictions' included, infinite where one failed."""
    errors = np.empty(len(descents))
    at = np.stack([descent.point.at for descent in descents])
    sure = [i for i, descent in enumerate(descents) if descent.is_corrected]
    by_coarse = _responses(objective.coarse, [descents[i] for i in sure], list(at[sure, None]))
    for i, responses in zip(sure, by_coarse, strict=True):
        errors[i] = objective.error_of(responses.rms)[0]
    others = [i for i, descent in enumerate(descents) if not descent.is_corrected]
    if not others:
        return errors
    chromosomes = objective.space.decode(at[others])
    rms, none = objective.rms(chromosomes), np.zeros((0, *objective.weights.shape, 1))
    for i, chromosome, each in zip(others, chromosomes, rms, strict=True):
        responses = Responses(none, each[None], np.zeros(1))
        tether = descents[i].restriction.tether
        if tether is not None:
            responses = objective.with_sample(responses, tether(chromosome[None]))
        errors[i] = objective.error_of(responses.rms)[0]
    return errors


def simulations_per_iteration(objective: Objective) -> int:
    """Most simulations that an iteration of one descent takes."""
    return 3 + Neighbours.of(objective).count + CANDIDATES


def curvature(objective: Objective, at: FloatArray) -> FloatArray:
    """Gauss-Newton Hessian of the error at coordinates (n_free,), in parts of the ranges."""
    descents, objective = _ready(objective, [Descent(Point(at))]), objective.coarse
    (around,) = linearised(objective, descents)
    floor = FLOORS[0] * float(objective.error_of(around.rms[None])[0])
    return Quadratic.at(objective, around, floor).hessian


def advance(objective: Objective, descents: Sequence[Descent]) -> list[Descent]:
    """The descents after one iteration of each that has not finished."""
    onward = list(descents)
    live = [i for i, descent in enumerate(descents) if not descent.finished]
    ready, objective = _ready(objective, [descents[i] for i in live]), objective.coarse
    most = held_at_once(objective)
    for first in range(0, len(live), most):
        batch = slice(first, first + most)
        iterated = _iterated(objective, ready[batch])
        for i, descent in zip(live[batch], iterated, strict=True):
            onward[i] = descent
    return onward


def held_at_once(objective: Objective) -> int:
    """Of how many points residuals and slopes are held at once."""
    residuals_each = objective.n_residuals * (1 + len(objective.space.parameters))
    return max(1, _BATCH_BYTES // (8 * residuals_each))


def _iterated(objective: Objective, descents: list[Descent]) -> list[Descent]:
    """The descents, whose integration steps are chosen, after one iteration."""
    space = objective.space
    around = linearised(objective, descents)
    surveys = _side_by_side(objective, _surveyed, [*zip(descents, around, strict=True)])
    onward = [descent for descent, _ in surveys]
    quadratics = {i: quadratic for i, (_, quadratic) in enumerate(surveys) if quadratic}
    at = np.array([onward[i].point.at for i in quadratics])
    bounds = [onward[i].restriction.bounds(space) for i in quadratics]
    ends = np.array([lower for lower, _ in bounds]), np.array([upper for _, upper in bounds])
    damping = np.array([onward[i].damping for i in quadratics])
    offered = candidates(space, at, ends, damping, list(quadratics.values()))
    offers = {}
    for i, whole in zip(quadratics, offered, strict=True):
        offer = whole.shortened if onward[i].cautious else whole
        if len(offer.coordinates) and not offer.promise <= onward[i].tolerance:
            offers[i] = offer
        else:
            onward[i] = resumed(objective, onward[i], "arrived")
    rows = [offer.coordinates for offer in offers.values()]
    tried = dict(zip(offers, _responses(objective, [onward[i] for i in offers], rows), strict=True))
    behind = {
        i: (
            onward[i].point.at,
            onward[i].restriction.bounds(space),
            quadratics[i],
            offer,
            around[i],
            tried[i],
        )
        for i, offer in offers.items()
        if _gains(objective, onward[i], tried[i]).max() < _LITTLE * offer.promise
    }
    way = restored if objective.exact_slopes else bent
    curved = dict(zip(behind, _side_by_side(objective, way, [*behind.values()]), strict=True))
    rows = [offer.coordinates for offer in curved.values()]
    again = _responses(objective, [onward[i] for i in curved], rows, keep=False)
    for i, responses in zip(curved, again, strict=True):
        offers[i], tried[i] = offers[i].joined(curved[i]), tried[i].joined(responses)
    for i, offer in offers.items():
        onward[i] = _judged(objective, onward[i], offer, tried[i])
    return onward


def _side_by_side(
    objective: Objective, function: Callable[..., _Result], tasks: Sequence[tuple[Any, ...]]
) -> list[_Result]:
    """What a function of the objective returns of each task, in threads where that takes long."""
    if objective.n_residuals * len(objective.space.parameters) < _LONG:
        return [function(objective, *task) for task in tasks]
    return objective.simulator.workers.results(lambda task: function(objective, *task), tasks)


def _surveyed(
    objective: Objective, descent: Descent, around: Linearisation
) -> tuple[Descent, Quadratic | None]:
    """The descent with its point's error, and the quadratic there unless it stalls or ends."""
    at, error = descent.point.at, float(objective.error_of(around.rms[None])[0])
    if not np.isfinite(error):
        return resumed(objective, descent, "failed"), None
    safe = descent.steps_at is not None and np.array_equal(at, descent.steps_at)
    descent = replace(
        descent,
        point=Point(at, error, around.rms, around.excess),
        safe=Point(at, error) if safe else descent.safe,
        gain=0.0,
        iterations=descent.iterations + 1,
    )
    if error <= ROUNDING:
        return replace(descent, finished=True), None
    burst = ~(around.errors <= _BURST + error)
    if burst.any():
        braced = resumed(objective, descent, "burst")
        if not braced.finished:
            return braced, None
        turned = tuple(sorted({*descent.backward, *np.flatnonzero(burst).tolist()}))
        if turned != descent.backward:
            return replace(descent, backward=turned), None
        # The rest of the parameters go on alone.
        around = replace(around, slopes=around.slopes.without(burst))
    if not np.isfinite(descent.error_of_round):
        descent = replace(descent, error_of_round=error)
    quadratic = Quadratic.at(objective, around, descent.floor)
    if not quadratic.leads_somewhere:
        return resumed(objective, descent, "arrived"), None
    return descent, quadratic


def _judged(objective: Objective, descent: Descent, offer: Candidates, ends: Responses) -> Descent:
    """The descent after its candidates have been simulated, at the best of them if it gains."""
    assert descent.steps_at is not None
    gains = _gains(objective, descent, ends)
    best = int(np.argmax(gains))
    gain = float(gains[best])
    damping = heavier(descent.damping)
    if gain > 0.0:
        at, damping = offer.coordinates[best], float(offer.damping[best])
        error = float(objective.error_of(ends.rms[best : best + 1])[0])
        point = Point(at, error, ends.rms[best], float(ends.excess[best]))
        far = _is_far(objective.space, at, descent.steps_at)
        steps_at = None if far else descent.steps_at
        descent = replace(descent, point=point, steps_at=steps_at, gain=gain)
    promising, behind = offer.promise > NOTHING, gain < _KEPT * offer.promise
    little = gain <= descent.tolerance
    # By less damping more may be gained at once: where a valley bends it is seen only then.
    once_more = behind and little and not descent.failures
    failed = gain <= 0.0 or once_more or (behind and promising)
    failures = descent.failures + 1 if failed else 0
    crawling = descent.crawling + 1 if gain < _CRAWL * offer.promise else 0
    descent = replace(descent, damping=damping, failures=failures, crawling=crawling)
    if failures >= PATIENCE and promising:
        return resumed(objective, descent, "misled")
    if failures >= PATIENCE or (little and not failed):
        return resumed(objective, descent, "arrived")
    return descent


def _is_far(space: SearchSpace, at: FloatArray, chosen: FloatArray) -> bool:
    """Whether integration steps, and corrections, that were chosen elsewhere may not do."""
    return bool(np.any(np.abs(at - chosen) > _FAR * space.width))


def _gains(objective: Objective, descent: Descent, ends: Responses) -> FloatArray:
    """Shares of the smoothed error, (n,), that candidates take away."""
    assert descent.point.rms is not None
    rms = np.stack([descent.point.rms, *ends.rms])
    errors = objective.smoothed_error_of(rms, descent.floor)
    gains: FloatArray = (errors[0] - errors[1:]) / errors[0]
    return gains


def _ready(objective: Objective, descents: list[Descent]) -> list[Descent]:
    """The descents with what their simulations go by, steps and what corrects them."""
    coarse = objective.coarse
    descents = list(_with_steps(coarse, descents))
    lacking = {i: descent for i, descent in enumerate(descents) if not descent.is_corrected}
    if coarse is objective or not lacking:
        return descents
    at = np.stack([descent.point.at for descent in lacking.values()])
    chromosomes = objective.space.decode(at)
    steps, exact = _exactly(objective, chromosomes, list(lacking.values()))
    fewer = np.array([descent.steps for descent in lacking.values()])
    less = coarse.residuals(chromosomes, fewer).values
    for k, (i, descent) in enumerate(lacking.items()):
        shift = Shift(at[k], tuple(steps[k].tolist()), descent.steps, (exact - less)[..., k])
        descents[i] = replace(descent, shift=shift, steps_at=at[k])
    return descents


def _exactly(
    objective: Objective, chromosomes: FloatArray, descents: Sequence[Descent]
) -> tuple[IntArray, FloatArray]:
    """Steps (n, n_records) that suffice, and residuals by them; those before if they still do."""
    shifts = [descent.shift for descent in descents]
    if all(shifts):
        steps = np.array([shift.steps for shift in shifts if shift])
        before = objective.residuals(chromosomes, steps)
        if np.all(before.excess <= 1.0):
            return steps, before.values
    steps = objective.steps_needed(chromosomes)
    return steps, objective.residuals(chromosomes, steps).values


def _with_steps(objective: Objective, descents: list[Descent]) -> list[Descent]:
    """The descents with integration steps chosen where they lack them."""
    points = [descent.point.at for descent in descents if descent.steps_at is None]
    if not points:
        return descents
    needed = iter(objective.steps_needed(objective.space.decode(np.stack(points))).tolist())
    return [
        replace(descent, steps=tuple(next(needed)), steps_at=descent.point.at, braced=0)
        if descent.steps_at is None
        else descent
        for descent in descents
    ]


def _distance(space: SearchSpace, descent: Descent) -> FloatArray:
    """Distances h of the neighbours, in parts of the ranges, (n_free,)."""
    h = PERTURBATIONS[descent.level]
    # Away from the nearer bound, so that the perturbed chromosome stays in range.
    _, upper = space.coded_bounds
    distance = np.where(descent.point.at + h * space.width > upper, -h, h)
    distance[list(descent.backward)] *= -1.0
    return distance


def linearised(objective: Objective, descents: Sequence[Descent]) -> list[Linearisation]:
    """Residuals and slopes where descents stand, by their steps."""
    space = objective.space
    if not objective.exact_slopes:
        neighbours = Neighbours.of(objective)
        distances = [_distance(space, descent) for descent in descents]
        rows = [
            neighbours.around(descent.point.at, distance * space.width)
            for descent, distance in zip(descents, distances, strict=True)
        ]
        around = _responses(objective, descents, rows)
        whole = zip(itertools.repeat(neighbours), descents, around, distances, strict=False)
        return _side_by_side(objective, _by_differences, [*whole])
    rows = [descent.point.at[None] for descent in descents]
    steps = np.array([descent.steps for descent in descents])
    tangents = objective.tangents(space.decode(np.concatenate(rows)), steps, space.width)
    here = _responses(objective, descents, rows)
    return _side_by_side(objective, _by_tangents, [*zip(descents, here, tangents, strict=True)])


def _by_differences(
    objective: Objective,
    neighbours: Neighbours,
    descent: Descent,
    around: Responses,
    distance: FloatArray,
) -> Linearisation:
    values = around.values if descent.restriction.tether is None else around.values[:-1]
    slopes = _tethered(objective, descent, neighbours.slopes(values, distance))
    errors = objective.error_of(around.rms[1:])[neighbours.places]
    excess = float(around.excess[0])
    return Linearisation(around.values[..., 0], slopes, around.rms[0], excess, errors)


def _by_tangents(
    objective: Objective, descent: Descent, here: Responses, tangents: Slopes
) -> Linearisation:
    """tangents: by the search coordinates, in parts of the ranges."""
    slopes = _tethered(objective, descent, tangents)
    error = float(objective.error_of(here.rms)[0])
    errors = np.where(slopes.finite, error, np.inf)
    return Linearisation(here.values[..., 0], slopes, here.rms[0], float(here.excess[0]), errors)


def _tethered(objective: Objective, descent: Descent, slopes: Slopes) -> Slopes:
    """Slopes of a descent's residuals, with those of its tether below."""
    space, tether = objective.space, descent.restriction.tether
    if tether is None:
        return slopes
    shift = _OF_TETHER * np.diag(space.width)
    ahead, behind = (tether(space.decode(descent.point.at + way * shift)) for way in (1.0, -1.0))
    row = np.zeros((len(objective.weights), len(space.width)))
    row[int(np.argmax(objective.weights))] = (ahead - behind) / (2.0 * _OF_TETHER)
    return joined(slopes, row)


def _responses(
    objective: Objective, descents: Sequence[Descent], rows: list[FloatArray], *, keep: bool = True
) -> list[Responses]:
    """Responses of each descent's rows of coordinates, by its steps, all in one batch."""
    if not descents:
        return []
    # Descents of like steps are neighbours, so that they share blocks of the simulation.
    order = sorted(range(len(descents)), key=lambda i: descents[i].steps)
    counts = [len(rows[i]) for i in order]
    steps = np.repeat([descents[i].steps for i in order], counts, axis=0)
    chromosomes = objective.space.decode(np.concatenate([rows[i] for i in order]))
    corrected = any(descent.shift is not None for descent in descents)
    batch = objective.residuals(chromosomes, steps, keep=keep or corrected)
    parts: dict[int, Responses] = {}
    for i, end in zip(order, np.cumsum(counts), strict=True):
        part = slice(end - len(rows[i]), end)
        responses = Responses(batch.values[..., part], batch.rms[part], batch.excess[part])
        shift, tether = descents[i].shift, descents[i].restriction.tether
        if shift is not None:
            responses = objective.shifted(responses, shift.values)
        if tether is not None:
            responses = objective.with_sample(responses, tether(chromosomes[part]))
        parts[i] = responses
    return [parts[i] for i in range(len(descents))]
