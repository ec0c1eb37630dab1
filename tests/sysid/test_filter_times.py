"""A filter through which an output was logged: its time, and that taking it out is the cure."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from benchmarks._stress_cases import cases
from benchmarks.stress import fitted
from sysid import Dataset
from sysid.gassi import GASSI
from sysid.judging.examination import suspected, verdict_of
from sysid.judging.findings import description
from sysid.problem.preparation import Preparation, prepare
from tests.soak import mostly_soak
from tests.sysid.test_latencies import MOTOR, TRUTH

DT, N, NOISE = 1e-3, 1500, [0.02, 0.5]


def log(seed, time, is_analog):
    """A motor's log by the matrix exponential; a drive filters its noisy samples."""
    rng = np.random.default_rng(seed)
    volts = np.repeat(rng.uniform(-12.0, 12.0, N // 20), 20)
    r, inductance, k, inertia, b = TRUTH.values()
    rates = np.zeros((4, 4))
    rates[0, :2], rates[0, 3] = [-r / inductance, -k / inductance], 1.0 / inductance
    rates[1, :2] = k / inertia, -b / inertia
    rates[2, 1:3] = 1.0 / time, -1.0 / time
    step, x = expm(rates * DT), np.zeros((N, 4))
    x[:, 3] = volts
    for i in range(N - 1):
        x[i + 1, :3] = step[:3] @ x[i]
    noise = rng.standard_normal((N, 2)) * NOISE
    if is_analog:
        return Dataset(volts, x[:, [0, 2]] + noise, DT)
    outputs, pole = x[:, :2] + noise, np.exp(-DT / time)
    outputs[:, 1] = lfilter([1.0 - pole], [1.0, -pole], outputs[:, 1])
    return Dataset(volts, outputs, DT)


@pytest.mark.parametrize(
    ("is_analog", "time"),
    mostly_soak([(True, 3e-3), (False, 3e-3), (False, 8e-3), (True, 1e-3)]),
)
def test_its_time_is_told_by_fits_and_without_it_all_is_well(is_analog, time):
    """By slopes it is a twentieth too long, and what is left of it was a delay, or a resonance."""
    training, validation = log(1, time, is_analog), log(2, time, is_analog)
    estimator = GASSI(MOTOR, population=40, generations=10).fit(training)
    (finding,) = suspected(estimator, estimator.uncertainty(training), [training]).findings
    print(description(finding))
    assert (finding.kind, finding.name) == ("filter", "w")
    assert finding.amplitude == pytest.approx(time, rel=0.01)
    assert (finding.late > 0.0) == is_analog == (" late" in description(finding))
    taken_out = Preparation(filtered={"w": finding.amplitude}, delay={"w": finding.late})
    clean = [prepare(MOTOR, record, taken_out).dataset for record in (training, validation)]
    estimator = GASSI(MOTOR, population=40, generations=10).fit(clean[0])
    assert verdict_of(estimator, clean[:1], clean[1:]).trust == "good"
    found = [e for e in estimator.uncertainty(clean[0]).determined() if e.name in TRUTH]
    assert len(found) == 5
    assert sum(e.excludes(TRUTH) for e in found) <= 1


@pytest.mark.soak
def test_a_time_that_slopes_tell_far_too_short_is_found_all_the_same():
    """The winding takes up most of a filter of its current: 1.7 ms had been told of 3."""
    case = {case.name: case for case in cases()}["current through a filter"]
    training, _ = case.records(0)
    estimator = fitted(case, training, 0)
    finding, *_ = suspected(estimator, estimator.uncertainty(list(training)), training).findings
    assert (finding.kind, finding.name, finding.late) == ("filter", "current", 0.0)
    assert finding.amplitude == pytest.approx(3e-3, rel=0.02)
    moved = {move.quantity.name: move.quantity.value + move.change for move in finding.moves}
    assert moved["L"] == pytest.approx(2e-3, rel=0.03)
