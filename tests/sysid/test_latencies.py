"""Held inputs that act later than they are logged: by how much, which, and what that moves."""

import numpy as np
import pytest
from scipy.linalg import expm

from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.gassi import GASSI
from sysid.judging.examination import suspected
from sysid.problem.preparation import Preparation, prepare
from tests.soak import mostly_soak

TRUTH = {"R": 2.3, "L": 1.1e-3, "K": 0.035, "J": 2.1e-5, "B": 4e-5}
UNITS = dict(zip(TRUTH, ("ohm", "H", "N*m/A", "kg*m^2", "N*m*s/rad"), strict=True))
MOTOR = ProcessModel(
    "motor",
    (State("i", "A"), State("w", "rad/s")),
    (Input("V", "V"),),
    (Output("i", "A"), Output("w", "rad/s")),
    tuple(
        Parameter(name, UNITS[name], 1.6 * value, value / 8.0, value * 8.0, "log")
        for name, value in TRUTH.items()
    ),
    lambda x, u, p: (
        (u[0] - p[0] * x[0] - p[2] * x[1]) / p[1],
        (p[2] * x[0] - p[4] * x[1]) / p[3],
    ),
)
DT, N = 1e-3, 2000


def log(late, seed, crosstalk=0.0):
    """A motor's log, exact but for sensors' noise, whose driver acts so many samples late."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(50, 200, N // 50)
    volts = np.repeat(rng.uniform(-12.0, 12.0, len(lengths)), lengths)[:N]
    r, inductance, k, inertia, b = TRUTH.values()
    a = np.array([[-r / inductance, -k / inductance], [k / inertia, -b / inertia]])
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[0, 2] = a, 1.0 / inductance
    first, last = expm(whole * late * DT), expm(whole * (1.0 - late) * DT)
    x, before, outputs = np.zeros(2), 0.0, np.zeros((N, 2))
    for row, now in zip(outputs, volts, strict=True):
        row[:] = x
        x = first[:2, :2] @ x + first[:2, 2] * before
        x, before = last[:2, :2] @ x + last[:2, 2] * now, now
    noise = rng.standard_normal((N, 2)) * [0.02, 0.8]
    seen = np.column_stack([crosstalk * volts, np.zeros(N)])
    return Dataset(volts, outputs + noise + seen, DT, f"log {seed}")


def fitted(record):
    estimator = GASSI(MOTOR, population=60, generations=14, random_state=0).fit(record)
    return estimator, estimator.uncertainty([record])


@pytest.mark.parametrize("late", mostly_soak([0.3, 0.1, 0.7]))
def test_a_driver_that_is_late_is_named_with_what_it_moves(late):
    record = log(late, seed=1)
    estimator, uncertainty = fitted(record)
    assert abs(estimator.parameters_["L"] / TRUTH["L"] - 1.0) > 0.08
    finding, *more = suspected(estimator, uncertainty, [record]).findings
    assert (finding.kind, finding.name, more) == ("delay", "V", [])
    assert finding.amplitude == pytest.approx(-late * DT, abs=0.01 * DT)
    (move,) = [m for m in finding.moves if m.quantity.name == "L"]
    assert move.quantity.value + move.change == pytest.approx(TRUTH["L"], rel=0.03)
    # What the finding asks for is the cure, to within what is known of it.
    cured = prepare(MOTOR, record, Preparation({"V": -late * DT})).dataset
    estimator, uncertainty = fitted(cured)
    (inductance,) = [e for e in uncertainty.determined() if e.name == "L"]
    assert inductance.low < TRUTH["L"] < inductance.high
    assert not any(f.counts for f in suspected(estimator, uncertainty, [cured]).findings)


def test_a_sensor_that_sees_the_voltage_is_not_taken_for_a_late_driver():
    record = log(0.0, seed=2, crosstalk=0.02)
    findings = suspected(*fitted(record), [record]).findings
    assert "crosstalk" in {findings[0].kind, *(f.kind for f in findings[0].instead)}
