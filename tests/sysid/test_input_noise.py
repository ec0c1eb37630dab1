"""What of measured inputs counts as their noise where a model is tested for what it lacks."""

from dataclasses import replace

import numpy as np

from sysid import BatchSimulator, Dataset
from sysid.examples import lag
from sysid.judging.disturbed import DisturbedRun
from sysid.threads import Workers
from tests.sysid.test_reactions import BEHIND, INERTIA, log, rotor


def test_a_load_below_its_noise_that_follows_the_commands_is_no_noise():
    taken, right = [], []
    command = np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, 200), 4)
    load = log(np.random.default_rng(0), 0.0, command)[0].inputs[:, 1]
    for seed in range(12):
        record, _ = log(np.random.default_rng(seed), 0.1, command)
        run = DisturbedRun.free(
            rotor(BEHIND), np.array([INERTIA]), record, np.zeros(2), 4, Workers(1)
        )
        taken.append(run.likely_noise(1))
        right.append(np.corrcoef(taken[-1], record.inputs[:, 1] - load)[0, 1])
    assert load.std() < 0.3 * 0.1
    # A Wiener filter takes four fifths of it.
    assert np.mean(taken, axis=0) @ load < 0.4 * (load @ load)
    assert np.mean(right) > 0.9


def test_a_tested_run_moves_by_little_of_its_inputs_noise():
    rng, n, vector = np.random.default_rng(0), 1000, np.array([2.0, 0.005])
    wave = np.sin(2.0 * np.pi * 0.5 * 0.002 * np.arange(n))
    exact = Dataset(wave, np.full((n, 1), np.nan), 0.002)
    simulator, start = BatchSimulator(lag(), accuracy=1e-7), np.zeros((1, 1))
    seen = wave + 0.3 * rng.standard_normal(n)
    noisy = replace(exact, inputs=seen[:, None], input_noise=np.array([0.3]))
    right, moved = (simulator.trajectories(vector, r, None, start)[0] for r in (exact, noisy))
    run = DisturbedRun.free(lag(), vector, noisy, start[0], 4, Workers(1))
    assert (run.outputs - right).std() < 0.7 * (moved - right).std()
    np.testing.assert_array_equal(run.measured, noisy.inputs)
