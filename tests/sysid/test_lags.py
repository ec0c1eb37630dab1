"""Channels that lag are told before a fit; what is not clear, and what does not lag, is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks._stress_cases import CORRECT, MODEL, MORE_CORRECT, cases
from benchmarks.stress import fitted
from sysid import Dataset
from sysid.judging.examination import verdict_of
from sysid.judging.lags import Lag, lag_faults, lags
from tests.soak import mostly_soak

CASES = {case.name: case for case in cases()}


@pytest.mark.parametrize(
    ("name", "lag"),
    [
        ("current a sample late", Lag(0, 0, 1)),
        ("speed ten samples late", Lag(1, 0, 10)),
        ("voltage two samples late", Lag(0, 0, -2)),
        ("voltage ten samples late", Lag(0, 0, -10)),
    ],
)
def test_a_lag_is_told_with_its_size(name, lag):
    training, _ = CASES[name].records(0)
    assert lag in lags(training)


def test_logs_whose_times_round_to_rates_apart_by_the_last_digit_lag_alike():
    case = CASES["speed ten samples late"]
    first, second = (case.records(seed)[0][0] for seed in range(2))
    records = [first, replace(second, dt=first.dt * (1.0 - 1e-13))]
    assert [fault.channel for fault in lag_faults(MODEL, records)] == ["omega"]


@pytest.mark.parametrize(
    "case", mostly_soak([*CORRECT, *MORE_CORRECT], always=8), ids=lambda case: case.name
)
def test_channels_that_do_not_lag_are_let_alone(case):
    training, _ = case.records(0)
    assert lags(training) == ()


@pytest.mark.filterwarnings("error")
def test_of_inputs_that_move_together_nothing_is_clear():
    training, _ = CASES["voltage ten samples late"].records(0)
    together = [replace(r, inputs=r.inputs[:, :1] * [1.0, 0.5]) for r in training]
    assert lags(together) == ()
    still = [replace(r, inputs=0.0 * r.inputs) for r in training]
    assert lags(still) == ()
    assert lags([Dataset(np.zeros((5, 1)), np.zeros((5, 1)), 0.01)]) == ()


def test_what_a_controller_makes_of_an_output_is_no_late_input():
    """u follows y by a sample: y seems to move before u."""
    rng, n = np.random.default_rng(0), 1500
    target, u, y = np.repeat(rng.normal(size=n // 50), 50), np.zeros(n), np.zeros(n)
    for k in range(n - 1):
        u[k] = 0.5 * (target[k] - y[k - 1])
        y[k + 1] = 0.9 * y[k] + u[k] + 0.5 * rng.normal()
    assert lags([Dataset(u, y, 0.01)]) == ()


def test_it_is_a_fault_of_the_data_that_the_verdict_names():
    case = CASES["current a sample late"]
    training, validation = case.records(0)
    (fault,) = lag_faults(MODEL, training)
    assert fault.channel == "current" and fault.severity == "doubt"
    assert "current follows voltage 1 sample (0.002 s) later" in fault.statement
    verdict = verdict_of(fitted(case, training, 0), training, [validation])
    assert verdict.parameters.trust == "limited"
    assert verdict.parameters.reasons[0] == fault.sentence
    assert "The data ask for" not in " ".join(verdict.parameters.reasons), "by wrong instants"


@pytest.mark.parametrize("noise", [0.1, 1.0, 2.0, 4.0, 8.0])
def test_a_plant_that_integrates_four_times_begins_gently(noise):
    """An angle by a brake's command: sampled with a hold, its numerator is 1, 11, 11, 1."""
    rng, n = np.random.default_rng(1), 4000
    denominator = np.poly([0.9, 0.8, 0.7, 0.6])
    u, error = np.repeat(rng.normal(size=n // 4), 4), noise * rng.normal(size=n)
    y = lfilter([0.0, 1.0, 11.0, 11.0, 1.0], denominator, u) + lfilter([1.0], denominator, error)
    assert lags([Dataset(u, y, 0.01)]) == ()
    late = lfilter([0.0] * 4 + [40.0], denominator, u) + lfilter([1.0], denominator, error)
    assert lags([Dataset(u, late, 0.01)]) == (Lag(0, 0, 3),)
