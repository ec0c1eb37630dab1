"""Errors made independent, against the covariance that each input's noise gives one by one."""

import numpy as np
import pytest

from sysid import Input, Output, Parameter, ProcessModel, State
from sysid.engine.intervals import Intervals
from sysid.experiments.error_filter import ErrorFilter

DT, N = 0.05, 40
INPUT_NOISE = np.array([0.3, 0.2])
VECTOR, START = np.array([30.0]), np.array([0.1, 0.0])
OSCILLATOR = ProcessModel(
    name="oscillator",
    states=(State("x", "m"), State("v", "m/s")),
    inputs=(Input("u", "m/s^2", "foh"), Input("w", "m/s^2", "zoh")),
    outputs=(Output("x", "m"), Output("a", "m/s^2")),
    parameters=(Parameter("k", "1/s^2", 30.0, 1.0, 100.0),),
    derivative=lambda x, u, p: (x[1], -p[0] * x[0] - 0.3 * x[1] + u[0] + 2.0 * u[1]),
    output=lambda x, u, p: (x[0], x[1] + 0.5 * u[1]),
)


def outputs(inputs):
    states = Intervals(OSCILLATOR, VECTOR, inputs, DT, 16).run(START)
    return np.column_stack([states[:, 0], states[:, 1] + 0.5 * inputs[:, 1]])


def error_filter(inputs, variances):
    intervals = Intervals(OSCILLATOR, VECTOR, inputs, DT, 16)
    return ErrorFilter.along(intervals, intervals.run(START), variances, INPUT_NOISE)


def test_it_is_a_root_of_the_inverse_of_the_errors_covariance():
    rng = np.random.default_rng(0)
    inputs, variances = rng.standard_normal((N, 2)), rng.uniform(0.5, 2.0, (N, 2)) * 1e-4
    moved = []
    for place in np.ndindex(inputs.shape):
        further = inputs.copy()
        further[place] += INPUT_NOISE[place[1]]
        moved.append((outputs(further) - outputs(inputs)).reshape(-1))
    covariance = np.diag(variances.reshape(-1)) + np.array(moved).T @ np.array(moved)
    root = error_filter(inputs, variances).of(np.eye(2 * N))
    assert root.T @ root @ covariance == pytest.approx(np.eye(2 * N), abs=1e-5)


def test_an_output_without_weight_counts_nothing():
    variances = np.full((N, 2), 1e-4)
    variances[:, 1] = np.inf
    filtered = error_filter(np.zeros((N, 2)), variances)
    errors = np.random.default_rng(0).standard_normal((N, 2, 1))
    without = errors.copy()
    without[:, 1] = np.nan
    both = [filtered.of(each.reshape(-1, 1)).reshape(N, 2) for each in (errors, without)]
    assert both[0][:, 0] == pytest.approx(both[1][:, 0])
    assert not both[0][:, 1].any()


def test_errors_of_a_run_without_noisy_inputs_are_white_but_for_their_size():
    variances = np.random.default_rng(0).uniform(0.5, 2.0, (N, 2))
    variances[3, 1] = np.inf
    errors = np.random.default_rng(1).standard_normal((N, 2))
    errors[3, 1] = np.nan
    whitened = ErrorFilter.white(variances).of(errors.reshape(-1, 1)).reshape(N, 2)
    expected = np.nan_to_num(errors) / np.sqrt(variances)
    assert whitened == pytest.approx(expected)


def test_what_errs_more_than_foretold_counts_less():
    filtered = error_filter(np.zeros((N, 2)), np.full((N, 2), 1e-4))
    errors = 1e-2 * np.random.default_rng(0).standard_normal((N, 2, 16))
    errors[20:, 0] *= 100.0
    looser = filtered.loosened(errors.reshape(2 * N, 16))
    larger = filtered.kept / looser.kept
    assert larger[:10] == pytest.approx(1.0, abs=0.2)
    assert larger[30:, 0].min() > 10.0
    left = looser.of(errors.reshape(2 * N, 16)).reshape(N, 2, 16)
    assert np.mean(left[28:, 0] ** 2) == pytest.approx(1.0, rel=0.3)
