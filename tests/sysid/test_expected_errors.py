"""The floor of residuals: how large those of the right parameters are, and how they scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid import BatchSimulator, Dataset
from sysid.examples import lag, lag_record
from sysid.judging.expected_errors import ExpectedErrors, expected_errors, floor_test
from sysid.problem.space import SearchSpace

START = np.zeros(1)


def of_truth(model, record) -> tuple[np.ndarray, ExpectedErrors]:
    """Residuals of the right parameters, and what they are expected to be."""
    simulator, vector = BatchSimulator(model, accuracy=1e-6), model.nominal
    run = simulator.trajectories(vector, record, None, START[None])[0]
    expected = expected_errors(simulator, SearchSpace.of(model), vector, record, START, None)
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
