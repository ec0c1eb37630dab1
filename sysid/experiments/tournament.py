"""All ordered pairs of structures: which of them sets of runs tell apart."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import ndtr, ndtri

from sysid.arrays import BoolArray, FloatArray
from sysid.experiments import rivals
from sysid.experiments.rivals import FULL, Answer, Effort, Hypothesis
from sysid.experiments.search import RunCandidate
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError
from sysid.threads import Workers

LEVEL = 0.01  # of the test by which a rival is refused
EVEN = 0.5  # power below which a pair counts as not told apart
_ATTEMPTS = 200  # draws for one that keeps a model's constraints
_MARGIN = 4.0  # of noncentralities, for other parameters: of half the difference
_SECOND = 1e-3  # what counts where all is sure, so that of equal sets one is the best
_LEAST = 1e-9  # noncentrality that counts as none
CLEAR = 1000.0  # noncentrality of which a refit to other runs, or one further, hardly makes little

Point = Sequence[FloatArray]
"""For each pair the rival's chromosome, (n_free,)."""


def power(noncentrality: FloatArray | float, level: float = LEVEL) -> FloatArray:
    """Probability that a test at a level refuses a rival that errs by a noncentrality.

    Of the one-sided test along what the best rival leaves (Cox, "Tests of separate families of
    hypotheses", 4th Berkeley Symposium, 1961).

    >>> power(np.array([0.0, 5.41, 25.0])).round(3).tolist()
    [0.01, 0.5, 0.996]
    """
    distance = np.sqrt(np.maximum(noncentrality, 0.0))
    return np.asarray(ndtr(distance + ndtri(level)), dtype=np.float64)


def shortfall(distances: FloatArray) -> FloatArray:
    """How far rivals at noncentralities (..., n_pairs) are from being refused, (...).

    The mean logarithm of the probabilities, of a fraction of the distances: parameters may be
    others than those that a design starts from. A pair that hardly any run tells apart gains little
    by twice as much of hardly anything, and does not hold others back, as in the least of all.
    """
    logarithms = np.log(power(distances / _MARGIN))
    beyond = np.log(np.maximum(distances, _LEAST))
    return np.asarray(-np.mean(logarithms + _SECOND * beyond, axis=-1))


@dataclass(frozen=True)
class Separation:
    """A loss of what rivals leave: the ``shortfall`` of pairs, in which the least ones count.

    ridges: (n_points * n_pairs, n, n). possible: (n_pairs,), the pairs that count. Each pair is as
    far apart as at the worst of the points at which its rival was tried.
    """

    ridges: FloatArray
    possible: BoolArray

    def distances(self, information: FloatArray) -> FloatArray:
        """Of sums of runs' M, (n, n_points * n_pairs, n + 1, n + 1): (n, n_pairs)."""
        left = rivals.remainders(information, self.ridges)
        least: FloatArray = left.reshape(len(left), -1, len(self.possible)).min(axis=1)
        return least

    def losses(self, information: FloatArray) -> FloatArray:
        """Of sums of runs' M, (n,)."""
        return shortfall(self.distances(information)[:, self.possible])

    def met(self, _information: FloatArray) -> bool:
        """Never: more runs tell more."""
        return False


@dataclass(frozen=True)
class AnsweredRun(RunCandidate):
    """A candidate with what each structure says that it logs; information: M of each pair."""

    answers: tuple[Answer, ...]


class Tournament:
    """Each structure as the truth against each other as its rival.

    pairs: places of truth and rival. points: at which rivals have been fitted to some runs.
    possible: (n_pairs,), whether any run that was tried can tell.
    """

    def __init__(
        self,
        structures: Sequence[Hypothesis],
        workers: Workers,
        rng: np.random.Generator,
    ) -> None:
        self.structures, self._workers = structures, workers
        self._rng, places = rng, range(len(structures))
        self.pairs = [(i, j) for i in places for j in places if i != j]
        self.points: list[Point] = []
        self.possible: BoolArray = np.ones(len(self.pairs), dtype=bool)
        self._n_free = max(len(each.values) for each in structures)

    def sharper(self, accuracy: float) -> Self:
        """The same pairs, no points, by simulations of another accuracy."""
        finer = [
            replace(each, simulator=each.simulator.finer(accuracy)) for each in self.structures
        ]
        return type(self)(finer, self._workers, self._rng)

    def answers(self, records: Sequence[Dataset]) -> Iterator[Answer]:
        """What each structure says of a run; records: of it, by the structures' benches."""
        pairs = list(zip(self.structures, records, strict=True))
        n_steps = max(
            int(each.simulator.steps_of_each(each.space.full(each.values)[None], record)[0])
            for each, record in pairs
        )
        return (rivals.answer(each, record, n_steps) for each, record in pairs)

    def judged(self, run: RunCandidate) -> AnsweredRun:
        """A run with the M of each pair at each point, points one after another."""
        assert isinstance(run, AnsweredRun)
        n, n_pairs = self._n_free + 1, len(self.pairs)
        matrices = np.zeros((len(self.points) * n_pairs, n, n))
        done = len(run.information)
        matrices[:done] = run.information
        for place in range(done, len(matrices)):
            k, c = divmod(place, n_pairs)
            i, j = self.pairs[c]
            if k and self.points[k][c] is self.points[k - 1][c]:
                matrices[place] = matrices[place - n_pairs]
                continue
            each = rivals.contrast(run.answers[i], self.structures[j], self.points[k][c])
            if np.isfinite(each.joint).all():  # else the run tells nothing
                matrices[place] = self._padded(each.joint)
        return replace(run, information=matrices)

    def unjudged(self) -> FloatArray:
        """Information of a run before any rival has been fitted."""
        return np.zeros((0, self._n_free + 1, self._n_free + 1))

    def criterion(self) -> Separation:
        """The loss at the points so far."""
        ridges = np.tile(np.eye(self._n_free), (len(self.pairs), 1, 1))
        for ridge, (_, j) in zip(ridges, self.pairs, strict=True):
            of_rival = self.structures[j].ridge
            ridge[: len(of_rival), : len(of_rival)] = of_rival
        return Separation(np.tile(ridges, (len(self.points), 1, 1)), self.possible)

    def likeliest(self) -> Point:
        """All rivals at their likeliest values."""
        return [self.structures[j].values for _, j in self.pairs]

    def begins(self, first: Point, count: int) -> list[Point]:
        """Points that rivals are refitted from: a first, others anywhere, and near the truths."""
        anywhere = [self._drawn() for _ in range(count - 1)]
        return [first, *anywhere, self._nested()]

    def _nested(self) -> Point:
        """All rivals at the truths' values, as far as they have the same parameters."""
        pairs = [(self.structures[i], self.structures[j]) for i, j in self.pairs]
        return [rivals.nested(rival, truth.space.names, truth.values) for truth, rival in pairs]

    def _drawn(self) -> Point:
        """All rivals anywhere in their ranges."""
        return [self._anywhere(self.structures[j]) for _, j in self.pairs]

    def refit(
        self,
        runs: Sequence[Sequence[Answer]],
        begins: Sequence[Point],
        effort: Effort = FULL,
        distances: FloatArray | None = None,
        below: float = np.inf,
    ) -> tuple[Point, FloatArray]:
        """Fit rivals to runs from several points: where they end, noncentralities (n_pairs,).

        runs: what each structure says of each. Where distances (n_pairs,) are not below a level
        they are taken as they are, and rivals stay at the first of the points.
        """
        point = list(begins[0])
        left = np.zeros(len(point)) if distances is None else distances.copy()

        def fit(c: int) -> None:
            (i, j), starts = self.pairs[c], [begin[c] for begin in begins]
            answers = [each[i] for each in runs]
            point[c], left[c] = rivals.refit(answers, self.structures[j], *starts, effort=effort)

        self._workers.each(fit, np.flatnonzero(left < below).tolist())
        return point, left

    def judge_possible(self, pool: Sequence[RunCandidate], most: int) -> None:
        """Find out which pairs so many of the runs in a pool could tell apart.

        A rival fitted to all of them leaves more of the best run, so many times, than one fitted
        to any set leaves of that set. Raises ModelError where there is none.
        """
        n_pairs = len(self.pairs)
        stack = np.array([each.information[-n_pairs:] for each in pool])
        curvature = stack.sum(axis=0)
        ridges = self.criterion().ridges[-n_pairs:]
        moves = np.linalg.solve(curvature[:, :-1, :-1] + ridges, curvature[:, :-1, -1, None])
        along = np.concatenate([-moves[..., 0], np.ones((n_pairs, 1))], axis=1)
        left = np.einsum("ci,rcij,cj->rc", along, stack, along)
        self.possible = power(most * left.max(axis=0)) > EVEN
        if not self.possible.any():
            raise ModelError(
                "no run within the limits tells any of the structures from another; give longer "
                "or more runs, wider limits, other excitations, or less noise"
            )

    def _anywhere(self, structure: Hypothesis) -> FloatArray:
        """A chromosome that keeps the constraints, or the likeliest if that is hard to find."""
        space = structure.space
        for _ in range(_ATTEMPTS):
            coded = space.coded_lower + self._rng.random(len(space.width)) * space.width
            chromosome = space.decode(coded)
            if space.feasible(chromosome):
                return chromosome
        return structure.values

    def _padded(self, matrix: FloatArray) -> FloatArray:
        """The M of a rival with parameters to spare, which do nothing."""
        n, whole = len(matrix) - 1, np.zeros((self._n_free + 1,) * 2)
        places = [*range(n), self._n_free]
        whole[np.ix_(places, places)] = matrix
        return whole
