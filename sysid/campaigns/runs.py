"""Campaigns: logs x model structures x seeds, spread over cores or machines by joblib.

Whatever joblib runs on, a campaign runs on: the cores of this machine by ``n_jobs``, a dask
cluster by ``joblib.parallel_config(backend="dask")`` around the call. One seed gives one result
on all of them.
"""

from __future__ import annotations

import itertools
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid.campaigns.parcels import pack, unpack
from sysid.campaigns.study import described, end_with, unpack_once, work_through
from sysid.problem.data import Dataset
from sysid.problem.metrics import Metrics, evaluate, mean_known
from sysid.problem.model import ModelError, ProcessModel
from sysid.threads import available_cores

if TYPE_CHECKING:
    import pandas as pd

    from sysid.gassi import GASSI

# Two seeds whose errors differ by no more than this share found the same minimum.
_SAME = 0.01


@dataclass(frozen=True)
class Run:
    """An identification to be done: a model, the records it is fitted to, settings and seed.

    settings: arguments of ``GASSI``. name: of the model structure, default the model's. data:
    of the records, default their names. validation: records it is judged by and never fitted to.

    >>> from sysid.examples import lag, lag_record
    >>> run = Run(lag(), [lag_record(seed=7)], {"population": 20, "generations": 3})
    >>> run.name, run.data
    ('lag', 'lag 7')
    """

    model: ProcessModel
    records: Sequence[Dataset]
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    name: str = ""
    data: str = ""
    validation: Sequence[Dataset] = ()

    def __post_init__(self) -> None:
        records = (self.records,) if isinstance(self.records, Dataset) else tuple(self.records)
        object.__setattr__(self, "records", records)
        object.__setattr__(self, "validation", tuple(self.validation))
        object.__setattr__(self, "name", self.name or self.model.name)
        object.__setattr__(self, "data", self.data or ", ".join(r.name for r in records))


@dataclass(frozen=True)
class Outcome:
    """What became of a run: a fitted estimator, or the problem that kept it from one.

    training, validation: metrics of the free run of each record. seconds: it took.

    >>> from sysid.examples import lag, lag_record
    >>> run = Run(lag(), [lag_record()])
    >>> Outcome(run, None, (), (), seconds=0.0, problem="a worker was lost").error
    inf
    """

    run: Run
    estimator: GASSI | None
    training: tuple[Metrics, ...]
    validation: tuple[Metrics, ...]
    seconds: float
    problem: str = ""

    @property
    def error(self) -> float:
        """The error that was minimised; infinite for a run that failed."""
        return np.inf if self.estimator is None else self.estimator.error_

    @property
    def rmse_absolute(self) -> dict[str, float]:
        """Mean over the training records of each output's RMSE, in its unit."""
        if not self.training:
            return {}
        rmse = mean_known([metrics.rmse_absolute for metrics in self.training], 0)
        return dict(zip(self.run.model.output_names, rmse.tolist(), strict=True))

    def row(self) -> dict[str, Any]:
        """The outcome as a flat row of a table."""
        row: dict[str, Any] = {
            "model": self.run.name,
            "data": self.run.data,
            "seed": self.run.seed,
            "error": self.error,
            "fit": float(mean_known([metrics.fit for metrics in self.training])),
            "validation_fit": float(mean_known([metrics.fit for metrics in self.validation])),
            **{f"rmse_{name}": rmse for name, rmse in self.rmse_absolute.items()},
            "seconds": self.seconds,
            "problem": self.problem,
        }
        if self.estimator is not None:
            row["feasible"] = self.estimator.feasible_
            row["stopped"] = self.estimator.stopped_
            row["simulations"] = self.estimator.n_simulations_
            row |= self.estimator.parameters_
        return row


@dataclass(frozen=True)
class Spread:
    """A structure on a set of records over the seeds of its runs.

    best, median, worst: errors of the runs that did not fail. agreeing: how many of them came
    within 1 % of the best. parameters: {name: (lowest, highest)} among those.

    >>> gain = {"gain": (2.98, 3.01)}
    >>> spread = Spread("lag", "bench", 5, 0, 0.011, 0.011, 0.2, agreeing=4, parameters=gain)
    >>> f"{spread.agreeing} of {spread.runs} seeds agree"
    '4 of 5 seeds agree'
    """

    model: str
    data: str
    runs: int
    failed: int
    best: float
    median: float
    worst: float
    agreeing: int
    parameters: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Campaign:
    """Outcomes in the order of the runs; without those that Ctrl-C left undone.

    >>> Campaign(outcomes=()).failed
    ()
    """

    outcomes: tuple[Outcome, ...]
    interrupted: bool = False

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """The outcomes that have a problem in place of a result."""
        return tuple(outcome for outcome in self.outcomes if outcome.estimator is None)

    def best(self) -> dict[tuple[str, str], Outcome]:
        """For each structure and set of records, by names, the run with the lowest error.

        What satisfies the model's constraints comes before what does not.
        """
        return {key: done[0] for key, group in self._groups().items() if (done := _ranked(group))}

    def spread(self) -> list[Spread]:
        """Each structure on each set of records over its seeds."""
        return [_spread(*key, group) for key, group in self._groups().items()]

    def frame(self) -> pd.DataFrame:
        """A row for each outcome: names, seed, error, fit %, parameters, problem."""
        import pandas as pd

        return pd.DataFrame([outcome.row() for outcome in self.outcomes])

    def _groups(self) -> dict[tuple[str, str], list[Outcome]]:
        groups: dict[tuple[str, str], list[Outcome]] = {}
        for outcome in self.outcomes:
            groups.setdefault((outcome.run.name, outcome.run.data), []).append(outcome)
        return groups


def combinations(
    models: Mapping[str, ProcessModel],
    records: Mapping[str, Sequence[Dataset]],
    seeds: Iterable[int] = (0,),
    settings: Mapping[str, Any] | None = None,
    validation: Sequence[Dataset] = (),
) -> list[Run]:
    """Runs of every model on every set of records with every seed.

    models: by the names they get in tables. records: by name, what one parameter set is fitted
    to. settings: arguments of ``GASSI`` for all.

    >>> from sysid.examples import lag, lag_record
    >>> len(combinations({"lag": lag()}, {"bench": [lag_record()]}, seeds=range(3)))
    3
    """
    seeds = list(seeds)
    return [
        Run(model, group, settings or {}, seed, name, data, validation)
        for name, model in models.items()
        for data, group in records.items()
        for seed in seeds
    ]


def campaign(
    runs: Sequence[Run],
    *,
    n_jobs: int | None = None,
    on_outcome: Callable[[Outcome], None] | None = None,
) -> Campaign:
    """Identify each of the runs, several at a time.

    n_jobs: processes, -1 for all cores; default what ``joblib.parallel_config`` says, else one.
    Each run gets its share of the cores unless its settings name ``threads``; on a cluster,
    where a run has a worker's thread, one. A run that fails is kept with its problem. Ctrl-C
    ends the campaign and keeps what is finished. on_outcome: called with each outcome as it
    comes. Raises ModelError when there is nothing to do, or a model cannot be sent to another
    process.

    >>> from sysid.examples import lag, lag_record
    >>> runs = [Run(lag(), [lag_record()], {"population": 30, "generations": 4}, seed=1)]
    >>> (outcome,) = campaign(runs).outcomes
    >>> round(outcome.estimator.parameters_["gain"], 1)
    3.0
    """
    import joblib

    if not runs:
        raise ModelError("a campaign needs at least one run")
    threads = _threads(n_jobs, len(runs))
    order = _order(runs)
    jobs = [
        joblib.delayed(_identify)(place, *packed, runs[place].seed, threads, os.getpid())
        for place, packed in zip(order, _packed([runs[place] for place in order]), strict=True)
    ]
    outcomes: dict[int, Outcome] = {}

    def take(parcel: bytes) -> None:
        place, outcome = _outcome(runs, parcel)
        outcomes[place] = outcome
        if on_outcome is not None:
            on_outcome(outcome)
        if outcome.estimator is not None and outcome.estimator.stopped_ == "interrupted":
            # The search took the Ctrl-C for itself, to keep its best so far.
            raise KeyboardInterrupt

    interrupted, problem = work_through(jobs, n_jobs, take)
    if not interrupted:
        for place in set(range(len(runs))) - set(outcomes):
            outcomes[place] = Outcome(runs[place], None, (), (), 0.0, problem)
    return Campaign(tuple(outcomes[place] for place in sorted(outcomes)), interrupted)


def _packed(runs: Sequence[Run]) -> list[tuple[bytes, bytes, bytes]]:
    """Model, records and settings of each run; what several runs share is packed once."""
    parcels: dict[tuple[int, ...], bytes] = {}

    def parcel(what: str, value: Any, *parts: Any) -> bytes:
        key = tuple(map(id, parts))
        if key not in parcels:
            parcels[key] = pack(what, value)
        return parcels[key]

    return [
        (
            parcel(f"model {r.name}", r.model, r.model),
            parcel("the records", (r.records, r.validation), *r.records, None, *r.validation),
            parcel(f"settings of {r.name}", dict(r.settings), r.settings),
        )
        for r in runs
    ]


def _identify(
    place: int, model: bytes, data: bytes, settings: bytes, seed: int, threads: int, caller: int
) -> bytes:
    """A worker's part: fit, evaluate, and send back all but the model, which is here already."""
    from sysid.gassi import GASSI

    end_with(caller)
    started = time.perf_counter()
    fitted: GASSI | None = None
    scores: list[tuple[Metrics, ...]] = [(), ()]
    problem = ""
    try:
        groups = unpack(data)
        arguments = {"threads": threads, **unpack(settings), "random_state": seed}
        fitted = GASSI(unpack_once(model), **arguments).fit(groups[0])
        scores = [
            tuple(evaluate(record.outputs, fitted.predict(record)) for record in group)
            for group in groups
        ]
        fitted.model = None
        fitted.space_ = replace(fitted.space_, model=None)  # type: ignore[arg-type]
    except Exception as error:
        fitted, problem = None, described(error)
    return pack("result", (place, fitted, *scores, time.perf_counter() - started, problem))


def _outcome(runs: Sequence[Run], parcel: bytes) -> tuple[int, Outcome]:
    place, fitted, training, validation, seconds, problem = unpack(parcel)
    run = runs[place]
    if fitted is not None:
        fitted.model, fitted.threads = run.model, run.settings.get("threads")
        # With the starts that the fit has estimated by itself.
        fitted.space_ = replace(fitted.space_, model=fitted.simulator().model)
    return place, Outcome(run, fitted, training, validation, seconds, problem)


def _threads(n_jobs: int | None, n_runs: int) -> int:
    """Cores of this machine for each of the runs that go on at a time; 1 on a cluster."""
    import joblib
    from joblib import parallel

    processes = parallel.LokyBackend, parallel.MultiprocessingBackend
    local = (*processes, parallel.SequentialBackend, parallel.ThreadingBackend)
    if not isinstance(parallel.get_active_backend()[0], local):
        return 1
    at_a_time = min(int(joblib.effective_n_jobs(n_jobs)), n_runs)
    return max(1, available_cores() // at_a_time)


def _order(runs: Sequence[Run]) -> list[int]:
    """Places of the runs, unlike models in turn: workers then compile them at the same time."""
    counts: dict[int, Iterator[int]] = defaultdict(itertools.count)
    turns = [next(counts[id(run.model)]) for run in runs]
    return sorted(range(len(runs)), key=lambda place: turns[place])


def _ranked(group: Sequence[Outcome]) -> list[Outcome]:
    """The runs that did not fail, the best first, feasible ones before infeasible ones."""
    fitted = [(o.estimator, o) for o in group if o.estimator is not None]
    fitted.sort(key=lambda pair: (not pair[0].feasible_, pair[1].error, pair[1].run.seed))
    return [outcome for _, outcome in fitted]


def _spread(model: str, data: str, group: Sequence[Outcome]) -> Spread:
    done = _ranked(group)
    errors = np.array([outcome.error for outcome in done] or [np.nan])
    agreeing = [o.row() for o in done if o.error <= (1.0 + _SAME) * errors.min()]
    ends = {}
    for name in done[0].run.model.parameter_names if done else ():
        values = [row[name] for row in agreeing]
        ends[name] = min(values), max(values)
    failed, best, worst = len(group) - len(done), float(errors.min()), float(errors.max())
    middle = float(np.median(errors))
    return Spread(model, data, len(group), failed, best, middle, worst, len(agreeing), ends)
