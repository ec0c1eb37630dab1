"""All that a verdict rests on, of a fitted estimator: runs and their tests, what is missing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.free_run import AccurateRun
from sysid.fitting.innovations import MISJUDGED
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.gassi import GASSI
from sysid.judging.alternatives import Alternative, best_alternative, moved_by_noise
from sysid.judging.assessment import RecordResult, Verdict, examine, judge
from sysid.judging.exchanges import exchanged_channels
from sysid.judging.expected_errors import expected_errors
from sysid.judging.filter_times import with_filter_times
from sysid.judging.findings import Finding, Missing, Unseen
from sysid.judging.lags import lag_faults
from sysid.judging.latencies import with_latencies
from sysid.judging.mistaken_units import output_in_another_unit
from sysid.judging.score_tests import ScoreTests, missing_physics
from sysid.judging.starts import estimated_starts
from sysid.problem.data import Dataset
from sysid.problem.faults import after_explaining, data_faults
from sysid.problem.model import ModelError, Parameter, ProcessModel
from sysid.threads import one_thread
from sysid.uncertainty import Uncertainty

_BEYOND = 10.0  # times its range, to where a parameter is freed that stands on an end of it


@dataclass(frozen=True)
class Suspicion:
    """What a model may lack: findings of score tests, and a variant that was fitted for them.

    unseen: what may be there and would not be seen in these data.
    """

    findings: tuple[Finding, ...]
    alternative: Alternative | None
    unseen: tuple[Unseen, ...] = ()


def verdict_of(
    estimator: GASSI,
    training: Sequence[Dataset],
    validation: Sequence[Dataset] = (),
    uncertainty: Uncertainty | None = None,
) -> Verdict:
    """The verdict on a fitted estimator: all that is tested, in one call.

    uncertainty: the estimator's, by the training, where it is at hand.

    >>> from sysid.examples import lag, lag_record
    >>> logs = lag_record(seed=1), lag_record(seed=2)
    >>> fitted = GASSI(lag(), population=20, generations=2).fit(logs[0])
    >>> verdict_of(fitted, logs[:1], logs[1:]).trust
    'good'
    """
    if estimator.is_refined_ and uncertainty is None:
        uncertainty = estimator.uncertainty(list(training))
    trained, validated = (
        [examined(estimator, record, uncertainty) for record in part]
        for part in (training, validation)
    )
    runs = [run for run, _ in trained]
    faults = data_faults(estimator.simulator().model, training, validation)
    suspicion = suspected(estimator, uncertainty, training, validation, runs=runs)
    return judge(
        estimator.simulator().model,
        [result for _, result in trained],
        [result for _, result in validated],
        uncertainty,
        estimator.feasible_,
        faults=(
            *lag_faults(estimator.simulator().model, training),
            *after_explaining(
                faults,
                estimator.simulator().model,
                "training",
                [
                    (record, run, result.evened)
                    for record, (run, result) in zip(training, trained, strict=True)
                ],
            ),
        ),
        findings=None if suspicion is None else suspicion.findings,
        alternative=None if suspicion is None else suspicion.alternative,
        unseen=() if suspicion is None else suspicion.unseen,
    )


@one_thread()
def examined(
    estimator: GASSI, record: Dataset, uncertainty: Uncertainty | None
) -> tuple[FloatArray, RecordResult]:
    """Free run (n_samples, n_outputs) of an estimator on a record, its errors and tests.

    uncertainty: None where the parameters have no intervals; nothing is known then of the errors
    that a right model would make.
    """
    run = AccurateRun.of(estimator.simulator(), estimator.vector_, record)
    starts = estimated_starts(run.simulator, estimator.vector_, record, run.start)
    later = _acting_later(run.simulator.model, record)
    if uncertainty is None:
        return run.outputs, examine(record, run.outputs, starts=starts, later=later)
    expect = partial(
        expected_errors,
        run.simulator,
        estimator.space_,
        estimator.chromosome_,
        record,
        run.start,
        uncertainty.by_slopes,
    )
    result = examine(record, run.outputs, expect(), starts, later)
    if record.input_noise.any() and result.is_above_floor:
        result = examine(record, run.outputs, expect(closely=True), starts, later)
    return run.outputs, result


def _acting_later(model: ProcessModel, record: Dataset) -> BoolArray:
    """Inputs that act on no output of their sample, (n_inputs,): held, and through states alone."""
    ahead = bool(record.windows.size) and bool(np.any(record.windows[..., 1] > 0.0))
    through = model.output is None and not ahead
    return np.array([through and given.hold == "zoh" for given in model.inputs], dtype=bool)


@one_thread()
def suspected(
    estimator: GASSI,
    uncertainty: Uncertainty | None,
    training: Sequence[Dataset],
    validation: Sequence[Dataset] = (),
    missing: Callable[[Uncertainty], Missing] | None = None,
    runs: Sequence[FloatArray] | None = None,
) -> Suspicion | None:
    """What the model may lack by the training records; None where that cannot be tested.

    By free runs, or innovations where noise of the inputs moves these so far that a filter averages
    it; not where equations bend over what is left of it, since a filter does not see that.
    validation: on which a variant that is fitted must do no worse. missing: as of
    ``score_tests_of``, where these tests have been begun elsewhere. runs: of ``examined`` on each
    training record, where they are at hand.
    """
    if uncertainty is None:
        return None
    exchange = exchanged_channels(estimator, uncertainty, training, runs)
    if exchange is not None:
        return Suspicion((exchange,), None)  # what else is found is of the wrong channels
    units = output_in_another_unit(estimator, uncertainty, training)
    if units:
        return Suspicion(units, None)
    if estimator.averaged_inputs_ and np.any(uncertainty.bent > MISJUDGED):
        return None
    try:
        if any(p.pushed for p in uncertainty.parameters):
            # What an end of a range leaves looks like something missing.
            freed = _freed(estimator.final_examined(list(training)), estimator.final_chromosome_)
            tested = missing_physics(*freed, uncertainty)
        else:
            missing = missing or score_tests_of(estimator, training).missing
            tested = missing(uncertainty)
    except ModelError:  # equations that cannot be added to, or a run that fails
        return None
    findings = tuple(
        moved_by_noise(f, estimator, uncertainty, training) if f.kind == "noise" else f
        for f in tested.findings
    )
    findings = with_latencies(findings, estimator, uncertainty, training)
    findings = with_filter_times(findings, estimator, uncertainty, training)
    fitted = best_alternative(findings, estimator, uncertainty, training, validation)
    return Suspicion(_beside(findings, fitted, uncertainty, training), fitted, tested.unseen)


def _beside(
    findings: tuple[Finding, ...],
    fitted: Alternative | None,
    uncertainty: Uncertainty,
    training: Sequence[Dataset],
) -> tuple[Finding, ...]:
    """Findings without the faults that are gone where a better alternative was fitted.

    They were tested beside a line's guess of it, of which a part may look like a channel's fault.
    """
    if fitted is None or not fitted.better or not any(_is_tested_again(f) for f in findings):
        return findings
    try:
        left = score_tests_of(fitted.estimator, training).missing(uncertainty).findings
    except ModelError:
        return findings
    there = {(finding.kind, finding.name) for finding in left}
    return tuple(f for f in findings if not _is_tested_again(f) or (f.kind, f.name) in there)


def _is_tested_again(finding: Finding) -> bool:
    """Whether it is a fault that a term, or a variant, may stand for in part."""
    return finding.kind != "variant" and finding.term is None


def score_tests_of(estimator: GASSI, training: Sequence[Dataset]) -> ScoreTests:
    """Tests of what the model may lack where a fit to the training records ended.

    Raises ModelError for equations that cannot be added to, and a run that fails.
    """
    return ScoreTests(estimator.final_examined(list(training)), estimator.final_chromosome_)


def _freed(objective: Objective, chromosome: FloatArray) -> tuple[Objective, FloatArray]:
    """The objective and its minimum where parameters on an end of their range go beyond it."""
    space = objective.space
    parameters = zip(space.parameters, space.on_bound(chromosome), strict=True)
    freed = tuple(_widened(p) if on_bound else p for p, on_bound in parameters)
    wide = objective.over(replace(space, parameters=freed))
    return wide, refine(wide, chromosome).chromosome


def _widened(parameter: Parameter) -> Parameter:
    """A parameter in a range far beyond its own, as far as its physical limits let it."""
    low, high = parameter.lower, parameter.upper
    if parameter.scale == "log":
        low, high = low / _BEYOND, high * _BEYOND
    else:
        low, high = low - _BEYOND * (high - low), high + _BEYOND * (high - low)
    return replace(parameter, lower=max(low, parameter.minimum), upper=min(high, parameter.maximum))
