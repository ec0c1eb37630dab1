"""One run of an identification, step by step: genetic search, then local refinement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import Status
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import simulations_per_iteration
from sysid.gassi.local import AT_ONCE, LocalSearch
from sysid.gassi.search import GeneticSearch, Preset
from sysid.problem.model import ModelError
from sysid.problem.space import SearchSpace

# Minima of the mean RMSE so close to the best are left for the likelihood to tell apart, and
# iterations kept for each.
_MOST_RIVALS, _ITERATIONS_EACH = 2, 20


@dataclass(frozen=True)
class Best:
    """The best chromosome yet (n_free,) of a space, its error, whether constraints hold."""

    space: SearchSpace
    chromosome: FloatArray
    error: float
    feasible: bool


@dataclass
class Run:
    """A search and what follows it, with what they have found and spent.

    likelihood: whether simulations are kept for telling minima apart by their likelihood.
    history: the best error after each generation, one being as many simulations as the
    population has chromosomes; the last with what exceeded the budget. flagged: simulations
    that failed in the search, by status.
    """

    objective: Objective
    preset: Preset
    search: GeneticSearch
    generations: int
    rng: np.random.Generator
    likelihood: bool
    local: LocalSearch | None = None
    history: list[float] = field(default_factory=list)
    flagged: dict[str, int] = field(default_factory=dict)

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do."""
        if not self.preset.refine:
            return self.search.done
        return self.local is not None and self.local.done

    @property
    def stage(self) -> str:
        """``search`` or ``refine``."""
        return "search" if self.local is None else "refine"

    @property
    def best(self) -> Best | None:
        """The best found, None before the first generation; starts are estimated only locally."""
        search, local = self.search, self.local
        if search.elite is None:
            return None
        found = Best(search.space, search.elite, search.elite_error, search.elite_feasible)
        if local is None:
            return found
        space = self.objective.space
        if self._gained(local):
            return Best(space, space.decode(local.best), local.error, local.feasible)
        whole = space.with_nominal_starts(found.chromosome)
        return Best(space, whole, found.error, found.feasible)

    @property
    def minima(self) -> list[FloatArray]:
        """The best chromosome (n_free,) and others far from it that are nearly as good."""
        best, local = self.best, self.local
        assert best is not None
        if local is None or not self._gained(local):
            return [best.chromosome]
        space = self.objective.space
        return [space.decode(at) for at in local.rivals(_MOST_RIVALS)]

    def _gained(self, local: LocalSearch) -> bool:
        """Whether the local refinement found anything better than the search: feasible first."""
        search = self.search
        rank = (not local.feasible, local.error)
        return rank < (not search.elite_feasible, search.elite_error)

    def step(self) -> None:
        """The next generation, or the next step of the local refinement."""
        if not self.search.done:
            self._generation()
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
        """All that the next steps depend on beside what the run was made with."""
        return {
            "rng": self.rng.bit_generator.state,
            "simulations": self.objective.simulations,
            "search": self.search.state(),
            "local": None if self.local is None else self.local.state(),
            "history": list(self.history),
            "flagged": dict(self.flagged),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``."""
        self.rng.bit_generator.state = state["rng"]
        self.search.restore(state["search"])
        self.objective.resume_count(state["simulations"])
        if state["local"] is not None:
            self.local = self._begin_local()
            self.local.restore(state["local"])
        self.history, self.flagged = state["history"], state["flagged"]

    def _generation(self) -> None:
        errors, result = self.objective.evaluate(self.search.ask())
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
            generations = round(len(search.history) / (1.0 - self.preset.local_share))
        most = search.population * generations
        if self.likelihood:
            kept = _MOST_RIVALS * _ITERATIONS_EACH * simulations_per_iteration(self.objective)
            most -= min(kept, most // 4)
        return LocalSearch(
            self.objective,
            space.with_nominal_starts(search.promising(AT_ONCE)),
            most,
            search.population,
            self.rng,
        )
