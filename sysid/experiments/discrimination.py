"""Experiments that tell model structures apart: the runs at which the best rival errs most."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.experiments.bench import Bench, FreeRun
from sysid.experiments.excitation import Excitation
from sysid.experiments.experiment import (
    ChosenRuns,
    designed_run,
    deviations_of,
    tried_with,
)
from sysid.experiments.feedback import Feedback
from sysid.experiments.information import Informant
from sysid.experiments.prior import Prior
from sysid.experiments.rivals import FULL, ROUGH, Answer, Hypothesis
from sysid.experiments.search import RunCandidate, Search
from sysid.experiments.tournament import (
    CLEAR,
    EVEN,
    AnsweredRun,
    Point,
    Tournament,
    power,
    shortfall,
)
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel
from sysid.problem.space import SearchSpace
from sysid.threads import Workers, available_cores, one_thread

_TRIED = 8  # parameters of each structure at most with which a run is tried before it is chosen
_REFITS = 2  # of all rivals, between generations of runs
_SURE = 0.95  # power from which a pair counts as told apart
_COARSER, _COARSEST = 100.0, 0.1  # times the accuracy, and its end, while runs are searched for


@dataclass(frozen=True)
class Contest:
    """Whether a rival is found out where another structure is right.

    distance: noncentrality of the refitted rival's chi-square: how much more than the noise it
    leaves. probability: that a test at 1 % refuses it. values: the rival's, where it does best.
    possible: whether any run that was tried could do it; a rival that holds the truth as a special
    case is never refused.

    >>> one = Contest("square", "linear", 25.0, 0.996, {"k": 1.2}, possible=True)
    >>> one.told
    True
    """

    truth: str
    rival: str
    distance: float
    probability: float
    values: Mapping[str, float]
    possible: bool

    @property
    def told(self) -> bool:
        """Whether the test refuses the rival in 95 of 100 such sets of runs."""
        return self.probability >= _SURE


@dataclass(frozen=True)
class Discrimination(ChosenRuns):
    """Runs that tell structures apart, and how surely.

    contests: of each ordered pair.

    >>> from sysid.experiments import DesignedRun
    >>> run = DesignedRun("step", {"height": 1.0}, np.ones((50, 1)), dt=0.01)
    >>> one = Contest("a", "b", 25.0, 0.996, {}, possible=True)
    >>> other = Contest("b", "a", 0.0, 0.01, {}, possible=False)
    >>> Discrimination((run,), (one, other), attempts=64, refused=3).inseparable
    ()
    >>> Discrimination((run,), (one, other), attempts=64, refused=3).nested
    (('b', 'a'),)
    """

    contests: tuple[Contest, ...]

    @property
    def inseparable(self) -> tuple[tuple[str, str], ...]:
        """Pairs that no run tells apart, whichever of the two is right."""
        possible = {frozenset((c.truth, c.rival)) for c in self.contests if c.possible}
        pairs = dict.fromkeys(
            (c.truth, c.rival)
            for c in self.contests
            if frozenset((c.truth, c.rival)) not in possible
        )
        return tuple(pair for pair in pairs if pair == tuple(sorted(pair)))

    @property
    def nested(self) -> tuple[tuple[str, str], ...]:
        """Truths with rivals that do all they do, to within the noise, and more.

        Such a rival is never refused: only the other direction tells, or that it needs more.
        """
        apart = {frozenset((c.truth, c.rival)) for c in self.contests if c.possible}
        pairs = [(c.truth, c.rival) for c in self.contests if not c.possible]
        return tuple(pair for pair in pairs if frozenset(pair) in apart)


@one_thread()
def discriminate(
    models: Mapping[str, ProcessModel],
    excitations: Sequence[Excitation],
    *,
    noise: Mapping[str, float],
    runs: int = 4,
    spaces: Mapping[str, SearchSpace] | None = None,
    priors: Mapping[str, Prior] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    margin: float = 0.1,
    benches: Mapping[str, Bench] | None = None,
    checks: int = 16,
    candidates: int = 64,
    generations: int = 6,
    offspring: int = 16,
    starts: int = 2,
    accuracy: float = 1e-3,
    seed: int = 0,
    watch: Callable[[int, int], None] | None = None,
) -> Discrimination:
    """Choose the runs that tell model structures apart most surely.

    Each structure in turn is taken for the truth, at the likeliest of its parameters, and each
    other one fitted to what the runs would then log (T-optimality: Atkinson and Fedorov 1975). The
    runs make the least of the distances that are left as large as can be.

    models: by a name each, with the same inputs and outputs. noise, runs, limits, margin, checks,
    candidates, generations, offspring, watch: as of ``design``; limits must hold whichever
    structure is right. spaces, priors: by the same names, what is searched and what is known; by
    default the models' ranges around their nominal values. benches: by the same names, what a run
    would log if that structure were right. starts: points from which each rival is
    fitted, the likeliest and others anywhere, beside the one that is nearest to the truth.

    Raises ModelError for unknown names, models whose inputs or outputs differ, equations that
    cannot be differentiated, where every candidate would pass a limit, and where no run tells any
    pair apart.

    >>> from dataclasses import replace
    >>> from sysid.experiments import Excitation, Setting
    >>> from sysid.examples import lag
    >>> def saturating(x, u, p):
    ...     return ((p[0] * u[0] / (1.0 + u[0] * u[0]) - x[0]) / p[1],)
    >>> models = {"linear": lag(), "saturating": replace(lag(), derivative=saturating)}
    >>> step = Excitation(
    ...     "step", {"height": Setting(0.1, 2.0)}, lambda s: np.full((50, 1), s["height"]), 0.01
    ... )
    >>> result = discriminate(
    ...     models, [step], noise={"y": 0.05}, runs=2, candidates=8, generations=0
    ... )
    >>> [contest.probability > 0.99 for contest in result.contests]
    [True, True]
    """
    # Runs are searched for by coarser simulations.
    coarse = min(_COARSER * accuracy, _COARSEST)
    structures = _structures(models, noise, spaces or {}, priors or {}, coarse)
    rng, workers = np.random.default_rng(seed), Workers(available_cores())
    benches = benches or _free_runs(structures, limits or {}, margin)
    knowledge = [
        (priors or {}).get(each.name) or Prior.of_ranges(each.space) for each in structures
    ]
    vectors = [
        each.space.full(prior.draws(each.space, checks, rng))
        for each, prior in zip(structures, knowledge, strict=True)
    ]
    tournament = Tournament(structures, workers, rng)

    rig = _AnyStructure([benches[each.name] for each in structures], vectors)

    def evaluate(excitation: Excitation, genes: FloatArray) -> RunCandidate | None:
        records = rig.records(excitation.signal(genes), excitation.dt)
        if records is None:
            return None
        answers = tuple(takewhile(lambda each: each.steady, tournament.answers(records)))
        if len(answers) < len(records):
            return None
        return tournament.judged(AnsweredRun(excitation, genes, tournament.unjudged(), answers))

    aim = tournament.criterion()
    search = Search(excitations, evaluate, aim, rng, runs, workers, watch, rig.keeps)
    search.scatter(candidates)
    begins = tournament.begins(tournament.likeliest(), 1)
    few = _answers(search.pool[: -(-runs // 2)])
    tournament.points.append(tournament.refit(few, begins, ROUGH)[0])
    search.revise(tournament.judged)
    tournament.judge_possible(search.pool, runs)
    sets: list[tuple[list[RunCandidate], Point, FloatArray]] = []
    for part in np.array_split(np.arange(generations), _REFITS):
        search.revise(tournament.judged)
        search.aim = aim = tournament.criterion()
        search.choose()
        for k in part:
            search.generation(offspring, k / max(generations - 1, 1))
            search.choose()
        chosen = [search.pool[i] for i in search.chosen]
        foreseen = aim.distances(search.total()[None])[0]
        latest = [tournament.points[-1], tournament.likeliest()]
        point, distances = tournament.refit(_answers(chosen), latest, ROUGH, foreseen, CLEAR)
        tournament.possible = tournament.possible | (power(distances) > EVEN)
        tournament.points.append(point)
        sets.append((chosen, point, distances))
    possible = tournament.possible
    chosen, point, _ = min(sets, key=lambda each: float(shortfall(each[2][possible])))
    begins = [point, *tournament.begins(tournament.likeliest(), starts - 1)]
    contests = _contests(tournament, _answers(chosen), begins, accuracy)
    runs_of_it = tuple(designed_run(candidate) for candidate in chosen)
    return Discrimination(
        runs_of_it, contests, attempts=search.attempts, refused=search.attempts - search.kept
    )


class _AnyStructure:
    """A rig of which any structure may be right: a bench of each, the same limits.

    vectors: of each structure, (n_checks, n_parameters), with which limits must be kept.
    """

    def __init__(self, benches: Sequence[Bench], vectors: Sequence[FloatArray]) -> None:
        self._benches, self._vectors = benches, vectors
        self._refusals = dict.fromkeys(range(len(benches)), 0)

    def records(
        self, inputs: FloatArray | Feedback, dt: float, count: int | None = None
    ) -> list[Dataset] | None:
        """What a run would log by each structure, None where a limit is passed.

        count: of the parameter vectors that are tried, by default some.
        """
        records: dict[int, Dataset] = {}
        for place in sorted(self._refusals, key=self._refusals.__getitem__, reverse=True):
            vectors = self._vectors[place][: count or self._some(inputs)]
            each = self._benches[place].records(inputs, dt, vectors)
            if each is None:
                self._refusals[place] += 1  # is asked sooner, to be done with what is refused
                return None
            records[place] = each[0]
        return [records[place] for place in range(len(self._benches))]

    def keeps(self, run: RunCandidate) -> bool:
        """Whether a run keeps limits with the vectors that it has not been tried with, too."""
        checks, inputs = len(self._vectors[0]), run.excitation.signal(run.genes)
        tried = self._some(inputs) >= checks
        return tried or self.records(inputs, run.excitation.dt, checks) is not None

    def _some(self, inputs: FloatArray | Feedback) -> int:
        return min(tried_with(inputs, 1, len(self._vectors[0])), _TRIED)


def _answers(runs: Sequence[RunCandidate]) -> list[tuple[Answer, ...]]:
    return [run.answers for run in runs if isinstance(run, AnsweredRun)]


def _contests(
    tournament: Tournament,
    runs: Sequence[Sequence[Answer]],
    begins: Sequence[Point],
    accuracy: float,
) -> tuple[Contest, ...]:
    """Every pair, its rival fitted to what structures say of runs.

    What is sure is left at that; rivals that come closer go to their ends, and by finer steps.
    """
    point, distances = tournament.refit(runs, begins, ROUGH)
    point, distances = tournament.refit(runs, [point], FULL, distances, CLEAR)
    sharp = tournament.sharper(accuracy)
    sharper = [tuple(sharp.answers([a.record for a in run])) for run in runs]
    point, distances = sharp.refit(sharper, [point], FULL, distances, CLEAR)
    contests = []
    for c, (i, j) in enumerate(tournament.pairs):
        truth, rival = tournament.structures[i], tournament.structures[j]
        probability = float(power(distances[c]))
        values = dict(zip(rival.space.names, point[c].tolist(), strict=True))
        possible = bool(tournament.possible[c]) or probability > EVEN
        contests.append(
            Contest(truth.name, rival.name, float(distances[c]), probability, values, possible)
        )
    return tuple(contests)


def _structures(
    models: Mapping[str, ProcessModel],
    noise: Mapping[str, float],
    spaces: Mapping[str, SearchSpace],
    priors: Mapping[str, Prior],
    accuracy: float,
) -> list[Hypothesis]:
    if len(models) < 2:
        raise ModelError("name two structures at least, between which runs are to decide")
    first, *others = models.values()
    for model in others:
        for kind in ("input_names", "output_names"):
            if getattr(model, kind) != getattr(first, kind):
                raise ModelError(
                    f"structures have the same inputs and outputs, in one order: {first.name} has "
                    f"{', '.join(getattr(first, kind))}, {model.name} "
                    f"{', '.join(getattr(model, kind))}"
                )
    structures = []
    for name, model in models.items():
        space = spaces.get(name) or SearchSpace.of(model)
        ranges = Prior.of_ranges(space)
        # Runs are evaluated side by side, each by one thread.
        simulator = BatchSimulator(model, accuracy=accuracy, threads=1)
        informant = Informant(simulator, space, *deviations_of(model, noise))
        values = (priors.get(name) or ranges).values
        structures.append(
            Hypothesis(name, simulator, informant, space, values, ranges.information())
        )
    return structures


def _free_runs(
    structures: Sequence[Hypothesis], limits: Mapping[str, tuple[float, float]], margin: float
) -> dict[str, Bench]:
    """Benches of models that run by themselves, each with the limits of what it has."""
    benches: dict[str, Bench] = {}
    kept: set[str] = set()
    for each in structures:
        model = each.simulator.model
        names = {*model.input_names, *model.output_names, *model.state_names}
        within = {name: ends for name, ends in limits.items() if name in names}
        benches[each.name] = FreeRun(each.simulator, within, margin)
        kept |= within.keys()
    for name in limits:
        if name not in kept:
            raise ModelError(f"limits: no structure has a signal {name!r}")
    return benches
