"""A run that starts at a measured sample keeps its noise, and the intervals know."""

from __future__ import annotations

import numpy as np
import pytest

from sysid import (
    BatchSimulator,
    Dataset,
    Input,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    State,
)
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.gassi import GASSI
from sysid.judging.expected_errors import expected_errors
from sysid.uncertainty import uncertainty

RATE, SIGMA, DT, N = 2.0, 0.05, 0.01, 200

INTEGRATOR = ProcessModel(
    name="integrator",
    states=(State("y", "m"),),
    inputs=(Input("u", "V"),),
    outputs=(Output("y", "m"),),
    parameters=(Parameter("rate", "m/(s*V)", RATE, 0.1, 10.0),),
    derivative=lambda x, u, p: (p[0] * u[0],),
)
SIMULATOR, SPACE = BatchSimulator(INTEGRATOR, accuracy=1e-6), SearchSpace.of(INTEGRATOR)


def estimate(seed, calibrated):
    rng, u = np.random.default_rng([5, seed]), np.ones(N)
    y = RATE * DT * np.arange(N) + SIGMA * rng.standard_normal(N)
    known = np.array([SIGMA]) if calibrated else np.zeros(0)
    objective = Objective(SIMULATOR, SPACE, [Dataset(u, y, DT, output_noise=known)])
    end = refine(objective, np.array([RATE])).chromosome
    return uncertainty(objective, end).parameters[0]


@pytest.mark.parametrize("calibrated", [True, False])
def test_the_noise_of_a_first_sample_has_the_closed_form(calibrated):
    """rate = sum t (y - y0) / sum t^2, in which y0 is in every term."""
    t = DT * np.arange(N)
    white, start = 1.0 / np.sum(t**2), (np.sum(t) / np.sum(t**2)) ** 2
    expected = SIGMA * np.sqrt(white + start)
    deviations = [estimate(seed, calibrated).std for seed in range(5)]
    # Where what the start left wanders through the residuals their colour counts it as well.
    np.testing.assert_allclose(deviations, expected, rtol=0.25)
    assert expected > 5.0 * SIGMA * np.sqrt(white)


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_right_model_is_expected_to_err_by_its_start(calibrated):
    known = np.array([SIGMA]) if calibrated else np.zeros(0)
    noisy = RATE * DT * np.arange(N) + SIGMA * np.random.default_rng(1).standard_normal(N)
    record = Dataset(np.ones(N), noisy, DT, output_noise=known)
    start = record.initial_state(INTEGRATOR)
    expected = expected_errors(SIMULATOR, SPACE, np.array([RATE]), record, start, None)
    size = np.sqrt(np.mean(np.sum(expected.systematic**2, axis=2)))
    assert size == pytest.approx(SIGMA, rel=1e-6 if calibrated else 0.2)


def test_intervals_hold_the_truth():
    estimates = [estimate(seed, calibrated=False) for seed in range(60)]
    assert np.mean([e.low < RATE < e.high for e in estimates]) > 0.9


def test_noise_below_fast_motion_is_that_which_the_model_leaves():
    """An oscillation of a hundred times the noise, whose samples do not show it."""
    rng, u = np.random.default_rng(0), np.cos(2.5 * np.arange(N))
    y = RATE * DT * np.concatenate([[0.0], np.cumsum(u)[:-1]]) * 4000.0 * SIGMA
    noisy = y + SIGMA * rng.standard_normal(N)
    record = Dataset(4000.0 * SIGMA * u, noisy, DT)
    start = record.initial_state(INTEGRATOR)
    expected = expected_errors(SIMULATOR, SPACE, np.array([RATE]), record, start, None)
    size = np.sqrt(np.mean(np.sum(expected.systematic**2, axis=2)))
    assert size == pytest.approx(SIGMA, rel=0.2)


def test_a_start_whose_noise_would_tell_more_than_all_else_is_estimated():
    """Least squares of a line through all samples know its slope by sqrt(12 / n) / T."""
    expected = SIGMA * np.sqrt(12.0 / N) / (N * DT)
    deviations, errors = [], []
    for seed in range(4):
        rng = np.random.default_rng([7, seed])
        y = RATE * DT * np.arange(N) + SIGMA * rng.standard_normal(N)
        estimator = GASSI(INTEGRATOR, population=10, generations=2)
        estimator.fit(Dataset(np.ones(N), y, DT))
        assert estimator.estimated_starts_ == ("y",)
        rate = estimator.uncertainty(Dataset(np.ones(N), y, DT)).parameters[0]
        slope = np.polyfit(DT * np.arange(N), y, 1)[0]
        assert rate.value == pytest.approx(slope, abs=0.02 * expected)
        deviations.append(rate.std)
        errors.append(rate.value - RATE)
    np.testing.assert_allclose(deviations, expected, rtol=0.15)
    assert np.abs(errors).max() < 3.0 * expected


def test_a_start_that_is_to_be_its_first_sample_stays_there():
    y = RATE * DT * np.arange(N) + SIGMA * np.random.default_rng(7).standard_normal(N)
    record = Dataset(np.ones(N), y, DT)
    estimator = GASSI(INTEGRATOR, population=10, generations=2, first_samples=["y"]).fit(record)
    assert estimator.initial_states_ == []
    t = DT * np.arange(N)
    assert estimator.parameters_["rate"] == pytest.approx(t @ (y - y[0]) / (t @ t), rel=1e-6)
