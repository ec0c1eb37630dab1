"""Local refinement with jumps: descents from several starts, then from variations of the best.

A record may be explained nearly as well by parameters far apart: resonances that alias under the
sampling, time constants that swap roles. Descents end in such minima, one or two parameters away
from one another. So the best minimum is varied, one parameter at a time over its whole range, and
new descents start from the dips of the error along these lines.
"""

from collections.abc import Mapping
from dataclasses import InitVar, dataclass, replace
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting import refinement
from sysid.fitting.descent import Descent, Point
from sysid.fitting.objective import Objective

AT_ONCE = 6  # descents under way together
_HORIZON = 10  # iterations as good as its last that take a descent with hope below the best error
_ARRIVED = 3e-4  # share of the error that an iteration gains less than where a descent ends
# Iterations of the last descent that simulations are kept for; and its most, beyond the budget
# if need be, for only a minimum means anything.
_POLISHING, _MOST_ITERATIONS = 10, 50
_SAME = 1e-3  # share by which an output's error differs between minima, or they are one
_NEAR = 0.02  # share of the best error within which descents and minima count as near it
_BEFORE_GIVING_UP = 2  # iterations
_MOST_POINTS, _FEWEST_POINTS = 16, 4  # along each parameter's range
_FAR = (0.15, 0.45)  # parts of a range by which parameters move along their valleys
_SLACK = 1e-8  # keeps parameters on which nothing depends from following
_LAGS, _WHITE = 25, 0.3  # of residuals' correlations, and up to which these are noise's
_ITERATIONS_EACH = 12  # what a descent from a first start may be expected to take

_PLAIN_STATE = ("reserve", "polishing", "polished", "best", "error", "feasible")


@dataclass(frozen=True)
class Minimum:
    """Ends of descents, its error and the outputs' (n_outputs,).

    varied: how often new starts were sought around it. met: by how many descents.
    """

    at: FloatArray
    error: float
    rms: FloatArray
    varied: int = 0
    met: int = 1


@dataclass(eq=False)
class LocalSearch:
    """Descents and jumps, step by step, within a budget of simulations.

    starts: (n, n_free) chromosomes, the most promising first. budget: simulations that the
    objective is to have counted in the end. points: of one round of variations, shared by all
    parameters. After each ``step``: ``best`` (n_free,) in search coordinates and its ``error``,
    feasible before infeasible; ``polished``, whether the search has ended.
    """

    objective: Objective
    starts: InitVar[FloatArray]
    budget: int
    points: int
    rng: np.random.Generator

    def __post_init__(self, starts: FloatArray) -> None:
        self.n_varied = len(self.objective.space.index)
        self.sparing = self.objective.sparing()
        self.points = int(np.clip(self.points // self.n_varied, _FEWEST_POINTS, _MOST_POINTS))
        self.iteration_cost = refinement.simulations_per_iteration(self.objective)
        affordable = max(1, self.left // (_ITERATIONS_EACH * self.iteration_cost))
        starts = starts[: min(AT_ONCE, affordable)]
        self.descents = [
            refinement.begin(self.objective, start, tolerance=_ARRIVED) for start in starts
        ]
        self.reserve = min(_POLISHING * self.iteration_cost, self.left // 3)
        self.polishing = self.polished = False
        self.dips: list[Point] = []
        self.minima: list[Minimum] = []
        self.best: FloatArray = self.descents[0].point.at
        self.error = np.inf
        self.feasible = self._feasible(self.best)

    @property
    def left(self) -> int:
        """Simulations that may still be spent."""
        return self.budget - self.objective.simulations

    def rivals(self, count: int) -> list[FloatArray]:
        """Search coordinates (n_free,) of the likeliest minima hardly worse than the best.

        Feasible before infeasible, then by the likelihood, the mean logarithm of outputs' errors.
        """
        rms = self._rms(self.best)
        near = [
            minimum
            for minimum in self.minima
            if minimum.error <= (1.0 + _NEAR) * self.error
            and not np.allclose(minimum.rms, rms, rtol=_SAME, atol=_SAME * minimum.error)
        ]
        counted = self.objective.weights > 0.0
        weights = self.objective.weights[counted]

        def rank(minimum: Minimum) -> tuple[bool, float]:
            with np.errstate(divide="ignore"):  # of an output explained exactly
                loss = float(np.log(minimum.rms[counted]) @ weights)
            return not self._feasible(minimum.at), loss

        ranked = sorted([Minimum(self.best, self.error, rms), *near], key=rank)
        return [minimum.at for minimum in ranked[:count]]

    def step(self) -> None:
        """One iteration of the descents under way, or else new starts."""
        if self.polishing:
            self._polish()
        elif self._only_polishing_left():
            self.polishing = True
            self.descents = [Descent(Point(self.best))]
        elif self.descents:
            self._descend()
        elif self.dips and min(self.minima, key=lambda minimum: minimum.error).varied > 0:
            begun = self.dips[:AT_ONCE]
            self.descents = [Descent(Point(dip.at), tolerance=_ARRIVED) for dip in begun]
            self.dips = self.dips[AT_ONCE:]
        else:
            self._vary()

    def state(self) -> dict[str, Any]:
        """The state on which the next steps depend, beside the arguments and ``rng``."""
        return {name: getattr(self, name) for name in _PLAIN_STATE} | {
            "descents": [descent.state() for descent in self.descents],
            "dips": [{"at": dip.at, "error": dip.error} for dip in self.dips],
            "minima": [vars(minimum) for minimum in self.minima],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``."""
        for name in _PLAIN_STATE:
            setattr(self, name, state[name])
        self.descents = [Descent.of(item) for item in state["descents"]]
        self.dips = [Point(**item) for item in state["dips"]]
        self.minima = [Minimum(**item) for item in state["minima"]]

    def _only_polishing_left(self) -> bool:
        if self.error <= refinement.ROUNDING or not (self.descents or self.minima):
            return True
        if not self.descents and self._all_are_met():
            return True
        going_on = self.descents or self.dips
        variation_cost = self.n_varied * self.points + 2 * self.iteration_cost
        return self.left < self.reserve + (self.iteration_cost if going_on else variation_cost)

    def _all_are_met(self) -> bool:
        """Whether no more minima are expected than descents have ended in, and the best is right.

        Of n descents that ended in w minima, w (n - 1) / (n - w - 2) are expected in all (Boender
        and Rinnooy Kan, "Bayesian stopping rules for multistart global optimization methods",
        Mathematical Programming 37, 1987). That is of starts at random, and of descents that all
        end; these lie around minima, and some are given up. So each minimum has to have been varied
        in both ways, and the best to leave nothing but noise.
        """
        w, n = len(self.minima), sum(minimum.met for minimum in self.minima)
        varied = all(minimum.varied >= 2 for minimum in self.minima)
        few = n > w + 2 and w * (n - 1) < (w + 0.5) * (n - w - 2)
        return varied and few and self._leaves_noise()

    def _leaves_noise(self) -> bool:
        """Whether residuals of the best do not go on from sample to sample in any output."""
        chromosome = self.objective.space.decode(self.best[None])
        steps = self.objective.steps_needed(chromosome)
        residual = self.objective.residuals(chromosome, steps).values[..., 0]
        power = np.sum(residual**2, axis=0)
        lags = range(1, min(_LAGS, len(residual)))
        follow = [np.sum(residual[k:] * residual[:-k], axis=0) for k in lags]
        return bool(np.all(np.abs(follow) <= _WHITE * power))

    def _polish(self) -> None:
        (descent,) = self.descents = refinement.advance(self.objective, self.descents)
        self.polished = descent.finished or descent.iterations >= _MOST_ITERATIONS
        self._take(descent)

    def _descend(self) -> None:
        affordable = (self.left - self.reserve) // self.iteration_cost
        moved = refinement.advance(self.objective, self.descents[:affordable])
        live = []
        for descent in moved:
            self._take(descent)
            # What remains to be smoothed matters to the last digits only.
            ended = descent.finished or descent.iterations >= _MOST_ITERATIONS
            if ended or descent.smoothing > 0:
                self.add(descent.point)
            else:
                live.append(descent)
        least = min([self.error, *(descent.point.error for descent in live)])
        self.descents = [descent for descent in live if not _hopeless(descent, least)]
        if not (self.descents or self.minima):
            self.add(Point(self.best, self.error))

    def _take(self, descent: Descent) -> None:
        """Offer the point that a descent has reached for sure."""
        point = descent.point if descent.finished else descent.safe
        if point is not None:
            self._offer(point)

    def _offer(self, point: Point) -> None:
        """Keep a point if it is the best yet."""
        if self.feasible and point.error >= self.error:
            return
        feasible = self._feasible(point.at)
        if (not feasible, point.error) < (not self.feasible, self.error):
            self.best, self.error, self.feasible = point.at, point.error, feasible

    def _feasible(self, at: FloatArray) -> bool:
        space = self.objective.space
        return space.feasible(space.decode(at))

    def _rms(self, at: FloatArray) -> FloatArray:
        rms: FloatArray = self.objective.rms(self.objective.space.decode(at[None]))[0]
        return rms

    def add(self, point: Point) -> None:
        """Add a minimum, unless the outputs err as in another; flat directions tell nothing."""
        at, error, rms = point.at, point.error, point.accurate_rms
        rms = self._rms(at) if rms is None else rms
        if not (np.isfinite(error) and np.all(np.isfinite(rms))):
            return
        self._offer(point)
        for place, minimum in enumerate(self.minima):
            if np.allclose(rms, minimum.rms, rtol=_SAME, atol=_SAME * error):
                self.minima[place] = replace(minimum, met=minimum.met + 1)
                return
        self.minima.append(Minimum(at, error, rms))

    def _vary(self) -> None:
        """New starts around the best of the minima that have been varied least."""
        centre = min(self.minima, key=lambda minimum: (minimum.varied // 2, minimum.error))
        place = [minimum is centre for minimum in self.minima].index(True)
        self.minima[place] = replace(centre, varied=centre.varied + 1)
        points = self._lines(centre) if centre.varied % 2 else self._valleys(centre)
        # Where the error is the same nothing has changed.
        dips = [point for point in points if (1.0 + _SAME) * centre.error < point.error < np.inf]
        self.dips = sorted(dips, key=lambda dip: dip.error) + self.dips

    def _lines(self, centre: Minimum) -> list[Point]:
        """Dips of the error along each parameter's whole range."""
        lower, width = self.objective.space.coded_lower, self.objective.space.width
        n, k = self.n_varied, self.points
        shares = (np.arange(k) + self.rng.random((n, k))) / k
        moves = shares - ((centre.at - lower) / width)[:n, None]
        rows = centre.at + moves[:, :, None] * (np.eye(len(width))[:n] * width)[:, None, :]
        errors = self._errors(rows.reshape(n * k, -1)).reshape(n, k)
        return [
            Point(rows[i, j], float(errors[i, j]))
            for i in range(n)
            for j in _dips(moves[i], errors[i], centre.error)
        ]

    def _valleys(self, centre: Minimum) -> list[Point]:
        """A point either way along each parameter's valley, where outputs change least."""
        lower, width = self.objective.space.coded_lower, self.objective.space.width
        hessian = refinement.curvature(self.objective, centre.at)
        loaded = hessian + _SLACK * np.diag(np.maximum(np.diag(hessian), 1e-300))
        covariance = np.linalg.inv(loaded)
        along = (covariance / np.diag(covariance)[:, None])[: self.n_varied]
        lengths = self.rng.uniform(*_FAR, (2 * self.n_varied, 1))
        moves = lengths * np.clip(np.concatenate([along, -along]), -1.0, 1.0)
        rows = np.clip(centre.at + moves * width, lower, lower + width)
        errors = self._errors(rows)
        return [Point(row, float(error)) for row, error in zip(rows, errors, strict=True)]

    def _errors(self, rows: FloatArray) -> FloatArray:
        """Error at each row of coordinates, infinite where it is infeasible or slow to simulate."""
        space = self.objective.space
        chromosomes = space.decode(rows)
        errors, _ = self.sparing.evaluate(chromosomes)
        return np.where(np.any(space.violations(chromosomes) > 0.0, axis=1), np.inf, errors)


def _hopeless(descent: Descent, least: float) -> bool:
    """Whether a descent will not come near the least error of all."""
    if descent.iterations < _BEFORE_GIVING_UP or descent.failures == 1:
        return False  # at its beginning, or about to try again with more damping
    enough, error = (1.0 + _NEAR) * least, descent.point.error
    return error > enough and error * (1.0 - descent.gain) ** _HORIZON > enough


def _dips(moves: FloatArray, errors: FloatArray, error: float) -> list[int]:
    """Indices of moves along a line with lower errors than those beside them, the centre's too."""
    before = int(np.searchsorted(moves, 0.0))
    line = np.concatenate([[np.inf], np.insert(errors, before, error), [np.inf]])
    low = (line[1:-1] <= line[:-2]) & (line[1:-1] <= line[2:]) & np.isfinite(line[1:-1])
    return [int(j) for j in np.flatnonzero(np.delete(low, before))]
