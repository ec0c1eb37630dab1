"""The time constant of a filter through which an output was logged, as fits tell it.

A fit takes part of a filter for inertia, and slopes around that minimum tell its time constant by
some per cent too long. So it is taken out of the logs, and all is fitted anew. A filter that is
computed from samples, as a drive's, answers each at once; one before they are taken, as of
resistor and capacitor, some half a sample later.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from sysid.arrays import FloatArray
from sysid.fitting.refinement import refine
from sysid.judging.alternatives import shared
from sysid.judging.findings import Finding, is_of_parameters, moves_of
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError
from sysid.problem.preparation import Preparation, prepare
from sysid.uncertainty import Uncertainty
from sysid.uncertainty.colour import fast_colour
from sysid.uncertainty.sensitivity import sensitivity

if TYPE_CHECKING:
    from sysid.gassi import GASSI

_REACH = 2.5  # times by which a time may be off that slopes tell
_TOLERANCE = 2e-3  # of the time
_MOST_SAMPLES = 20_000  # to be fitted so often
_SURE = 10.0  # of twice the logarithm of a likelihood ratio, below which it is a drive's filter


@dataclass(frozen=True)
class _Unfiltered:
    """A fit to logs without a filter; late: by which it was late beside its time [s].

    deviance: minus twice the logarithm of its likelihood.
    """

    time: float
    late: float
    deviance: float
    chromosome: FloatArray


def with_filter_times(
    findings: tuple[Finding, ...],
    estimator: GASSI,
    uncertainty: Uncertainty,
    training: Sequence[Dataset],
) -> tuple[Finding, ...]:
    """Findings, with the time of an output's filter, where one counts first, as fits tell it."""
    place, first = next(((k, f) for k, f in enumerate(findings) if f.counts), (0, None))
    model = estimator.simulator().model
    if first is None or first.kind != "filter" or first.name not in model.output_names:
        return findings
    measured = all(np.isfinite(record.outputs).all() for record in training)
    if not measured or sum(record.n_samples for record in training) > _MOST_SAMPLES:
        return findings
    assert first.amplitude is not None
    j = model.output_names.index(first.name)
    try:
        drive, analog = (
            _likeliest(estimator, training, j, first.amplitude, is_analog)
            for is_analog in (False, True)
        )
    except ModelError:  # a simulation that fails there
        return findings
    fit = analog if analog.deviance < drive.deviance - _SURE else drive
    parameters = dict(zip(estimator.space_.names, fit.chromosome.tolist(), strict=True))
    estimates = [e for e in shared(uncertainty, parameters) if is_of_parameters(e, model)]
    moves = moves_of(estimates, [e.at(parameters) - e.value for e in estimates])
    fitted = replace(first, amplitude=fit.time, late=fit.late, moves=moves)
    return (*findings[:place], fitted)  # what a line's guess of it leaves looks like much else


def _likeliest(
    estimator: GASSI, training: Sequence[Dataset], j: int, guess: float, is_analog: bool
) -> _Unfiltered:
    from scipy.optimize import minimize_scalar  # half a second

    tried = list[_Unfiltered]()

    def deviance(factor: float) -> float:
        time = guess * math.exp(factor)
        tried.append(_without(estimator, training, j, time, is_analog))
        return tried[-1].deviance

    reach = math.log(_REACH)
    ends = (-reach, reach)
    minimize_scalar(deviance, bounds=ends, method="bounded", options={"xatol": _TOLERANCE})
    return min(tried, key=lambda fit: fit.deviance)


def _without(
    estimator: GASSI, training: Sequence[Dataset], j: int, time: float, is_analog: bool
) -> _Unfiltered:
    """A fit to logs of whose output j a filter is taken out, and its errors in what was logged."""
    model = estimator.simulator().model
    name = model.output_names[j]
    records, late = [], 0.0
    for record in training:
        late = time - record.dt / math.expm1(record.dt / time) if is_analog else 0.0
        as_it_was = Preparation(delay={name: late}, filtered={name: time})
        made = prepare(model, record, as_it_was).dataset
        records.append(made.part(0, record.n_samples - 1, record.name))
    objective = estimator.final_examined(records)
    chromosome = refine(objective, estimator.final_chromosome_).chromosome
    local = sensitivity(objective, chromosome)
    simulated = np.concatenate([record.outputs for record in records])
    simulated = simulated + local.residual * local.objective.scales_of_each
    errors, first = list[FloatArray](), 0
    for record, made in zip(training, records, strict=True):
        outputs = simulated[first : first + made.n_samples]
        outputs[:, j] = _filtered(outputs[:, j], record.outputs[0, j], time / record.dt, is_analog)
        errors.append(outputs - record.outputs[: made.n_samples])
        first += made.n_samples
    colour = fast_colour(np.concatenate(errors), local.seen, local.lengths)
    return _Unfiltered(time, late, colour.deviance, chromosome)


def _filtered(signal: FloatArray, start: float, samples: float, is_analog: bool) -> FloatArray:
    """A signal as logged through a filter; straight between samples where that is analog."""
    pole = math.exp(-1.0 / samples)
    share = 1.0 - samples * (1.0 - pole) if is_analog else 1.0 - pole
    weights = np.array([share, 1.0 - pole - share])
    moved: FloatArray = lfilter(weights, [1.0, -pole], signal - start)
    return moved + start
