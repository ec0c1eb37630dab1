"""Held inputs that change between samples: a delay of parts of a sample, as drivers have it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid import BatchSimulator, Dataset, ModelError
from sysid.engine.filter_settings import FilterSettings
from sysid.examples import lag
from sysid.gassi import GASSI
from sysid.problem.preparation import Preparation, prepare
from tests.sysid.support import held_lag

DT, GAIN, TAU = 0.01, 2.0, 0.006  # s: a fifth is left of a step a sample later
N, PARTS = 60, 40
P = np.array([[GAIN, TAU]])


def answer(u, shift, parts=1):
    return held_lag(u, shift, GAIN, TAU / DT, parts)


def levels(seed):
    return np.repeat(np.random.default_rng(seed).uniform(-1.0, 1.0, N // 4), 4)


def moved(u, y, shift, **more):
    """A record whose input is so many samples late, as it is prepared."""
    record = Dataset(u, y, DT, **more)
    return prepare(lag(), record, Preparation({"u": shift * DT})).dataset


@settings(max_examples=40, deadline=None)
@given(st.floats(-2.5, 2.5), st.integers(0, 1000))
def test_the_model_is_driven_as_the_plant_was(shift, seed):
    u = levels(seed)
    record = moved(u, answer(u, shift), shift)
    simulated = BatchSimulator(lag(), accuracy=1e-6).trajectories(P, record)[0]
    np.testing.assert_allclose(simulated, record.outputs, atol=1e-3)


def test_by_the_mean_of_a_sample_fast_states_are_far_off():
    u = levels(0)
    record = moved(u, answer(u, -0.3), -0.3)
    by_means = replace(record, changes=np.zeros(0))
    simulated = BatchSimulator(lag(), accuracy=1e-6).trajectories(P, by_means)[0]
    assert np.abs(simulated - record.outputs).max() > 0.05


def test_means_over_windows_see_it_as_well():
    u = levels(1)
    fine = answer(u, -0.4, PARTS)
    middles = 0.5 * (fine[1:] + fine[:-1])
    means = np.array([0.0, *middles.reshape(-1, PARTS).mean(axis=1)])
    windows = np.tile([-DT, 0.0], (N, 1, 1))
    record = moved(u, means, -0.4, windows=windows)
    start = np.array([[answer(u, -0.4)[1]]])
    (simulated,) = BatchSimulator(lag(), accuracy=1e-6).trajectories(P, record, starts=start)
    np.testing.assert_allclose(simulated[1:], record.outputs[1:], atol=2e-3)


def test_tangents_are_slopes_of_these_runs():
    u = levels(2)
    record, steps = moved(u, answer(u, -0.3), -0.3), np.array([[16]])
    simulator = BatchSimulator(lag())
    (tangents,) = simulator.tangents(P, [record], np.eye(2)[None], steps)
    for j, size in enumerate(1e-4 * P[0]):
        up, down = (
            simulator.trajectories(P + sign * size * np.eye(2)[j], record, 16)[0]
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(tangents[0, ..., j], (up - down) / (2.0 * size), rtol=1e-4)


@pytest.mark.parametrize("averaged", [False, True])
def test_a_filter_that_corrects_nothing_sees_the_same_runs(averaged):
    u = levels(3)
    windows = np.tile([-0.5 * DT, 0.0], (N, 1, 1)) if averaged else np.zeros(0)
    record = moved(u, answer(u, -0.3), -0.3, windows=windows, input_noise=np.array([1e-9]))
    model = lag().with_initial({"y": 0.0})  # not a sample, which has noise
    common = P, [record], [np.ones(1)], np.array([[16]]), [None]
    runs = BatchSimulator(model).residuals(*common).values
    filtering = FilterSettings(np.array([0.1]), corrects=False)
    filtered = BatchSimulator(model).innovations(*common, [filtering]).values
    np.testing.assert_allclose(filtered[1:], runs[1:], atol=1e-6)


def test_a_driver_that_is_late_no_longer_moves_a_time_constant():
    u = levels(4)
    y = answer(u, -0.25) + 1e-3 * np.random.default_rng(4).standard_normal(N)
    how = {"population": 40, "generations": 10, "random_state": 0}
    late = GASSI(lag(), **how).fit(Dataset(u, y, DT)).parameters_["tau"]
    record = moved(u, y, -0.25)
    right = GASSI(lag(), **how).fit(record).parameters_["tau"]
    by_means = GASSI(lag(), **how).fit(replace(record, changes=np.zeros(0))).parameters_["tau"]
    assert right == pytest.approx(TAU, rel=5e-3)
    assert abs(late / TAU - 1.0) > 0.05
    assert abs(by_means / TAU - 1.0) > 0.05


def test_a_part_of_a_record_keeps_them_and_fewer_samples_do_not():
    u = levels(5)
    record = moved(u, answer(u, -0.3), -0.3)
    np.testing.assert_array_equal(record.part(3, 20, "part").changes, record.changes[3:20])
    fewer = prepare(
        lag(), Dataset(np.tile(u, 4), np.zeros(4 * N), DT), Preparation({"u": 3e-3}, decimate=4)
    )
    assert not fewer.dataset.last_part.any()


@pytest.mark.parametrize("wrong", [{"changes": np.zeros((2, 1))}, {"last_part": np.array([1.5])}])
def test_changes_that_no_input_makes_are_refused(wrong):
    given = {"changes": np.zeros((3, 1)), "last_part": np.array([0.5])} | wrong
    with pytest.raises(ModelError, match=r"changes|last_part"):
        Dataset(np.zeros(3), np.zeros(3), DT, **given)
