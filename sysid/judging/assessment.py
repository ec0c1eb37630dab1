"""The verdict on an identification: how well outputs are predicted, and whether parameters hold.

The two are different things. A model of the wrong structure may predict well what is like the
data, with parameters that are not the plant's; one of the right structure may have every parameter
right and predict hardly more than noise hides.
"""

import math
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import fdtrc

from sysid.arrays import BoolArray, FloatArray
from sysid.judging.alternatives import Alternative
from sysid.judging.evidence import independent_of_each
from sysid.judging.expected_errors import ExpectedErrors, FloorTest, floor_test
from sysid.judging.findings import MOVED, Finding, Unseen, description
from sysid.judging.phrases import change, sized
from sysid.judging.residual_patterns import errors_alone, errors_by_speed, shared_errors
from sysid.judging.residual_tests import ResidualTest, residual_test
from sysid.judging.starts import Starts
from sysid.problem.data import Dataset
from sysid.problem.faults import DataFault
from sysid.problem.metrics import FITTED, Metrics, evaluate, mean_known
from sysid.problem.model import ProcessModel
from sysid.uncertainty import Uncertainty
from sysid.uncertainty.colour import SUCCESSIVE

Trust = Literal["good", "limited", "poor"]

# Validation errors in parts of the training errors: what chance does, and what is not the same
# system any more.
_HARDLY_WORSE, _FAR_WORSE = 1.3, 2.0
# Of an output's deviation, below which an error, or what is left of an input, is nothing to mend;
# and below which it says nothing of parameters either.
_SMALL, _TRACE = 0.01, 5e-3
# Correlation with an input below which what is left is found in long records, but is nothing to
# mend: one per cent of the residuals' variance.
_NOTICEABLE = 0.1
_MOSTLY = 0.3  # above which it is no noise at all
# Of an output's variance, beyond which what a model leaves may have moved its parameters, and share
# of the autocorrelations inside their band, below which it is no noise of that output's sensor.
_MUCH, _WANDERS = 0.025, 0.25
# Share of them inside it, and fit [%], from where on a poor fit may be for a sensor's noise alone.
_WHITE, _SOMETHING = 0.9, 10.0
_BY_CHANCE = 0.01  # probability below which something is not by chance
# Correlation of two outputs' residuals that is no sensor's; rank correlation of their size with an
# output's rate of change; how far apart parameters of parts of the data are, in parts of chance.
_SHARED, _BY_SPEED, _DISAGREEING = 0.3, 0.2, 1.5
_STRUCTURE_UNTESTED = (
    "What the model may lack was not tested: if something is missing, parameters may be off "
    "by more than their intervals."
)
_PARAMETER_PRAISE = "Nothing was found missing that would move a parameter beyond its interval."
_OF_EQUATIONS = (
    "bend",
    "function",
    "disturbance",
    "follower",
    "resonance",
)  # that equations lack something
_SURELY = 1e-5  # probability above which a function that a fit has no use for was chance
_ROUNDING = 2e-4  # of an output's deviation, below which errors may be those of a simulation


@dataclass(frozen=True, repr=False)
class RecordResult:
    """A model's errors on a record; ``simulated``: whether its free run came to the end.

    independent: (n_outputs,), how many independent samples would tell the mean square of each
    output's residuals as surely. floor: residuals in parts of what a right model leaves; noise: in
    parts of what one leaves whose parameters are known exactly; None where nothing is known of
    that.
    starts: initial states that were estimated from the record. shared, by_speed: (n_outputs,),
    correlations as of ``shared_errors`` and ``errors_by_speed``; None where they were not tested.
    alone: (n_outputs,), shares as of ``errors_alone``; None of a run that did not come to the end.
    evened: (n_samples, n_outputs), the residuals as of ``ExpectedErrors.evened``.
    """

    name: str
    simulated: bool
    metrics: Metrics
    residuals: ResidualTest
    independent: FloatArray
    evened: FloatArray
    floor: FloorTest | None = None
    noise: FloorTest | None = None
    starts: Starts | None = None
    shared: FloatArray | None = None
    by_speed: FloatArray | None = None
    alone: FloatArray | None = None

    def __repr__(self) -> str:
        fits = ", ".join(f"{fit:.1f}" for fit in self.metrics.fit)
        return f"<RecordResult: {self.name}, fit {fits} %>"

    @property
    def is_above_floor(self) -> bool:
        """Whether an output errs by more than a right model would, were this the only record."""
        tests = [test for test in (self.floor, self.noise) if test is not None]
        return any(test.above(_BY_CHANCE).any() for test in tests)


@dataclass(frozen=True)
class Statement:
    """How far to trust something, and why: a sentence for each reason, the gravest first."""

    trust: Trust
    reasons: tuple[str, ...]

    @classmethod
    def of(cls, grave: Sequence[str], light: Sequence[str], praise: str) -> "Statement":
        """Poor for a grave reason, limited for a light one, else good, for which praise stands."""
        if grave:
            return cls("poor", (*grave, *light))
        return cls("limited", tuple(light)) if light else cls("good", (praise,))


@dataclass(frozen=True)
class Verdict:
    """How well outputs are predicted, whether parameters may be used, and what was not tested.

    notes: what was found but takes nothing away, and what could not be tested.
    """

    predicted: Statement
    parameters: Statement
    notes: tuple[str, ...] = ()

    @property
    def trust(self) -> Trust:
        """The lesser of both."""
        order: tuple[Trust, ...] = ("poor", "limited", "good")
        return min(self.predicted.trust, self.parameters.trust, key=order.index)

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        """Reasons why not good, those of predictions first; of a good verdict both praises."""
        both = self.predicted, self.parameters
        doubtful = [s for s in both if s.trust != "good"] or both
        return tuple(dict.fromkeys(reason for s in doubtful for reason in s.reasons))


def examine(
    record: Dataset,
    simulated: FloatArray,
    expected: ExpectedErrors | None = None,
    starts: Starts | None = None,
    later: BoolArray | None = None,
) -> RecordResult:
    """Errors and residual tests of a model's free run, (n_samples, n_outputs), on a record.

    expected: errors that a right model makes on it; None where nothing is known of them. later:
    (n_inputs,), inputs that act on no output of their sample.
    """
    residual, finite = record.outputs - simulated, bool(np.all(np.isfinite(simulated)))
    systematic = None if expected is None else expected.systematic
    evened = residual if expected is None else expected.evened(residual)
    exact = None if expected is None else expected.of_exact_parameters
    independent = independent_of_each(residual)
    shared = by_speed = None
    alone = errors_alone(evened, record.outputs) if finite else None
    if alone is not None and record.jitter.size:
        alone[record.jitter.any(axis=0)] = 0.0  # each has a variance of its own
    if systematic is not None and finite:
        by_speed = errors_by_speed(evened, simulated, systematic)
        if record.jitter.size:
            by_speed[record.jitter.any(axis=0)] = 0.0  # that is why they do
        if not record.input_noise.any():  # which comes through the plant to all outputs
            shared = shared_errors(residual, systematic)
    return RecordResult(
        record.name,
        finite,
        evaluate(record.outputs, simulated),
        residual_test(
            residual, record.inputs, record.input_noise, systematic=systematic, later=later
        ),
        independent,
        evened,
        None if expected is None else floor_test(residual, expected, independent),
        None if exact is None else floor_test(residual, exact, independent),
        starts,
        shared,
        by_speed,
        alone,
    )


def judge(
    model: ProcessModel,
    training: Sequence[RecordResult],
    validation: Sequence[RecordResult],
    uncertainty: Uncertainty | None,
    feasible: bool = True,
    *,
    findings: Sequence[Finding] | None = None,
    alternative: Alternative | None = None,
    faults: Sequence[DataFault] = (),
    unseen: Sequence[Unseen] = (),
) -> Verdict:
    """The verdict on an identification.

    validation: none where no records were held back. uncertainty: None without intervals.
    feasible: whether the parameters satisfy the constraints. findings: of score tests, None where
    there were none; alternative: a variant among them that was fitted. faults: of
    the data, of which those in doubt count. unseen: what may be there all the same.
    """
    broken = [] if feasible else ["No parameters were found that satisfy all the constraints."]
    broken += _failed_runs(model, (*training, *validation))
    predicted = _prediction(model, training, validation, broken, faults)
    judged = validation or training
    doubts = [fault for fault in faults if fault.severity == "doubt"]
    spoilt = [fault for fault in doubts if not fault.voids_validation]
    light = [fault.sentence for fault in spoilt if fault.part == "training"]
    if alternative is not None and alternative.better:
        light.append(_lacking(alternative))
    missing = [f for f in findings or () if f.kind != "variant"]
    if alternative is not None and alternative.better and alternative.terms:
        # Other functions were asked for beside a test's guess of this one.
        missing = [f for f in missing if f.kind not in _OF_EQUATIONS]
    if any(fault.kind == "lag" for fault in doubts):
        # The same, seen less sharply, and what the equations would need to make up for it.
        missing = [f for f in missing if not (f.comes_late or f.kind in _OF_EQUATIONS)]
    in_vain = None if alternative is None or alternative.better else alternative
    by_chance = list[str]()
    if in_vain is not None:
        refuted = [f for f in missing if _is_of(f, in_vain) and f.p_value > _SURELY]
        missing = [f for f in missing if f not in refuted]
        by_chance = [f"{_refuted(f, in_vain)}: so it looks at times by chance." for f in refuted]
    counting = [f for f in missing if f.counts]
    if not counting and _moved_together(missing) > MOVED:
        counting = missing
    light += [
        _in_vain(f, in_vain) if in_vain is not None and _is_of(f, in_vain) else _moving(f)
        for f in counting
    ]
    if predicted.trust != "poor":  # which is more than these can say
        if not light:
            light += _unexplained(model, judged)
        if not light:
            light += _patterns(model, (*training, *validation))
        if not light and uncertainty is not None:
            light += _disagreement(uncertainty, len(training))
        if uncertainty is not None:
            light += _filter_errors(model, uncertainty)
            light += _bent_filter(model, uncertainty)
    light += _of_intervals(model, uncertainty, findings)
    grave = list(broken)
    if predicted.trust == "poor" and not broken:
        grave.append("Of a model that predicts so poorly the parameters are not the plant's.")
    parameters = Statement.of(grave, light, _PARAMETER_PRAISE)
    slight = "; ".join(description(f) for f in missing if f not in counting)
    moving = f"Found, but moving no parameter by {MOVED:g} standard deviations: {slight}."
    notes = [moving] if slight else []
    notes += by_chance
    notes += [fault.sentence for fault in spoilt if fault.part == "validation"]
    notes += map(_not_seen, unseen)
    return Verdict(predicted, parameters, (*notes, *_untested(model, judged, uncertainty)))


def _prediction(
    model: ProcessModel,
    training: Sequence[RecordResult],
    validation: Sequence[RecordResult],
    broken: Sequence[str],
    faults: Sequence[DataFault],
) -> Statement:
    """How well outputs are predicted."""
    grave, light = list(broken), list[str]()
    poor, excused = _poor_fits(model, validation, "on the validation data")
    grave += poor.values()
    light += excused.values()
    for output in _worse_in_validation(model, training, validation):
        if not output.at_floor and output.name not in poor:
            far = output.ratio > _FAR_WORSE and output.beyond > _HARDLY_WORSE * _SMALL
            reasons = grave if far else light
            reasons.append(f"{output.times_as_much} in validation as in training.")
    voided = [f.sentence for f in faults if f.severity == "doubt" and f.voids_validation]
    if voided:
        light += voided
    elif not validation:
        light.append("No data were held back for validation: the errors are those of the fit.")
    if not grave:
        poor, excused_there = _poor_fits(model, training, "even on the training data")
        grave += poor.values()
        light += (reason for name, reason in excused_there.items() if name not in excused)
    light += _far_from_noise(model, validation or training, poor)
    light += _input_traces(model, validation or training)
    light += _failing_starts((*training, *validation))
    return Statement.of(grave, light, _praise(model, training, validation))


def _poor_fits(
    model: ProcessModel, results: Sequence[RecordResult], where: str
) -> tuple[dict[str, str], dict[str, str]]:
    """Reasons by output: what is explained poorly, and that for which there is an excuse.

    What comes anew with each sample, and goes with no input, no model explains; nor does a right
    one whose parameters are hardly known. Where noise is known and explains all, there is no
    reason.
    """
    poor, excused = dict[str, str](), dict[str, str]()
    if not results:
        return poor, excused
    fits = mean_known([result.metrics.fit for result in results], 0)
    noise, floor = (
        ~above & _known(results) for above in (_above_noise(results), _above_floor(results))
    )
    white = np.mean([result.residuals.white for result in results], axis=0) > _WHITE
    whitened = white & ~_follows(results).any(axis=1) & (fits > _SOMETHING)
    for j in np.flatnonzero((fits < FITTED) & ~noise).tolist():
        name = model.output_names[j]
        reason = f"{name} is explained poorly {where} (fit {fits[j]:.0f} %)"
        if floor[j]:
            excused[name] = f"{reason}: what it depends on is hardly known."
        elif whitened[j]:
            excused[name] = f"{reason}, but what is left is white, as a sensor's noise is."
        else:
            poor[name] = f"{reason}."
    return poor, excused


def _far_from_noise(
    model: ProcessModel, results: Sequence[RecordResult], poor: Container[str]
) -> Iterator[str]:
    """Reasons: outputs of which much is left that is no noise, beside those explained poorly."""
    left = (1.0 - mean_known([result.metrics.fit for result in results], 0) / 100.0) ** 2
    wanders = np.mean([result.residuals.white for result in results], axis=0) < _WANDERS
    calibrated = _known(results)
    beyond = np.where(calibrated, _above_floor(results), wanders)
    for j in np.flatnonzero((left > _MUCH) & beyond).tolist():
        name = model.output_names[j]
        why = (
            "more than noise explains"
            if calibrated[j]
            else "and wanders, as no sensor's noise does"
        )
        if name not in poor:
            yield f"{100.0 * left[j]:.0f} % of {name}'s variance is left, {why}."


def _of_intervals(
    model: ProcessModel, uncertainty: Uncertainty | None, findings: Sequence[Finding] | None
) -> Iterator[str]:
    """Reasons: no intervals, or such as ends, corrections or what was not tested may deceive."""
    if uncertainty is None:
        yield "The parameters have no intervals, so how surely each is known is not known."
        return
    yield from _parameters_on_bounds(uncertainty)
    yield from _corrected(model, uncertainty)
    if findings is None:
        yield _STRUCTURE_UNTESTED


def _moved_together(findings: Sequence[Finding]) -> float:
    """Standard deviations by which findings move a quantity, each given those before it."""
    totals: dict[str, float] = {}
    for move in (move for finding in findings for move in finding.moves):
        totals[move.quantity.name] = totals.get(move.quantity.name, 0.0) + move.deviations
    return max(map(abs, totals.values()), default=0.0)


def _failed_runs(model: ProcessModel, results: Sequence[RecordResult]) -> Iterator[str]:
    """Reason: records that the model cannot follow to the end."""
    failed = [result.name for result in results if not result.simulated]
    if failed:
        yield (
            f"Model {model.name} cannot be simulated on {', '.join(failed)}: its response grows "
            "beyond all bounds, or needs too small steps."
        )


@dataclass(frozen=True)
class _Worse:
    """An output that errs more in validation than in training.

    ratio: of both errors; beyond: by how much it is larger, in parts of the output's deviation;
    at_floor: whether it is noise alone.
    """

    name: str
    ratio: float
    beyond: float
    at_floor: bool

    @property
    def times_as_much(self) -> str:
        """How much more it errs, in words."""
        return f"{self.name} errs {self.ratio:.1f} times as much"


def _worse_in_validation(
    model: ProcessModel, training: Sequence[RecordResult], validation: Sequence[RecordResult]
) -> list[_Worse]:
    """Outputs that err more in validation than in training, by more than chance."""
    if not validation:
        return []
    # Absolute, because each record has its own largest output.
    trained, validated = (
        np.sqrt(mean_known([r.metrics.rmse_absolute**2 for r in results], 0))
        for results in (training, validation)
    )
    fits = mean_known([r.metrics.fit for r in validation], 0)
    count, base = (
        np.sum([r.independent for r in results], axis=0) for results in (validation, training)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = validated / trained
        # A fit of 90 % is an error of a tenth of the deviation.
        beyond = (1.0 - fits / 100.0) * np.sqrt(np.maximum(1.0 - 1.0 / ratios**2, 0.0))
        sure = fdtrc(count, base, ratios**2) < _BY_CHANCE
        worse = (ratios > _HARDLY_WORSE) & (beyond > _SMALL) & sure
    floor = ~_above_floor(validation) & _known(validation)
    values = zip(ratios.tolist(), beyond.tolist(), floor.tolist(), strict=True)
    outputs = [_Worse(n, *row) for n, row in zip(model.output_names, values, strict=True)]
    return [outputs[j] for j in np.flatnonzero(worse)]


def _known(results: Sequence[RecordResult]) -> BoolArray:
    """Outputs whose expected errors are known on every record, (n_outputs,)."""
    if any(result.floor is None for result in results):
        return np.zeros(len(results[0].metrics.rmse), dtype=bool)
    everywhere: BoolArray = np.all([r.floor.known for r in results if r.floor is not None], axis=0)
    return everywhere


def _above_floor(results: Sequence[RecordResult]) -> BoolArray:
    """Outputs that on some record err by more than a right model would, (n_outputs,)."""
    return _above(results, [result.floor for result in results])


def _above_noise(results: Sequence[RecordResult]) -> BoolArray:
    """Outputs that on some record err by more than one with exact parameters, (n_outputs,)."""
    return _above(results, [result.noise for result in results])


def _above(results: Sequence[RecordResult], tests: Sequence[FloorTest | None]) -> BoolArray:
    above = np.zeros(len(results[0].metrics.rmse), dtype=bool)
    limit = _BY_CHANCE / len(results)
    for test in (test for test in tests if test is not None):
        above |= test.above(limit)
    return above


def _input_traces(model: ProcessModel, results: Sequence[RecordResult]) -> Iterator[str]:
    """Reasons: outputs that could be predicted better from an input."""
    follows = _follows(results) & (_input_parts(results) > _SMALL)
    for output, following in zip(model.output_names, follows, strict=True):
        if following.any():
            inputs = [model.input_names[i] for i in np.flatnonzero(following)]
            yield (
                f"Residuals of {output} still follow {' and '.join(inputs)}: the model lacks "
                "dynamics there."
            )


def _failing_starts(results: Sequence[RecordResult]) -> Iterator[str]:
    """Reasons: records on which a start, not the model, is what fails."""
    for result in results:
        for start in result.starts.estimates if result.starts is not None else ():
            if start.on_end:
                sample = (
                    f", its first sample is {start.first:.3g}" if np.isfinite(start.first) else ""
                )
                yield (
                    f"On {result.name} {start.state} starts at an end of its range, "
                    f"{start.value:.3g} {start.unit}{sample}: the start may be what fails there. "
                    f"Widen its range under 'initial', {start.low:.3g} .. {start.high:.3g}."
                )


def _follows(results: Sequence[RecordResult]) -> BoolArray:
    """Where residuals follow an input by more than chance, noticeably, (n_outputs, n_inputs)."""
    chance, sizes = _input_correlations(results)
    follows: BoolArray = (chance < _BY_CHANCE) & (sizes > _NOTICEABLE)
    return follows


def _input_correlations(results: Sequence[RecordResult]) -> tuple[FloatArray, FloatArray]:
    """Chance of the residuals' correlations, all tests together, and their largest in the mean.

    (n_outputs, n_inputs) each; chance is at least 1 where nothing is tested.
    """
    tests = sum(r.residuals.tested.sum() * len(r.residuals.chance) for r in results)
    chance = max(tests, 1) * np.min([result.residuals.chance for result in results], axis=0)
    sizes = np.mean([np.abs(result.residuals.cross).max(axis=0) for result in results], axis=0)
    return chance, sizes


def _input_parts(results: Sequence[RecordResult]) -> FloatArray:
    """What is left of an input in parts of the output's deviation, (n_outputs, n_inputs)."""
    _, sizes = _input_correlations(results)
    left = 1.0 - mean_known([result.metrics.fit for result in results], 0) / 100.0
    return sizes * left[:, None]


def _unexplained(model: ProcessModel, results: Sequence[RecordResult]) -> Iterator[str]:
    """Reasons: outputs that leave more than noise, by causes that have moved parameters as well."""
    fits = mean_known([result.metrics.fit for result in results], 0)
    shares = np.mean([result.residuals.white for result in results], axis=0)
    above, calibrated = _above_floor(results), _known(results)
    above_rounding = (1.0 - fits / 100.0 > _ROUNDING)[:, None]
    mostly = (_input_correlations(results)[1] > _MOSTLY) & above_rounding
    follows = _follows(results) & (mostly | (_input_parts(results) > _TRACE))
    for j, output in enumerate(model.output_names):
        left = (1.0 - fits[j] / 100.0) ** 2
        if above[j]:
            ratio = max(float(r.floor.ratio[j]) for r in results if r.floor is not None)
            yield (
                f"{output} errs {ratio:.1f} times as much as its sensors' noise explains: "
                "something is missing, and parameters that act on it may be off by more than "
                "their intervals."
            )
        elif left > _MUCH and shares[j] < _WANDERS and not calibrated[j]:
            yield (
                f"{100.0 * left:.0f} % of {output}'s variance is left, and wanders: noise of "
                "a measured input that came through the plant, or dynamics that the model lacks. "
                "Parameters that act on it may be off by more than their intervals."
            )
        elif follows[j].any() and not calibrated[j]:
            inputs = [model.input_names[i] for i in np.flatnonzero(follows[j])]
            yield (
                f"What is left of {output} follows {' and '.join(inputs)}: parameters that act on "
                "it may be off by more than their intervals."
            )


def _patterns(model: ProcessModel, results: Sequence[RecordResult]) -> Iterator[str]:
    """Reasons: residuals that are no sensor's noise, whatever their size."""
    shared = _largest(results, [result.shared for result in results])
    by_speed = _largest(results, [result.by_speed for result in results])
    together = [n for n, size in zip(model.output_names, shared, strict=True) if size > _SHARED]
    if together:
        yield (
            f"{' and '.join(together)} err together (correlation {shared.max():.2f}), as "
            "sensors do not: something acts in the plant that the model lacks, and parameters may "
            "be off by more than their intervals."
        )
    for name, size in zip(model.output_names, by_speed, strict=True):
        if size > _BY_SPEED:
            yield (
                f"{name} errs more the faster it changes (rank correlation {size:.2f}): instants "
                "of sampling that are not those of the log, a time constant that varies, or "
                "motion faster than the model's, as of a shaft or belt that gives. "
                "Parameters may be off by more than their intervals."
            )
    alone = _largest(results, [result.alone for result in results])
    for name, share in zip(model.output_names, alone, strict=True):
        if share:
            yield (
                f"{100.0 * share:.2g} % of what is left of {name} stands alone, far from what is "
                "left beside it: outliers too small to be seen in the samples, or jerks that the "
                "model lacks, as of play. Squared, they count more than their number."
            )


def _largest(results: Sequence[RecordResult], values: Sequence[FloatArray | None]) -> FloatArray:
    """Of each output the largest over the records where its error is more than rounding."""
    largest = np.zeros(len(results[0].metrics.fit))
    for result, sizes in zip(results, values, strict=True):
        if sizes is not None:
            noticeable = 1.0 - result.metrics.fit / 100.0 > _ROUNDING
            largest = np.maximum(largest, np.where(noticeable, sizes, 0.0))
    return largest


def _disagreement(uncertainty: Uncertainty, logs: int) -> Iterator[str]:
    """Reason: parts of the data that want parameters of their own."""
    ratio = uncertainty.disagreement**0.5
    if ratio > _DISAGREEING:
        parts = "Logs" if logs > 1 else "Parts of the log"
        yield (
            f"{parts} want parameters of their own, {ratio:.1f} times as far apart as noise "
            "explains: something is missing, or changes."
        )


def coloured_innovations(uncertainty: Uncertainty) -> BoolArray:
    """Outputs whose innovations follow one another, (n_outputs,); empty where there was no filter.

    Those of the right parameters of a right model are white (Kailath, "An innovations approach to
    least-squares estimation", IEEE Transactions on Automatic Control 13, 1968).
    """
    coloured: BoolArray = np.abs(uncertainty.succession) > SUCCESSIVE
    return coloured


def _filter_errors(model: ProcessModel, uncertainty: Uncertainty) -> Iterator[str]:
    """Reason: a filter whose errors it could have foreseen."""
    for j in np.flatnonzero(coloured_innovations(uncertainty)):
        yield (
            f"The filter's errors of {model.output_names[j]} follow one another (correlation "
            f"{uncertainty.succession[j]:.2f} of each with the one before), which those of the "
            "right parameters do not: the search has not found them, or the model lacks something."
        )


def _corrected(model: ProcessModel, uncertainty: Uncertainty) -> Iterator[str]:
    """Reason: errors of channels that were fitted; another channel's may look the same."""
    neutral = {p.name: (p.corrects, p.nominal) for p in model.parameters if p.corrects}
    for estimate in uncertainty.parameters:
        low = -math.inf if estimate.low is None else estimate.low
        high = math.inf if estimate.high is None else estimate.high
        channel, none = neutral.get(estimate.name, ("", low))
        if not low <= none <= high:
            yield (
                f"{channel} was corrected, {estimate.name} = {estimate.value:.4g}: data do not "
                "always tell which channel is wrong, and with another corrected the parameters are "
                "others. Find out which, and mend it before the next log."
            )


def _bent_filter(model: ProcessModel, uncertainty: Uncertainty) -> Iterator[str]:
    """Reason: a filter that takes for straight what is bent within noise, where that matters."""
    if uncertainty.moved_by_bends > MOVED:  # intervals count what is less
        j = int(np.argmax(uncertainty.bent))
        yield (
            f"The noise of the inputs hides where the equations bend (in {uncertainty.bent[j]:.0%} "
            f"of the samples of {model.output_names[j]}), as where motion turns: parameters that "
            "act there may be off by more than their intervals say. Less time near standstill, or "
            "less of that noise, tells them better."
        )


def _parameters_on_bounds(uncertainty: Uncertainty) -> Iterator[str]:
    """Reason: parameters that stand on an end of their range, where it decides anything."""
    ends = [p.name for p in uncertainty.parameters if p.on_bound and not p.harmless]
    starts = [name for name in ends if "(0)" in name]
    names = [name for name in ends if name not in starts]
    if names:
        verb = "stands" if len(names) == 1 else "stand"
        yield f"{', '.join(names)} {verb} on an end of the range: widen it, or fix the value."
    if starts:
        verb = "stands" if len(starts) == 1 else "stand"
        yield f"{', '.join(starts)} {verb} on an end of the range: widen it under 'initial'."


def _lacking(alternative: Alternative) -> str:
    """Reason: a variant that explains the data better."""
    fits = [
        f"{name} {old:.0f} -> {new:.0f} %"
        for name, (old, new) in alternative.fits.items()
        if new - old >= 1.0
    ]
    moved = [f"{name} {change(*move)}" for name, move in list(alternative.values.items())[:3]]
    effect = ", ".join([*fits, *moved]) or "it explains the training data better"
    return f"The model lacks {alternative.name}; fitted with it: {effect}."


def _moving(finding: Finding) -> str:
    """Reason: something missing that moves parameters."""
    moved = [
        f"{m.quantity.name} "
        + change(m.quantity.value, m.quantity.value + m.change, m.quantity.unit)
        for m in finding.moves[:3]
        if abs(m.deviations) > 1.0
    ]
    chance, text = _chance(finding), description(finding)
    says = "The data ask for " if finding.amplitude is None or finding.is_hidden else ""
    if finding.widens:
        moved.append(f"intervals {finding.wider:.1f} times as wide")
    way = "weighed by their colour, they ask for" if finding.kind == "feedback" else "with that"
    effect = (
        f"{way} {', '.join(moved)}" if moved else f"{100.0 * finding.share:.0f} % of what is left"
    )
    # A line leads nowhere that far.
    far = finding.turned_round or finding.kind in ("rest", "resonance")
    return f"{says}{text} ({chance})" + (f"; {effect}." if not far else ".")


def _not_seen(unseen: Unseen) -> str:
    """Note: what would not show in the data, and where it would move parameters."""
    moved = [move for move in unseen.moves if abs(move.deviations) > MOVED][:3]
    by = ", ".join(
        f"{m.quantity.name} by {abs(100.0 * m.change / m.quantity.value):.2g} %"
        if m.quantity.value
        else f"{m.quantity.name} by {sized(abs(m.change), m.quantity.unit, 2)}"
        for m in moved
    )
    interval = "its interval" if len(moved) == 1 else "their intervals"
    taken = moved[0].quantity.name if len(moved) == 1 else "these"
    return (
        f"These data would not show {unseen.text}. That would move {by}, far beyond "
        f"{interval}, for the fit takes it for a part of {taken}. {unseen.cure}"
    )


def _refuted(finding: Finding, fitted: Alternative) -> str:
    """What is left looks like a function that is not there, as its fit says."""
    worse = ", ".join(
        f"{name} {old:.0f} -> {new:.0f} %"
        for name, (old, new) in fitted.fits.items()
        if not old - new < 1.0
    )
    explains = "explains the data no better"
    if fitted.comparison.validated and worse:
        explains = f"explains validation worse ({worse})"
        if not all(math.isfinite(new) for _, new in fitted.fits.values()):
            explains = "cannot be simulated on validation, where it grows beyond all bounds"
    return (
        f"What is left looks like {description(finding)} ({_chance(finding)}), but fitted with it "
        f"the model {explains}"
    )


def _in_vain(finding: Finding, fitted: Alternative) -> str:
    """Reason: a function that is refuted, by which something else shows."""
    return (
        f"{_refuted(finding, fitted)}: something else is missing, and parameters may be "
        "off by more than their intervals."
    )


def _is_of(finding: Finding, fitted: Alternative) -> bool:
    """Whether it is the function that was fitted, or one of those that look like it."""
    return any(term in fitted.terms for term in (finding.term, *finding.rivals))


def _chance(finding: Finding) -> str:
    return "p < 1e-9" if finding.p_value < 1e-9 else f"p = {finding.p_value:.0e}"


def _untested(
    model: ProcessModel,
    results: Sequence[RecordResult],
    uncertainty: Uncertainty | None,
) -> Iterator[str]:
    """What could not be tested, and for want of what."""
    tested = _known(results)
    names = [n for n, is_tested in zip(model.output_names, tested, strict=True) if not is_tested]
    if uncertainty is None:
        yield "Without intervals it is not tested whether more than the noise is left to explain."
    elif names:
        yield (
            f"The noise of {', '.join(names)} is neither calibrated nor given: whether more could "
            "be explained is not tested."
        )


def _praise(
    model: ProcessModel, training: Sequence[RecordResult], validation: Sequence[RecordResult]
) -> str:
    """The reason for good predictions."""
    if not validation:
        return ""
    fit = float(mean_known([result.metrics.fit for result in validation]))
    chance, sizes = _input_correlations(validation)
    traces = sizes[chance < _BY_CHANCE]
    worse = [
        f"{output.times_as_much} as in training"
        for output in _worse_in_validation(model, training, validation)
    ]
    as_well = "parameters known so well explain them" if worse else "those that were"
    details = "; ".join([f"mean fit {fit:.1f} %", *worse])
    reason = f"Data not used in the fit are explained as well as {as_well} ({details})"
    at_noise = _known(validation) & ~_above_noise(validation)
    if at_noise.any():
        names = [n for n, at in zip(model.output_names, at_noise, strict=True) if at]
        reason += f", {', '.join(names)} down to the noise"
    if len(traces):
        reason += ", and what the residuals keep of the inputs is no more than a trace of the "
        reason += f"outputs (correlations of at most {traces.max():.2f})"
    elif any(result.residuals.tested.any() for result in validation):
        reason += ", and nothing of the inputs is left in the residuals"
    return f"{reason}."
