"""All that a verdict rests on, of a fitted estimator: runs and their tests, what is missing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.free_run import estimate_start
from sysid.gassi import GASSI, PRESETS
from sysid.judging.alternatives import Alternative, best_alternative, fits
from sysid.judging.assessment import FITTED, RecordResult, Verdict, examine, judge
from sysid.judging.expected_errors import expected_errors
from sysid.judging.lags import lag_faults
from sysid.judging.score_tests import Finding, missing_physics
from sysid.judging.starts import estimated_starts
from sysid.problem.data import Dataset
from sysid.problem.faults import data_faults
from sysid.problem.model import ModelError
from sysid.threads import one_thread
from sysid.uncertainty import Uncertainty


@dataclass(frozen=True)
class Suspicion:
    """What a model may lack: findings of score tests, and a variant that was fitted for them."""

    findings: tuple[Finding, ...]
    alternative: Alternative | None


def verdict_of(
    estimator: GASSI, training: Sequence[Dataset], validation: Sequence[Dataset] = ()
) -> Verdict:
    """The verdict on a fitted estimator: all that is tested, in one call.

    >>> from sysid.examples import lag, lag_record
    >>> logs = lag_record(seed=1), lag_record(seed=2)
    >>> fitted = GASSI(lag(), population=20, generations=2).fit(logs[0])
    >>> verdict_of(fitted, logs[:1], logs[1:]).trust
    'good'
    """
    refined = PRESETS[estimator.preset].refine and estimator.stopped_ != "interrupted"
    uncertainty = estimator.uncertainty(list(training)) if refined else None
    trained, validated = (
        [examined(estimator, record, uncertainty)[1] for record in part]
        for part in (training, validation)
    )
    suspicion = suspected(estimator, uncertainty, training, validation)
    return judge(
        estimator.simulator().model,
        trained,
        validated,
        uncertainty,
        estimator.feasible_,
        faults=(
            *lag_faults(estimator.simulator().model, training),
            *data_faults(estimator.simulator().model, training, validation),
        ),
        findings=None if suspicion is None else suspicion.findings,
        alternative=None if suspicion is None else suspicion.alternative,
    )


@one_thread()
def examined(
    estimator: GASSI, record: Dataset, uncertainty: Uncertainty | None
) -> tuple[FloatArray, RecordResult]:
    """Free run (n_samples, n_outputs) of an estimator on a record, its errors and tests.

    uncertainty: None where the parameters have no intervals; nothing is known then of the errors
    that a right model would make.
    """
    run, simulator, vector = estimator.predict(record), estimator.simulator(), estimator.vector_
    start = estimate_start(simulator, vector, record)
    starts = estimated_starts(simulator, vector, record, start)
    if uncertainty is None:
        return run, examine(record, run, starts=starts)
    space, chromosome = estimator.space_, estimator.chromosome_
    expected = expected_errors(simulator, space, chromosome, record, start, uncertainty.covariance)
    return run, examine(record, run, expected, starts)


@one_thread()
def suspected(
    estimator: GASSI,
    uncertainty: Uncertainty | None,
    training: Sequence[Dataset],
    validation: Sequence[Dataset] = (),
) -> Suspicion | None:
    """What the model may lack by the training records; None where that cannot be tested.

    validation: on which a variant that is fitted must do no worse.
    """
    if uncertainty is None:
        return None
    if any(p.pushed and not p.why for p in uncertainty.parameters):
        runs = [estimator.predict(record) for record in training]
        if np.all(fits(training, runs) > FITTED):
            return None  # what an end of a range leaves looks like something missing
    try:
        objective = estimator.final_objective(list(training))
        findings = missing_physics(objective, estimator.chromosome_, uncertainty)
    except ModelError:  # equations that cannot be added to, or a run that fails
        return None
    fitted = best_alternative(findings, estimator, uncertainty, training, validation)
    return Suspicion(findings, fitted)
