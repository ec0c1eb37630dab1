"""Held inputs that act later than they are logged, as behind a driver, or earlier.

A fit hides most of it: 0.3 ms at 1 kHz make a motor's inductance a third larger, and what is left
looks like a speed that is logged late, or a sensor of it that sees the current. Slopes at that
minimum tell no more. So such inputs are moved, and all is fitted anew.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.judging.alternatives import shared
from sysid.judging.findings import Finding, is_of_parameters, moves_of
from sysid.judging.score_tests import missing_physics
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel
from sysid.problem.preparation import acting_later
from sysid.uncertainty import Uncertainty

if TYPE_CHECKING:
    from sysid.gassi import GASSI

# Kinds of findings that it may be.
_ALIKE = ("delay", "filter", "mean", "lag", "crosstalk", "bend", "follower", "resonance")
_STEP, _FARTHEST = 0.25, 2.0  # samples, between times that are tried in turn, and the last of them
# Times more that are tried, each where those before it say, and samples by which they differ.
_CLOSER, _SAME = 3, 2e-3
_CUT = 3  # samples at the ends of records that are left out, more than any of these times
_LEAST, _MOST = 50, 20_000  # samples of a record, to lose these, and of all to be fitted so often
_SURE = 30.0  # of twice the logarithm of a likelihood ratio, below which it may be chance


@dataclass(frozen=True, eq=False)
class _Moved:
    """A fit with inputs that act so much later [s]; rms: (n_outputs,), the outputs' errors."""

    time: float
    objective: Objective
    chromosome: FloatArray
    rms: FloatArray

    @property
    def deviance(self) -> float:
        """Minus twice the logarithm of its likelihood."""
        with np.errstate(divide="ignore"):
            return 2.0 * float(self.objective.counts @ np.log(self.rms))


def with_latencies(
    findings: tuple[Finding, ...],
    estimator: GASSI,
    uncertainty: Uncertainty,
    training: Sequence[Dataset],
) -> tuple[Finding, ...]:
    """Findings, or in their place the time by which held inputs act later, where it is all.

    Of each input alone, then of all by the same: refits tell how late, and it is taken for what is
    missing if nothing that counts is found where they end.
    """
    surest = next((finding for finding in findings if finding.counts), None)
    if surest is None or surest.kind not in _ALIKE or not _can_be_moved(training):
        return findings
    model, dt = estimator.simulator().model, training[0].dt
    held = _exact_and_held(model, training)
    groups = [[i] for i in held] + [held] * (len(held) > 1)
    # All inputs later is the only output earlier.
    if len(model.outputs) == 1 and surest.kind == "delay" and not surest.of_input:
        groups = [places for places in groups if len(places) < len(model.inputs)]
    for places in groups:
        pair = _later(estimator, training, places, dt)
        if pair is not None and not _lacks(pair[1], uncertainty):
            names = [model.input_names[i] for i in places]
            return tuple(_finding(*pair, name, uncertainty) for name in names)
    return findings


def _finding(here: _Moved, late: _Moved, name: str, uncertainty: Uncertainty) -> Finding:
    """An input that is logged early; here: the fit as it is logged."""
    names = late.objective.space.names
    parameters = dict(zip(names, late.chromosome.tolist(), strict=True))
    # Where records start has moved as well, and is nobody's parameter.
    model = late.objective.simulator.model
    estimates = [e for e in shared(uncertainty, parameters) if is_of_parameters(e, model)]
    moves = moves_of(estimates, [e.at(parameters) - e.value for e in estimates])
    chance = float(chdtrc(1, here.deviance - late.deviance))
    share = 1.0 - float(np.mean((late.rms / here.rms) ** 2))
    return Finding("delay", name, "s", -late.time, chance, share, moves, of_input=True)


def _can_be_moved(training: Sequence[Dataset]) -> bool:
    """Whether records are long enough, not so long that fits take minutes, and as logged."""
    lengths = [record.n_samples for record in training]
    prepared = any(record.last_part.any() for record in training)
    return min(lengths) >= _LEAST and sum(lengths) <= _MOST and not prepared


def _exact_and_held(model: ProcessModel, training: Sequence[Dataset]) -> list[int]:
    """Places of the inputs that are held, and logged without noise."""
    noisy = np.any([record.input_noise for record in training], axis=0)
    moving = np.any([np.ptp(record.inputs, axis=0) > 0.0 for record in training], axis=0)
    held = np.array([given.hold == "zoh" for given in model.inputs], dtype=bool)
    return np.flatnonzero(held & moving & ~noisy).tolist()


def _later(
    estimator: GASSI, training: Sequence[Dataset], places: Sequence[int], dt: float
) -> tuple[_Moved, _Moved] | None:
    """A fit anew, and the likeliest with inputs that act later, or earlier.

    None where chance explains that.
    """

    def moved(samples: float, begin: FloatArray) -> _Moved:
        # What acted before a record, and may yet act at its begin, is not known.
        late = (acting_later(record, places, samples * dt) for record in training)
        records = [r.part(_CUT, r.n_samples - _CUT, r.name) for r in late]
        objective = estimator.final_examined(records)
        end = refine(objective, begin)
        return _Moved(samples * dt, objective, end.chromosome, end.rms)

    try:
        here = moved(0.0, estimator.final_chromosome_)
        tried = [moved(-_STEP, here.chromosome), here, moved(_STEP, here.chromosome)]
        while (best := min(tried, key=_deviance)) in (tried[0], tried[-1]):
            samples = best.time / dt + math.copysign(_STEP, best.time)
            if abs(samples) > _FARTHEST:
                break
            tried = sorted([*tried, moved(samples, best.chromosome)], key=_time)
        for _ in range(_CLOSER):
            time = _vertex(tried)
            if any(abs(time - fit.time) < _SAME * dt for fit in tried):
                break
            tried = sorted([*tried, moved(time / dt, best.chromosome)], key=_time)
            best = min(tried, key=_deviance)
    except ModelError:  # a simulation that fails there
        return None
    return (here, best) if here.deviance - best.deviance > _SURE else None


_deviance, _time = attrgetter("deviance"), attrgetter("time")


def _vertex(tried: Sequence[_Moved]) -> float:
    """Where the parabola through the likeliest fit and those beside it is lowest, within these."""
    best = min(range(len(tried)), key=lambda k: tried[k].deviance)
    place = min(max(best, 1), len(tried) - 2)
    (t0, d0), (t1, d1), (t2, d2) = ((f.time, f.deviance) for f in tried[place - 1 : place + 2])
    slope = (d1 - d0) / (t1 - t0)
    curvature = ((d2 - d1) / (t2 - t1) - slope) / (t2 - t0)
    if not curvature > 0.0:
        return t1
    return min(max(0.5 * (t0 + t1 - slope / curvature), t0), t2)


def _lacks(late: _Moved, uncertainty: Uncertainty) -> bool:
    """Whether something that counts is found where a fit ended."""
    try:
        findings = missing_physics(late.objective, late.chromosome, uncertainty).findings
    except ModelError:
        return True
    return any(finding.counts for finding in findings)
