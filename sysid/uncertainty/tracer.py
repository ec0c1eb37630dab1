"""A quantity that is moved, and fits of everything else to each place of it."""

import itertools
from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.descent import Descent, Point
from sysid.fitting.refinement import beside, corrected, errors_of, refine_each
from sysid.problem.space import SearchSpace
from sysid.uncertainty.covariance import Covariance
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.quantities import Profiled
from sysid.uncertainty.sensitivity import Sensitivity

_STEPS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)  # standard deviations, outwards
_ITERATIONS = 20
# A parameter without a standard deviation is moved by parts of its range.
_BLIND_SHARE = 0.05
_FAR_OUT = 4.0  # times the level, from where by how much less a place explains does not matter
_RESOLUTION = 0.02  # of the statistic, to which refits go
# Refits of one end, few where a model explains little and none of its minima is the plant's,
_REFITS, _FEW = 20, 4
_NEAR = 0.1  # until the root of the statistic is so near its level,
_GAP = 0.02  # or two fits on both sides of it so near each other, in parts of the way there
# Times the distance, that the next point may be away at most, and where a valley has branches.
_LEAP, _CAREFUL = 8.0, 1.5
_TETHER = 200.0  # loss of likelihood by a quantity that is a standard deviation off its place
_BEYOND = 3.0  # widths of a range to which its open end is searched


class Fit(NamedTuple):
    """A fit of all parameters to a place of a quantity.

    at: (n_free,), search coordinates. loss: what its error is more than the estimate's by the same
    integration steps, whose own errors may be larger than what is to be told. alone: whether it
    does not explain less only because of where it began: from elsewhere the descent ended worse.
    """

    place: float
    statistic: float
    at: FloatArray
    loss: float
    alone: bool = False

    @property
    def root(self) -> float:
        """The root of the statistic, which is nearly straight."""
        return float(np.sqrt(self.statistic))


class Wanted(NamedTuple):
    """A place that a fit is wanted for, and search coordinates (n_free,) near it.

    A descent begins from the best of each group: a valley may have branches.
    """

    place: float
    groups: tuple[tuple[FloatArray, ...], ...]


_Result = TypeVar("_Result")
# A search along a profile, which asks for fits one after the other.
Search = Generator[Wanted, Fit, _Result]


def traced(
    searches: Sequence[tuple["Tracer", Search[_Result]]], fits: list[Fit] | None = None
) -> list[_Result]:
    """Results of searches along profiles of one estimate, side by side in the same batches.

    fits: is given all that were made on the way.
    """
    if not searches:
        return []
    results: dict[int, _Result] = {}
    base = _Base(searches[0][0])
    answers: dict[int, Fit | None] = dict.fromkeys(range(len(searches)))
    while answers:
        wanted: dict[int, Wanted] = {}
        for i, answer in answers.items():
            try:
                wanted[i] = searches[i][1].send(answer)  # type: ignore[arg-type]  # None begins it
            except StopIteration as end:
                results[i] = end.value
        if not wanted:
            break
        made = base.fitted([(searches[i][0], task) for i, task in wanted.items()])
        answers = dict(zip(wanted, made, strict=True))
        if fits is not None:
            fits += made
    return [results[i] for i in range(len(searches))]


class _Base:
    """The estimate that profiles are around, and what is known there for all fits."""

    def __init__(self, tracer: "Tracer") -> None:
        self.objective, self.error_by = tracer.objective, tracer.local.error_by
        self.corrected = corrected(self.objective, tracer.local.chromosome)
        shift = None if self.corrected is None else self.corrected.shift
        self.error = None if shift is None else self.error_by(shift.steps)

    def fitted(self, tasks: Sequence[tuple["Tracer", Wanted]]) -> list[Fit]:
        """The best fits to places, of tracers around the estimate."""
        objective = self.objective
        refined = iter(refine_each(objective, self._begun(tasks), _ITERATIONS))
        each = [list(itertools.islice(refined, len(wanted.groups))) for _, wanted in tasks]
        ends = [min(ended, key=lambda end: end.error) for ended in each]
        worse = [max(end.error for end in ended) for ended in each]
        fits = []
        for (tracer, wanted), end, worst in zip(tasks, ends, worse, strict=True):
            loss = end.error - (self.error_by(end.steps) if np.isfinite(end.error) else 0.0)
            at = objective.space.encode(end.chromosome)
            alone = tracer.statistic(worst - end.error) > Z95**2
            fits.append(Fit(wanted.place, tracer.statistic(loss), at, loss, alone))
        return fits

    def _offered(self, tracer: "Tracer", place: float, at: FloatArray) -> Descent:
        descent = beside(self.objective.space, tracer.begun(place, at), self.corrected)
        if self.error is None:
            return descent
        return replace(descent, goal=self.error + _FAR_OUT * Z95**2 / tracer.factor)

    def _begun(self, tasks: Sequence[tuple["Tracer", Wanted]]) -> list[Descent]:
        """Descents to each place, from the best of each group of what is near."""
        groups = [
            (tracer, wanted.place, near) for tracer, wanted in tasks for near in wanted.groups
        ]
        offered = [
            self._offered(tracer, place, at) for tracer, place, near in groups for at in near
        ]
        errors = iter(errors_of(self.objective, offered))
        descents = iter(offered)
        return [
            min((next(errors), i, next(descents)) for i in range(len(near)))[2]
            for *_, near in groups
        ]


class Tracer:
    """Moves a quantity from ``centre``, where it stands, and has all parameters fitted to it.

    gradient: (n_free,), its changes with the search coordinates. failed: whether simulations end
    a side.
    """

    def __init__(
        self,
        local: Sensitivity,
        covariance: Covariance,
        gradient: FloatArray,
        quantity: Profiled,
    ) -> None:
        self.local, self.quantity, self.gradient = local, quantity, gradient
        self.ties = covariance.ties
        self.start = local.objective.space.encode(local.chromosome)
        self.objective = objective = local.criterion
        self.centre = quantity.at(self.start)
        deviation = covariance.deviation(gradient)
        self.unit = deviation if np.isfinite(deviation) else _BLIND_SHARE * quantity.width
        # Statistic per loss of error.
        samples = sum(record.n_samples for record in objective.records)
        self.factor = 2.0 * samples / covariance.inflation(gradient)
        output = int(np.argmax(objective.weights))
        rms = np.sqrt(np.sum(local.residual[:, output] ** 2) / objective.counts[output])
        scale = objective.counts[output] * rms / (objective.weights[output] * self.factor)
        # Next to zero a logarithm's deviation is no measure.
        near = min(self.unit, _BLIND_SHARE * quantity.width)
        self.stiffness = float(np.sqrt(2.0 * _TETHER * scale) / near)
        loss = 1.0 / (self.factor * max(local.error, 1e-300))  # share of the error
        self.tolerance = float(np.clip(_RESOLUTION * loss, 1e-7, 1e-3))
        # How the others go with the quantity where the slopes at the estimate are a guide.
        along = covariance.matrix @ gradient if np.isfinite(deviation) else gradient
        self.direction = along / float(gradient @ along)
        self.failed = False

    def side(self, sign: float) -> Search[list[tuple[float, float]]]:
        """Places and statistics on one side, outwards until well beyond the 95 % level."""
        end = self._end(sign)
        fits = [self._at_centre]
        points: list[tuple[float, float]] = []
        for step in _STEPS:
            place = self.centre + sign * step * self.unit
            beyond = sign * (place - end) >= 0.0
            place = end if beyond else place
            if place == self.centre:
                break
            fits.append((yield self._wanted(place, fits)))
            points.append((place, fits[-1].statistic))
            if beyond or fits[-1].statistic > 1.5 * Z95**2:
                break
        return points

    def bound(self, sign: float, begin: Fit | None = None) -> Search[float | None]:
        """Value on one side at which the statistic passes the 95 % level, None for nowhere.

        begin: a fit on that side, below the level, that the search goes on from.
        """
        end = self._end(sign)
        inside = begin or self._at_centre
        outside: Fit | None = None
        fits = [self._at_centre, inside] if begin else [inside]
        if sign * (end - inside.place) <= 0.0:
            return None
        beyond = halve = False
        leap = _LEAP
        for _ in range(_FEW if self.local.explains_little else _REFITS):
            place = self._next(sign, end, inside, outside, halve=halve, leap=leap)
            fit = yield self._wanted(place, fits)
            if fit.alone and fit.statistic <= Z95**2:
                # What lies beyond was of another branch of the valley.
                fits = [each for each in fits if each.statistic <= Z95**2]
                outside, leap = None, _CAREFUL
            fits.append(fit)
            repeated = outside is not None and place == outside.place
            halve, beyond = beyond == (fit.statistic > Z95**2), fit.statistic > Z95**2
            if beyond:
                outside = fit
            else:
                inside, outside = fit, None if repeated else outside
                if place == end:
                    return None
            if outside is not None and (repeated or abs(fit.root - Z95) < _NEAR):
                break
        if outside is None:
            return None
        if not np.isfinite(outside.statistic):
            self.failed = True
            return self.quantity.value(inside.place)
        share = (Z95 - inside.root) / (outside.root - inside.root)
        return self.quantity.value(inside.place + share * (outside.place - inside.place))

    def _next(
        self,
        sign: float,
        end: float,
        inside: Fit,
        outside: Fit | None,
        *,
        halve: bool,
        leap: float,
    ) -> float:
        """The place to fit next on the way to an end, between fits on both sides of the level.

        halve: where a straight root misled, the last two fits are on one side. leap: as of
        ``_LEAP``.
        """
        out = abs(inside.place - self.centre)
        if outside is None:
            # The root of the statistic is nearly straight, if it is felt at all.
            growth = float(np.clip(1.2 * Z95 / max(inside.root, 1e-3), 1.5, leap))
            step = out * growth if out > 0.0 else Z95 * self.unit
            return self.centre + sign * min(step, abs(end - self.centre))
        apart = abs(outside.place - inside.place)
        if apart <= _GAP * (out + apart):
            # A descent from afar may have stopped short: there once more.
            return outside.place
        share = 0.5 if halve else _share(inside, outside)
        return inside.place + share * (outside.place - inside.place)

    def statistic(self, loss: float) -> float:
        """Twice the loss of log-likelihood by a loss of error."""
        return max(0.0, self.factor * loss)

    def as_seen(self, fit: Fit) -> Fit:
        """A fit that was made for another quantity, by this one's place and statistic."""
        return fit._replace(place=self.quantity.at(fit.at), statistic=self.statistic(fit.loss))

    def begun(self, place: float, at: FloatArray) -> Descent:
        """A descent to a place from search coordinates (n_free,), or the nearest possible."""
        space = self.objective.space
        restriction = self.quantity.kept(place, self.stiffness)
        near = np.clip(at, *searched_bounds(space))
        point = Point(np.clip(near, *restriction.bounds(space)))
        return Descent(point, tolerance=self.tolerance, restriction=restriction)

    def is_searched(self, place: float) -> bool:
        """Whether a place is between the ends of what is searched."""
        return self._end(-1.0) <= place <= self._end(1.0)

    def _end(self, sign: float) -> float:
        """The end of the range on one side, or where the search for one ends."""
        farthest = self.centre + sign * _BEYOND * self.quantity.width
        return sign * min(sign * self.quantity.ends[0 if sign < 0.0 else 1], sign * farthest)

    @property
    def _at_centre(self) -> Fit:
        return Fit(self.centre, 0.0, self.start, 0.0)

    def _wanted(self, place: float, fits: Sequence[Fit]) -> Wanted:
        """A fit to a place, from where fits near it lead, and those alone that explain the data."""
        nodes: list[Fit] = []
        for fit in sorted(fits, key=lambda fit: abs(fit.place - place)):
            if np.isfinite(fit.statistic) and fit.place not in [node.place for node in nodes]:
                nodes.append(fit)
        within = [node for node in nodes if node.statistic <= Z95**2]
        # What lies beyond the level may be of another branch, which from there is the nearer one.
        kinds = [nodes] if len(within) in (0, len(nodes)) else [nodes, within]
        return Wanted(place, tuple(self._near(place, nodes) for nodes in kinds))

    def _near(self, place: float, nodes: Sequence[Fit]) -> tuple[FloatArray, ...]:
        """Where one fit leads, the way between two, and three."""
        straight = nodes[0].at + (place - nodes[0].place) * self.direction
        led = [_led(place, nodes[:n]) for n in (2, 3) if len(nodes) >= n]
        return (nodes[0].at, straight, *led)


def searched_bounds(space: SearchSpace) -> tuple[FloatArray, FloatArray]:
    """Search coordinates (n_free,) between which anything is searched.

    An open end is no reason to go where nothing can be simulated.
    """
    (lower, upper), far = space.coded_bounds, _BEYOND * space.width
    farthest = space.coded_lower + space.width + far
    return np.maximum(lower, space.coded_lower - far), np.minimum(upper, farthest)


def _led(place: float, nodes: Sequence[Fit]) -> FloatArray:
    """Search coordinates (n_free,) at a place on the polynomial through those of fits."""
    at = np.zeros_like(nodes[0].at)
    for node in nodes:
        others = [n.place for n in nodes if n is not node]
        at += node.at * np.prod([(place - o) / (node.place - o) for o in others])
    return at


def _share(inside: Fit, outside: Fit) -> float:
    """The part of the way out at which a straight root passes the 95 % level."""
    if not np.isfinite(outside.statistic):
        return 0.5
    return float(np.clip((Z95 - inside.root) / (outside.root - inside.root), 0.1, 0.9))
