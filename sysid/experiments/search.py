"""The search for runs that together tell most.

A run adds its information to that of the others. So a set of runs is chosen as an exact design is:
greedily, then by exchanges, each run for whichever candidate serves better (Fedorov, "Theory of
Optimal Experiments", 1972). Settings of chosen runs are recombined and moved, many together or
alone (Meyer and Nachtsheim, "The coordinate-exchange algorithm for constructing exact optimal
experimental designs", Technometrics 37, 1995), by less and less, and their offspring become
candidates.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Protocol

import numpy as np

from sysid.arrays import FloatArray
from sysid.experiments.excitation import Excitation
from sysid.problem.model import ModelError
from sysid.threads import Workers

_WIDEST, _FINEST = 0.3, 0.02  # deviation of a moved setting, in parts of its range
_TOGETHER = 0.5  # of offspring that differ in about half of the settings
_TWO = 0.3  # of the others, that differ in two, not in one
_MOVES = 0.6, 0.2, 0.2  # of a setting that is moved alone: nearby, anywhere, to an end
_HALVINGS = 3  # of the way from a run that passes a limit to one that does not
_ROUNDS = 20  # of exchanges
_GAIN = 1e-9  # by which an exchange must lower the loss
_NONE = (
    "each of {} runs that were tried would pass a limit; let the settings reach down to less, or "
    "know the parameters better"
)


class Aim(Protocol):
    """What a set of runs is to bring, by the sum of its runs' information."""

    def losses(self, information: FloatArray) -> FloatArray:
        """Of information (n, n_draws, n_free, n_free), (n,), less is better."""

    def met(self, information: FloatArray) -> bool:
        """Whether information (n_draws, n_free, n_free) is enough."""


@dataclass(frozen=True)
class RunCandidate:
    """A run that may be chosen: its excitation, places in its settings' ranges, information.

    information: (n_draws, n_free, n_free).
    """

    excitation: Excitation
    genes: FloatArray
    information: FloatArray


@dataclass(frozen=True)
class _Trial:
    """A run to try: its excitation and genes, and from where to where ``back`` leads."""

    excitation: Excitation
    genes: FloatArray
    back: Callable[[FloatArray], FloatArray]


# Makes a candidate of an excitation and its genes; None where a run would pass a limit.
Evaluate = Callable[[Excitation, FloatArray], RunCandidate | None]


@dataclass
class Search:
    """Candidates so far, and the best set of them.

    attempts: runs that were simulated; chosen: the set, as places in ``pool``, the same one perhaps
    several times. workers: who evaluate. watch: is told the attempts and those within the limits
    after each. confirm: whether a candidate that is to be chosen keeps limits of which ``evaluate``
    has asked too few; None: it has asked all.
    """

    excitations: Sequence[Excitation]
    evaluate: Evaluate
    aim: Aim
    rng: np.random.Generator
    most: int
    workers: Workers
    watch: Callable[[int, int], None] | None = None
    confirm: Callable[[RunCandidate], bool] | None = None

    def __post_init__(self) -> None:
        self.pool: list[RunCandidate] = []
        self.chosen: list[int] = []
        self._sure: set[int] = set()  # of the places, those that were confirmed
        self._out: list[int] = []  # and those that were not
        self.attempts = self.kept = 0

    def run(self, candidates: int, generations: int, offspring: int) -> None:
        """Candidates anywhere, then generations of offspring of the best set.

        Raises ModelError where none of the candidates keeps the limits.
        """
        self.scatter(candidates)
        self.choose()
        if not self.chosen:
            raise ModelError(
                "what is asked for is known as well as that already; ask for narrower intervals"
            )
        for k in range(generations):
            self.generation(offspring, k / max(generations - 1, 1))
            self.choose()

    def scatter(self, n: int) -> None:
        """Candidates anywhere in the settings' ranges, of each excitation alike many.

        One that passes a limit is drawn to where its settings excite less. Raises ModelError where
        none of them keeps the limits.
        """
        trials = []
        for k in range(n):
            excitation = self.excitations[k % len(self.excitations)]
            genes = self.rng.random(len(excitation.settings))
            trials.append(_Trial(excitation, genes, excitation.calmer))
        self._settle(trials)
        if not self.pool:
            raise ModelError(_NONE.format(n))

    def generation(self, n: int, progress: float) -> None:
        """Offspring of the chosen; progress: 0 at the first generation, 1 at the last."""
        width = _WIDEST * (_FINEST / _WIDEST) ** progress
        trials = []
        for _ in range(n):
            mother, father = (self.pool[i] for i in self.rng.choice(self.chosen, 2))
            genes = mother.genes.copy()
            if father.excitation is mother.excitation and self.rng.random() > progress:
                from_father = self.rng.random(len(genes)) < 0.5
                genes[from_father] = father.genes[from_father]
            back = partial(_midway, mother.genes)
            trials.append(_Trial(mother.excitation, self._moved(genes, width), back))
        self._settle(trials)

    def _moved(self, genes: FloatArray, width: float) -> FloatArray:
        """Genes of which about half are moved together, as along a limit, or one or two alone."""
        rng = self.rng
        if rng.random() < _TOGETHER:
            moves = width * rng.standard_normal(len(genes))
            return np.clip(genes + moves * (rng.random(len(genes)) < 0.5), 0.0, 1.0)
        moved = genes.copy()
        count = min(1 + (rng.random() < _TWO), len(genes))
        for k in rng.choice(len(genes), count, replace=False):
            nearby = np.clip(moved[k] + 2.0 * width * rng.standard_normal(), 0.0, 1.0)
            moved[k] = rng.choice([nearby, rng.random(), rng.integers(2)], p=_MOVES)
        return moved

    def revise(
        self,
        revised: Callable[[RunCandidate], RunCandidate],
        places: Sequence[int] | None = None,
    ) -> None:
        """Replace candidates, by default all of them, by what is now known of them."""

        def replaced(place: int) -> None:
            self.pool[place] = revised(self.pool[place])

        self.workers.each(replaced, range(len(self.pool)) if places is None else places)

    def settle(self, revised: Callable[[RunCandidate], RunCandidate]) -> None:
        """Revise the chosen alone, and add runs as long as that leaves too little."""
        settled: set[int] = set()
        while not settled.issuperset(self.chosen):
            self.revise(revised, sorted({*self.chosen} - settled))
            settled.update(self.chosen)
            self._greedily(self._stack)
            while not self._confirmed():
                self._greedily(self._stack)

    def choose(self) -> None:
        """The best set that greed and exchanges lead to, of candidates that are confirmed.

        Raises ModelError where none of them is.
        """
        while True:
            stack = self._stack
            self._greedily(stack)
            for _ in range(_ROUNDS):
                exchanged = [self._exchange(stack, place) for place in range(len(self.chosen))]
                if not any(exchanged):
                    break
            if self._confirmed():
                return

    @property
    def _stack(self) -> FloatArray:
        """Information of all candidates, (n_pool, n_draws, n_free, n_free)."""
        return np.array([candidate.information for candidate in self.pool])

    def _confirmed(self) -> bool:
        """Whether all that are chosen keep all limits; those that do not are out of it."""
        if self.confirm is None:
            return True
        doubtful = sorted({*self.chosen} - self._sure)
        kept = self.workers.results(self.confirm, [self.pool[place] for place in doubtful])
        refused = [place for place, keeps in zip(doubtful, kept, strict=True) if not keeps]
        self._sure.update(set(doubtful) - set(refused))
        self._out += refused
        self.kept -= len(refused)
        if len(self._out) == len(self.pool):
            raise ModelError(_NONE.format(len(self.pool)))
        self.chosen = [place for place in self.chosen if place not in refused]
        return not refused

    def total(self) -> FloatArray:
        """Information of the chosen together, (n_draws, n_free, n_free)."""
        total: FloatArray = np.sum([self.pool[i].information for i in self.chosen], axis=0)
        return total

    def _greedily(self, stack: FloatArray) -> None:
        """One more run after the other, until there are enough or all targets are met."""
        total = stack[self.chosen].sum(axis=0)
        while len(self.chosen) < self.most and not self.aim.met(total):
            self.chosen.append(int(np.argmin(self._losses(total + stack))))
            total = total + stack[self.chosen[-1]]

    def _losses(self, information: FloatArray) -> FloatArray:
        """Of information (n_pool, n_draws, n_free, n_free), (n_pool,)."""
        losses = self.aim.losses(information)
        losses[self._out] = np.inf
        return losses

    def _exchange(self, stack: FloatArray, place: int) -> bool:
        """Replace a chosen run by the best for its place; whether that was another."""
        others = self.total() - stack[self.chosen[place]]
        losses = self._losses(others + stack)
        best = int(np.argmin(losses))
        better = bool(losses[best] < losses[self.chosen[place]] - _GAIN)
        if better:
            self.chosen[place] = best
        return better

    def _settle(self, trials: Sequence[_Trial]) -> None:
        """Add the candidates that trials lead to, in their order whatever the threads."""
        candidates: list[RunCandidate | None] = [None] * len(trials)
        counting = Lock()

        def settle(place: int) -> None:
            trial, genes = trials[place], trials[place].genes
            for _ in range(_HALVINGS + 1):
                candidates[place] = candidate = self.evaluate(trial.excitation, genes)
                with counting:
                    self.attempts += 1
                    self.kept += candidate is not None
                    if self.watch is not None:
                        self.watch(self.attempts, self.kept)
                if candidate is not None:
                    return
                genes = trial.back(genes)

        self.workers.each(settle, range(len(trials)))
        self.pool += [candidate for candidate in candidates if candidate is not None]


def _midway(origin: FloatArray, genes: FloatArray) -> FloatArray:
    return 0.5 * (genes + origin)
