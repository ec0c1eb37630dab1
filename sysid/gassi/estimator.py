"""GASSI as a scikit-learn style estimator over any process model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from sklearn.utils.validation import check_is_fitted

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.fitting.free_run import free_run
from sysid.fitting.objective import Balance, Objective
from sysid.fitting.refinement import Refinement
from sysid.gassi.checkpoint import Checkpoint, load, origin
from sysid.gassi.genetic_search import PRESETS, GeneticSearch, Preset, PresetName
from sysid.gassi.likelihood import fit_likelihood
from sysid.gassi.search_run import Best, SearchRun
from sysid.problem.data import Dataset
from sysid.problem.guesses import Guess, guess_ranges
from sysid.problem.metrics import fit_percent
from sysid.problem.model import ModelError, ProcessModel, Scale
from sysid.problem.ranges import Range
from sysid.problem.records import Data, RecordEstimator, split
from sysid.problem.space import SearchSpace
from sysid.threads import one_thread
from sysid.uncertainty import Profile, Uncertainty, profile, uncertainty

Criterion = Literal["likelihood", "error"]

# Settings that the result does not depend on, or that a checkpoint knows otherwise.
_NOT_DECIDING = ("model", "threads", "dt")


@dataclass(frozen=True)
class Progress:
    """What a watcher of the search is told: generation ``done`` of ``total``, the best error.

    stage: ``search``; ``refine`` while the local refinement spends the rest of them; ``weigh``
    in the last step by the likelihood, which counts iterations and knows no total.
    """

    stage: str
    done: int
    total: int
    error: float


class GASSI(RecordEstimator):
    """Identify a process model's parameters with a genetic algorithm.

    Parameters
    ----------
    model : ProcessModel; its ``with_outputs``, ``with_initial`` and ``with_holds`` choose which
        outputs count, where its states start, and how inputs run between samples.
    preset : ``default``, ``thesis`` (Algorithms 2 to 5 with the penalty (4.13)-(4.20), as
        written), ``cega`` (the same without penalty) or ``classic`` (Algorithm 1).
    population, generations : chromosomes per generation, generations evaluated. Their product is
        the number of simulations that search and local refinement share.
    ranges : {name: (lower, upper)}, search ranges in place of the model's. One of the ends may
        be None: then the other is a bound, and this one only where the search starts.
    fixed : {name: value}, parameters not searched.
    tied : {name: "0.5 * other"}, parameters that are multiples of others.
    guess : narrow the ranges of parameters of which nothing is said by what the records tell,
        with the model's ``guesses`` function.
    scale : {name: "log" or "linear"}, scales to search on in place of the model's.
    elite_percent : share of the population replaced by the elite, r_elite.
    minimum_generations, termination_ratio : i_min and r_termination of (4.11).
    weights : {output: weight}, relative importance of the outputs.
    per_log : normalise each record by its own max|y| instead of the maximum over all.
    criterion : what the default preset ends with: ``likelihood`` weighs every output by its own
        error, so that a noisy one does not decide what a clean one tells better; ``error`` stays
        with the mean RMSE that the search minimises.
    balance : ``samples``, several records count as one long one; ``logs``, each alike.
    accuracy : normalised RMS error that a simulation aims at.
    max_steps : integration steps a sample may take before a chromosome is flagged.
    threads : default all cores; the result does not depend on it.
    random_state : seed; one seed gives one result.
    dt : sample time [s] of arrays; Datasets bring their own.

    Attributes
    ----------
    parameters_ : dict of all the model's parameters after ``fit``.
    vector_ : (n_parameters,), the same in the model's order.
    chromosome_ : (n_free,), the free ones in ``space_.names`` order.
    initial_states_ : for each record a dict of the initial states that were estimated.
    guesses_ : {name: Guess} of the ranges that were read from the records.
    space_ : SearchSpace that was searched; estimated initial states stand behind the parameters.
    output_weights_ : (n_outputs,), what the outputs counted in the end.
    rivals_ : parameters of other minima that the data do not tell from the result.
    error_ : mean over outputs of the RMSE normalised by max|y| (see ``Objective``).
    search_error_ : the lowest error before local refinement.
    feasible_ : whether all constraints hold.
    history_ : (n_generations,), the best error after each generation; in the local refinement
        one is ``population`` simulations.
    stopped_ : ``generations``, ``converged`` or ``interrupted``.
    flagged_ : {status name: count} of simulations that failed during the search.
    n_simulations_ : simulations of one chromosome on all records.
    """

    def __init__(
        self,
        model: ProcessModel | None = None,
        *,
        preset: PresetName = "default",
        population: int = 300,
        generations: int = 40,
        ranges: Mapping[str, Range] | None = None,
        fixed: Mapping[str, float] | None = None,
        tied: Mapping[str, str] | None = None,
        scale: Mapping[str, Scale] | None = None,
        guess: bool = False,
        elite_percent: float = 0.5,
        minimum_generations: int = 0,
        termination_ratio: float = 0.0,
        weights: Mapping[str, float] | None = None,
        per_log: bool = False,
        balance: Balance = "samples",
        criterion: Criterion = "likelihood",
        accuracy: float = 1e-3,
        max_steps: int = 512,
        threads: int | None = None,
        random_state: int = 0,
        dt: float | None = None,
    ) -> None:
        self.model = model
        self.preset = preset
        self.population = population
        self.generations = generations
        self.ranges = ranges
        self.fixed = fixed
        self.tied = tied
        self.scale = scale
        self.guess = guess
        self.elite_percent = elite_percent
        self.minimum_generations = minimum_generations
        self.termination_ratio = termination_ratio
        self.weights = weights
        self.per_log = per_log
        self.balance = balance
        self.criterion = criterion
        self.accuracy = accuracy
        self.max_steps = max_steps
        self.threads = threads
        self.random_state = random_state
        self.dt = dt

    @one_thread()
    def fit(
        self,
        X: Data,
        y: FloatArray | None = None,
        *,
        records: Any = None,
        on_progress: Callable[[Progress], None] | None = None,
        checkpoint: Path | None = None,
        resume: Path | None = None,
    ) -> GASSI:
        """Search the parameters that make the model follow the records.

        X: one Dataset, several of any lengths and rates, or an (n_samples, n_inputs) array
        with y (n_samples,) or (n_samples, n_outputs), NaN where a sample was lost. records:
        (n_samples,), which record each row of the arrays belongs to, default one record. Ctrl-C
        stops the search and keeps the best so far.

        checkpoint: file that the search's whole state is written to as it goes, at most twice a
        second. resume: such a file to go on from, with the same result as if the search had
        never stopped; further checkpoints go to the same file unless another is named.

        Raises ModelError when every simulation of the first generation fails, for settings that
        make no sense, or for a checkpoint of other data, settings or model.
        """
        data = self._records(X, y, records, None, reset=True)
        model = self._model()
        if self.criterion not in get_args(Criterion):
            raise ModelError(
                f"unknown criterion {self.criterion!r}; choose from "
                + ", ".join(get_args(Criterion))
            )
        preset = PRESETS.get(self.preset)
        if preset is None:
            raise ModelError(f"unknown preset {self.preset!r}; choose from {', '.join(PRESETS)}")
        self.guesses_: dict[str, Guess] = {}
        if self.guess:
            self.guesses_ = guess_ranges(model, data, self.ranges, self.fixed, self.tied)
        guessed = {name: (guess.low, guess.high) for name, guess in self.guesses_.items()}
        self.space_ = SearchSpace.of(
            model,
            {**guessed, **(self.ranges or {})},
            self.fixed,
            preset.log_scale,
            tied=self.tied,
            scale=self.scale,
        )
        objective = self._objective(data)
        self.output_weights_: FloatArray = objective.weights
        self._rivals: tuple[FloatArray, ...] = ()
        self._final_accuracy = self.accuracy
        run = self._run(objective, preset)
        keeper = self._keeper(data, run, checkpoint, resume)
        notify = on_progress or (lambda progress: None)
        self.stopped_ = "generations"
        try:
            while not run.done:
                run.step()
                if keeper is not None:
                    keeper.save(run.state())
                self._take(run)
                generation = min(len(run.history), self.generations)
                notify(Progress(run.stage, generation, self.generations, self.error_))
        except KeyboardInterrupt:
            if run.best is None:
                raise
            self.stopped_ = "interrupted"
        finally:
            if keeper is not None:
                keeper.flush()
        self._take(run)
        if self.stopped_ != "interrupted":
            self._end(run, notify)
        return self

    def _end(self, run: SearchRun, notify: Callable[[Progress], None]) -> None:
        """Where a run that came to its own end goes on to."""
        if run.search.converged:
            self.stopped_ = "converged"
        if not run.search.preset.refine or self.criterion != "likelihood":
            return
        done = 0

        def watch(step: Refinement) -> None:
            nonlocal done
            done += 1
            notify(Progress("weigh", done, done, self.error_))

        try:
            settled = fit_likelihood(run.objective, run.minima(), watch)
        except KeyboardInterrupt:
            self.stopped_ = "interrupted"
            return
        self._final_accuracy = settled.objective.simulator.accuracy
        objective = run.objective
        if self._final_accuracy < self.accuracy:
            objective = objective.finer(self._final_accuracy)
        self._set(
            Best(
                objective.space,
                settled.chromosome,
                float(objective.evaluate(settled.chromosome[None])[0][0]),
                run.objective.space.feasible(settled.chromosome),
            )
        )
        self.output_weights_ = settled.objective.weights
        self._rivals = settled.rivals
        self.n_simulations_ = run.objective.simulations

    def predict(self, X: Dataset | FloatArray, *, records: Any = None) -> FloatArray:
        """Free-run outputs of the identified model, (n_samples, n_outputs).

        An array X starts from the declared initial states, each of its ``records`` anew, and the
        outputs are (n_samples,) if those of ``fit`` were; a Dataset starts from its first sample,
        and initial states that the model leaves open are estimated from its outputs.
        """
        check_is_fitted(self, "vector_")
        simulator = self._simulator()
        if isinstance(X, Dataset):
            return free_run(simulator, self.vector_, X)
        inputs = self._inputs(X, reset=False)
        q = len(self._model().outputs)
        parts = []
        for rows in split(len(inputs), records):
            # A simulation needs two rows; of a single one only the start is wanted.
            driven = np.concatenate([inputs[rows], inputs[rows][-1:]])
            unknown = np.full((len(driven), q), np.nan)
            record = Dataset(driven, unknown, self._step(None))
            parts.append(free_run(simulator, self.vector_, record)[:-1])
        return self._shaped(np.concatenate(parts))

    def score(self, X: Data, y: FloatArray | None = None, *, records: Any = None) -> float:
        """Mean fit % over outputs and records, divided by 100: 1 is perfect."""
        check_is_fitted(self, "vector_")
        data = self._records(X, y, records, None, reset=False)
        fits = [fit_percent(record.outputs, self.predict(record)) for record in data]
        return float(np.nanmean(fits)) / 100.0

    @one_thread()
    def uncertainty(
        self, X: Data, y: FloatArray | None = None, *, records: Any = None
    ) -> Uncertainty:
        """Intervals of the parameters, and what the records cannot tell of them.

        X, y, records: what ``fit`` was given. Raises ModelError where the local refinement did
        not run to its end: only at a minimum of the error do its sensitivities tell.
        """
        return uncertainty(self._settled(X, y, records), self.chromosome_, self._rivals)

    @one_thread()
    def profile(
        self, name: str, X: Data, y: FloatArray | None = None, *, records: Any = None
    ) -> Profile:
        """How much worse the best fit becomes as one parameter is moved, others fitted anew.

        X, y, records: what ``fit`` was given. Raises ModelError as ``uncertainty``, and for a
        parameter that is not free.
        """
        return profile(self._settled(X, y, records), self.chromosome_, name)

    @property
    def rivals_(self) -> list[dict[str, float]]:
        """All the model's parameters in other minima that the data do not tell from the result."""
        names = self._model().parameter_names
        vectors = [self.space_.full(rival) for rival in self._rivals]
        return [dict(zip(names, vector.tolist(), strict=True)) for vector in vectors]

    def _settled(self, X: Data, y: FloatArray | None, records: Any) -> Objective:
        """The objective at whose minimum ``fit`` ended."""
        check_is_fitted(self, "vector_")
        if not PRESETS[self.preset].refine:
            raise ModelError(f"preset {self.preset} has no local refinement, so no intervals")
        if self.stopped_ == "interrupted":
            raise ModelError("the identification was interrupted, so there are no intervals")
        data = self._records(X, y, records, None, reset=False)
        objective = self._objective(data).weighed(self.output_weights_)
        if self._final_accuracy < self.accuracy:
            return objective.finer(self._final_accuracy)
        return objective

    def _step(self, dt: float | None) -> float:
        if self.dt is None:
            raise ModelError(
                "arrays carry no time: give the sample time, GASSI(model, dt=...) in seconds, or "
                "Datasets"
            )
        return self.dt

    def _objective(self, records: Sequence[Dataset]) -> Objective:
        """The figure that ``fit`` minimises over ``space_``."""
        return Objective(
            self._simulator(),
            self.space_,
            records,
            per_log=self.per_log,
            balance=self.balance,
            weights=self._weights(self._model()),
        )

    def _model(self) -> ProcessModel:
        if self.model is None:
            raise ModelError("GASSI needs a process model: GASSI(model)")
        return self.model

    def _simulator(self) -> BatchSimulator:
        return BatchSimulator(
            self._model(), accuracy=self.accuracy, threads=self.threads, max_steps=self.max_steps
        )

    def _weights(self, model: ProcessModel) -> FloatArray | None:
        if self.weights is None:
            return None
        for name, weight in self.weights.items():
            if name not in model.output_names:
                raise ModelError(
                    f"weight for unknown output {name!r}; model {model.name} has "
                    + ", ".join(model.output_names)
                )
            if not (np.isfinite(weight) and weight >= 0.0):
                raise ModelError(f"weight of {name} is {weight}; it must be 0 or more")
        weights = np.array([float(self.weights.get(name, 1.0)) for name in model.output_names])
        if weights.sum() == 0.0:
            raise ModelError("every output has weight 0; at least one must count")
        return weights

    def _run(self, objective: Objective, preset: Preset) -> SearchRun:
        rng = np.random.default_rng(self.random_state)
        # Of the generations the genetic search has its share, the local refinement the rest.
        own = self.generations
        if preset.refine and own > 0:
            own = max(1, round((1.0 - preset.local_share) * own))
        search = GeneticSearch(
            self.space_,
            preset,
            self.population,
            own,
            rng,
            self.elite_percent,
            self.minimum_generations,
            self.termination_ratio,
        )
        likelihood = self.criterion == "likelihood"
        return SearchRun(objective, search, self.generations, likelihood)

    def _keeper(
        self, data: Sequence[Dataset], run: SearchRun, checkpoint: Path | None, resume: Path | None
    ) -> Checkpoint | None:
        """What writes the checkpoints, after the run has been set to where it goes on."""
        path = checkpoint if checkpoint is not None else resume
        if path is None:
            return None
        settings = {k: v for k, v in self.get_params(deep=False).items() if k not in _NOT_DECIDING}
        begun_with = origin(self._model(), data, settings)
        if resume is not None:
            run.restore(load(Path(resume), begun_with))
        keeper = Checkpoint(Path(path), begun_with)
        keeper.save(run.state())
        return keeper

    def _take(self, run: SearchRun) -> None:
        """The run's best and what it took, as they are known from outside."""
        assert run.best is not None
        self._set(run.best)
        self.search_error_: float = run.search.elite_error
        self.history_: FloatArray = np.array(run.history)
        self.flagged_ = dict(run.flagged)
        self.n_simulations_ = run.objective.simulations

    def _set(self, best: Best) -> None:
        self.space_ = best.space
        self.chromosome_: FloatArray = best.chromosome
        self.vector_ = best.space.full(best.chromosome)
        names = self._model().parameter_names
        self.parameters_ = {n: float(v) for n, v in zip(names, self.vector_, strict=True)}
        self.initial_states_ = best.space.named_starts(best.chromosome)
        self.error_: float = best.error
        self.feasible_ = best.feasible

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "vector_")
