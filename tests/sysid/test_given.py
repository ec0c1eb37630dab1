"""Identification in stages: what the first stage left open widens what the second says."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter

from sysid import GASSI, Dataset, Given, ModelError
from sysid.examples import lag, lag_record

QUICK = {"population": 20, "generations": 4}


def drifting(seed, gain=3.0, tau=0.04, n=60):
    """A lag that never settles, so that a wrong tau is paid for with the gain."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 2), 2)
    pole = np.exp(-0.01 / tau)
    y = lfilter([0.0, 1.0 - pole], [1.0, -pole], gain * u)
    return Dataset(u, y + 0.02 * rng.normal(size=n), 0.01, f"drifting {seed}")


def second_stage(record, tau, factor=()):
    estimator = GASSI(lag(), given=Given({"tau": tau}, factor), **QUICK).fit(record)
    (estimate,) = estimator.uncertainty(record).parameters
    return estimator.parameters_["gain"], estimate


def test_an_interval_holds_what_the_first_stage_left_open():
    record, tau, deviation = drifting(1), 0.04, 0.004
    gain, alone = second_stage(record, tau)
    _, estimate = second_stage(record, tau, [[deviation]])
    # What another tau would have made of it, by fitting again.
    up, down = (second_stage(record, tau + sign * 1e-4)[0] for sign in (1.0, -1.0))
    follows = (up - down) / 2e-4 * deviation
    assert follows**2 > 4.0 * alone.std**2  # or the test would show little
    assert_allclose(estimate.std, np.hypot(alone.std, follows), rtol=0.03)
    assert_allclose(gain, estimate.value)


def test_independent_changes_add_up_and_those_that_cancel_do_not():
    record = drifting(2)
    alone = second_stage(record, 0.04)[1].std
    once, twice = (second_stage(record, 0.04, [[0.002]] * k)[1].std for k in (1, 2))
    assert_allclose(twice**2 - alone**2, 2.0 * (once**2 - alone**2), rtol=1e-6)


@pytest.mark.soak
def test_intervals_of_the_second_stage_hold_the_truth_and_merely_fixed_ones_do_not():
    held = np.zeros(2)
    for seed in range(20):
        whole = lag_record(seed=seed, gain=2.0)  # another gain, the same tau
        short = Dataset(whole.inputs[:24], whole.outputs[:24], whole.dt)
        first = GASSI(lag(), random_state=seed, **QUICK).fit(short)
        place = first.space_.names.index("tau")
        factor = first.uncertainty(short).factor[:, [place]].tolist()
        for k, given in enumerate((factor, [])):
            _, estimate = second_stage(drifting(seed), first.parameters_["tau"], given)
            held[k] += estimate.low <= 3.0 <= estimate.high
    assert held[0] >= 17 > held[1]


def test_the_factor_is_the_covariance_in_the_parameters_units():
    record = lag_record()
    estimator = GASSI(lag(), **QUICK).fit(record)
    found = estimator.uncertainty(record)
    covariance = found.factor.T @ found.factor
    assert_allclose(np.sqrt(np.diag(covariance)), [e.std for e in found.parameters], rtol=1e-6)
    (row, column) = np.sqrt(np.diag(covariance))
    assert_allclose(covariance[0, 1] / (row * column), found.correlation()[0, 1], rtol=1e-6)


@pytest.mark.parametrize(
    ("given", "more", "what"),
    [
        (Given({"tua": 1.0}), {}, "tua"),
        (Given({"tau": 1.0}), {"fixed": {"tau": 1.0}}, "both fixed and given"),
        (Given({"tau": 0.04}, [[1.0, 2.0]]), {}, "must have 1 numbers"),
        (Given({"tau": 0.04}, [[np.nan]]), {}, "not finite"),
        (Given({"tau": -1.0}), {}, "outside its physical limits"),
    ],
)
def test_what_cannot_be_given_is_refused(given, more, what):
    with pytest.raises(ModelError, match=what):
        GASSI(lag(), given=given, **more, **QUICK).fit(lag_record())
