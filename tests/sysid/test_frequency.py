"""Frequency responses against closed forms, SciPy and their own scatter."""

import numpy as np
import pytest
from scipy import signal

from sysid import Dataset, LinearModel, ModelError
from sysid.response.frequency import frequency_response, sampled_response

DT = 0.01
# A resonance driven by two inputs, one of them four times as strong.
LINEAR = LinearModel(
    A=np.array([[0.0, 1.0], [-900.0, -12.0]]),
    B=np.array([[0.0, 0.0], [900.0, 225.0]]),
    C=np.array([[1.0, 0.0]]),
    D=np.zeros((1, 2)),
)


def measured(n, noise, seed, correlated=0.0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 2))
    u[:, 1] += correlated * u[:, 0]
    system = signal.cont2discrete(tuple(LINEAR), DT)[:4]
    y = signal.dlsim((*system, DT), u)[1]
    return Dataset(u, y + noise * rng.normal(size=y.shape), DT)


@pytest.mark.parametrize("correlated", [0.0, 0.8])
def test_the_estimate_scatters_about_the_truth_as_it_says(correlated):
    records = [measured(6000, 0.3, seed, correlated) for seed in (1, 2)]
    found = frequency_response(records)
    truth = sampled_response(LINEAR, found.frequency, DT, ["zoh", "zoh"])
    errors = np.abs((found.response - truth) / found.deviation)
    # Leakage beside the resonance is no scatter; elsewhere a complex error of unit variance.
    calm = np.abs(found.frequency - 4.8) > 2.0
    assert np.sqrt(np.mean(errors[calm] ** 2, axis=0)) == pytest.approx(1.0, abs=0.15)


def test_a_held_input_acts_as_scipys_discretisation_says():
    frequency = np.array([0.5, 4.8, 20.0, 49.0])
    system = signal.cont2discrete(tuple(LINEAR), DT)[:4]
    a, b, c, _ = system
    expected = [
        c @ np.linalg.solve(np.exp(2j * np.pi * f * DT) * np.eye(2) - a, b) for f in frequency
    ]
    held = sampled_response(LINEAR, frequency, DT, ["zoh", "zoh"])
    assert held == pytest.approx(np.array(expected), rel=1e-9)


def test_an_interpolated_input_acts_as_in_continuous_time():
    frequency = np.array([0.5, 4.8])
    s = 2j * np.pi * frequency
    expected = 900.0 / (s**2 + 12.0 * s + 900.0)
    mixed = sampled_response(LINEAR, frequency, DT, ["foh", "zoh"])
    assert mixed[:, 0, 0] == pytest.approx(expected, rel=1e-9)
    assert abs(mixed[0, 0, 1] / expected[0]) == pytest.approx(0.25, rel=1e-3)


def test_coherence_of_a_single_input_is_the_ordinary_one():
    data = measured(4096, 0.5, 3)
    single = Dataset(data.inputs[:, :1], data.outputs, DT)
    found = frequency_response([single])
    length = round(1.0 / (found.frequency[0] * DT))
    frequency, expected = signal.coherence(
        data.inputs[:, 0], data.outputs[:, 0], fs=1 / DT, window="hann", nperseg=length,
        noverlap=length // 2, detrend=False,
    )  # fmt: skip
    inner = slice(3, -1)  # the mean is taken off each segment there, off the whole record here
    assert found.frequency == pytest.approx(frequency[1:-1])
    assert found.coherence[inner, 0, 0] == pytest.approx(expected[1:-1][inner], abs=0.02)


def test_power_of_the_inputs_is_all_in_their_density():
    data = measured(8192, 0.0, 4)
    found = frequency_response([data])
    power = found.input_density.sum(axis=0) * found.frequency[0]
    assert power == pytest.approx(data.inputs.var(axis=0), rel=0.03)


def levels(n_samples, hold, rng):
    return np.repeat(rng.uniform(-1.0, 1.0, n_samples // hold + 1), hold)[:n_samples, None]


@pytest.mark.parametrize("n_samples", [400, 3000, 60000])
def test_noise_alone_is_not_significant_however_few_the_segments(n_samples):
    shares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        record = Dataset(levels(n_samples, 20, rng), rng.normal(size=(n_samples, 1)), DT)
        shares.append(frequency_response([record]).significant.mean())
    assert np.mean(shares) < 0.005


def test_a_response_is_significant_where_its_input_has_power_and_noise_does_not_hide_it():
    rng = np.random.default_rng(1)
    u = levels(20000, 20, rng)
    lag = signal.lfilter([0.1], [1.0, -0.9], u, axis=0)
    estimate = frequency_response([Dataset(u, lag + 0.01 * rng.normal(size=u.shape), DT)])
    significant, frequency = estimate.significant[:, 0, 0], estimate.frequency
    assert significant[frequency < 2.0].all()
    nulls = np.isclose(frequency % 5.0, 0.0, atol=0.05)  # of levels held for 0.2 s
    assert not significant[nulls].any()


def test_what_a_window_leaks_of_a_tone_is_no_power():
    time = DT * np.arange(20000)
    u = np.sin(2.0 * np.pi * 5.0 * time)[:, None]
    estimate = frequency_response([Dataset(u, 2.0 * u, DT)])
    significant = estimate.frequency[estimate.significant[:, 0, 0]]
    assert len(significant) and np.all(np.abs(significant - 5.0) < 1.0)


def test_lost_samples_and_still_inputs_are_left_out():
    data = measured(3000, 0.0, 5)
    inputs = np.column_stack([data.inputs, np.full(3000, 2.0)])
    outputs = data.outputs.copy()
    outputs[1500] = np.nan
    found = frequency_response([Dataset(inputs, outputs, DT)])
    whole = frequency_response([Dataset(inputs, data.outputs, DT)])
    assert found.varied.tolist() == [True, True, False]
    assert np.isnan(found.response[:, :, 2]).all()
    assert 0 < found.n_segments < whole.n_segments
    truth = sampled_response(LINEAR, found.frequency, DT, ["zoh", "zoh"])
    assert np.median(np.abs(found.response[:, 0, 0] / truth[:, 0, 0] - 1.0)) < 0.1


@pytest.mark.parametrize(
    ("records", "said"),
    [
        ([Dataset(np.zeros((200, 1)), np.ones((200, 1)), DT)], "no input changes"),
        ([measured(20, 0.0, 0)], "do not tell 2 inputs apart"),
        ([measured(400, 0.0, 0), Dataset(np.zeros((9, 2)), np.zeros((9, 1)), 0.1)], "sample times"),
    ],
)
def test_what_gives_no_estimate_is_refused(records, said):
    with pytest.raises(ModelError, match=said):
        frequency_response(records)
