"""Intervals of identified parameters, and what the data leave undetermined.

What the equations cannot tell is tied: such parameters get no interval, but the combinations that
the outputs show do. All else has one. Where the slopes at the estimate are a guide it is that of
the covariance; where it would be wide, or reach the end of a range, it is that of the profile
likelihood, which may end on one side only.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.innovations import MISJUDGED, filters
from sysid.fitting.objective import Objective
from sysid.problem.expressions import measuring_effort
from sysid.problem.given import covariance_factor
from sysid.uncertainty.colour import successive_correlation
from sysid.uncertainty.covariance import covariance, larger
from sysid.uncertainty.ends import RangeEnds
from sysid.uncertainty.estimate import Z95, Estimate, Invariant, Why
from sysid.uncertainty.quantities import Coordinate, Expression
from sysid.uncertainty.sensitivity import Sensitivity, bend_errors, has_tangents, sensitivity
from sysid.uncertainty.simulated_ends import SimulatedEnds
from sysid.uncertainty.ties import Ties, change, coded_gradient, named_values, ties
from sysid.uncertainty.tracer import Fit, Tracer
from sysid.uncertainty.walk import Walk, ends_of

# Standard deviation of a logarithm above which the slopes at the estimate are a guide only if
# simulations agree, and above which they are none.
_WIDE, _WEAK = 0.1, 0.3
_AWAY = 0.5  # deviations between an estimate and the minimum that slopes foretell
_SAMPLED = 40  # points of a range at which it is tried whether simulations fail
_DRAWS = 20_000  # of all quantities together
_ALIKE = 0.05  # rivals closer than this are one
_AT_VALUE = 0.01  # of a width of an interval, from its end: its value stands there
_NOT_BY_CHANCE = 3.3  # deviations: one in a thousand
_SIDES = (-1.0, 1.0)
_ROUNDS = 3  # of searches that go on from what others came to
_FAR = 0.1  # of the way to an end, by which such a place is beyond it
_LEAST = 1e-12  # variance, and share of others', of what a covariance holds for known exactly


@dataclass(frozen=True)
class Ambiguity:
    """Parameters of which only combinations act on the outputs.

    kind: ``tied`` by the equations, or ``rival``: they differ between minima that the data do not
    tell apart. determined: the combinations that have an interval. measure: the parameters whose
    measurement by other means would resolve it, as many as there are directions to resolve, what
    is easiest to measure first.
    """

    kind: Literal["tied", "rival"]
    parameters: tuple[str, ...]
    determined: tuple[Estimate, ...]
    measure: tuple[str, ...]


@dataclass(frozen=True)
class Rival:
    """Another minimum that explains the data as well: its free parameters, and their intervals."""

    values: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, repr=False)
class Uncertainty:
    """Intervals of an identified chromosome, and what the data leave undetermined.

    parameters: an estimate for each free parameter (and estimated initial state). covariance:
    (n_free, n_free) of the search coordinates (logarithms where searched so, else the values),
    zero of those without an interval. by_slopes: likewise of all of them, up to the ties, by the
    slopes at the estimate: by how much simulated outputs vary. singular_values: of the sensitivity,
    its columns of length one, falling. rank: how many directions the data determine. rivals: other
    minima that the data do not tell from this one. joint: share of repetitions in which all
    intervals hold at once; simultaneous: factor by which to widen them for that to be 95 %.
    disagreement: variance of the estimates from single logs (or parts of the only one) in parts of
    what their noise makes, 1 where that is chance. factor: (n, n_free), independent changes of the
    parameters, one standard deviation each, and a unit of every tie: what a later stage is
    ``Given``. succession:
    (n_outputs,), correlation of each innovation with the one before where a filter's were
    minimised, which are white at the right parameters of the right model; empty elsewhere. bent:
    likewise, share of the innovations for which its equations are no straight lines within noise.
    moved_by_bends: by how many of the deviations that they had else that moves any of the
    quantities, at most, to first order; 0 where hardly any innovation is bent.
    """

    parameters: tuple[Estimate, ...]
    ambiguities: tuple[Ambiguity, ...]
    covariance: FloatArray
    singular_values: FloatArray
    rank: int
    rivals: tuple[Rival, ...] = ()
    joint: float = 0.95
    simultaneous: float = 1.0
    disagreement: float = 1.0
    factor: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    succession: FloatArray = field(default_factory=lambda: np.zeros(0))
    bent: FloatArray = field(default_factory=lambda: np.zeros(0))
    moved_by_bends: float = 0.0
    by_slopes: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def __repr__(self) -> str:
        single = sum(not estimate.why for estimate in self.parameters)
        combined = len(self.determined()) - single
        shares = f"{single} of {len(self.parameters)} parameters, {combined} combinations"
        return f"<Uncertainty: intervals of {shares}; rank {self.rank}>"

    def correlation(self) -> FloatArray:
        """Correlation of the free parameters, NaN where there is no variance."""
        deviation = np.sqrt(np.diag(self.covariance))
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation: FloatArray = self.covariance / np.outer(deviation, deviation)
        return correlation

    def of(self, places: Sequence[int], names: Sequence[str]) -> Self:
        """The same of some of the coordinates, under other names; none of what others are in."""
        renamed = {
            self.parameters[place].name: name for place, name in zip(places, names, strict=True)
        }
        left_out = {p.name for p in self.parameters} - {*renamed}
        return replace(
            self,
            parameters=tuple(
                replace(self.parameters[j], name=renamed[self.parameters[j].name]) for j in places
            ),
            ambiguities=tuple(
                replace(
                    a,
                    parameters=tuple(renamed[n] for n in a.parameters if n in renamed),
                    determined=tuple(
                        e
                        for e in a.determined
                        if e.combination is None or left_out.isdisjoint(e.combination.names)
                    ),
                    measure=tuple(renamed[n] for n in a.measure if n in renamed),
                )
                for a in self.ambiguities
            ),
            covariance=self.covariance[np.ix_(places, places)],
            rivals=tuple(
                Rival(
                    {renamed[n]: value for n, value in rival.values.items() if n in renamed},
                    {renamed[n]: ends for n, ends in rival.intervals.items() if n in renamed},
                )
                for rival in self.rivals
            ),
            factor=self.factor[:, places] if self.factor.size else self.factor,
            by_slopes=self.by_slopes[np.ix_(places, places)],
        )

    def determined(self) -> tuple[Estimate, ...]:
        """All quantities with an interval: parameters, then combinations."""
        combined = itertools.chain(*(a.determined for a in self.ambiguities))
        return tuple(e for e in (*self.parameters, *combined) if not e.why)


def uncertainty(
    objective: Objective,
    chromosome: FloatArray,
    rivals: Sequence[FloatArray] = (),
    ridge: Sequence[FloatArray] = (),
    structure: Ties | None = None,
    profiled: Sequence[int] | None = None,
) -> Uncertainty:
    """Intervals, ambiguities and what is determined at an identified chromosome, (n_free,).

    The estimate is taken as the minimum of the objective; the colour of its residuals and the
    records' zero errors enter the covariance. rivals: other minima that explain the data as well.
    ridge: further points of the valley that the chromosome lies in. structure: what the equations
    leave undetermined, by default what the model's do. profiled: coordinates whose intervals are
    asked for: of the others no profiles are traced, nor of what they are in; default all.
    """
    local = sensitivity(objective, chromosome)
    analysis = _Analysis(local, structure or ties(local), ridge)
    names = objective.space.names
    hidden = {n for j, n in enumerate(names) if profiled is not None and j not in profiled}
    drafts = [analysis.parameter(j) for j in range(len(chromosome))]
    tied = list(analysis.ambiguities())
    combined = [analysis.combination(c) for _, combinations in tied for c in combinations]
    drafted = [
        replace(draft, tracer=None) if draft.estimate.is_of(hidden) else draft
        for draft in (*drafts, *combined)
    ]
    doubted = analysis.doubted(drafted)
    if doubted.any() and objective.free_run is objective and not objective.exact_slopes:
        # Differences may have been too far for a valley so narrow.
        exact = objective.with_exact_slopes()
        if has_tangents(exact, chromosome):
            return uncertainty(exact, chromosome, rivals, ridge, structure, profiled)
    bottoms = [_Analysis(sensitivity(objective, point), analysis.ties) for point in ridge]
    others = list(analysis.unlike(rivals))
    # A descent to a rival may have stopped short, by less than what is left open there.
    apart = [_Analysis(sensitivity(objective, r), analysis.ties, away=Z95) for r in others]
    minima = [rival.as_rival() for rival in apart]

    def judged(estimate: Estimate) -> Estimate:
        if estimate.why or not any(estimate.excludes(rival.named) for rival in apart):
            return estimate
        if all(_overlap(estimate, rival.by_slopes(estimate)) for rival in apart):
            return _with_bottoms(estimate, apart)
        return replace(estimate, why="rival")

    confirmed = analysis.confirmed(drafted, doubted)
    settled = analysis.opened(analysis.settled(confirmed))
    harmless = analysis.harmless_ends(settled, profiled)
    whole = (_with_bottoms(estimate, bottoms) for estimate in settled)
    estimates = iter(map(judged, whole))
    parameters = [
        replace(estimate, harmless=is_harmless)
        for estimate, is_harmless in zip(
            itertools.islice(estimates, len(drafts)), harmless.tolist(), strict=True
        )
    ]
    ambiguities = [
        replace(ambiguity, determined=tuple(itertools.islice(estimates, len(combinations))))
        for ambiguity, combinations in tied
    ]
    disputed = [e for e in parameters if e.why == "rival"]
    disputed.sort(key=lambda e: measuring_effort(e.unit))
    if disputed:
        names = tuple(e.name for e in disputed)
        ambiguities.insert(0, Ambiguity("rival", names, (), names[:1]))
    spread = analysis.covariance.spread
    result = Uncertainty(
        tuple(parameters),
        tuple(ambiguities),
        analysis.reported_covariance(parameters),
        analysis.covariance.singular_values,
        analysis.covariance.rank,
        _told_apart(minima, disputed),
        disagreement=spread.disagreement if spread else 1.0,
        factor=analysis.factor(
            others, itertools.chain(parameters, *(a.determined for a in ambiguities)), bottoms
        ),
        succession=_succession(local),
        bent=_bent(local),
        by_slopes=analysis.covariance.matrix,
    )
    intervals = [e.name for e in result.determined() if not e.is_of(hidden)]
    joint, simultaneous = analysis.together(intervals)
    moved = analysis.moved_by_bends(intervals) if np.any(result.bent > MISJUDGED) else 0.0
    return replace(result, joint=joint, simultaneous=simultaneous, moved_by_bends=moved)


def _ends_at_value(estimate: Estimate) -> bool:
    """Whether a traced interval of two ends has its value at one of them."""
    if estimate.std is not None or estimate.low is None or estimate.high is None:
        return False
    beside = min(estimate.high - estimate.value, estimate.value - estimate.low)
    return beside < _AT_VALUE * (estimate.high - estimate.low)


def _told_apart(minima: Sequence[Rival], disputed: Sequence[Estimate]) -> tuple[Rival, ...]:
    """Rivals that dispute an estimate; of those within all disputed intervals of one the first."""
    kept: list[Rival] = []
    for rival in minima:
        if any(estimate.excludes(rival.values) for estimate in disputed) and not any(
            all(
                first.intervals[e.name][0] <= rival.values[e.name] <= first.intervals[e.name][1]
                for e in disputed
                if e.name in first.intervals
            )
            for first in kept
        ):
            kept.append(rival)
    return tuple(kept)


def _with_bottoms(estimate: Estimate, bottoms: Sequence["_Analysis"]) -> Estimate:
    """The hull of an interval and those by the slopes at further bottoms of its valley.

    Twice the log-likelihood of the bottom that the truth lies in is not always within 3.84 of the
    best one's; how far it may be within its own is told there.
    """
    if estimate.why or estimate.low is None or estimate.high is None:
        return estimate
    each = [e for e in (bottom.by_slopes(estimate) for bottom in bottoms) if e.std is not None]
    low = min([estimate.low, *(e.low for e in each if e.low is not None)])
    high = max([estimate.high, *(e.high for e in each if e.high is not None)])
    most = _FAR * (estimate.high - estimate.low)
    if estimate.low - low <= most and high - estimate.high <= most:
        return estimate
    return replace(estimate, std=None, low=low, high=high)


def _overlap(estimate: Estimate, rival: Estimate) -> bool:
    """Whether an interval has values in common with that around another minimum."""
    if rival.std is None or rival.low is None or rival.high is None:
        return False
    below = estimate.high is not None and estimate.high < rival.low
    return not below and (estimate.low is None or rival.high >= estimate.low)


def determined_rank(objective: Objective, chromosome: FloatArray) -> int:
    """As ``rank`` of the ``uncertainty``, without the intervals, whose profiles cost most of it."""
    local = sensitivity(objective, chromosome)
    return _Analysis(local, ties(local)).covariance.rank


def _succession(local: Sensitivity) -> FloatArray:
    criterion = local.criterion
    if filters(criterion):
        return successive_correlation(local.residual, local.seen, local.lengths)
    return np.zeros(0)


def _bent(local: Sensitivity) -> FloatArray:
    criterion = local.criterion
    if filters(criterion):
        return criterion.share_bent(local.bends)
    return np.zeros(0)


@dataclass(frozen=True)
class _Draft:
    """An estimate; without a deviation, unless it is tied, one whose ends its profile tells.

    traced: whether they are that profile's. wide: whether slopes are a guide only if simulations
    agree. place: of a parameter, a part of whose range may be one where simulations fail.
    """

    estimate: Estimate
    tracer: Tracer | None = None
    place: int | None = None
    traced: bool = False
    wide: bool = False

    @property
    def interval(self) -> tuple[float, float] | None:
        """Its two ends, where it has them."""
        low, high = self.estimate.low, self.estimate.high
        return None if low is None or high is None else (low, high)

    def without_interval(self) -> Self:
        """The same, of which slopes tell nothing."""
        return replace(self, estimate=replace(self.estimate, std=None, low=None, high=None))

    def as_traced(self) -> Self:
        """The same, its ends those of its profile."""
        return replace(self, estimate=replace(self.estimate, std=None), traced=True)

    def searches(self, fits: Sequence[Fit]) -> dict[float, Fit | None]:
        """Sides on which the profile is to be searched, and the fits to go on from."""
        if self.tracer is None:
            return {}
        if self.estimate.std is None and not self.traced:
            return dict.fromkeys(_SIDES)
        far = {sign: self.farthest(fits, sign, _FAR) for sign in _SIDES}
        if self.traced or not any(far.values()):
            return {sign: fit for sign, fit in far.items() if fit is not None}
        return far

    def farthest(self, fits: Sequence[Fit], sign: float, part: float = 0.0) -> Fit | None:
        """Of fits that explain the data the farthest beyond an end, by a part of the way there."""
        end = self.estimate.low if sign < 0.0 else self.estimate.high
        if self.tracer is None or end is None:
            return None
        edge = end + part * (end - self.estimate.value)
        there = [fit for fit in map(self.tracer.as_seen, fits) if fit.statistic <= Z95**2]
        value = self.tracer.quantity.value
        beyond = [fit for fit in there if sign * (value(fit.place) - edge) > 0.0]
        return max(beyond, key=lambda fit: sign * fit.place, default=None)

    def with_end(self, sign: float, end: float | None) -> Self:
        """The same with an end of its profile."""
        estimate = replace(self.estimate, std=None)
        estimate = replace(estimate, low=end) if sign < 0.0 else replace(estimate, high=end)
        return replace(self, estimate=estimate, traced=True)


class _Analysis:
    """Estimates and ambiguities: by the covariance, or where that is no guide by profiles.

    away: deviations between an estimate and the minimum that slopes foretell, from where they are
    no guide.
    """

    def __init__(
        self,
        local: Sensitivity,
        structure: Ties,
        ridge: Sequence[FloatArray] = (),
        away: float = _AWAY,
    ) -> None:
        self.local, self.ties, self.away = local, structure, away
        self.objective, self.space = local.objective, local.objective.space
        self.chromosome, self.coded = local.chromosome, self.space.encode(local.chromosome)
        self.ridge = [Fit(0.0, 0.0, self.space.encode(point), 0.0) for point in ridge]
        self.named = named_values(self.space, self.chromosome)
        self.on_bound = self.space.on_bound(self.chromosome)
        self.free = covariance(local, structure.directions)
        self.pushed = self._pushed_by(Z95)
        self.covariance = self.free
        if self.pushed.any():
            simulated = self.free.simulated
            self.covariance = covariance(local, structure.directions, self.pushed, simulated)
        self.gradients: dict[str, FloatArray] = {}
        self.combined: dict[str, Invariant] = {}
        self.alike: list[FloatArray] = []

    def factor(
        self,
        rivals: Sequence[FloatArray],
        estimates: Iterable[Estimate],
        bottoms: Sequence["_Analysis"],
    ) -> FloatArray:
        """As of ``Uncertainty``; bottoms: further ones of the valley."""
        points = [*self.alike, *map(self.space.encode, rivals)]
        matrix = self.covariance.matrix
        for bottom in bottoms:
            away = (bottom.coded - self.coded) / Z95
            matrix = larger(matrix, bottom.covariance.matrix + np.outer(away, away))
        matrix = self._as_wide_as(
            matrix, points, [e for e in estimates if e.name in self.gradients]
        )
        return covariance_factor(matrix, self.ties.directions, self.local.increments)

    def _as_wide_as(
        self, matrix: FloatArray, points: Sequence[FloatArray], estimates: Sequence[Estimate]
    ) -> FloatArray:
        """Covariance (n_free, n_free) that reaches as far as intervals do, neither less nor more.

        matrix: by slopes. points: search coordinates (n_free,) that explain the data. Where slopes
        hardly feel a quantity they reach beyond its interval: all else is kept as it is at each of
        its values. Where they feel one of which a profile is all that is known, as of a valley
        beyond where it bends or ends, they are widened along the way to each point by the least
        that does. Others stay as well known as they are.
        """
        for estimate in estimates:
            gradient, widest = self.gradients[estimate.name], self._widest(estimate)
            along = matrix @ gradient
            variance = float(gradient @ along)
            if variance > widest**2:
                change = (widest**2 / variance - 1.0) / variance
                matrix = matrix + np.outer(along, along) * change
        rows = np.reshape([*self.gradients.values()], (len(self.gradients), len(self.coded)))
        back = np.linalg.pinv(rows)  # of what moves with nothing but ties the least
        profiled = [e.name for e in estimates if e.std is None or e.why]
        moving = np.isin([*self.gradients], profiled)
        changes = [moving * c for c in map(self._changes, points) if np.isfinite(c).all()]
        while changes:
            joint = rows @ matrix @ rows.T
            size = np.sqrt(np.maximum(np.diag(joint), _LEAST))
            precision = np.linalg.pinv(
                joint / np.outer(size, size) + _LEAST * np.eye(len(size)), hermitian=True
            )
            far = [float(c / size @ precision @ (c / size)) for c in changes]
            place = int(np.argmax(far))
            if far[place] <= Z95**2:
                break
            along = back @ changes.pop(place)
            matrix = matrix + np.outer(along, along) * (1.0 / Z95**2 - 1.0 / far[place])
        return matrix

    def _widest(self, estimate: Estimate) -> float:
        """Deviation of which the farther end of an interval is one of 95 %, in parts of slopes.

        Where there is no end, that of the range.
        """
        ends = estimate.low, estimate.high
        if estimate.combination is None:
            place = self.space.names.index(estimate.name)
            bounds = [float(bound[place]) for bound in self.space.coded_bounds]
            at = float(self.coded[place])
            there = [
                bound if end is None else float(np.log(end)) if self.space.log[place] else end
                for end, bound in zip(ends, bounds, strict=True)
            ]
            return max(abs(end - at) for end in there) / Z95
        ranges = Expression(self.space, self.combined[estimate.name], log=False).ends
        there = [bound if end is None else end for end, bound in zip(ends, ranges, strict=True)]
        return max(abs(end - estimate.value) for end in there) / Z95

    def _changes(self, point: FloatArray) -> FloatArray:
        """How far quantities are at search coordinates from the estimate, in parts of slopes."""
        there, changes = named_values(self.space, self.space.decode(point)), []
        for name in self.gradients:
            combination = self.combined.get(name)
            if combination is None:
                place = self.space.names.index(name)
                changes.append(point[place] - self.coded[place])
                continue
            changes.append(change(combination, self.named, there))
        return np.array(changes)

    def parameter(self, j: int) -> _Draft:
        """Estimate of a free parameter."""
        parameter, gradient = self.space.parameters[j], np.eye(len(self.coded))[j]
        estimate = Estimate(
            parameter.name,
            parameter.unit,
            float(self.chromosome[j]),
            on_bound=bool(self.on_bound[j]),
            pushed=bool(self.pushed[j]),
        )
        if self.ties.bound[j]:
            return _Draft(replace(estimate, why="tied"))
        self.gradients[parameter.name] = gradient
        deviation = self.covariance.deviation(gradient)
        spread = self.free if self.pushed[j] else self.covariance
        tracer = Tracer(self.local, spread, gradient, Coordinate(self.space, j))
        if not self._is_guide(j, deviation):
            return _Draft(estimate, tracer, j)
        low, high = (self._decoded(j, self.coded[j] + sign * Z95 * deviation) for sign in _SIDES)
        std = deviation * abs(float(self.local.increments[j]))
        wide = bool(self.space.log[j] and deviation >= _WIDE)
        return _Draft(replace(estimate, std=std, low=low, high=high), tracer, j, wide=wide)

    def by_slopes(self, estimate: Estimate) -> Estimate:
        """A quantity's estimate here; without a deviation where slopes alone are no guide."""
        if estimate.combination is not None:
            draft = self.combination(estimate.combination)
        else:
            draft = self.parameter(self.space.names.index(estimate.name))
        return draft.without_interval().estimate if draft.wide else draft.estimate

    def ambiguities(self) -> Iterator[tuple[Ambiguity, list[Invariant]]]:
        """Parameters that hang together by the equations, and the combinations that do not."""
        for places, directions in self.ties.groups():
            units = [parameter.unit for parameter in self.space.parameters]
            by_effort = sorted(places, key=lambda j: measuring_effort(units[j]))
            measure: list[int] = []
            for j in by_effort:
                columns = directions[:, [*measure, j]]
                if np.linalg.matrix_rank(columns / np.abs(columns).max(axis=0)) > len(measure):
                    measure.append(j)
            names = {self.space.names[j] for j in places}
            combinations = [c for c in self.ties.combinations if names & {*c.names}]
            parameters, measured = (
                tuple(self.space.names[j] for j in chosen) for chosen in (by_effort, measure)
            )
            yield Ambiguity("tied", parameters, (), measured), combinations

    def unlike(self, chromosomes: Sequence[FloatArray]) -> list[FloatArray]:
        """Those that differ in what is not tied, of each kind the first."""
        free = ~np.array(self.ties.bound, dtype=bool)
        kept: list[FloatArray] = []
        for chromosome in chromosomes:
            alike = (np.allclose(chromosome[free], c[free], rtol=_ALIKE) for c in kept)
            if not any(alike):
                kept.append(chromosome)
        return kept

    def as_rival(self) -> Rival:
        """This minimum as another, with intervals by the covariance here."""
        intervals = {}
        for j, name in enumerate(self.space.names):
            deviation = self.free.deviation(np.eye(len(self.coded))[j])
            if not self.ties.bound[j] and np.isfinite(deviation):
                ends = [float(self.coded[j]) + sign * Z95 * deviation for sign in _SIDES]
                low, high = np.clip(ends, *(bounds[j] for bounds in self.space.coded_bounds))
                intervals[name] = self._decoded(j, low), self._decoded(j, high)
        return Rival(dict(zip(self.space.names, self.chromosome.tolist(), strict=True)), intervals)

    def reported_covariance(self, parameters: Sequence[Estimate]) -> FloatArray:
        """Covariance (n_free, n_free) of the parameters that have an interval, else zero."""
        matrix = self.covariance.matrix
        deviations = np.array(
            [0.0 if e.why else self.covariance.deviation(g)
             for e, g in zip(parameters, np.eye(len(matrix)), strict=True)]
        )  # fmt: skip
        plain = np.sqrt(np.diag(matrix))
        usable = np.isfinite(deviations) & (plain > 0.0)
        widening = np.divide(deviations, plain, out=np.zeros_like(plain), where=usable)
        return matrix * np.outer(widening, widening)

    def together(self, names: Sequence[str]) -> tuple[float, float]:
        """Share of repetitions in which all these intervals hold, and how to make it 95 %."""
        values, axes = np.linalg.eigh(self.covariance.matrix)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        gradients = [self.gradients[name] for name in names]
        rows = np.reshape(gradients, (len(names), len(self.coded))) @ root
        lengths = np.linalg.norm(rows, axis=1, keepdims=True)
        correlated = np.isfinite(lengths[:, 0]) & (lengths[:, 0] > 0.0)
        rng = np.random.default_rng(0)
        common = (
            rng.standard_normal((_DRAWS, rows.shape[1]))
            @ (rows[correlated] / lengths[correlated]).T
        )
        alone = rng.standard_normal((_DRAWS, int((~correlated).sum())))
        largest = np.abs(np.concatenate([common, alone], axis=1)).max(axis=1, initial=0.0)
        joint, widest = float(np.mean(largest <= Z95)), float(np.quantile(largest, 0.95))
        return joint, max(widest / Z95, 1.0)

    def moved_by_bends(self, names: Sequence[str]) -> float:
        """Deviations that any of the quantities is moved by, at most, where noise bends equations.

        To first order; infinite where a simulation fails under that noise.
        """
        local = self.local
        if not np.isfinite(local.bends[:, local.seen]).all():
            return float("inf")
        weight = self.objective.least_squares_weights(local.residual)
        pushes = [np.einsum("tip,ti,i->p", local.slopes, c, weight) for c in bend_errors(local)]
        moves = self.covariance.curvature @ np.sum(pushes, axis=0)
        most = 0.0
        for gradient in (self.gradients[name] for name in names):
            move, deviation = abs(float(gradient @ moves)), self.covariance.deviation(gradient)
            without = np.sqrt(max(deviation**2 - move**2, _LEAST * deviation**2))  # it counts
            most = max(most, move / without if without > 0.0 else 0.0)
        return most

    def _pushed_by(self, deviations: float) -> BoolArray:
        """Parameters, (n_free,), that data push so many deviations beyond an end of a range."""
        outwards = self._outwards(self.free.newton_step)
        each = np.array([self.free.deviation(g) for g in np.eye(len(outwards))])
        free = ~np.array(self.ties.bound, dtype=bool)
        pushed: BoolArray = self.on_bound & free & (outwards > deviations * each)
        return pushed

    def opened(self, estimates: Sequence[Estimate]) -> Sequence[Estimate]:
        """Estimates without the ends of profiles that are those of ranges."""
        if not (self.on_bound & ~self.pushed).any():
            return estimates
        return self._range_ends.opened(self.covariance, estimates)

    def harmless_ends(
        self, estimates: Sequence[Estimate], places: Sequence[int] | None
    ) -> BoolArray:
        """Parameters, (n_free,), on an end of their range that decides nothing.

        Nor do all such ends together. By chance data may push a friction that is next to nothing
        below nothing. Where an interval ends at its value it is an end of a range that ends it.
        places: of those for which that is asked, default all.
        """
        candidates = self.on_bound & ~self._pushed_by(_NOT_BY_CHANCE)
        bound = set(itertools.compress(self.space.names, self.on_bound.tolist()))
        if any(_ends_at_value(e) for e in estimates if not e.is_of(bound)):
            return np.zeros(len(candidates), dtype=bool)
        if places is not None:
            candidates &= np.isin(np.arange(len(candidates)), places)
        harmless = np.zeros(len(candidates), dtype=bool)
        harmless[self._range_ends.harmless(np.flatnonzero(candidates).tolist(), estimates)] = True
        return harmless

    @cached_property
    def _range_ends(self) -> RangeEnds:
        deviations = {name: self.covariance.deviation(g) for name, g in self.gradients.items()}

        def changes(point: FloatArray) -> dict[str, float]:
            return dict(zip(self.gradients, self._changes(point).tolist(), strict=True))

        return RangeEnds(self.local, self.free, self.on_bound, changes, deviations)

    def _is_guide(self, j: int, deviation: float) -> bool:
        """Whether the slopes at the estimate tell how far a parameter may be from it."""
        low, high = (self.coded[j] + sign * Z95 * deviation for sign in _SIDES)
        lower, upper = (float(bounds[j]) for bounds in self.space.coded_bounds)
        inside = lower < low and high < upper
        narrow = deviation < _WEAK if self.space.log[j] else True
        settled = self._arrived(np.eye(len(self.coded))[j], deviation)
        return inside and narrow and settled and not self.local.failing[j]

    def _arrived(self, gradient: FloatArray, deviation: float) -> bool:
        """Whether the slopes have their minimum near the estimate, seen along a quantity.

        A descent in a bent valley may stop away from it. What an end of a range holds stays there.
        """
        step, curvature = self.covariance.newton_step, self.covariance.curvature
        held = np.flatnonzero(self.on_bound & (self._outwards(step) > 0.0))
        follows = curvature[:, held] @ np.linalg.pinv(curvature[np.ix_(held, held)])
        return bool(abs(gradient @ (step - follows @ step[held])) < self.away * deviation)

    def _outwards(self, step: FloatArray) -> FloatArray:
        """A step's parts towards the nearer end of each range, (n_free,)."""
        lower, upper = self.space.coded_bounds
        parts: FloatArray = np.where(self.coded - lower < upper - self.coded, -step, step)
        return parts

    def combination(self, combination: Invariant) -> _Draft:
        """Estimate of a combination of tied parameters."""
        text, value = combination.text, float(combination.value(self.named))
        estimate = Estimate(text, combination.unit, value, combination=combination)
        gradient = coded_gradient(combination, self.space, self.chromosome)
        self.gradients[text], self.combined[text] = gradient, combination
        deviation = self.covariance.deviation(gradient)
        positive = bool(np.all(self.space.log[gradient != 0.0])) and value > 0.0
        moved = gradient / value if positive else gradient
        quantity = Expression(self.space, combination, positive)
        if self._wanted_beyond(combination, moved):
            return _Draft(replace(estimate, why="end"))
        tracer = Tracer(self.local, self.covariance, moved, quantity)
        narrow = np.isfinite(deviation) and (not positive or deviation < _WEAK * value)
        if not (narrow and self._arrived(gradient, deviation)):
            return _Draft(estimate, tracer)
        product = " + " not in text and " - " not in text
        if product and deviation < _WEAK * abs(value):
            low, high = sorted(value * np.exp(sign * Z95 * deviation / value) for sign in _SIDES)
        else:
            low, high = (value + sign * Z95 * deviation for sign in _SIDES)
        estimate = replace(estimate, std=deviation, low=float(low), high=float(high))
        return _Draft(estimate, tracer, wide=positive and deviation >= _WIDE * value)

    def _wanted_beyond(self, combination: Invariant, gradient: FloatArray) -> bool:
        """Whether the data push what changes so (n_free,) beyond what ranges of its members allow.

        Of a parameter its one end tells that, and that it stands there; of a combination nothing.
        """
        members = np.isin(self.space.names, combination.names)
        if not self.on_bound[members].any():
            return False
        step, deviation = gradient @ self.free.newton_step, self.free.deviation(gradient)
        return bool(abs(step) > Z95 * deviation)

    def doubted(self, drafts: Sequence[_Draft]) -> BoolArray:
        """Which drafts' intervals, (n,), simulations refuse at the ends that slopes tell."""
        narrow = ((i, d) for i, d in enumerate(drafts) if d.estimate.std and not d.wide)
        tracers = {i: draft.tracer for i, draft in narrow if draft.tracer}
        doubted = np.zeros(len(drafts), dtype=bool)
        doubted[[*tracers]] = ~np.array(self._ends.as_foretold([*tracers.values()]), dtype=bool)
        return doubted

    def confirmed(self, drafts: Sequence[_Draft], doubted: BoolArray) -> list[_Draft]:
        """Drafts without intervals that slopes tell and profiles would not.

        Of what is doubted, and of what is so wide that slopes alone are no guide; what is kept of
        the latter counts as its profile's.
        """
        intervals = {
            i: (draft.tracer, draft.interval)
            for i, draft in enumerate(drafts)
            if draft.tracer and draft.interval and (doubted[i] or draft.wide)
        }
        kept = self._ends.at_the_level([*intervals.values()])
        refused = {i for i, is_kept in zip(intervals, kept, strict=True) if not is_kept}
        return [
            d.without_interval() if i in refused else d.as_traced() if d.wide else d
            for i, d in enumerate(drafts)
        ]

    @cached_property
    def _ends(self) -> SimulatedEnds:
        return SimulatedEnds(self.local, self.covariance, self.on_bound)

    def settled(self, drafts: Sequence[_Draft]) -> list[Estimate]:
        """Estimates with the ends that profiles tell.

        What explains the data is in every interval, whatever it was fitted for. Where a valley
        bends the profile of one quantity so comes to places to which the slopes of another do not
        lead, or before which its valley turns back; from there the search for its end goes on.
        """
        drafts, fits = list(drafts), list(self.ridge)
        for _ in range(_ROUNDS):
            searches = [
                (k, tracer, sign, begin)
                for k, draft in enumerate(drafts)
                if (tracer := draft.tracer)
                for sign, begin in draft.searches(fits).items()
            ]
            if not searches:
                break
            ends = ends_of([Walk.begun(t, sign, begin) for _, t, sign, begin in searches], fits)
            for (k, _, sign, _), end in zip(searches, ends, strict=True):
                drafts[k] = drafts[k].with_end(sign, end)
        self.alike = [fit.at for fit in fits if fit.statistic <= Z95**2]
        return [self._profiled(draft, fits) if draft.traced else draft.estimate for draft in drafts]

    def _profiled(self, draft: _Draft, fits: Sequence[Fit]) -> Estimate:
        assert draft.tracer is not None
        low, high = (
            end if fit is None else draft.tracer.quantity.value(fit.place)
            for end, fit in (
                (draft.estimate.low, draft.farthest(fits, -1.0)),
                (draft.estimate.high, draft.farthest(fits, 1.0)),
            )
        )
        why: Why = "vague" if low is None and high is None else ""
        estimate = replace(draft.estimate, low=low, high=high, why=why)
        if draft.place is not None and (draft.tracer.failed or self.local.failing[draft.place]):
            return replace(estimate, failing=self._failing(draft.place))
        return estimate

    def _failing(self, place: int) -> float:
        """Share of a parameter's range in which the model cannot be simulated."""
        lower, width = self.space.coded_lower[place], self.space.width[place]
        trial = np.repeat(self.coded[None], _SAMPLED, axis=0)
        trial[:, place] = lower + width * (np.arange(_SAMPLED) + 0.5) / _SAMPLED
        errors, _ = self.objective.evaluate(self.space.decode(trial))
        return float(np.mean(~np.isfinite(errors)))

    def _decoded(self, place: int, coordinate: float) -> float:
        """The value of a parameter at a coordinate."""
        return float(np.exp(coordinate)) if self.space.log[place] else float(coordinate)
