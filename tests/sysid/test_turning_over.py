"""A pendulum that turns over: by free runs nothing leads to it, and its valley is narrow."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sysid import GASSI, BatchSimulator, Dataset, SearchSpace
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.gassi.nudged import held, let_go
from tests.sysid.support import pendulum, pendulum_derivative

DT, SAMPLES, NOISE = 0.01, 1500, 9e-4
TRUTH = {"inertia": 0.0143, "viscous": 0.0145, "weight": 0.668}


@pytest.fixture(scope="module")
def record():
    """A log by SciPy at tight tolerance, of a torque that throws the pendulum over."""
    rng = np.random.default_rng(3)
    torque = np.repeat(rng.uniform(-1.0, 1.0, SAMPLES // 30), 30)
    state, angles = np.array([0.03, 0.0]), []
    for level in torque:
        angles.append(state[0])
        state = solve_ivp(
            lambda t, x, level=level: pendulum_derivative(x, (level,), TRUTH.values()),
            (0.0, DT), state, rtol=1e-11, atol=1e-12,
        ).y[:, -1]  # fmt: skip
    assert np.ptp(angles) > 4.0 * math.pi, "it turns over"
    return Dataset(torque, np.array(angles) + rng.normal(0.0, NOISE, SAMPLES), DT)


def objective(record):
    model = pendulum(theta=(-0.2, 0.2), omega=(-2.0, 2.0))
    space = SearchSpace.of(model).with_starts([record])
    return Objective(BatchSimulator(model), space, [record])


def test_what_measurements_hold_leads_the_free_run_where_it_would_not_go_alone(record):
    free = objective(record)
    start = np.array([*(1.3 * value for value in TRUTH.values()), 0.0, 0.0])
    alone = refine(free, start)
    assert free.unexplained(alone.rms) > 0.1
    (end,) = let_go(free, [refine(held(free), start).chromosome])
    np.testing.assert_allclose(end.chromosome[:3], list(TRUTH.values()), rtol=2e-3)
    assert free.unexplained(end.rms) < 1e-2


@pytest.mark.soak
def test_it_is_found_and_its_intervals_hold_the_truth(record):
    fitted = GASSI(pendulum(theta=(-0.2, 0.2), omega=(-2.0, 2.0)), random_state=0).fit(record)
    assert fitted.error_ * np.abs(record.outputs).max() == pytest.approx(NOISE, rel=0.05)
    for estimate in fitted.uncertainty(record).parameters:
        if estimate.name in TRUTH:
            assert estimate.low < TRUTH[estimate.name] < estimate.high
            assert estimate.high - estimate.low < 0.02 * estimate.value
