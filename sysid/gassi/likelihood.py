"""The last step of an identification: which minimum, by which weights.

The mean of the outputs' RMSEs serves the search. It is not the figure to end with: it lets an
output that is noisy, or whose errors wander slowly, decide what another with small white errors
could tell better. The likelihood of independent normal errors whose variances are unknown has its
maximum where the product of the RMSEs is least (Ljung, "System Identification", section 7.4, with
a diagonal covariance): every output then weighs by the inverse of its own error. Among minima the
likelihood chooses once more, each output counted by as many independent samples as the colour of
its errors leaves; those that it cannot tell apart are rivals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.descent import TOLERANCE, Point
from sysid.fitting.free_run import accurate, fine_enough, noiseless
from sysid.fitting.innovations import Innovations, filters
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import MOST_ITERATIONS, Refinement, begin, refine, refine_each
from sysid.gassi.excerpt import Excerpt
from sysid.gassi.filter_search import SAMPLES, better_by_filter
from sysid.gassi.lookalikes import hardly_felt, lookalikes
from sysid.gassi.noise_fit import NoiseFit, foresees_more, too_well
from sysid.gassi.optima import (
    LEAST_SHARE,
    QUICKLY,
    ROUGHLY,
    TOLD_APART,
    Optima,
    Optimum,
    bounded,
    chromosomes_of,
    to_compare,
)
from sysid.gassi.slide import centred, slid
from sysid.problem.earlier_minima import EarlierMinima

_ROUNDS = 6  # of weights and parameters in turn
_STEADY = 1e-3  # share by which weights may still change
# Deviance above which a further bottom of one valley does not count, where chance has but one
# direction: which of two is the deeper varies by twice the root of how far apart they are, more
# than within either.
_ALIKE = 6.63
_CONCEIVABLE = 40.0  # the same of a minimum that has not been refined to its end
_MOVING = 2.0  # deviations that errors of the integration may make on an excerpt
_AT_ONCE = 8  # descents side by side, which later ones need not repeat
_EXPLORED = 2  # minima whose lookalikes are descended from
# Minima whose lookalikes are descended from by the last weights, and the best ends of each.
_SHARP_ROUNDS, _SHARP_ENDS = 4, 3
_EXPLORED_BY_FILTER = 5  # the same by a filter
_SHARPER = (1e-4, 1e-6)  # shares of the largest error that each counts for, one after another
_BY_FAR = 1e-3  # share of another's error, by which an output alone tells where minima are
_NOISE = 1e-2  # of its largest value, from which what an output errs by is taken for noise
_BETTER = 1.0  # deviance by which one of them has to be better than the one before
_COMPARED = 0.05  # deviance to which minima are compared: what decides is hundreds of times that

Watch = Callable[[Point], None]
# Whether a chromosome (n_free,) is far from minima, and others.
_New = Callable[[FloatArray, Sequence[FloatArray]], bool]
NoisyInputs = Literal["compensated", "innovations"]


@dataclass(frozen=True)
class Likeliest:
    """The likeliest minimum, and others that the data do not tell from it, (n_free,) each.

    rivals: minima apart from it. ridge: further bottoms of the valley in which it lies.
    """

    optimum: Optimum
    rivals: tuple[FloatArray, ...]
    ridge: tuple[FloatArray, ...]


@dataclass(frozen=True)
class Begun:
    """Where a fit of some of the records has ended, as a fit of all of them begins there.

    chromosomes: (n_free,) each, the best first. noise: (n_outputs,), by which a filter judged them.
    is_settled: whether the first was told from all others.
    """

    chromosomes: Sequence[FloatArray] = ()
    noise: FloatArray | None = None
    is_settled: bool = False

    @classmethod
    def of(
        cls, earlier: EarlierMinima | None, objective: Objective, chromosomes: Sequence[FloatArray]
    ) -> Begun:
        """Of minima the parameters alone, of each (n,), which the objective may be simulated at."""
        if earlier is None:
            return cls()
        started = [objective.space.with_nominal_starts(each) for each in chromosomes]
        kept = [each for each in started if np.isfinite(objective.rms(each[None])).all()]
        outputs = objective.simulator.model.output_names
        noise = None
        if all(name in earlier.noise for name in outputs):
            noise = np.array([earlier.noise[name] for name in outputs])
        return cls(kept, noise, earlier.is_settled)


def fit_likelihood(
    objective: Objective,
    minima: Sequence[FloatArray],
    watch: Watch | None = None,
    *,
    noise: NoisyInputs | None = None,
    process: FloatArray | None = None,
    begun: Begun | None = None,
    explored: bool = False,
) -> Likeliest:
    """The likeliest of some minima (n_free,) of the mean RMSE and of their lookalikes.

    noise: how all of them are refitted in the end, where inputs or the process are noisy; by
    innovations, too, where free runs would not do. process: as of ``Innovations``. begun: where
    descents begin as well; if it is settled nothing looks like the minima. explored: whether these
    have their lookalikes among them.
    """
    objective, begun = accurate(objective, minima[0]), begun or Begun()
    # A filter begins at the minima of free runs, and does not end there; what looks like a minimum
    # it tells itself.
    roughly = noise == "innovations"
    lookalike = not (explored or begun.is_settled or roughly)
    minima = minima if roughly else [*minima, *begun.chromosomes]
    beside = not (begun.is_settled or roughly)
    optima = _explored(
        objective, minima, watch, lookalike=lookalike, beside=beside, roughly=roughly,
        sharpens=noise is None,
    )  # fmt: skip
    if not roughly:
        objective, optima = _in_noise(objective, optima, watch)
    if noise is None:
        optima = _sharpened(objective, optima, watch)
    best, *others = optima.ranked()
    refitted = None
    if noise is not None:
        for corrects in (False, True) if noise == "compensated" else (True,):
            fit = NoiseFit(objective, best.objective, corrects, process, watch)
            refitted = refitted or _refitted(fit, [best, *others], optima, begun)
    if refitted is not None:
        optima = refitted
        best, *others = optima.ranked()
    rivals = [optimum for optimum in others if optima.deviance(optimum, best) < TOLD_APART]
    connected = optima.connected(best, rivals)
    apart = list(itertools.compress(rivals, np.logical_not(connected)))
    valley = itertools.compress(rivals, connected)
    ridge = [rival for rival in valley if optima.deviance(rival, best) < _ALIKE]
    return Likeliest(_slid(_resting(best)), chromosomes_of(apart), chromosomes_of(ridge))


def _resting(best: Optimum) -> Optimum:
    """The minimum of a filter with as many steps as an answer wants, and by what bends there."""
    fitted = best.objective
    if not filters(fitted):
        return best
    finer = fitted.exactly(best.chromosome)
    if finer.coarseness == fitted.coarseness and not fitted.doubts:
        return best
    settled = finer.renewed(best.chromosome)
    end = refine(settled, best.chromosome)
    return Optimum.of(settled, end.chromosome, end.rms)


def promising(
    objective: Objective,
    minima: Sequence[FloatArray],
    watch: Watch | None = None,
    *,
    most: int,
    lookalike: bool = True,
    sharpens: bool = False,
) -> list[FloatArray]:
    """Of some minima (n_free,), and perhaps their lookalikes, those that more data may favour.

    The best first; where they are is known roughly, for they are meant to be fitted to their end,
    as many as that is affordable for. sharpens: as of ``_explored``.
    """
    optima = _explored(
        objective, minima, watch, lookalike=lookalike, roughly=True, sharpens=sharpens
    )
    best, *others = optima.ranked()
    near = [rival for rival in others if optima.deviance(rival, best) < TOLD_APART]
    return [optimum.chromosome for optimum in (best, *near)[:most]]


def _slid(optimum: Optimum) -> Optimum:
    return _moved(optimum, slid(optimum.objective, optimum.chromosome))


def _centred(optimum: Optimum) -> Optimum:
    return _moved(optimum, centred(optimum.objective, optimum.chromosome))


def _moved(optimum: Optimum, chromosome: FloatArray | None) -> Optimum:
    if chromosome is None:
        return optimum
    rms = optimum.objective.rms(chromosome[None])[0]
    return Optimum.of(optimum.objective, chromosome, rms)


def _explored(
    objective: Objective,
    minima: Sequence[FloatArray],
    watch: Watch | None,
    *,
    lookalike: bool,
    beside: bool = False,
    roughly: bool = False,
    sharpens: bool = False,
) -> Optima:
    """Minima (n_free,) refined by likelihood, and those that look like the best.

    Without lookalikes the first is the best, and the others are refined as long as they may be it.
    beside: whether those are looked for that differ in what is hardly felt. sharpens: whether where
    an output tells far more that is left to its own weights.
    """
    optima = Optima(objective)
    for minimum in minima if lookalike else minima[:1]:
        optima.add(_weighed(objective, minimum, watch, roughly=roughly))
    first = optima.ranked()[0]
    # A poor minimum explains an output far better than others by chance.
    if sharpens and _is_sharp(objective, first, _BY_FAR) and first.rms.max() > _NOISE:
        return optima
    explored = None
    for _ in range(_EXPLORED if lookalike or beside else 1):
        best = optima.ranked()[0]
        if explored is not None and (
            optima.deviance(explored, best) < _BETTER  # nothing better was found around it
            or best.objective.explains_little(best.rms)
        ):
            break
        starts = [] if lookalike or explored else [*minima[1:]]
        starts += lookalikes(best.objective, best.chromosome) if lookalike else []
        starts += hardly_felt(best.objective, best.chromosome) if beside else []
        explored = best
        # By the best one's weights, until it turns out to matter.
        for end in _conceivable(best.objective, starts, optima, best):
            if optima.new(end.chromosome):
                optima.add(_weighed(objective, end.chromosome, watch, roughly=roughly))
    return optima


def _sharpened(objective: Objective, optima: Optima, watch: Watch | None) -> Optima:
    """Minima compared by all that the best explained outputs tell.

    As an encoder's angle does after many turns. What counts for more than it errs is made to count
    for less in steps, for the less it does the narrower is the valley that a minimum lies in.
    """
    last = LEAST_SHARE
    for least in _SHARPER:
        best, *others = optima.ranked()
        if not _is_sharp(objective, best, last):
            break
        near = [o for o in others if optima.deviance(o, best) < _CONCEIVABLE]
        finer = fine_enough(best.objective, best.chromosome, bounded(best.rms, least))
        if finer is not best.objective:
            objective = objective.as_fine_as(finer)
        objective = objective.with_exact_slopes()
        optima = Optima(objective, least=least)
        for optimum in (best, *near):
            optima.add(_weighed(objective, optimum.chromosome, watch, least=least))
        last = least
    if last == LEAST_SHARE or _is_exact(optima.ranked()[0]):
        return optima
    return _with_lookalikes(objective, optima, watch, last)


def _is_exact(optimum: Optimum) -> bool:
    """Whether what is left is the simulation's own error: nothing is to be found beside it."""
    return noiseless(optimum.objective, optimum.chromosome, optimum.rms)


def _is_sharp(objective: Objective, optimum: Optimum, share: float = LEAST_SHARE) -> bool:
    """Whether an output errs less than a share of another: coarser weights then tell little."""
    rms = optimum.rms[objective.weights > 0.0]
    return bool(rms.min() < share * rms.max())


def _with_lookalikes(
    objective: Objective, optima: Optima, watch: Watch | None, least: float
) -> Optima:
    """Minima that look like the best, of which only the last weights tell, as with lags traded.

    From a better one on anew; of those that are as good the best few.
    """
    for _ in range(_SHARP_ROUNDS):
        best = optima.ranked()[0]
        starts = lookalikes(best.objective, best.chromosome, narrow=True)
        ends = _conceivable(best.objective, starts, optima, best)
        for end in sorted(ends, key=lambda end: end.error)[:_SHARP_ENDS]:
            if optima.new(end.chromosome):
                optima.add(_weighed(objective, end.chromosome, watch, least=least))
            if optima.deviance(best, optima.ranked()[0]) > _BETTER:
                break
        else:
            break
    return optima


def _in_noise(
    objective: Objective, optima: Optima, watch: Watch | None
) -> tuple[Objective, Optima]:
    """Minima anew by as many steps as the best one's errors let the data tell, if by more."""
    best, *others = optima.ranked()
    finer = fine_enough(best.objective, best.chromosome, bounded(best.rms, LEAST_SHARE))
    if finer is best.objective:
        return objective, optima
    near = (optimum for optimum in others if optima.deviance(optimum, best) < _CONCEIVABLE)
    minima = chromosomes_of([best, *near])
    objective = objective.as_fine_as(finer)
    return objective, _explored(objective, minima, watch, lookalike=False)


def _weighed(
    objective: Objective,
    chromosome: FloatArray,
    watch: Watch | None,
    *,
    roughly: bool = False,
    least: float = LEAST_SHARE,
) -> Optimum:
    """The minimum by the inverse of its errors: weights and parameters in turn."""
    tolerance = ROUGHLY if roughly else TOLERANCE
    given, rms = objective.weights, objective.rms(chromosome[None])[0]
    # A refinement may end where a simulation takes more steps than a chromosome is allowed.
    noisy = np.isfinite(rms).all() and not noiseless(objective, chromosome, rms)
    for _ in range(_ROUNDS if noisy else 0):
        weights = given / bounded(rms, least)
        weighed = objective.weighed(weights)
        steady = np.allclose(weighed.weights, objective.weights, rtol=_STEADY)
        objective = weighed
        end = refine(objective, chromosome, tolerance=tolerance, on_iteration=watch)
        chromosome, rms = end.chromosome, end.rms
        settled = steady and end.iterations < MOST_ITERATIONS  # along bent valleys it takes more
        if settled or not np.isfinite(rms).all():
            break
    return Optimum.of(objective, chromosome, rms)


def _refitted(
    fit: NoiseFit, ranked: Sequence[Optimum], by_error: Optima, begun: Begun
) -> Optima | None:
    """The best optimum and those not told from it by the error, refitted for noisy inputs.

    None where without corrections the inputs' noise would explain more than there is. The others
    are refitted, and compared, at the noise of the first, and the best of them by its own. A
    filter tells minima apart that free runs do not, and others look like its own. Free runs may
    lead it to a poor one, whose noise is too large to compare by: from one that is far better all
    begins anew at its noise. begun: as of ``fit_likelihood``.
    """
    # Without its noise a filter is not begun better there than where free runs lead.
    goes_on = begun.is_settled and begun.noise is not None and len(begun.chromosomes) > 0
    first = _beside(fit, begun) if goes_on else fit(ranked[0].chromosome)
    if first is None:
        return None
    likely = [o for o in ranked[1:] if by_error.deviance(o, ranked[0]) < _CONCEIVABLE]
    starts = [optimum.chromosome for optimum in likely]
    filtered = filters(first.objective)
    if filtered and begun.chromosomes and not begun.is_settled:
        first, more = _from_begun(fit, first, begun)
        starts += more
    if filtered:
        first, starts = better_by_filter(fit, first, starts)
    explores = filtered and not begun.is_settled
    if explores:
        first = _centred(first)
    scale = too_well(ranked[0].rms)
    optima, explored = Optima.around(first, fit.given, scale), None
    (first,) = (best,) = optima.ranked()
    for _ in range(_EXPLORED_BY_FILTER if filtered else 1):
        if explored is not None and optima.deviance(explored, best) < _BETTER:
            break
        explored = best
        starts += lookalikes(first.objective, best.chromosome) if explores else []
        exact = _exact_among(first, starts) if filtered else None
        if exact is not None:
            optima = Optima.around(exact, fit.given, scale)
            (first,) = (best,) = (explored,) = optima.ranked()
        ends = _conceivable(first.objective, starts, optima, best)
        for optimum in _compared(first.objective, ends, optima):
            optima.add(optimum)
        (best, *others), starts = optima.ranked(), []
        if filtered and optima.deviance(first, best) > TOLD_APART:
            anew = fit(best.chromosome)
            if anew is None or not foresees_more(anew, first):
                optima.refit(best, anew)
                best = optima.ranked()[0]
            else:
                near = (o for o in others if optima.deviance(o, best) < _CONCEIVABLE)
                starts = [optimum.chromosome for optimum in near]
                optima, explored = Optima.around(anew, fit.given, scale), None
                (first,) = (best,) = optima.ranked()
    if best is not first:
        optima.refit(best, fit(best.chromosome))
    return optima


def _compared(objective: Objective, ends: Sequence[Refinement], optima: Optima) -> list[Optimum]:
    """New minima beside where descents have ended, as they are compared with ones far from them.

    Steps that do at one minimum may be too coarse at another, which then seems to be elsewhere.
    """
    if not ends:
        return []
    finer = _fine_enough(objective, ends)
    # A share of the error is that of deviance by so many residuals.
    tolerance = max(TOLERANCE, _COMPARED / (2.0 * float(finer.counts.sum())))
    begun = [begin(finer, end.chromosome, tolerance=tolerance) for end in ends]
    reached = refine_each(finer, begun, enough=partial(_known, finer, optima.new, ()))
    chromosomes = [_inside(finer, end.chromosome) for end in reached if optima.new(end.chromosome)]
    if not chromosomes:
        return []
    errors = to_compare(objective).rms(np.stack(chromosomes))
    return [Optimum.of(objective, *pair) for pair in zip(chromosomes, errors, strict=True)]


def _fine_enough(objective: Objective, ends: Sequence[Refinement]) -> Objective:
    """An objective with as many steps as an answer at the most demanding of the ends wants."""
    if not filters(objective):
        return objective
    for end in ends:
        objective = objective.exactly(end.chromosome)
    return objective


def _inside(objective: Objective, chromosome: FloatArray) -> FloatArray:
    """A minimum (n_free,) at no end of a range that only ties reach."""
    inside = slid(objective, chromosome)
    return chromosome if inside is None else inside


def _exact_among(first: Optimum, starts: Sequence[FloatArray]) -> Optimum | None:
    """A filter's minimum by exact means, if starts (n_free,) ask for these and it did not."""
    fitted = first.objective
    assert isinstance(fitted, Innovations)
    if fitted.exact or not starts or not fitted.rings_at(np.stack(starts)):
        return None
    exact = fitted.exact_means
    end = refine(exact, first.chromosome)
    return Optimum.of(exact, end.chromosome, end.rms)


def _conceivable(
    objective: Objective, starts: Sequence[FloatArray], optima: Optima, best: Optimum
) -> list[Refinement]:
    """Where descents come to soon, what is no minimum yet known and not far behind the best.

    None is left out for another of them, which may be at its end sooner.
    """
    # A filter forgets where an excerpt starts, as free runs do not.
    if filters(objective) and starts:
        excerpt = Excerpt.of(objective.records, SAMPLES, every=False)
        if excerpt is not None:
            easier = objective.eased(best.chromosome, _MOVING)
            starts = _conceivable_by(excerpt, easier, starts, optima, best)
    here = best.by(objective)
    goal = optima.error_at(objective, here, _CONCEIVABLE)
    return [
        end
        for end in _quickly(objective, starts, optima.new, goal)
        if optima.deviance(Optimum.of(objective, end.chromosome, end.rms), here) < _CONCEIVABLE
    ]


def _conceivable_by(
    excerpt: Excerpt,
    objective: Objective,
    starts: Sequence[FloatArray],
    optima: Optima,
    best: Optimum,
) -> list[FloatArray]:
    """What is left of starts (n_free,), moved to their minima on an excerpt, by that alone.

    By how far the best one's minimum there is from that on all samples all of them are moved back.
    """
    part, space = excerpt.of_all(objective), objective.space
    first = refine(
        part,
        excerpt.on_parts(space, part.space, best.chromosome),
        tolerance=ROUGHLY,
        max_iterations=QUICKLY,
    )
    (there,) = excerpt.on_all(part.space, [first.chromosome])[1]
    back = space.encode(best.chromosome) - space.encode(there)

    def on_all(chromosomes: Sequence[FloatArray]) -> list[FloatArray]:
        there = np.stack(excerpt.on_all(part.space, chromosomes)[1])
        return list(space.decode(np.clip(space.encode(there) + back, *space.coded_bounds)))

    begun = [excerpt.on_parts(space, part.space, start) for start in starts]

    def new(chromosome: FloatArray, others: Sequence[FloatArray]) -> bool:
        there, *ends = on_all([chromosome, *others])
        return optima.new(there, ends)

    share = excerpt.n_samples / sum(record.n_samples for record in objective.records)
    minimum = Optimum.of(part, first.chromosome, first.rms)
    ends = _quickly(part, begun, new, optima.error_at(part, minimum, _CONCEIVABLE / share))
    reached = (Optimum.of(part, end.chromosome, end.rms) for end in ends)
    near = [o for o in reached if share * optima.deviance(o, minimum) < _CONCEIVABLE]
    return on_all(chromosomes_of(near)) if near else []


def _quickly(
    objective: Objective,
    starts: Sequence[FloatArray],
    new: _New,
    goal: float,
) -> list[Refinement]:
    """Where descents come to soon that is new, also to those before them; others end on the way.

    goal: as of ``refine_each``.
    """
    ends: list[Refinement] = []
    for first in range(0, len(starts), _AT_ONCE):
        before = [end.chromosome for end in ends]
        descents = [
            begin(objective, start, tolerance=ROUGHLY) for start in starts[first : first + _AT_ONCE]
        ]
        wave = refine_each(
            objective,
            descents,
            max_iterations=QUICKLY,
            enough=partial(_known, objective, new, before),
            goal=goal,
        )
        for end in sorted(wave, key=lambda end: end.error):
            if new(end.chromosome, [kept.chromosome for kept in ends]):
                ends.append(end)
    return ends


def _known(
    objective: Objective,
    new: _New,
    before: Sequence[FloatArray],
    point: Point,
) -> bool:
    return not new(objective.space.decode(point.at), before)


def _beside(fit: NoiseFit, begun: Begun) -> Optimum | None:
    """The minimum beside that of an earlier fit.

    The earlier noise tells the right minimum from afar: what innovations of new records show at the
    earlier one may be far more.
    """
    return fit(begun.chromosomes[0], begun.noise)


def _from_begun(fit: NoiseFit, first: Optimum, begun: Begun) -> tuple[Optimum, list[FloatArray]]:
    """The better of a filter's minimum and one beside that of an earlier fit, and other starts."""
    anew, rivals = _beside(fit, begun), begun.chromosomes[1:]
    if anew is None:
        return first, [*rivals]
    better, worse = (anew, first) if foresees_more(anew, first) else (first, anew)
    return better, [worse.chromosome, *rivals]
