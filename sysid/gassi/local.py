"""Local refinement with jumps: descents from several starts, then from variations of the best.

A record may be explained nearly as well by parameters far apart: resonances that alias under the
sampling, time constants that swap roles. Descents end in such minima, which lie one or two
parameters away from one another. So the best minimum is varied, one parameter at a time over its
whole range, and new descents start from the dips of the error along these lines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting import refinement
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import ROUNDING, Descent

AT_ONCE = 6  # descents under way together
# A descent is given up when so many iterations more, each as good as its last, would not take it
# below the best error known.
_HORIZON = 10
_ARRIVED = 3e-4  # part of the error that an iteration gains less than where a descent ends
# Iterations that simulations are kept for, of the last descent, from the best; and its most. It
# runs to its end even where the budget was too small for it: only a minimum means anything.
_POLISHING, _MOST_ITERATIONS = 15, 50
_SAME = 1e-3  # part by which an output's error differs between minima, or they are one
_NEAR = 0.02  # descents that may come so close to the best, in parts of its error, go on
_BEFORE_GIVING_UP = 2  # iterations
_MOST_POINTS, _FEWEST_POINTS = 16, 4  # along each parameter's range
_FAR = (0.15, 0.45)  # parts of a range by which parameters move along their valleys
_SLACK = 1e-8  # keeps what nothing depends on from following
_ITERATIONS_EACH = 12  # what a descent from a first start may be expected to take


@dataclass(frozen=True)
class Minimum:
    """Where a descent ended: search coordinates (n_free,), error, how often it has been varied.

    rms: (n_outputs,), each output's error.
    """

    at: FloatArray
    error: float
    rms: FloatArray
    varied: int = 0


@dataclass(frozen=True)
class Dip:
    """A variation from which the error may fall: search coordinates (n_free,) and error."""

    at: FloatArray
    error: float


_PLAIN = ("reserve", "polishing", "polished", "best", "error", "feasible")
_ITEMS: dict[str, Callable[..., Any]] = {"descents": Descent, "dips": Dip, "minima": Minimum}


class LocalSearch:
    """Descents and jumps, step by step, within a budget of simulations.

    starts: (n, n_free) chromosomes, the most promising first. most: simulations that the
    objective is to have counted in the end. points: of one round of variations, shared by all
    parameters. rng: draws the variations.

    After each ``step``: ``best`` (n_free,) in search coordinates and ``error``, feasible before
    infeasible.
    """

    def __init__(
        self,
        objective: Objective,
        starts: FloatArray,
        most: int,
        points: int,
        rng: np.random.Generator,
    ) -> None:
        self.objective = objective
        self.most = most
        self.rng = rng
        self.n_varied = len(objective.space.index)
        self.points = int(np.clip(points // self.n_varied, _FEWEST_POINTS, _MOST_POINTS))
        self.each = refinement.simulations_per_iteration(objective)
        affordable = max(1, self.left // (_ITERATIONS_EACH * self.each))
        self.descents = [
            refinement.begin(objective, start) for start in starts[: min(AT_ONCE, affordable)]
        ]
        self.reserve = min(_POLISHING * self.each, self.left // 3)
        self.polishing = self.polished = False
        self.dips: list[Dip] = []
        self.minima: list[Minimum] = []
        self.best: FloatArray = self.descents[0].at
        self.error = np.inf
        self.feasible = self._feasible(self.best)

    @property
    def left(self) -> int:
        """Simulations that may still be spent."""
        return self.most - self.objective.simulations

    @property
    def done(self) -> bool:
        """Whether the best has been polished."""
        return self.polished

    def rivals(self, most: int) -> list[FloatArray]:
        """The likeliest of the minima hardly worse than the best, so many, (n_free,) each.

        Feasible before infeasible, then by the likelihood where they are: the mean logarithm of
        the outputs' errors.
        """
        rms = self.objective.rms(self.objective.space.decode(self.best[None]))[0]
        near = [m for m in self.minima if m.error <= (1.0 + _NEAR) * self.error]
        near = [m for m in near if not np.allclose(m.rms, rms, rtol=_SAME, atol=_SAME * m.error)]
        near = [Minimum(self.best, self.error, rms), *near]
        weights = self.objective.weights
        with np.errstate(divide="ignore"):  # of an output explained exactly
            near.sort(
                key=lambda m: (
                    not self._feasible(m.at),
                    float(np.log(m.rms[weights > 0.0]) @ weights[weights > 0.0]),
                )
            )
        return [minimum.at for minimum in near[:most]]

    def step(self) -> None:
        """One iteration of the descents under way, or else new starts for some."""
        if self.polishing:
            self._polish()
        elif self._nothing_more():
            self.polishing = True
            self.descents = [Descent(self.best)]
        elif self.descents:
            self._descend()
        elif self.dips and min(self.minima, key=lambda m: m.error).varied > 0:
            self.descents = [Descent(dip.at) for dip in self.dips[:AT_ONCE]]
            self.dips = self.dips[AT_ONCE:]
        else:
            self._vary()

    def state(self) -> dict[str, Any]:
        """All that the next steps depend on beside what it was made with and ``rng``."""
        plain = {name: getattr(self, name) for name in _PLAIN}
        return plain | {name: [vars(item) for item in getattr(self, name)] for name in _ITEMS}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``."""
        for name in _PLAIN:
            setattr(self, name, state[name])
        for name, kind in _ITEMS.items():
            setattr(self, name, [kind(**values) for values in state[name]])

    def _nothing_more(self) -> bool:
        """Whether only the last descent remains."""
        if self.error <= ROUNDING or not (self.descents or self.minima):
            return True
        return self.left < self.reserve + self._next_cost()

    def _next_cost(self) -> int:
        """Simulations that the next step takes at least."""
        if self.descents or self.dips:
            return self.each
        return self.n_varied * self.points + 2 * self.each

    def _polish(self) -> None:
        (descent,) = self.descents = refinement.advance(self.objective, self.descents)
        self.polished = descent.finished or descent.iterations >= _MOST_ITERATIONS
        self._take(descent)

    def _descend(self) -> None:
        affordable = (self.left - self.reserve) // self.each
        moved = refinement.advance(self.objective, self.descents[:affordable], _ARRIVED)
        self.descents = []
        for descent in moved:
            self._take(descent)
            # What remains to be smoothed matters to the last digits only.
            ended = descent.finished or descent.iterations >= _MOST_ITERATIONS
            if ended or descent.smoothing > 0:
                self._add(descent.at, descent.error, descent.shown)
            else:
                self.descents.append(descent)
        least = min([self.error, *(descent.error for descent in self.descents)])
        self.descents = [d for d in self.descents if not _hopeless(d, least)]
        if not (self.descents or self.minima):
            self._add(self.best, self.error)

    def _take(self, descent: Descent) -> None:
        """What a descent has surely reached, if it is the best yet."""
        if descent.finished:
            self._offer(descent.at, descent.error)
        elif descent.sure is not None:
            self._offer(descent.sure, descent.sure_error)

    def _offer(self, at: FloatArray, error: float) -> None:
        feasible = self._feasible(at)
        if (not feasible, error) < (not self.feasible, self.error):
            self.best, self.error, self.feasible = at, error, feasible

    def _feasible(self, at: FloatArray) -> bool:
        space = self.objective.space
        return space.feasible(space.decode(at))

    def _add(self, at: FloatArray, error: float, rms: FloatArray | None = None) -> None:
        """One minimum more, unless the outputs err as in another; flat directions tell nothing.

        rms: the outputs' errors, where they are known.
        """
        if rms is None:
            rms = self.objective.rms(self.objective.space.decode(at[None]))[0]
        if not (np.isfinite(error) and np.all(np.isfinite(rms))):
            return
        self._offer(at, error)
        for known in self.minima:
            if np.allclose(rms, known.rms, rtol=_SAME, atol=_SAME * error):
                return
        self.minima.append(Minimum(at, error, rms))

    def _vary(self) -> None:
        """New starts around the best of the minima that have been varied least."""
        chosen = min(
            range(len(self.minima)),
            key=lambda i: (self.minima[i].varied // 2, self.minima[i].error),
        )
        centre = self.minima[chosen]
        self.minima[chosen] = replace(centre, varied=centre.varied + 1)
        found = self._lines(centre) if centre.varied % 2 else self._valleys(centre)
        # Where the error is the same nothing has changed.
        fresh = [dip for dip in found if (1.0 + _SAME) * centre.error < dip.error < np.inf]
        self.dips = sorted(fresh, key=lambda dip: dip.error) + self.dips

    def _lines(self, centre: Minimum) -> list[Dip]:
        """Dips of the error along each parameter's whole range."""
        lower, width = self.objective.space.coded_lower, self.objective.space.width
        n, k = self.n_varied, self.points
        shares = (np.arange(k) + self.rng.random((n, k))) / k
        moves = shares - ((centre.at - lower) / width)[:n, None]
        rows = centre.at + moves[:, :, None] * (np.eye(len(width))[:n] * width)[:, None, :]
        errors = self._errors(rows.reshape(n * k, -1)).reshape(n, k)
        return [
            Dip(rows[i, j], float(errors[i, j]))
            for i in range(n)
            for j in _dips(moves[i], errors[i], centre.error)
        ]

    def _valleys(self, centre: Minimum) -> list[Dip]:
        """A point either way along each parameter's valley.

        A valley is the way on which the outputs change least as one parameter is changed, the
        others following, by the sensitivities at the minimum.
        """
        lower, width = self.objective.space.coded_lower, self.objective.space.width
        hessian = refinement.curvature(self.objective, centre.at)
        loaded = hessian + _SLACK * np.diag(np.maximum(np.diag(hessian), 1e-300))
        covariance = np.linalg.inv(loaded)
        along = (covariance / np.diag(covariance)[:, None])[: self.n_varied]
        lengths = self.rng.uniform(*_FAR, (2 * self.n_varied, 1))
        moves = lengths * np.clip(np.concatenate([along, -along]), -1.0, 1.0)
        rows = np.clip(centre.at + moves * width, lower, lower + width)
        errors = self._errors(rows)
        return [Dip(row, float(error)) for row, error in zip(rows, errors, strict=True)]

    def _errors(self, rows: FloatArray) -> FloatArray:
        """Error at each row of coordinates, infinite where it is infeasible."""
        space = self.objective.space
        chromosomes = space.decode(rows)
        errors, _ = self.objective.evaluate(chromosomes)
        return np.where(np.any(space.violations(chromosomes) > 0.0, axis=1), np.inf, errors)


def _hopeless(descent: Descent, least: float) -> bool:
    """Whether a descent will not come near the least error known."""
    enough = (1.0 + _NEAR) * least
    if descent.error <= enough or descent.iterations < _BEFORE_GIVING_UP:
        return False
    if descent.failures == 1:
        return False  # about to try again with more damping
    return descent.error * (1.0 - descent.gain) ** _HORIZON > enough


def _dips(moves: FloatArray, errors: FloatArray, error: float) -> list[int]:
    """Which moves along a line have lower errors than those beside them, the centre included."""
    before = int(np.searchsorted(moves, 0.0))
    line = np.concatenate([[np.inf], np.insert(errors, before, error), [np.inf]])
    low = (line[1:-1] <= line[:-2]) & (line[1:-1] <= line[2:]) & np.isfinite(line[1:-1])
    return [int(j) for j in np.flatnonzero(np.delete(low, before))]
