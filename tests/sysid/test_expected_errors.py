"""The floor of residuals: how large those of the right parameters are, and how they scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sysid import BatchSimulator, Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.examples import lag, lag_record
from sysid.judging.expected_errors import ExpectedErrors, expected_errors, floor_test
from sysid.problem.space import SearchSpace

START = np.zeros(1)


def of_truth(model, record, closely=False) -> tuple[np.ndarray, ExpectedErrors]:
    """Residuals of the right parameters, and what they are expected to be."""
    simulator, vector = BatchSimulator(model, accuracy=1e-6), model.nominal
    run = simulator.trajectories(vector, record, None, START[None])[0]
    expected = expected_errors(
        simulator, SearchSpace.of(model), vector, record, START, None, closely
    )
    return record.outputs - run, expected


def test_what_a_plant_passes_on_slowly_is_above_its_mean_by_chance_as_often_as_is_told():
    """A lag of 0.5 s in a record of 2 s makes a few swings of an input's white noise."""
    model = lag()
    model = replace(
        model, parameters=(model.parameters[0], replace(model.parameters[1], nominal=0.4))
    )
    p_values = []
    for seed in range(60):
        rng = np.random.default_rng([11, seed])
        acting = np.repeat(rng.uniform(-1.0, 1.0, 20), 10)[:, None]
        blank = Dataset(acting, np.full((200, 1), np.nan), 0.01)
        y = BatchSimulator(model, accuracy=1e-6).trajectories(
            model.nominal, blank, None, START[None]
        )[0]
        record = Dataset(
            acting + rng.standard_normal(acting.shape),
            y + 0.01 * rng.standard_normal(y.shape),
            0.01,
            input_noise=np.array([1.0]),
            output_noise=np.array([0.01]),
        )
        p_values.append(floor_test(*of_truth(model, record)).p_value[0])
    assert np.mean(np.array(p_values) < 0.05) < 0.13
    assert np.mean(np.array(p_values) < 0.3) > 0.1


def test_windows_that_are_known_so_well_only_are_a_known_noise():
    """Means over 2 ms, each of them 0.3 ms early or late, of nothing else than that."""
    model, plain, rng = lag(), lag_record(seed=4), np.random.default_rng(3)
    n, dt, finer = plain.n_samples, plain.dt, 100
    fine = Dataset(
        np.repeat(plain.inputs, finer, axis=0), np.full((finer * n, 1), np.nan), dt / finer
    )
    simulator = BatchSimulator(model, accuracy=1e-8)
    y = simulator.trajectories(model.nominal, fine, None, START[None])[0][:, 0]
    way = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]))]) * fine.dt
    late = 3e-4 * rng.standard_normal(n)
    late[0], ends = 0.0, np.arange(n) * dt
    begins = ends - 2e-3
    instants = np.arange(finer * n) * fine.dt
    means = (np.interp(ends + late, instants, way) - np.interp(begins + late, instants, way)) / 2e-3
    means[0], begins[0] = y[0], ends[0]
    windows = np.stack([begins - ends, np.zeros(n)], axis=1)[:, None]
    record = Dataset(plain.inputs, means[:, None], dt, windows=windows)
    assert not floor_test(*of_truth(model, record)).known[0]
    jittered = replace(record, jitter=np.full((n, 1), 3e-4))
    test = floor_test(*of_truth(model, jittered))
    assert 0.8 < test.ratio[0] < 1.2 and test.p_value[0] > 0.01
    wrong = replace(jittered, jitter=np.full((n, 1), 1e-4))
    test = floor_test(*of_truth(model, wrong))
    assert test.ratio[0] > 2.0 and test.p_value[0] < 1e-6


def summing() -> ProcessModel:
    """The output is the sum of the input over time, from zero on."""
    return ProcessModel(
        name="summing",
        states=(State("sum", "1"),),
        inputs=(Input("u", "1"),),
        outputs=(Output("y", "1"),),
        parameters=(Parameter("k", "1", 1.0, 0.1, 10.0),),
        derivative=lambda x, u, p: (p[0] * u[0],),
        output=lambda x, u, p: (x[0],),
    )


@pytest.mark.soak
def test_a_sum_of_an_inputs_noise_is_as_often_so_large_as_is_told():
    """Most of a random walk's mean square is one slow swing: three times the mean is no rarity."""
    n, dt, rng = 400, 0.01, np.random.default_rng(5)
    blank, noise = np.zeros((n, 1)), {"input_noise": np.array([1.0])}
    record = Dataset(blank, blank, dt, output_noise=np.array([1e-3]), **noise)
    roughly, closely = (of_truth(summing(), record, closely)[1] for closely in (False, True))
    mean_square = dt**2 * (n - 1) / 2.0
    np.testing.assert_allclose(roughly.variance, mean_square, rtol=0.5)
    np.testing.assert_allclose(closely.variance, mean_square, rtol=0.13)
    walks = dt * np.cumsum(rng.standard_normal((4000, n - 1)), axis=1)
    p_values = np.array([floor_test(walk[:, None], closely).p_value[0] for walk in walks])
    assert 0.0003 < np.mean(p_values < 0.001) < 0.004
    assert 0.03 < np.mean(p_values < 0.05) < 0.08
    assert 0.2 < np.mean(p_values < 0.3) < 0.4


def two_wells() -> ProcessModel:
    """From nearly between two wells; which of them it falls into, noise decides."""
    return ProcessModel(
        name="two wells",
        states=(State("x", "1", initial=0.01),),
        inputs=(Input("u", "1"),),
        outputs=(Output("x", "1"),),
        parameters=(Parameter("k", "1/s", 20.0, 1.0, 100.0),),
        derivative=lambda x, u, p: (p[0] * (x[0] - x[0] * x[0] * x[0]) + u[0],),
    )


def test_noise_that_would_have_led_elsewhere_tells_nothing_of_where_errors_are_large():
    """What is left is the sensor's noise alone, as large at the fall as in the well."""
    n, rng = 400, np.random.default_rng(6)
    blank, noise = np.zeros((n, 1)), {"input_noise": np.array([1.0])}
    model = two_wells()
    x = BatchSimulator(model).trajectories(model.nominal, Dataset(blank, blank, 0.01), None)[0]
    record = Dataset(
        blank, x + 0.01 * rng.standard_normal((n, 1)), 0.01, output_noise=np.array([0.01]), **noise
    )
    expected = expected_errors(
        BatchSimulator(model), SearchSpace.of(model), model.nominal, record, x[0], None
    )
    assert expected.variance[0] > 0.5
    residual = record.outputs - x
    np.testing.assert_allclose(expected.evened(residual), residual, rtol=0.2)


def test_errors_of_zeros_are_expected_and_an_inputs_adds_up():
    n, dt = 400, 0.01
    zeros = {"input_zero": np.array([0.1]), "output_zero": np.array([0.02])}
    blank = np.zeros((n, 1))
    record = Dataset(blank, blank, dt, output_noise=np.array([1e-3]), **zeros)
    expected = of_truth(summing(), record)[1]
    time = dt * np.arange(n)
    mean_square = 1e-6 + 0.02**2 + 0.1**2 * np.mean(time**2)
    np.testing.assert_allclose(expected.variance, mean_square, rtol=1e-6)
    for sign in (-1.0, 1.0):
        drift = sign * 0.15 * time[:, None]
        assert floor_test(drift, expected).p_value[0] > 0.1
    assert floor_test(drift, replace(expected, systematic=blank[..., None])).p_value[0] < 1e-6
