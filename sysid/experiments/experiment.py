"""Experiments that design themselves: which runs tell most about a model's parameters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.experiments import criteria
from sysid.experiments.bench import Bench, FreeRun
from sysid.experiments.excitation import Excitation
from sysid.experiments.feedback import Feedback
from sysid.experiments.information import Informant, tells_nothing_there
from sysid.experiments.prior import Prior
from sysid.experiments.quantities import chosen, determined, relative_gradients
from sysid.experiments.search import RunCandidate, Search
from sysid.identifiability import Combination, TiedGroup
from sysid.identifiability.cache import kept_identifiability
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel, Scale
from sysid.problem.ranges import Range
from sysid.problem.space import SearchSpace
from sysid.threads import Workers, available_cores, one_thread
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.ties import named_values

# Runs are searched for by coarser simulations and few draws of the inputs' noise; of those chosen
# it is told by what was asked for and by many. Times the accuracy, its end, draws.
_COARSER, _COARSEST, _DRAWS = 10.0, 0.1, 96
_FEW = 4  # parameter vectors at least that a feedback is tried with, before it is chosen


@dataclass(frozen=True)
class DesignedRun:
    """A run of a design: the excitation's name, its settings, and the inputs that they make.

    inputs: (n_samples, n_inputs), or what makes them while it runs. dt: sample time [s].
    """

    excitation: str
    settings: Mapping[str, float]
    inputs: FloatArray | Feedback
    dt: float

    @property
    def n_samples(self) -> int:
        """Its samples; of a feedback the most."""
        inputs = self.inputs
        return inputs.n_samples if isinstance(inputs, Feedback) else len(inputs)


def is_as_narrow(width: float, wanted: float) -> bool:
    """Whether a half width is the wanted one at most, in the two digits of it that are printed.

    >>> is_as_narrow(0.1002, 0.1), is_as_narrow(0.107, 0.1)
    (True, False)
    """
    return float(f"{100.0 * width:.2g}") <= 100.0 * wanted * (1.0 + 1e-9)


@dataclass(frozen=True)
class PredictedQuantity:
    """What a design would tell of a parameter or a combination: its 95 % interval.

    before, after: half width of the interval in parts of the value, at the values that the design
    starts from. widest: the same after it, at the least favourable of the draws. target: what was
    asked for, None for nothing.
    """

    name: str
    unit: str
    value: float
    before: float
    after: float
    widest: float
    target: float | None = None

    @property
    def met(self) -> bool:
        """Whether what was asked for is to be expected, as printed."""
        return self.target is None or is_as_narrow(self.after, self.target)


@dataclass(frozen=True)
class ChosenRuns:
    """Runs that a search has chosen.

    attempts: runs that were simulated; refused: those of them that would have passed a limit.
    """

    runs: tuple[DesignedRun, ...]
    attempts: int = field(kw_only=True)
    refused: int = field(kw_only=True)

    @property
    def duration(self) -> float:
        """Length of all runs together [s]."""
        return float(sum(run.n_samples * run.dt for run in self.runs))


@dataclass(frozen=True)
class Design(ChosenRuns):
    """Runs that together tell most, and what they would tell.

    quantities: of all that the equations let experiments tell. tied, unseen: what no experiment
    with these outputs tells, with what would (``fix``). information: (n_free, n_free), of the
    search coordinates, of all runs at the values that the design starts from. phantoms: runs that
    were left out since the simulation's error would have passed for information.

    >>> run = DesignedRun("step", {"height": 1.0}, np.ones((50, 1)), dt=0.01)
    >>> Design((run, run), (), (), (), np.eye(2), attempts=64, refused=3).duration
    1.0
    """

    quantities: tuple[PredictedQuantity, ...]
    tied: tuple[TiedGroup, ...]
    unseen: tuple[str, ...]
    information: FloatArray
    phantoms: int = field(default=0, kw_only=True)

    @property
    def met(self) -> bool:
        """Whether all that was asked for is to be expected."""
        return all(quantity.met for quantity in self.quantities)


@one_thread()
def design(
    model: ProcessModel,
    excitations: Sequence[Excitation],
    *,
    noise: Mapping[str, float],
    runs: int = 4,
    targets: Mapping[str, float] | None = None,
    precision: float | None = None,
    quantities: Sequence[str] = (),
    criterion: criteria.Name = "D",
    prior: Prior | None = None,
    before: FloatArray | None = None,
    ranges: Mapping[str, Range] | None = None,
    fixed: Mapping[str, float] | None = None,
    tied: Mapping[str, str] | None = None,
    scale: Mapping[str, Scale] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    margin: float = 0.1,
    bench: Bench | None = None,
    draws: int = 4,
    checks: int = 16,
    candidates: int = 64,
    generations: int = 6,
    offspring: int = 16,
    accuracy: float = 1e-3,
    seed: int = 0,
    watch: Callable[[int, int], None] | None = None,
) -> Design:
    """Choose the runs that tell most about the parameters of a model.

    excitations: what may be run, each with free settings. noise: standard deviation of the white
    noise of each output, and of each measured input, in its unit, by name; an output left out does
    not count, an input left out is known exactly. runs: the most there
    may be. targets: half width of the 95 % interval that is wanted, in parts of the value, by
    parameter or combination (``{"K_m": 0.01, "J_m + J_b": 0.05}``); runs are added until all are
    met; precision: the same for all that experiments can tell. Without them the ``criterion``
    decides: D of all parameters; A (mean variance) or E (largest variance) of ``quantities``, by
    default all that experiments can tell.

    prior: what is known, by default the model's ranges around its nominal values; before: (n_free,
    n_free), information of runs that have been made. ranges, fixed, tied, scale: as of an
    identification.
    limits: (low, high) of inputs, states and outputs by name, which no run may pass with any of
    ``checks`` parameter vectors drawn from what is known; ``margin`` of them is kept. bench: what
    takes the place of these limits where a plant is not the model alone. draws: parameter vectors
    over which the criterion is averaged (ED-optimality). candidates, generations, offspring: how
    many runs are tried at random, and how often how many new ones are made of the best. watch: is
    told how many runs have been simulated, and how many of them kept the limits.

    Left out are runs of which the simulation's error would pass for information. Raises ModelError
    for unknown names, equations that cannot be differentiated, and where every candidate would pass
    a limit.

    >>> from sysid.experiments import Excitation, Setting
    >>> from sysid.examples import lag
    >>> def square(s):
    ...     return s["size"] * np.sign(np.sin(np.arange(100) * 0.01 / s["period"] * 6.28))[:, None]
    >>> settings = {"size": Setting(0.1, 2.0), "period": Setting(0.05, 2.0, log=True)}
    >>> result = design(
    ...     lag(), [Excitation("square", settings, square, 0.01)], noise={"y": 0.01},
    ...     limits={"u": (-1.0, 1.0)}, runs=2, candidates=16, generations=2, draws=2,
    ... )
    >>> [quantity.name for quantity in result.quantities]
    ['gain', 'tau']
    >>> result.duration, all(q.after < 0.02 < q.before for q in result.quantities)
    (2.0, True)
    """
    space = SearchSpace.of(model, ranges, fixed, tied=tied, scale=scale)
    # Candidates are evaluated side by side, each by one thread.
    simulator = BatchSimulator(model, accuracy=accuracy, threads=1)
    coarse = BatchSimulator(model, accuracy=min(_COARSER * accuracy, _COARSEST), threads=1)
    informant = Informant(coarse, space, *deviations_of(model, noise))
    exact = Informant(simulator, space, *deviations_of(model, noise), draws=_DRAWS)
    measured = [name for name in model.output_names if name in noise]
    structure = kept_identifiability(space.as_model().with_outputs(measured))
    wanted = chosen(tuple(targets or quantities), structure, space)
    if precision is not None:
        targets = {quantity.text: precision for quantity in wanted}
    knowledge, rng = prior or Prior.of_ranges(space), np.random.default_rng(seed)
    information = knowledge.information() + (0.0 if before is None else before)
    drawn = knowledge.draws(space, max(draws, checks), rng)
    robust, vectors = drawn[:draws], space.full(drawn)
    bench = bench or FreeRun(simulator, limits, margin)
    null = [informant.null_directions(chromosome) for chromosome in robust]
    phantoms: list[str] = []

    def expected(by: Informant, excitation: Excitation, genes: FloatArray) -> FloatArray | None:
        inputs = excitation.signal(genes)
        records = bench.records(inputs, excitation.dt, vectors[: tried_with(inputs, draws, checks)])
        if records is None:
            return None
        gained = _information(by, records[:draws], robust)
        return gained if np.isfinite(gained).all() else None

    def evaluate(excitation: Excitation, genes: FloatArray) -> RunCandidate | None:
        for by in (informant, exact):  # where coarser steps err, finer ones need not
            gained = expected(by, excitation, genes)
            if gained is None:
                return None
            if all(map(tells_nothing_there, gained, null)):
                return RunCandidate(excitation, genes, gained)
        phantoms.append(excitation.name)
        return None

    def settled(candidate: RunCandidate) -> RunCandidate:
        gained = expected(exact, candidate.excitation, candidate.genes)
        return candidate if gained is None else replace(candidate, information=gained)

    goals = np.array(list((targets or {}).values())) / Z95
    gradients = relative_gradients(wanted, space, robust)
    of_information = criteria.Criterion(criterion, information, gradients, goals)
    workers = Workers(available_cores())
    confirm = partial(kept_by_all, lambda inputs, dt: bench.records(inputs, dt, vectors))
    search = Search(excitations, evaluate, of_information, rng, runs, workers, watch, confirm)
    search.run(candidates, generations, offspring)
    search.settle(settled)
    total = search.total()
    return Design(
        tuple(designed_run(search.pool[i]) for i in search.chosen),
        _predicted(determined(structure, space), space, robust, information, total, targets or {}),
        structure.tied,
        structure.unseen,
        total[0],
        attempts=search.attempts,
        refused=search.attempts - search.kept,
        phantoms=len(phantoms),
    )


def tried_with(inputs: FloatArray | Feedback, draws: int, checks: int) -> int:
    """Parameter vectors that a candidate is tried with: all, of a feedback few, which take long."""
    return max(draws, _FEW) if isinstance(inputs, Feedback) else max(draws, checks)


def kept_by_all(
    records: Callable[[Feedback, float], object | None], candidate: RunCandidate
) -> bool:
    """Whether a candidate keeps limits with the vectors that it has not been tried with, too.

    records: what all of them give, None where a limit is passed.
    """
    excitation = candidate.excitation
    inputs = excitation.signal(candidate.genes)
    return not isinstance(inputs, Feedback) or records(inputs, excitation.dt) is not None


def designed_run(candidate: RunCandidate) -> DesignedRun:
    """A candidate that was chosen."""
    excitation, genes = candidate.excitation, candidate.genes
    return DesignedRun(
        excitation.name, excitation.at(genes), excitation.signal(genes), excitation.dt
    )


def _predicted(
    quantities: Sequence[Combination],
    space: SearchSpace,
    robust: FloatArray,
    before: FloatArray,
    gained: FloatArray,
    targets: Mapping[str, float],
) -> tuple[PredictedQuantity, ...]:
    """What information gained at each draw, beside that before, tells of the quantities."""
    judged = criteria.Criterion("A", before, relative_gradients(quantities, space, robust))
    first, after = (
        Z95 * judged.deviations(information[None])[0]
        for information in (np.zeros_like(gained), gained)
    )
    values = named_values(space, robust[0])
    return tuple(
        PredictedQuantity(
            quantity.text, quantity.unit, quantity.value(values), float(first[0, j]),
            float(after[0, j]), float(after[:, j].max()), targets.get(quantity.text),
        )
        for j, quantity in enumerate(quantities)
    )  # fmt: skip


def _information(
    informant: Informant, records: Sequence[Dataset], chromosomes: FloatArray
) -> FloatArray:
    """Information at each chromosome of the record that it would give, (n, n_free, n_free)."""
    if all(record is records[0] for record in records):
        return informant.information(records[0], chromosomes)
    pairs = zip(records, chromosomes, strict=True)
    return np.array([informant.information(record, row[None])[0] for record, row in pairs])


def deviations_of(model: ProcessModel, noise: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Noise of the outputs, infinite for those that do not count, and of the inputs, else none."""
    names = (*model.output_names, *model.input_names)
    for name, deviation in noise.items():
        if name not in names:
            raise ModelError(
                f"noise: model {model.name} has no output or input {name!r}; it has "
                f"{', '.join(names)}"
            )
        if not 0.0 < deviation < np.inf:
            raise ModelError(f"noise of {name}: {deviation} is no standard deviation; above 0")
    if not noise.keys() & set(model.output_names):
        raise ModelError("noise: name the outputs that are measured, each with its deviation")
    of_outputs = np.array([noise.get(name, np.inf) for name in model.output_names])
    return of_outputs, np.array([noise.get(name, 0.0) for name in model.input_names])
