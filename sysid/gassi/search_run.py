"""A whole search, step by step: genetic search, then local refinement."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import Status
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import simulations_per_iteration
from sysid.gassi.genetic_search import GeneticSearch
from sysid.gassi.local_search import AT_ONCE, LocalSearch
from sysid.problem.model import ModelError
from sysid.problem.space import SearchSpace

# Minima of the mean RMSE so close to the best are left for the likelihood to tell apart, and
# iterations kept for each.
_MOST_RIVALS, _ITERATIONS_EACH = 2, 20


class Best(NamedTuple):
    """The best chromosome (n_free,) of a space, its error, and whether constraints hold."""

    space: SearchSpace
    chromosome: FloatArray
    error: float
    feasible: bool


@dataclass
class SearchRun:
    """A genetic search and the local search that follows it.

    likelihood: whether simulations are kept for telling minima apart by their likelihood. begun:
    chromosomes, (n_free,) each, that descents start from before those of the genetic search.
    history: the best error after each generation, of as many simulations as the population has
    chromosomes; the last with what exceeded the budget. flagged: failures of the genetic search.
    """

    objective: Objective
    search: GeneticSearch
    generations: int
    likelihood: bool
    begun: Sequence[FloatArray] = ()
    local: LocalSearch | None = None
    history: list[float] = field(default_factory=list)
    flagged: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        refines = self.search.preset.refine
        self._bred = self.objective.sparing(self.begun) if refines else self.objective

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do."""
        if not self.search.preset.refine:
            return self.search.done
        return self.local is not None and self.local.polished

    @property
    def best(self) -> Best | None:
        """The best yet, None before the first generation; starts are estimated only locally."""
        search, local, space = self.search, self.local, self.objective.space
        if search.elite is None:
            return None
        if local is not None and self._locally_better(local):
            return Best(space, space.decode(local.best), local.error, local.feasible)
        elite = space.with_nominal_starts(search.elite)
        return Best(space, elite, search.elite_error, search.elite_feasible)

    def _locally_better(self, local: LocalSearch) -> bool:
        elite_rank = not self.search.elite_feasible, self.search.elite_error
        return (not local.feasible, local.error) < elite_rank

    def minima(self) -> list[FloatArray]:
        """The best chromosome (n_free,) and others far from it that are nearly as good."""
        assert self.local is not None and self.best is not None
        if not self._locally_better(self.local):
            return [self.best.chromosome]
        return [self.best.space.decode(at) for at in self.local.rivals(_MOST_RIVALS)]

    def step(self) -> None:
        """The next generation, or the next step of the local search."""
        if not self.search.done:
            self._breed()
            return
        if self.local is None:
            self.local = self._begin_local()
        self.local.step()
        generation = min(-(-self.objective.simulations // self.search.population), self.generations)
        best = self.best
        assert best is not None
        self.history += [best.error] * (generation - len(self.history))
        if len(self.history) > len(self.search.history):
            self.history[-1] = best.error

    def state(self) -> dict[str, Any]:
        """The state on which the next steps depend, beside the arguments."""
        return {
            "rng": self.search.rng.bit_generator.state,
            "simulations": self.objective.simulations,
            "search": self.search.state(),
            "local": None if self.local is None else self.local.state(),
            "history": list(self.history),
            "flagged": dict(self.flagged),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``."""
        self.search.rng.bit_generator.state = state["rng"]
        self.search.restore(state["search"])
        self.objective.resume_count(state["simulations"])
        if state["local"] is not None:
            self.local = self._begin_local()
            self.local.restore(state["local"])
        self.history, self.flagged = state["history"], state["flagged"]

    def _breed(self) -> None:
        errors, result = self._bred.evaluate(self.search.ask())
        for status in (Status.UNBOUNDED, Status.OVER_BUDGET):
            count = int(np.sum(result.status == status))
            if count:
                name = status.name.lower()
                self.flagged[name] = self.flagged.get(name, 0) + count
        if not np.isfinite(errors).any() and self.search.elite is None:
            raise ModelError(
                f"every simulation of the first generation failed ({self.flagged}); "
                "narrow the ranges, or raise max_steps if the model is this stiff"
            )
        self.search.tell(errors)
        self.history.append(self.search.elite_error)

    def _begin_local(self) -> LocalSearch:
        search = self.search
        space = search.space.with_starts(self.objective.records)
        self.objective = self.objective.over(space)
        generations = self.generations
        if search.converged:
            generations = round(len(search.history) / (1.0 - search.preset.local_share))
        budget = search.population * generations
        if self.likelihood:
            kept = _MOST_RIVALS * _ITERATIONS_EACH * simulations_per_iteration(self.objective)
            budget -= min(kept, budget // 4)
        starts = space.with_nominal_starts(np.array([*self.begun, *search.promising(AT_ONCE)]))
        return LocalSearch(self.objective, starts, budget, search.population, search.rng)
