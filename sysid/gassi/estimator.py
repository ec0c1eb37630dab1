"""GASSI as a scikit-learn estimator over any process model."""

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.compiler import kalman_filter
from sysid.engine.simulation import BatchSimulator, noisy_inputs
from sysid.fitting.descent import Point
from sysid.fitting.free_run import free_run
from sysid.fitting.innovations import Innovations, filters
from sysid.fitting.objective import Balance, Objective
from sysid.fitting.refinement import begin, refine_each
from sysid.gassi.cega_objective import CegaObjective
from sysid.gassi.checkpoint import Checkpoint, load, origin
from sysid.gassi.excerpt import Excerpt
from sysid.gassi.first_samples import noticed_starts, with_starts
from sysid.gassi.genetic_search import PRESETS, GeneticSearch, Preset, PresetName
from sysid.gassi.likelihood import Begun, NoisyInputs, fit_likelihood, promising
from sysid.gassi.nudged import held, let_go
from sysid.gassi.search_run import Best, SearchRun
from sysid.problem.data import Dataset, require_information
from sysid.problem.earlier_minima import EarlierMinima
from sysid.problem.given import Given
from sysid.problem.guesses import Guess, guess_ranges
from sysid.problem.metrics import fit_percent
from sysid.problem.model import ModelError, ProcessModel, Scale
from sysid.problem.ranges import Range
from sysid.problem.records import Data, RecordEstimator, split
from sysid.problem.space import SearchSpace
from sysid.threads import one_thread
from sysid.uncertainty import Profile, Uncertainty, determined_rank, profile, uncertainty

Criterion = Literal["auto", "compensated", "innovations", "likelihood", "error"]

_OF_NOISY_INPUTS: Mapping[str, NoisyInputs] = {name: name for name in get_args(NoisyInputs)}
_OVERWHELMED = (
    "since the noise of the measured inputs would explain more than all of the free run's error: "
    "what it does adds up over this record, and only the outputs tell it"
)
_AVERAGED = (
    "; averages of them are taken, since their noise hides where the equations bend: it also moves "
    "free runs too far for these to tell what the model may lack"
)

# Times the samples of a search in a record, beyond which a fit goes by parts as well: more of them
# tell little more, and take the longer.
_VERY_LONG = 8

# Minima that a search by parts does not tell apart and that are fitted to their end: to all
# samples, or for less to the parts themselves.
_ALIKE_BY_ALL, _ALIKE_BY_PARTS = 3, 10
_FAR_OFF = 0.1  # of an output's deviation, that is no noise of a precise measurement

# Not compared with a checkpoint's: they do not decide the result, or it holds them otherwise.
_NOT_COMPARED = ("model", "threads", "dt")


@dataclass(frozen=True)
class Progress:
    """Progress of a search: generation ``done`` of ``total`` and the best error so far.

    stage: ``search`` by the genetic algorithm, ``refine`` by local least squares, or ``weigh`` by
    the likelihood at the end, where ``done`` and ``total`` are the iterations so far.
    """

    stage: str
    done: int
    total: int
    error: float


@dataclass(repr=False, eq=False)
class GASSI(RecordEstimator):
    """Identify a process model's parameters with a genetic algorithm.

    Parameters
    ----------
    model : ProcessModel; its ``with_outputs``, ``with_initial`` and ``with_holds`` choose which
        outputs count, where its states start, and how inputs run between samples.
    preset : ``default``, ``thesis`` (Algorithms 2 to 5 with the penalty (4.13)-(4.20), as
        written), ``cega`` (Algorithm 2 with its own error (4.6)) or ``classic`` (Algorithm 1).
    population, generations : chromosomes per generation, generations evaluated. Their product is
        the number of simulations that search and local refinement share.
    ranges : {name: (lower, upper)}, search ranges in place of the model's. One of the ends may
        be None: then the other is a bound, and this one only where the search starts.
    fixed : {name: value}, parameters not searched.
    tied : {name: "0.5 * other"}, parameters that are multiples of others.
    given : ``Given``, parameters not searched since an earlier identification found them; its
        covariance widens the intervals.
    guess : narrow the ranges of parameters without a range or value here, by what the model's
        ``guesses`` function reads from the records.
    scale : {name: "log" or "linear"}, scales to search on in place of the model's.
    elite_percent : share of the population replaced by the elite, r_elite; 0 for none.
    minimum_generations, termination_ratio : i_min and r_termination of (4.11).
    weights : {output: weight}, relative importance of the outputs.
    per_log : normalise each record by its own max|y| instead of the maximum over all.
    criterion : what the default preset ends with: ``likelihood`` weighs every output by its own
        error; ``compensated`` as well, and takes out what the noise of measured inputs does to
        the errors; ``innovations`` are those of an extended Kalman filter for that noise;
        ``error`` stays with the mean RMSE that the search minimises. ``auto`` is ``likelihood``
        without ``input_noise``, with it ``compensated``, and ``innovations`` with ``windows`` or
        ``process_noise``.
    first_samples : states that start at their first sample whatever its noise. Others, where it
        would move what is estimated by more than a standard deviation, get a start of their own.
    process_noise : {state: intensity} of white noise that drives states, for ``innovations``:
        standard deviation of the state after a second, were it to do nothing but sum that noise,
        in its unit over sqrt(s).
    balance : ``samples``, several records count as one long one; ``logs``, each alike.
    accuracy : normalised RMS error that a simulation aims at.
    max_steps : integration steps a sample may take before a chromosome is flagged.
    search_samples : of records that have more than twice as many samples, search and descents go
        by parts of about so many, and only their minima are fitted to all; of short records that
        repeat each other by a few of them. Of a record of more than eight times as many the whole
        fit goes by parts. 0: all, always. Of the presets that refine.
    threads : default all cores; the result does not depend on their number.
    random_state : seed; equal seeds give equal results.
    dt : sample time [s] of arrays; Datasets bring their own.

    Attributes
    ----------
    parameters_ : dict of all the model's parameters after ``fit``.
    vector_ : (n_parameters,), the same in the model's order.
    chromosome_ : (n_free,), the free parameters in ``space_.names`` order.
    estimated_starts_ : states whose start was estimated for the noise of their first samples.
    final_chromosome_ : (n_free,), the same as ``final_objective`` has it, where parts of very long
        records have starts of their own.
    initial_states_ : for each record a dict of the initial states that were estimated.
    guesses_ : {name: Guess} of the ranges that were read from the records.
    space_ : SearchSpace that was searched; estimated initial states stand behind the parameters.
    output_weights_ : (n_outputs,), final weights of the outputs.
    criterion_, criterion_reason_ : what it was, and why.
    output_noise_ : (n_outputs,), noise of the outputs, None where that of inputs and process does
        not count. least_noise_ : below which it is not sought, as where edges time a speed.
    averaged_inputs_ : whether a filter took noisy inputs as averages.
    rivals_ : parameters in each further minimum that explains the data as well as the result.
    error_ : mean over outputs of the RMSE normalised by max|y| (see ``Objective``); of ``cega``
        (4.6) (see ``CegaObjective``).
    search_error_ : the lowest error before local refinement.
    feasible_ : whether all constraints hold.
    history_ : (n_generations,), the best error after each ``population`` simulations.
    stopped_ : ``generations``, ``converged`` (its termination ratio), ``settled`` (no other minimum
        was to be expected) or ``interrupted``.
    flagged_ : {status name: count} of simulations that failed during the search.
    excerpt_ : the ``Excerpt`` of long records that the search went by, and the fit as well where
        it is ``cut``; None where it was all.
    n_simulations_ : simulations of one chromosome on all records, or on the excerpt.

    Examples
    --------
    >>> import numpy as np
    >>> from sysid import GASSI, Dataset, Input, Output, Parameter, ProcessModel, State
    >>> model = ProcessModel(
    ...     name="lag",
    ...     states=(State("y", "V"),),
    ...     inputs=(Input("u", "V"),),
    ...     outputs=(Output("y", "V"),),
    ...     parameters=(Parameter("tau", "s", 0.1, 0.01, 1.0, "log"),),
    ...     derivative=lambda x, u, p: ((u[0] - x[0]) / p[0],),
    ... )
    >>> time = np.arange(0.0, 1.0, 0.01)
    >>> record = Dataset(np.ones(100), 1.0 - np.exp(-time / 0.2), 0.01)
    >>> estimator = GASSI(model, population=10, generations=2).fit(record)
    >>> round(estimator.parameters_["tau"], 6)
    0.2
    """

    fitted = "vector_"

    model: ProcessModel | None = None
    _: KW_ONLY
    preset: PresetName = "default"
    population: int = 300
    generations: int = 40
    ranges: Mapping[str, Range] | None = None
    fixed: Mapping[str, float] | None = None
    tied: Mapping[str, str] | None = None
    given: Given | None = None
    scale: Mapping[str, Scale] | None = None
    guess: bool = False
    elite_percent: float = 0.5
    minimum_generations: int = 0
    termination_ratio: float = 0.0
    weights: Mapping[str, float] | None = None
    per_log: bool = False
    balance: Balance = "samples"
    criterion: Criterion = "auto"
    first_samples: Collection[str] = ()
    process_noise: Mapping[str, float] | None = None
    accuracy: float = 1e-3
    max_steps: int = 512
    search_samples: int = 8192
    threads: int | None = None
    random_state: int = 0
    dt: float | None = None

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
        earlier: EarlierMinima | None = None,
    ) -> Self:
        """Search for the parameters with which the model follows the records.

        X: one Dataset, several of any lengths and rates, or an (n_samples, n_inputs) array
        with y (n_samples,) or (n_samples, n_outputs), NaN where a sample was lost. records:
        (n_samples,), which record each row of the arrays belongs to, default one record. Ctrl-C
        stops the search and keeps the best so far.

        checkpoint: file that the search's whole state is written to, at most twice a second.
        resume: such a file to go on from, to the same result; further checkpoints go to the same
        file unless another is named.
        earlier: of presets that refine, where a fit of some of the records has ended. Descents
        begin there as well, so that the result explains all of the records no worse than the minima
        beside it. If it is settled nothing is searched for: the result is the minimum beside it,
        and it is taken that no other looks like it.

        Raises ModelError when every simulation of the first generation fails, for records without
        information, settings that make no sense, or a checkpoint of other data, settings or model.
        """
        self.estimated_starts_: tuple[str, ...] = ()
        data = self._records(X, y, records, None, reset=True)
        model, preset = self._model(), self._preset()
        fixed = dict(self.fixed or {})
        if self.given is not None:
            self.given.check(model, fixed)
            fixed |= self.given.values
        self.guesses_: dict[str, Guess] = {}
        if self.guess:
            self.guesses_ = guess_ranges(model, data, self.ranges, fixed, self.tied)
        ranges = {name: (guess.low, guess.high) for name, guess in self.guesses_.items()}
        ranges |= self.ranges or {}
        self.space_ = SearchSpace.of(
            model, ranges, fixed, preset.log_scale, tied=self.tied, scale=self.scale
        )
        model.require_ends(self.space_.full(np.array([self.space_.lower, self.space_.upper])))
        objective = self._objective(data)
        require_information(data, model.output_names, len(self.space_.names))
        self.output_weights_: FloatArray = objective.weights
        self._rivals: tuple[FloatArray, ...] = ()
        self._ridge: tuple[FloatArray, ...] = ()
        self._final_accuracy = self._slopes_accuracy = self.accuracy
        self._exact_slopes = False
        self.criterion_, self.criterion_reason_ = self._criterion(data, preset)
        self.output_noise_: FloatArray | None = None
        self.least_noise_: FloatArray | None = None
        self.averaged_inputs_ = False
        self.excerpt_ = self._excerpt(data) if preset.refine else None
        searched = self._searched(objective)
        objective = objective if self._cut is None else self._cut.among(objective)
        earlier = earlier if preset.refine else None
        run = self._search_run(searched, preset, earlier)
        checkpoints = self._checkpoints(data, run, checkpoint, resume)
        notify = on_progress or (lambda progress: None)
        self.stopped_ = self._search(run, checkpoints, notify)
        self._set_run(run)
        try:
            if self.stopped_ != "interrupted" and not (earlier and earlier.is_settled):
                self._search_held(run, searched, preset, notify)
            self._conclude(run, objective, notify, earlier)
        except KeyboardInterrupt:
            self.stopped_ = "interrupted"
        return self

    def _search(
        self, run: SearchRun, checkpoints: Checkpoint | None, notify: Callable[[Progress], None]
    ) -> str:
        """Run the search to its end; why it ended, as in ``stopped_``."""
        try:
            while not run.done:
                run.step()
                if checkpoints is not None:
                    checkpoints.save(run.state())
                self._set_run(run)
                stage = "search" if run.local is None else "refine"
                generation = min(len(run.history), self.generations)
                notify(Progress(stage, generation, self.generations, self.error_))
        except KeyboardInterrupt:
            if run.best is None:
                raise
            return "interrupted"
        finally:
            if checkpoints is not None:
                checkpoints.flush()
        if run.search.converged:
            return "converged"
        return "settled" if len(run.history) < self.generations else "generations"

    def _search_held(
        self,
        run: SearchRun,
        objective: Objective,
        preset: Preset,
        notify: Callable[[Progress], None],
    ) -> None:
        """Search by runs that measurements hold, too, where the best free run is far from them.

        objective: that of the search, over the parameters alone.
        """
        free, best = run.objective, run.best
        if run.local is None or best is None or self._cut is not None:  # that had such runs
            return
        if free.unexplained(free.rms(best.chromosome[None])[0]) < _FAR_OFF:
            return
        by_held = held(objective)
        if by_held is None:
            return
        search = self._search_run(by_held, preset, None)
        while not search.done:
            search.step()
            notify(Progress("refine", len(search.history), self.generations, self.error_))
        for end in let_go(free, search.minima()):
            at = free.space.encode(end.chromosome)
            run.local.add(Point(at, end.error, end.rms))
        self._set_run(run)

    def _conclude(
        self,
        run: SearchRun,
        objective: Objective,
        notify: Callable[[Progress], None],
        earlier: EarlierMinima | None,
    ) -> None:
        """Fit the minima of a search to all of the records, and keep the best.

        objective: of the records, over the parameters alone. earlier: as of ``fit``.
        """
        iterations = itertools.count(1)

        def watch(_: Point) -> None:
            done = next(iterations)
            notify(Progress("weigh", done, done, self.error_))

        excerpt, fitted = self.excerpt_, run.objective
        if excerpt is not None:
            space, (chromosome,) = self._on_fitted(run, objective, [self.final_chromosome_])
            fitted = objective.over(space)
            self._set_evaluated(fitted, chromosome)
        if self.stopped_ == "interrupted" or not self._preset().refine:
            return
        if self.criterion_ != "error":
            begun = Begun.of(earlier, fitted, run.begun)
            minima = self._promising(run, fitted, watch, lookalike=not begun.is_settled)
            self._maximise_likelihood(fitted, minima, watch, begun)
        elif excerpt is not None:
            minima = self._on_fitted(run, fitted, run.minima())[1]
            ends = refine_each(fitted, [begin(fitted, each) for each in minima])
            best = min(ends, key=lambda end: (not space.feasible(end.chromosome), end.error))
            self._set_evaluated(fitted, best.chromosome)

    def _promising(
        self,
        run: SearchRun,
        objective: Objective,
        watch: Callable[[Point], None],
        *,
        lookalike: bool,
    ) -> list[FloatArray]:
        """Minima (n_free,) of a search, of an excerpt's those that all of the records may favour.

        objective: of the records. lookalike: whether others may look like them.
        """
        excerpt, minima = self.excerpt_, run.minima()
        if excerpt is None:
            return minima
        searched = run.objective
        if excerpt.cut:
            searched, minima = objective, self._on_fitted(run, objective, minima)[1]
        # What looks like a filter's minimum it tells itself, by all of the records.
        lookalike = lookalike and self.criterion_ != "innovations"
        most = _ALIKE_BY_PARTS if excerpt.cut else _ALIKE_BY_ALL
        sharpens = self.criterion_ not in _OF_NOISY_INPUTS
        minima = promising(
            searched, minima, watch, lookalike=lookalike, most=most, sharpens=sharpens
        )
        return minima if excerpt.cut else excerpt.on_all(searched.space, minima)[1]

    def _maximise_likelihood(
        self,
        objective: Objective,
        minima: Sequence[FloatArray],
        watch: Callable[[Point], None],
        begun: Begun,
    ) -> None:
        """Refit the minima of the mean RMSE by likelihood, and keep the likeliest.

        begun: as of ``fit_likelihood``.
        """
        noise, process = _OF_NOISY_INPUTS.get(self.criterion_), self._process()
        fit = partial(fit_likelihood, watch=watch, noise=noise, process=process)
        explored = self.excerpt_ is not None
        result = fit(objective, minima, begun=begun, explored=explored)
        likeliest = result.optimum
        if not filters(likeliest.objective):
            fitted, chromosome = likeliest.objective, likeliest.chromosome
            self.estimated_starts_ = noticed_starts(fitted, chromosome, self.first_samples)
        if self.estimated_starts_:
            minima = [likeliest.chromosome, *result.rivals]
            objective, minima = self._with_starts(objective, minima)
            result = fit(objective, minima, begun=replace(begun, chromosomes=()), explored=True)
        likeliest, self._rivals, self._ridge = result.optimum, result.rivals, result.ridge
        self._final_accuracy = likeliest.objective.simulator.accuracy
        self._slopes_accuracy = likeliest.objective.coarse.simulator.accuracy
        self._exact_slopes = likeliest.objective.exact_slopes
        self._set_evaluated(self._at_final_accuracy(objective), likeliest.chromosome)
        self.output_weights_ = likeliest.objective.weights
        if isinstance(likeliest.objective, Innovations):
            self.output_noise_ = likeliest.objective.noise
            self.least_noise_ = likeliest.objective.least_noise
            self.averaged_inputs_ = likeliest.objective.quiet
            if likeliest.objective.corrects and self.criterion_ == "compensated":
                self.criterion_, self.criterion_reason_ = "innovations", _OVERWHELMED
            if self.averaged_inputs_:
                self.criterion_reason_ += _AVERAGED

    def _with_starts(
        self, objective: Objective, chromosomes: Sequence[FloatArray]
    ) -> tuple[Objective, list[FloatArray]]:
        """An objective and chromosomes (n_free,) with the starts in ``estimated_starts_``."""
        model, before = self._model(), objective.space
        started = [with_starts(model, objective.records, before, c) for c in chromosomes]
        self.space_ = started[0][0]
        anew = objective.simulated_by(self.simulator()).over(self.space_)
        self._set_evaluated(anew, started[0][1])
        return anew, [chromosome for _, chromosome in started]

    def predict(self, X: Dataset | FloatArray, *, records: Any = None) -> FloatArray:
        """Free-run outputs of the identified model, (n_samples, n_outputs).

        An array X starts from the declared initial states, each of its ``records`` anew, and the
        outputs are (n_samples,) if those of ``fit`` were; a Dataset starts from its first sample,
        and initial states that the model leaves open are estimated from its outputs.
        """
        self._check_fitted()
        simulator = self.simulator()
        if isinstance(X, Dataset):
            return free_run(simulator, self.vector_, X)
        inputs, parts = self._inputs(X, reset=False), []
        for rows in split(len(inputs), records):
            # A simulation needs two rows: the last is repeated, so that one row suffices.
            padded = np.concatenate([inputs[rows], inputs[rows][-1:]])
            unknown = np.full((len(padded), len(simulator.model.outputs)), np.nan)
            record = Dataset(padded, unknown, self._step(None))
            parts.append(free_run(simulator, self.vector_, record)[:-1])
        return self._shaped(np.concatenate(parts))

    def score(self, X: Data, y: FloatArray | None = None, *, records: Any = None) -> float:
        """Mean fit % over outputs and records, divided by 100: 1 is perfect."""
        self._check_fitted()
        data = self._records(X, y, records, None, reset=False)
        fits = [fit_percent(record.outputs, self.predict(record)) for record in data]
        return float(np.nanmean(fits)) / 100.0

    @one_thread()
    def uncertainty(
        self, X: Data, y: FloatArray | None = None, *, records: Any = None
    ) -> Uncertainty:
        """Intervals of the parameters, and which of them the records cannot tell apart.

        X, y, records: those of ``fit``. Raises ModelError unless refinement ended in a minimum.
        """
        objective = self.final_objective(X, y, records)
        minima = self.final_chromosome_, self._rivals, self._ridge
        if self._cut is None:
            return uncertainty(objective, *minima)
        places = self._cut.places_on_all(objective.space)
        return uncertainty(objective, *minima, profiled=places).of(places, self.space_.names)

    @one_thread()
    def determined_rank(self, X: Data, y: FloatArray | None = None, *, records: Any = None) -> int:
        """How many of the free numbers, or of their combinations, the records determine.

        That of ``uncertainty``, without its intervals, which take far longer. X, y, records: those
        of ``fit``. Raises ModelError as ``uncertainty``.
        """
        return determined_rank(self.final_objective(X, y, records), self.final_chromosome_)

    @one_thread()
    def profile(
        self, name: str, X: Data, y: FloatArray | None = None, *, records: Any = None
    ) -> Profile:
        """Profile likelihood: the best fit as one parameter moves and all others are refitted.

        X, y, records: those of ``fit``. Raises ModelError as ``uncertainty``, and for a parameter
        that is not free.
        """
        return profile(self.final_objective(X, y, records), self.final_chromosome_, name)

    @property
    def is_refined_(self) -> bool:
        """Whether ``fit`` came to a minimum that can be simulated, so that it has intervals."""
        ended = self._preset().refine and self.stopped_ != "interrupted"
        return ended and not self._grows

    @property
    def _grows(self) -> bool:
        """Whether free runs, of which the fit was, grow beyond all bounds where it ended."""
        return self.output_noise_ is None and not np.isfinite(self.error_)

    @property
    def rivals_(self) -> list[dict[str, float]]:
        """All the model's parameters in each further minimum that explains the data as well."""
        return [self._named(self.space_.full(rival)) for rival in self._rivals]

    def final_objective(
        self, X: Data, y: FloatArray | None = None, records: Any = None
    ) -> Objective:
        """The objective at whose minimum ``fit`` ended.

        X, y, records: those of ``fit``. Raises ModelError as ``uncertainty``.
        """
        fitted = self._fitted_objective(X, y, records)
        if isinstance(fitted, Innovations):
            return fitted.doubting(self.final_chromosome_).eased(self.final_chromosome_)
        return fitted

    def final_free_run(
        self, X: Data, y: FloatArray | None = None, records: Any = None
    ) -> Objective:
        """The objective of the free run's errors, by the weights with which ``fit`` ended.

        X, y, records: those of ``fit``. Raises ModelError as ``uncertainty``.
        """
        return self._fitted_objective(X, y, records).free_run

    def final_examined(
        self, X: Data, y: FloatArray | None = None, records: Any = None
    ) -> Objective:
        """The objective of the errors that tell what is missing, as of ``final_free_run``.

        A filter, which follows what it cannot foresee, hides that: its errors are asked only where
        it averages noisy inputs.
        """
        final = self.final_objective if self.averaged_inputs_ else self.final_free_run
        return final(X, y, records)

    def _fitted_objective(self, X: Data, y: FloatArray | None, records: Any) -> Objective:
        self._check_fitted()
        if not PRESETS[self.preset].refine:
            raise ModelError(f"preset {self.preset} has no local refinement, so no intervals")
        if self.stopped_ == "interrupted":
            raise ModelError("the identification was interrupted, so there are no intervals")
        if self._grows:
            raise ModelError(
                "the model cannot be simulated where the fit ended, so there are no intervals: "
                "narrow the ranges, or raise max_steps"
            )
        data = self._records(X, y, records, None, reset=False)
        objective = self._objective(data)
        objective = objective if self._cut is None else self._cut.of_all(objective)
        objective = self._at_final_accuracy(objective.weighed(self.output_weights_))
        if self.output_noise_ is None:
            return objective
        return Innovations.of(
            objective,
            self.output_noise_,
            corrects=self.criterion_ == "innovations",
            process=self._process(),
            quiet=self.averaged_inputs_,
            near=self.final_chromosome_,
        )

    def _at_final_accuracy(self, objective: Objective) -> Objective:
        """The objective, simulated as accurately as at the end of ``fit``."""

        def by(accuracy: float) -> Objective:
            return objective.finer(accuracy) if accuracy < self.accuracy else objective

        final = by(self._final_accuracy)
        if self._slopes_accuracy != self._final_accuracy:
            final = final.with_slopes_by(by(self._slopes_accuracy).simulator)
        return final.with_exact_slopes() if self._exact_slopes else final

    def _step(self, dt: float | None) -> float:
        if self.dt is None:
            raise ModelError(
                "arrays carry no time: give the sample time, GASSI(model, dt=...) in seconds, or "
                "Datasets"
            )
        return self.dt

    def _objective(self, records: Sequence[Dataset]) -> Objective:
        """The error that ``fit`` minimises over ``space_``."""
        kind = CegaObjective if self._preset().squares else Objective
        return kind(
            self.simulator(),
            self.space_,
            records,
            per_log=self.per_log,
            balance=self.balance,
            weights=self._weights(),
            given=self.given.changes(self._model()) if self.given else None,
        )

    def _excerpt(self, records: Sequence[Dataset]) -> Excerpt | None:
        """The parts that a search of long records goes by, and a fit of very long ones."""
        excerpt = Excerpt.of(records, self.search_samples)
        longest = max(record.n_samples for record in records)
        if excerpt is None or longest <= _VERY_LONG * self.search_samples:
            return excerpt
        return replace(excerpt, cut=True)

    @property
    def _cut(self) -> Excerpt | None:
        """The parts that the whole fit goes by, where it does."""
        return self.excerpt_ if self.excerpt_ is not None and self.excerpt_.cut else None

    def _searched(self, objective: Objective) -> Objective:
        """An objective of the records as that of what the search goes by."""
        excerpt = self.excerpt_
        by_held = None if self._cut is None else held(objective)
        if by_held is not None and excerpt is not None:
            objective = by_held
            excerpt = replace(excerpt, records=objective.records, cut=False)
        return objective if excerpt is None else excerpt.among(objective)

    def _on_fitted(
        self, run: SearchRun, objective: Objective, chromosomes: Sequence[FloatArray]
    ) -> tuple[SearchSpace, list[FloatArray]]:
        """Space and chromosomes (n_free,) of a search as those of what the fit goes by."""
        excerpt, space = self.excerpt_, run.objective.space
        assert excerpt is not None
        if not excerpt.cut:
            return excerpt.on_all(space, chromosomes)
        begun = [with_starts(self._model(), objective.records, space, c) for c in chromosomes]
        return begun[0][0], [chromosome for _, chromosome in begun]

    def _model(self) -> ProcessModel:
        if self.model is None:
            raise ModelError("GASSI needs a process model: GASSI(model)")
        starts = getattr(self, "estimated_starts_", ())
        # Kernels are looked up by the model, which is quick for the same one.
        return self.model.with_initial(dict.fromkeys(starts, "estimate")) if starts else self.model

    def simulator(self) -> BatchSimulator:
        """The model's simulator, by the estimator's settings."""
        return BatchSimulator(
            self._model(), accuracy=self.accuracy, threads=self.threads, max_steps=self.max_steps
        )

    def _preset(self) -> Preset:
        for kind, choices in (("criterion", get_args(Criterion)), ("preset", PRESETS)):
            choice = getattr(self, kind)
            if choice not in choices:
                raise ModelError(f"unknown {kind} {choice!r}; choose from {', '.join(choices)}")
        return PRESETS[self.preset]

    def _criterion(self, records: Sequence[Dataset], preset: Preset) -> tuple[Criterion, str]:
        """What the default preset ends with on these records, and why."""
        noisy = noisy_inputs(records)
        if not preset.refine:
            return "error", f"preset {self.preset} goes by nothing else"
        if self._process().any():
            self._check_filter(noisy)
            return "innovations", "noise of the process is given"
        if self.criterion not in ("auto", *_OF_NOISY_INPUTS):
            return self.criterion, "as set"
        if not noisy:
            if self.criterion == "auto":
                return "likelihood", "no input is known to be measured with noise"
            where = ", ".join(record.name for record in records[:3])
            raise ModelError(
                f"criterion {self.criterion} needs the noise of a measured input, and {where} "
                "tells none; give it (noise: {NAME: ...}, input_noise of a Dataset), or choose "
                "criterion likelihood"
            )
        return self._of_noisy_inputs(records, noisy)

    def _of_noisy_inputs(
        self, records: Sequence[Dataset], noisy: tuple[int, ...]
    ) -> tuple[Criterion, str]:
        """What it ends with where inputs are known to be measured with noise, and why."""
        model = self._model()
        names = ", ".join(model.input_names[j] for j in noisy)
        try:
            kalman_filter(model, noisy)
        except ModelError as error:
            if self.criterion != "auto":
                raise
            return "likelihood", f"{names} is measured with noise, but {error}"
        if self.criterion != "auto":
            return self.criterion, "as set"
        timed = any(record.windows.size for record in records)
        reason = f"{names} is measured with noise, which a free run passes on to the outputs"
        if timed:
            reason += ", and over which times samples were averaged is known"
        return "innovations" if timed else "compensated", reason

    def _check_filter(self, noisy: tuple[int, ...]) -> None:
        """Raise ModelError where no filter can serve for the noise of the process."""
        if self.criterion not in ("auto", "innovations"):
            raise ModelError(
                f"process_noise is for criterion innovations, not {self.criterion}; leave out one"
            )
        driven = tuple(np.flatnonzero(self._process()).tolist())
        reached = kalman_filter(self._model(), noisy, driven).kernel.reached
        if silent := [self._model().state_names[i] for i in driven if i not in reached]:
            raise ModelError(
                f"process_noise of {', '.join(silent)} reaches no output; leave it out"
            )

    def _process(self) -> FloatArray:
        """Noise of the states' rates, (n_states,)."""
        names, noise = self._model().state_names, dict(self.process_noise or {})
        for name, intensity in noise.items():
            if name not in names:
                raise ModelError(f"process_noise: no state {name!r}; there are {', '.join(names)}")
            if not (math.isfinite(intensity) and intensity >= 0.0):
                raise ModelError(f"process_noise of {name}: {intensity} is no standard deviation")
        return np.array([noise.get(name, 0.0) for name in names])

    def _weights(self) -> FloatArray | None:
        if self.weights is None:
            return None
        model = self._model()
        names = model.output_names
        for name, weight in self.weights.items():
            if name not in names:
                raise ModelError(
                    f"weight for unknown output {name!r}; model {model.name} has {', '.join(names)}"
                )
            if not (np.isfinite(weight) and weight >= 0.0):
                raise ModelError(f"weight of {name} is {weight}; it must be 0 or more")
        weights = np.array([float(self.weights.get(name, 1.0)) for name in names])
        if weights.sum() == 0.0:
            raise ModelError("every output has weight 0; at least one must count")
        return weights

    def _search_run(
        self, objective: Objective, preset: Preset, earlier: EarlierMinima | None
    ) -> SearchRun:
        # The genetic search gets its share of the generations, local refinement the rest.
        generations = self.generations
        if preset.refine and generations > 0:
            generations = max(1, round((1.0 - preset.local_share) * generations))
        rng = np.random.default_rng(self.random_state)
        rule = self.elite_percent, self.minimum_generations, self.termination_ratio
        population, chromosome = self.population, None
        begun = [] if earlier is None else [self._nearest(values) for values in earlier.values]
        if earlier is not None and earlier.is_settled:
            # So few simulations leave the local search nothing but its last descent.
            population, generations, chromosome = 2, 1, begun[0]
        search = GeneticSearch(
            objective.space, preset, population, generations, rng, *rule, begin=chromosome
        )
        return SearchRun(objective, search, self.generations, self.criterion_ != "error", begun)

    def _nearest(self, values: Mapping[str, float]) -> FloatArray:
        """The chromosome (n_free,) in the ranges nearest to values by name, else the nominal."""
        space = self.space_
        wanted = [values.get(parameter.name, parameter.nominal) for parameter in space.parameters]
        return np.clip(wanted, space.lower, space.upper)

    def _checkpoints(
        self, data: Sequence[Dataset], run: SearchRun, checkpoint: Path | None, resume: Path | None
    ) -> Checkpoint | None:
        """Writer of the run's checkpoints, if wanted; restores the run when it resumes from one."""
        path = checkpoint if checkpoint is not None else resume
        if path is None:
            return None
        settings = {k: v for k, v in self.get_params(deep=False).items() if k not in _NOT_COMPARED}
        search_origin = origin(self._model(), data, settings)
        if resume is not None:
            run.restore(load(Path(resume), search_origin))
        writer = Checkpoint(Path(path), search_origin)
        writer.save(run.state())
        return writer

    def _set_run(self, run: SearchRun) -> None:
        """Set the fitted attributes to the state of a run."""
        assert run.best is not None
        self._set_best(run.best)
        self.search_error_: float = run.search.elite_error
        self.history_: FloatArray = np.array(run.history)
        self.flagged_ = dict(run.flagged)
        self.n_simulations_ = run.objective.simulations

    def _set_evaluated(self, objective: Objective, chromosome: FloatArray) -> None:
        """Set the fitted attributes to a chromosome (n_free,) of an objective."""
        error = float(objective.evaluate(chromosome[None])[0][0])
        feasible = objective.space.feasible(chromosome)
        self._set_best(Best(objective.space, chromosome, error, feasible))
        self.n_simulations_ = objective.simulations

    def _set_best(self, best: Best) -> None:
        space, chromosome, self.error_, self.feasible_ = best
        self.final_chromosome_: FloatArray = chromosome
        if self._cut is not None:
            space, (chromosome,) = self._cut.on_all(space, [chromosome])
        self.space_, self.chromosome_ = space, chromosome
        self.vector_ = self.space_.full(self.chromosome_)
        self.parameters_ = self._named(self.vector_)
        self.initial_states_ = self.space_.named_starts(self.chromosome_)

    def _named(self, vector: FloatArray) -> dict[str, float]:
        return dict(zip(self._model().parameter_names, vector.tolist(), strict=True))
