"""How far an identified model may be trusted: its errors, residuals, intervals, in one verdict."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sysid.arrays import FloatArray
from sysid.judging.residual_tests import ResidualTest, residual_test
from sysid.problem.data import Dataset
from sysid.problem.faults import DataFault
from sysid.problem.metrics import Metrics, evaluate, mean_known
from sysid.problem.model import ProcessModel
from sysid.uncertainty import Uncertainty

Trust = Literal["good", "limited", "poor"]

# Validation errors in parts of the training errors: what chance does, and what is not the same
# system any more.
_HARDLY_WORSE, _FAR_WORSE = 1.3, 2.0
_INDEPENDENT = 0.75  # share of lags inside a 95 % band below which something is left
_FITTED = 50.0  # fit [%] below which a model explains little
_EXACT = 99.0  # fit [%] above which an error several times as large is still a small one
# Correlation with an input below which what is left is found in long records, but is nothing to
# mend: one per cent of the residuals' variance.
_NOTICEABLE = 0.1
# Of an output's variance, beyond which what a model leaves may have moved its parameters, and share
# of the autocorrelations inside their band, below which it is no noise of that output's sensor.
_MUCH, _WANDERS = 0.05, 0.25


@dataclass(frozen=True)
class RecordResult:
    """A model's errors on a record; ``simulated``: whether its free run came to the end."""

    name: str
    simulated: bool
    metrics: Metrics
    residuals: ResidualTest


@dataclass(frozen=True)
class Verdict:
    """How far to trust, and why: a sentence for each reason, the gravest first."""

    trust: Trust
    reasons: tuple[str, ...]


def examine(record: Dataset, simulated: FloatArray) -> RecordResult:
    """Errors and residual tests of a model's free run, (n_samples, n_outputs), on a record."""
    return RecordResult(
        record.name,
        bool(np.all(np.isfinite(simulated))),
        evaluate(record.outputs, simulated),
        residual_test(record.outputs - simulated, record.inputs, record.input_noise),
    )


def judge(
    model: ProcessModel,
    training: Sequence[RecordResult],
    validation: Sequence[RecordResult],
    uncertainty: Uncertainty | None,
    feasible: bool = True,
    faults: Sequence[DataFault] = (),
) -> Verdict:
    """The verdict on an identification.

    validation: none where no records were held back. uncertainty: None without intervals.
    feasible: whether the parameters satisfy the constraints. faults: of the data, those in doubt
    lower it.
    """
    grave = [] if feasible else ["No parameters were found that satisfy all the constraints."]
    light: list[str] = []
    grave += _failed_runs(model, (*training, *validation))
    for name, ratio, fit in _validation_errors(model, training, validation):
        if fit < _FITTED:
            grave.append(f"{name} is explained poorly on the validation data (fit {fit:.0f} %).")
        elif ratio > _HARDLY_WORSE:
            reasons = grave if ratio > _FAR_WORSE and fit < _EXACT else light
            reasons.append(f"{name} errs {ratio:.1f} times as much in validation as in training.")
    if not validation:
        light.append("No data were held back for validation: the errors are those of the fit.")
    light += [fault.sentence for fault in faults if fault.severity == "doubt"]
    light += _input_traces(model, validation or training)
    light += _wandering_residuals(model, validation or training)
    if uncertainty is not None:
        light += _parameters_on_bounds(uncertainty)
    if grave:
        return Verdict("poor", (*grave, *light))
    return Verdict("limited", tuple(light)) if light else Verdict("good", _praise(validation))


def _failed_runs(model: ProcessModel, results: Sequence[RecordResult]) -> Iterator[str]:
    """Reason: records that the model cannot follow to the end."""
    failed = [result.name for result in results if not result.simulated]
    if failed:
        yield (
            f"Model {model.name} cannot be simulated on {', '.join(failed)}: its response grows "
            "beyond all bounds, or needs too small steps."
        )


def _validation_errors(
    model: ProcessModel, training: Sequence[RecordResult], validation: Sequence[RecordResult]
) -> list[tuple[str, float, float]]:
    """Each output's error in validation in parts of that in training, and its fit [%]."""
    if not validation:
        return []
    # Absolute, because each record has its own largest output.
    trained, validated = (
        np.sqrt(mean_known([(r.metrics.rmse * r.metrics.scale) ** 2 for r in results], 0))
        for results in (training, validation)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = validated / trained
    fits = mean_known([r.metrics.fit for r in validation], 0)
    return list(zip(model.output_names, ratios.tolist(), fits.tolist(), strict=True))


def _input_traces(model: ProcessModel, results: Sequence[RecordResult]) -> Iterator[str]:
    """Reasons: outputs whose residuals still follow an input."""
    shares, sizes = _input_correlations(results)
    follows = (shares < _INDEPENDENT) & (sizes > _NOTICEABLE)
    for output, following in zip(model.output_names, follows, strict=True):
        if following.any():
            inputs = [model.input_names[i] for i in np.flatnonzero(following)]
            yield (
                f"Residuals of {output} still follow {' and '.join(inputs)}: the model lacks "
                "dynamics there."
            )


def _input_correlations(results: Sequence[RecordResult]) -> tuple[FloatArray, FloatArray]:
    """Share of correlations inside their band and the largest, (n_outputs, n_inputs), means."""
    shares = mean_known([result.residuals.independent for result in results], 0)
    sizes = np.mean([np.abs(result.residuals.cross).max(axis=0) for result in results], axis=0)
    return shares, sizes


def _wandering_residuals(model: ProcessModel, results: Sequence[RecordResult]) -> Iterator[str]:
    """Reasons: outputs with large coloured residuals, whose cause has moved parameters as well."""
    fits = mean_known([result.metrics.fit for result in results], 0)
    shares = np.mean([result.residuals.white for result in results], axis=0)
    for output, fit, share in zip(model.output_names, fits, shares, strict=True):
        left = (1.0 - fit / 100.0) ** 2
        if left > _MUCH and share < _WANDERS:
            yield (
                f"{100.0 * left:.0f} % of {output}'s variance is left, and wanders: noise of "
                "a measured input that came through the plant, or dynamics that the model lacks. "
                "Parameters that act on it may be off by more than their intervals."
            )


def _parameters_on_bounds(uncertainty: Uncertainty) -> Iterator[str]:
    """Reason: parameters that stand on an end of their range."""
    names = [p.name for p in uncertainty.parameters if p.on_bound]
    if names:
        verb = "stands" if len(names) == 1 else "stand"
        yield f"{', '.join(names)} {verb} on an end of the range: widen it, or fix the value."


def _praise(validation: Sequence[RecordResult]) -> tuple[str]:
    """The reason for a good verdict."""
    fit = float(mean_known([result.metrics.fit for result in validation]))
    shares, sizes = _input_correlations(validation)
    traces = sizes[shares < _INDEPENDENT]
    reason = (
        f"Data not used in the fit are explained as well as those that were (mean fit {fit:.1f} %)"
    )
    if len(traces):
        reason += ", and of the inputs no more than a trace is left in the residuals "
        reason += f"(correlations of at most {traces.max():.2f})"
    elif np.isfinite(shares).any():
        reason += ", and nothing of the inputs is left in the residuals"
    return (f"{reason}.",)
