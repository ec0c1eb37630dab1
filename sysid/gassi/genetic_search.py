"""The genetic search: populations out (``ask``), their errors in (``tell``), no simulation.

The presets are settings of one loop, in which a generation is evaluated, ranked and bred.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.gassi import operators
from sysid.gassi.penalty import infeasibility, penalise
from sysid.problem.model import ModelError
from sysid.problem.space import SearchSpace

PresetName = Literal["default", "thesis", "cega", "classic"]


@dataclass(frozen=True)
class Preset:
    """Settings of one of the algorithms.

    operators: ``adaptive`` (Algorithms 2 to 5) or ``classic`` (Algorithm 1). penalty: whether
    infeasible chromosomes are penalised (4.13)-(4.20). log_scale: search parameters marked
    ``log`` by their logarithm. keep_in_range: clip to the ranges' bounds; else the search only
    starts in the ranges. spread: population that the mutation noise is taken from. stratified:
    Latin-hypercube start. collapse: share of the initial spread below which the population
    starts anew, away from the elite. local_share: of the simulations, left to local refinement.
    squares: whether the error is (4.6), else (4.22).
    """

    operators: Literal["adaptive", "classic"]
    penalty: bool
    log_scale: bool = False
    keep_in_range: bool = False
    spread: Literal["initial", "current"] = "initial"
    stratified: bool = False
    collapse: float = 0.0
    local_share: float = 0.0
    squares: bool = False

    @property
    def refine(self) -> bool:
        """Whether local refinement follows the search."""
        return self.local_share > 0.0


PRESETS: dict[PresetName, Preset] = {
    "classic": Preset(operators="classic", penalty=False),
    "cega": Preset(operators="adaptive", penalty=False, squares=True),
    "thesis": Preset(operators="adaptive", penalty=True),
    "default": Preset(
        operators="adaptive",
        penalty=True,
        log_scale=True,
        keep_in_range=True,
        spread="current",
        stratified=True,
        collapse=0.03,
        local_share=0.85,
    ),
}

# Chromosomes that local refinement may start from, and how far apart they are at least: root mean
# square over the parameters, in parts of their ranges.
_KEPT, _APART = 8, 0.1

# Hyperparameters that Algorithm 1 leaves open and the adaptive algorithms do without.
_CLASSIC_RATIO, _CLASSIC_CROSSOVER, _CLASSIC_MUTATION = 0.3, 0.8, 0.05

_UNRANKED = (True, np.inf)  # behind every chromosome that was simulated


@dataclass
class GeneticSearch:
    """One run of a genetic algorithm over a search space.

    generations: how many are evaluated, i_max. elite_percent: r_elite. minimum_generations,
    termination_ratio: i_min and r_termination of (4.11); with 0 only the generations count. After
    each ``tell``: ``elite`` (n_free,), its error and feasibility, and its ``history`` of errors.
    begin: (n_free,), the chromosome that all of the first population are, drawn without one.
    """

    space: SearchSpace
    preset: Preset
    population: int
    generations: int
    rng: np.random.Generator
    elite_percent: float = 0.5
    minimum_generations: int = 0
    termination_ratio: float = 0.0
    begin: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.population < 2:
            raise ModelError(f"population is {self.population}; it must be at least 2")
        if self.generations < 1:
            raise ModelError(f"generations is {self.generations}; it must be at least 1")
        if not 0.0 <= self.elite_percent < 100.0:
            raise ModelError(f"elite_percent is {self.elite_percent}; it must be in [0, 100)")
        self.elite: FloatArray | None = None
        self.elite_error = np.inf
        self.elite_feasible = False
        self.history: list[float] = []
        self.converged = False
        self._elite_rank = _UNRANKED
        self._start()
        if self.begin is not None:
            self._coded = np.repeat(self.space.encode(self.begin)[None], self.population, axis=0)
        self._initial_spread = self._coded.std(axis=0)
        self._kept = np.empty((0, len(self.space.parameters)))
        self._kept_behind: BoolArray = np.empty(0, dtype=bool)
        self._kept_errors = np.empty(0)
        self._first_error = np.inf
        self._first_change: int | None = None

    def _start(self) -> None:
        """Draw a population that is independent of the elite, which is kept."""
        draw = operators.stratified if self.preset.stratified else operators.uniform
        self._coded = draw(self.population, *self._box, self.rng)
        # The best since then, by which the population breeds.
        self._leader: FloatArray | None = None
        self._leader_rank = _UNRANKED

    @property
    def _box(self) -> tuple[FloatArray, FloatArray]:
        """Ends of the ranges in search coordinates, (n_free,) each."""
        return self.space.coded_lower, self.space.encode(self.space.upper)

    @property
    def done(self) -> bool:
        """The termination rule (4.11)."""
        return self.converged or len(self.history) >= self.generations

    def ask(self) -> FloatArray:
        """The population to evaluate, (population, n_free), in the parameters' units."""
        return self.space.decode(self._coded)

    def tell(self, errors: FloatArray) -> None:
        """Take the population's errors, not finite where a simulation failed; breed the next."""
        chromosomes = self.space.decode(self._coded)
        flagged = ~np.isfinite(errors)
        violations = self.space.violations(chromosomes)
        scores = infeasibility(violations)
        behind = scores > 0.0 if self.preset.penalty else np.zeros(len(scores), dtype=bool)
        self._save_elite(errors, behind, scores == 0.0, chromosomes)
        if self.preset.refine:
            self._keep(errors, behind)
        self._check_termination()
        if self.done:
            return
        ranked = penalise(errors, violations) if self.preset.penalty else errors
        fitness = operators.normalised_fitness(ranked, flagged)
        if self.preset.operators == "adaptive":
            self._breed_adaptive(fitness)
        else:
            self._breed_classic(fitness)
        if self.preset.keep_in_range:
            np.clip(self._coded, *self.space.coded_bounds, out=self._coded)

    def promising(self, count: int) -> FloatArray:
        """Of a preset with local refinement, the best that lie apart, (at most count, n_free)."""
        return self.space.decode(self._kept[:count])

    def state(self) -> dict[str, Any]:
        """The state on which the next generations depend, beside the settings and ``rng``."""
        arguments = {field.name for field in fields(self)}
        return {k: copy.copy(v) for k, v in vars(self).items() if k not in arguments}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``."""
        for name in self.state():
            setattr(self, name, state[name])

    def _save_elite(
        self, errors: FloatArray, behind: BoolArray, feasible: BoolArray, chromosomes: FloatArray
    ) -> None:
        """Keep the best yet: feasible before infeasible, then the lower error (4.9)."""
        # An infeasibility score is relative to its own generation; between generations only
        # feasible or not, and the error, can be compared.
        usable = np.flatnonzero(np.isfinite(errors))
        if len(usable):
            best = usable[np.lexsort((errors[usable], behind[usable]))[0]]
            rank = (bool(behind[best]), float(errors[best]))
            if rank < self._leader_rank:
                self._leader, self._leader_rank = chromosomes[best].copy(), rank
            if rank < self._elite_rank:
                self.elite, self._elite_rank = chromosomes[best].copy(), rank
                self.elite_error, self.elite_feasible = rank[1], bool(feasible[best])
        self.history.append(self.elite_error)

    def _keep(self, errors: FloatArray, behind: BoolArray) -> None:
        """Merge the generation into the best chromosomes that lie apart."""
        rows = np.concatenate([self._kept, self._coded])
        all_behind = np.concatenate([self._kept_behind, behind])
        all_errors = np.concatenate([self._kept_errors, errors])
        chosen: list[int] = []
        for j in np.lexsort((all_errors, all_behind)):
            if len(chosen) == _KEPT or not np.isfinite(all_errors[j]):
                break
            away = (rows[chosen] - rows[j]) / self.space.width
            if np.all(np.mean(away**2, axis=1) > _APART**2):
                chosen.append(int(j))
        self._kept = rows[chosen]
        self._kept_behind, self._kept_errors = all_behind[chosen], all_errors[chosen]

    def _check_termination(self) -> None:
        """Running mean of the elite's error since it first changed, (4.10) and (4.11).

        It divides by the number of terms; (4.10) prints one less, undefined for the first.
        """
        i = len(self.history) - 1
        if not np.isfinite(self._first_error):
            self._first_error = self.history[i]
            return
        if self._first_change is None and self.history[i] != self.history[i - 1]:
            self._first_change = i
        if self._first_change is None or i <= self.minimum_generations:
            return
        mean = float(np.mean(self.history[self._first_change :]))
        self.converged = mean <= self.termination_ratio * self._first_error

    def _breed_adaptive(self, fitness: FloatArray) -> None:
        spread = self._coded.std(axis=0)
        if np.mean(spread / self._initial_spread) < self.preset.collapse:
            self._start()
            return
        sigma = spread if self.preset.spread == "current" else self._initial_spread
        operators.adaptive_crossover(self._coded, fitness, self.rng)
        operators.adaptive_mutation(self._coded, fitness, sigma, self.rng)
        if self._leader is not None:
            leader = self.space.encode(self._leader)
            operators.replace_by_elite(self._coded, leader, self.elite_percent, self.rng)

    def _breed_classic(self, fitness: FloatArray) -> None:
        self._coded = operators.roulette(self._coded, fitness, self.rng)
        operators.arithmetical_crossover(self._coded, _CLASSIC_RATIO, _CLASSIC_CROSSOVER, self.rng)
        operators.uniform_mutation(self._coded, *self._box, _CLASSIC_MUTATION, self.rng)
