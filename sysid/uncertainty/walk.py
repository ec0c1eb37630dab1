"""The way along a valley to an end of an interval.

An end is where a quantity q is largest, or smallest, of all that explains the data (Venzon and
Moolgavkar, "A method for computing profile-likelihood-based confidence intervals", Applied
Statistics 37, 1988). A walk there keeps to the floor of the valley that the estimate lies in. With
the quadratic of the error at a point x, H and g in parts of the ranges, and a = dq/dx,

    v = H^-1 a / (a'H^-1 a)                     leads along the floor, by a unit of q,
    c = -G g + G a (a'G g) / (a'G a)            back to it, q as it is: G = (H + mu I)^-1,

and the quadratic foretells after which distance d the floor is at the level. The walls of a narrow
valley are a hundred million times as steep as its floor, so that no straight step stays in it:

1. A tenth of d, led back by steps c of the errors there and of the slopes at x (chords), shows how
   far the valley bends on the way.
2. d, a half, a quarter ... of it, bent so and led back likewise, are tried until one loses no more
   than foretold. From there the walk goes on, by slopes anew, until d is next to nothing.

A coordinate that comes to an end of its range stays there. Where nothing is left that moves q, it
has no end within the ranges. Fits of everything to one place of q after another take ten times as
long, as each of them climbs down into the valley from a wall.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.descent import Descent, Point
from sysid.fitting.objective import FLOORS, Linearisation, Objective
from sysid.fitting.quadratic import Quadratic, infeasible
from sysid.fitting.refinement import held_at_once, linearised
from sysid.fitting.slopes import triangle_of
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.tracer import Fit, Tracer, searched_bounds, traced

# Steps of a walk, few where a model explains little and none of its minima is the plant's.
_MOST, _FEW = 30, 10
_SIDE_BY_SIDE = 4  # walks, two tries of each of which are half a block of a simulation
_PROBE = 0.1  # of a step, which shows how the valley bends
_FRACTIONS = ((1.0, 0.5), (0.25, 0.1))  # of a step, pairs of which are tried side by side
_SHORTER, _LONGER = 0.04, 3.0  # the next step's reach, where none of them does and where all did
_LEAST_REACH = 1e-4  # deviations
_ASTRAY, _NEAR = 0.5, 0.05  # roots of the statistic above what is foretold: too many, and few
# mu of chords, in parts of the largest curvature: across the valley first, and then along it. By
# differences slopes along it are not known.
_RESTORING = 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-12, 1e-12
_RESTORING_BY_DIFFERENCES = 1e-7, 1e-8, 1e-8, 1e-8, 1e-8, 1e-8
# Parts of the most, below which directions lead nowhere.
_UNFELT, _UNFELT_BY_DIFFERENCES = 1e-9, 1e-5
_TIED = 1e-9  # part of the largest curvature that ties are given
_IDLE = 1e-3  # part of a slope in such directions, from which on they move the quantity
_SETTLED = 0.02  # share of the statistic that a chord takes away, below which more do not matter
_HOLDINGS = 5  # rounds in which coordinates that go beyond an end of their range are held there
_AT_END = 1e-6  # parts of a range
_NO_ROOM = 0.1  # part of a step, below which one at an end of its range does not let it go on
# Of the statistic, that a walk goes on for to begin with, and after some steps: promises are
# not kept at a kink.
_WORTH, _SOON, _WORTH_LATER = 0.05, 6, 0.3
_CLOSE = 0.02  # of the way from the estimate, from which the quadratic tells where the end is


@dataclass(frozen=True)
class Walk:
    """A walk of a tracer's quantity to one side, and where it has come to.

    at: (n_free,), search coordinates. steps: of the integration, per sample, for each record.
    reach: how far the quantity may be moved at once. count: steps taken. fits: what explains the
    data on the way. end: the quantity where it is at its level, None where that is nowhere; known
    once the walk has arrived.
    """

    tracer: Tracer
    sign: float
    at: FloatArray
    steps: tuple[int, ...]
    reach: float
    count: int = 0
    fits: tuple[Fit, ...] = ()
    end: float | None = None
    arrived: bool = False
    lost: bool = False

    @classmethod
    def begun(cls, tracer: Tracer, sign: float, fit: Fit | None = None) -> Self:
        """A walk from the estimate, or a fit on its way."""
        at, fits = (tracer.start, ()) if fit is None else (fit.at, (fit,))
        return cls(tracer, sign, at, tuple(tracer.local.steps), Z95 * tracer.unit, fits=fits)

    @property
    def goes_on(self) -> bool:
        """Whether it has neither arrived nor lost the valley."""
        most = _FEW if self.tracer.local.explains_little else _MOST
        return not (self.arrived or self.lost) and self.count < most

    @property
    def last(self) -> Fit | None:
        """The last fit below the level, on this side of the estimate."""
        side = (fit for fit in self.fits if self.sign * (fit.place - self.tracer.centre) > 0.0)
        return next((fit for fit in reversed([*side]) if fit.statistic <= Z95**2), None)

    def statistic(self, error: float) -> float:
        """Twice the loss of log-likelihood by an error, below zero where it explains more."""
        return self.tracer.factor * (error - self.tracer.local.error_by(self.steps))

    def moved(self, at: FloatArray, statistic: float) -> Self:
        """The walk at a point where the statistic is that."""
        fit = Fit(
            self.tracer.quantity.at(at), max(statistic, 0.0), at, statistic / self.tracer.factor
        )
        return replace(self, at=at, fits=(*self.fits, fit))


@dataclass(frozen=True)
class _Outlook:
    """What a walk sees from where it stands; steps are in parts of the ranges, (n_free,).

    slope: a. held: coordinates that stay on an end of their range. back: c. along: v. whole: d to
    where the floor is at the level; distance: as far as is gone at once. after: the statistic once
    c is gone; rising, bent: its change with q then, and the change of that.
    """

    walk: Walk
    local: Linearisation
    quadratic: Quadratic
    slope: FloatArray
    held: BoolArray
    back: FloatArray
    along: FloatArray
    whole: float
    distance: float
    after: float
    rising: float
    bent: float

    def foretold(self, fraction: float) -> float:
        """The statistic after a part of the distance."""
        d = fraction * self.distance
        return self.after + self.rising * d + 0.5 * self.bent * d**2

    def excess(self, fraction: float, statistic: float) -> float:
        """Roots of the statistic that it is above what is foretold."""
        foretold = max(self.foretold(fraction), 0.0)
        return math.sqrt(max(statistic, 0.0)) - math.sqrt(foretold)

    def chord(self, errors: FloatArray, damping: float) -> FloatArray:
        """The step (n_free,) back to the floor by errors (n_residuals, n_outputs)."""
        slopes = self.local.slopes
        (push,) = self.quadratic.push(slopes, lambda j: np.ascontiguousarray(errors[None, :, j]), 1)
        inverse = _damped_inverse(self._hessian, damping, self.held)
        return _kept(-inverse @ push, self.slope, inverse @ self.slope)

    @cached_property
    def _hessian(self) -> FloatArray:
        return self.quadratic.hessian


def ends_of(walks: Sequence[Walk], fits: list[Fit] | None = None) -> list[float | None]:
    """Ends that walks come to, or where one loses the valley a search from where it was last.

    None for nowhere. fits: is given all that explain the data on the way.
    """
    walks = walked(walks)
    fits = [] if fits is None else fits
    fits += itertools.chain.from_iterable(walk.fits for walk in walks)
    searches = [
        (walk.tracer, walk.tracer.bound(walk.sign, walk.last)) for walk in walks if not walk.arrived
    ]
    others = iter(traced(searches, fits))
    return [walk.end if walk.arrived else next(others) for walk in walks]


def walked(walks: Sequence[Walk]) -> list[Walk]:
    """Walks of quantities around one estimate, side by side, as far as they come."""
    walks = list(walks)
    while live := [i for i, walk in enumerate(walks) if walk.goes_on]:
        most = min(_SIDE_BY_SIDE, held_at_once(walks[0].tracer.objective))
        for k in range(0, len(live), most):
            part = live[k : k + most]
            for i, walk in zip(part, _onward([walks[i] for i in part]), strict=True):
                walks[i] = walk
    return walks


def _onward(walks: Sequence[Walk]) -> list[Walk]:
    """The walks one step further."""
    objective = walks[0].tracer.objective
    descents = [Descent(Point(w.at), steps=w.steps, steps_at=w.at) for w in walks]
    onward, ahead = list(walks), {}
    for i, local in enumerate(linearised(objective, descents)):
        seen = _seen(walks[i], local)
        if isinstance(seen, Walk):
            onward[i] = seen
        else:
            ahead[i] = seen
    bends = dict(zip(ahead, _bends([*ahead.values()]), strict=True))
    for fractions in _FRACTIONS:
        tried = [(i, fraction) for i in ahead for fraction in fractions]
        results = _led_back([(ahead[i], fraction, bends[i]) for i, fraction in tried])
        for (i, fraction), (at, statistic, finer) in zip(tried, results, strict=True):
            if i in ahead and ahead[i].excess(fraction, statistic) <= _ASTRAY:
                onward[i] = _further(ahead.pop(i), fraction, at, statistic)
                if finer:
                    onward[i] = _finer(onward[i])
    for i, outlook in ahead.items():
        reach = _SHORTER * abs(outlook.distance)
        lost = reach < _LEAST_REACH * outlook.walk.tracer.unit
        onward[i] = replace(walks[i], reach=reach, count=walks[i].count + 1, lost=lost)
    return onward


def _further(outlook: _Outlook, fraction: float, at: FloatArray, statistic: float) -> Walk:
    """The walk at a part of the distance, from where it may go farther or less far at once."""
    walk, distance = outlook.walk, abs(outlook.distance)
    if fraction == 1.0:
        reach = max(walk.reach, _LONGER * distance)
    else:
        # An end of a range, that let it go on but little, will not be in the way again.
        cut = distance < _NO_ROOM * min(walk.reach, abs(outlook.whole))
        reach = walk.reach if cut else 2.0 * fraction * distance
    return replace(walk.moved(at, statistic), reach=reach, count=walk.count + 1)


def _finer(walk: Walk) -> Walk:
    """The walk with the integration steps that are needed where it has come to."""
    objective = walk.tracer.objective
    needed = objective.steps_needed(objective.space.decode(walk.at[None]))[0].tolist()
    steps = tuple(math.ceil(1.1 * max(pair)) for pair in zip(needed, walk.steps, strict=True))
    return replace(walk, steps=steps)


def _seen(walk: Walk, local: Linearisation) -> Walk | _Outlook:
    """What a walk sees ahead, or the walk where it has arrived, or is lost."""
    tracer, space = walk.tracer, walk.tracer.objective.space
    error = float(tracer.objective.error_of(local.rms[None])[0])
    quadratic = Quadratic.at(tracer.objective, local, FLOORS[0] * error)
    if not quadratic.leads_somewhere:
        return replace(walk, lost=True)
    if not tracer.objective.exact_slopes:
        quadratic = _across(quadratic, tracer.ties / space.width)
    low, high = ((ends - walk.at) / space.width for ends in searched_bounds(space))
    slope, statistic = tracer.quantity.slope(walk.at) * space.width, walk.statistic(error)
    held = np.zeros(len(slope), dtype=bool)
    for _ in range(_HOLDINGS):
        seen = _outlook(walk, statistic, local, quadratic, slope, held)
        back = np.clip(seen.back, np.minimum(low, 0.0), np.maximum(high, 0.0))
        room = _room(seen.distance * seen.along, low - back, high - back)
        at_end = np.where(seen.distance * seen.along > 0.0, high < _AT_END, low > -_AT_END)
        beyond = at_end & (room < _NO_ROOM)
        if not np.any(beyond & ~held):
            break
        held = held | beyond
    worth = _WORTH if walk.count < _SOON else _WORTH_LATER
    if statistic - seen.after <= worth and (ended := _ended(walk, seen)):
        return ended
    distance = seen.distance * float(np.clip(room.min(), 0.0, 1.0))
    return replace(seen, back=back, distance=distance)


def _ended(walk: Walk, seen: _Outlook) -> Walk | None:
    """A walk on the floor where nothing is left to be gone; None where it goes on.

    It is lost above the level, where no way back is seen, or none to its side of the estimate.
    """
    tracer, above = walk.tracer, seen.after > Z95**2
    if not seen.along.any():
        return replace(walk, lost=True) if above else replace(walk, arrived=True)
    if math.isnan(seen.whole):
        return replace(walk, lost=True)
    place = tracer.quantity.at(walk.at)
    if abs(seen.whole) >= _CLOSE * abs(place - tracer.centre):
        return None
    end = place + seen.whole
    if walk.sign * (end - tracer.centre) <= 0.0:
        return replace(walk, lost=True)
    value = tracer.quantity.value(end) if tracer.is_searched(end) else None
    return replace(walk, end=value, arrived=True)


def _outlook(
    walk: Walk,
    statistic: float,
    local: Linearisation,
    quadratic: Quadratic,
    slope: FloatArray,
    held: BoolArray,
) -> _Outlook:
    """What is seen ahead, of a statistic here, while some coordinates are held."""
    factor, root = walk.tracer.factor, quadratic.root
    free = np.where(held, 0.0, slope)
    exact = walk.tracer.objective.exact_slopes
    unfelt = _UNFELT if exact else _UNFELT_BY_DIFFERENCES
    along = _along(np.where(held, 0.0, root), free, unfelt)
    damped = _damped_inverse(quadratic.hessian, _restoring(walk.tracer)[-1], held)
    back = _kept(-damped @ (root.T @ quadratic.right), free, damped @ free)
    change, step = root @ back, root @ along
    gained = -float(change @ quadratic.right + 0.5 * change @ change)
    after = statistic - factor * gained
    rising, bent = factor * float(step @ (quadratic.right + change)), factor * float(step @ step)
    whole = _to_level(after, rising, bent, walk.sign)
    distance = 0.0 if math.isnan(whole) else float(np.clip(whole, -walk.reach, walk.reach))
    return _Outlook(
        walk, local, quadratic, slope, held, back, along, whole, distance, after, rising, bent
    )


def _kept(step: FloatArray, slope: FloatArray, across: FloatArray) -> FloatArray:
    """A step (n_free,) less what moves the quantity of a slope, by a move across the valley."""
    moved = float(slope @ across)
    return step - across * float(slope @ step) / moved if moved > 0.0 else step


def _to_level(after: float, rising: float, bent: float, sign: float) -> float:
    """Distance to where a parabola is at the level on one side, NaN where it is above throughout.

    >>> _to_level(0.0, 0.0, 2.0, -1.0), _to_level(4.0, 0.0, 2.0, 1.0), _to_level(1.0, 0.0, 0.0, 1.0)
    (-1.959963984540054, nan, inf)
    """
    root = rising**2 - 2.0 * bent * (after - Z95**2)
    if root < 0.0 or (bent <= 0.0 and after > Z95**2):
        return math.nan
    if bent <= 0.0:
        return sign * math.inf
    return (-rising + sign * math.sqrt(root)) / bent


def _restoring(tracer: Tracer) -> tuple[float, ...]:
    """mu of chords one after the other, and last that of c."""
    return _RESTORING if tracer.objective.exact_slopes else _RESTORING_BY_DIFFERENCES


def _room(move: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Parts of a move, (n_free,), that stay between bounds on it."""
    room = np.where(move > 0.0, high, low)
    return np.divide(room, move, out=np.full_like(move, np.inf), where=np.abs(move) > 0.0)


def _across(quadratic: Quadratic, ties: FloatArray) -> Quadratic:
    """The quadratic that rises a little along ties, (n, n_free) in parts of the ranges.

    Slopes by differences feel them by chance, and would lead far along them for nothing.
    """
    if not len(ties):
        return quadratic
    n, most = len(quadratic.right), np.sqrt(np.max(np.sum(quadratic.root**2, axis=0)))
    rows = np.sqrt(_TIED) * most * ties / np.linalg.norm(ties, axis=1, keepdims=True)
    below = np.zeros((len(rows), 1))
    triangle = triangle_of(np.block([[quadratic.root, quadratic.right[:, None]], [rows, below]]))
    return replace(quadratic, root=triangle[:n, :n], right=triangle[:n, n])


def _along(root: FloatArray, slope: FloatArray, unfelt: float) -> FloatArray:
    """v by R, (n_free, n_free), and a, (n_free,); zero where nothing moves the quantity.

    What is not felt moves it at no cost. unfelt: as of ``_UNFELT``.
    """
    size = np.linalg.norm(root, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    _, values, axes = np.linalg.svd(root / size)
    felt, scaled = values > unfelt * values[0], slope / size
    parts = axes @ scaled
    idle = axes[~felt].T @ parts[~felt]
    if idle @ idle > _IDLE * (scaled @ scaled):
        way = idle / size
    else:
        way = axes[felt].T @ (parts[felt] / values[felt] ** 2) / size
    moved = float(slope @ way)
    along: FloatArray = way / moved if moved > 0.0 else np.zeros_like(way)
    return along


def _damped_inverse(hessian: FloatArray, damping: float, held: BoolArray) -> FloatArray:
    """(H + mu I)^-1, (n_free, n_free), of what is not held; damping: mu in parts of the most.

    Zero where nothing else is felt.
    """
    left_out = held | held[:, None]
    free = np.where(left_out, 0.0, hessian)
    mu = damping * float(np.diag(free).max())
    if mu <= 0.0:
        return np.zeros_like(free)
    return np.where(left_out, 0.0, np.linalg.inv(free + mu * np.eye(len(free))))


def _bends(outlooks: Sequence[_Outlook]) -> list[FloatArray]:
    """By how much the valley bends over the distance ahead, (n_free,) each."""
    straight = [(seen, _PROBE, np.zeros_like(seen.back)) for seen in outlooks]
    bends = []
    for seen, (at, statistic, _) in zip(outlooks, _led_back(straight), strict=True):
        width = seen.walk.tracer.objective.space.width
        bend = (at - seen.walk.at) / width - seen.back - _PROBE * seen.distance * seen.along
        bends.append(bend / _PROBE**2 if np.isfinite(statistic) else np.zeros_like(bend))
    return bends


@dataclass
class _Return:
    """A part of a step on its way back to the floor: the best point, and the one tried next."""

    outlook: _Outlook
    fraction: float
    point: FloatArray
    at: FloatArray
    statistic: float = np.inf
    excess: float = 0.0
    settled: bool = False

    def tried(self, statistic: float, excess: float, *, last: bool) -> None:
        """Note what was found at the point."""
        if not np.isfinite(statistic):
            self.settled = True
            return
        gained = self.statistic - statistic
        if gained > 0.0:
            self.at, self.statistic, self.excess = self.point, statistic, excess
        as_foretold = self.outlook.excess(self.fraction, self.statistic) <= _NEAR
        self.settled = as_foretold or (last and gained < _SETTLED * abs(statistic))


def _led_back(
    parts: Sequence[tuple[_Outlook, float, FloatArray]],
) -> Iterator[tuple[FloatArray, float, bool]]:
    """Points (n_free,) back on the floor, the statistic there, and whether it needs finer steps.

    parts: outlooks, fractions of their distances, and by how much the valley bends.
    """
    if not parts:
        return iter(())
    objective = parts[0][0].walk.tracer.objective
    space = objective.space
    bounds = searched_bounds(space)
    returns = []
    for seen, f, bend in parts:
        step = seen.back + f * seen.distance * seen.along + f**2 * bend
        point = np.clip(seen.walk.at + step * space.width, *bounds)
        returns.append(_Return(seen, f, point, point))
    dampings = _restoring(parts[0][0].walk.tracer)
    for k, damping in enumerate(dampings):
        live = [each for each in returns if not each.settled]
        if not live:
            break
        _tried(objective, live, damping, bounds, last=k >= len(dampings) // 2)
    return ((each.at, each.statistic, each.excess > 1.0) for each in returns)


def _tried(
    objective: Objective,
    returns: Sequence[_Return],
    damping: float,
    bounds: tuple[FloatArray, FloatArray],
    *,
    last: bool,
) -> None:
    """Simulate where parts of steps have come to, and lead them one chord further back."""
    space = objective.space
    points = np.stack([each.point for each in returns])
    steps = np.array([each.outlook.walk.steps for each in returns])
    responses = objective.residuals(space.decode(points), steps)
    errors = np.where(infeasible(space, points), np.inf, objective.error_of(responses.rms))
    for k, each in enumerate(returns):
        statistic = each.outlook.walk.statistic(float(errors[k]))
        each.tried(statistic, float(responses.excess[k]), last=last)
        if not each.settled:
            chord = each.outlook.chord(responses.values[..., k], damping)
            each.point = np.clip(each.point + chord * space.width, *bounds)
