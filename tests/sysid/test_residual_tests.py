"""Residual tests: how often they say what, over many repetitions of what is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from sysid.judging.residual_tests import residual_test


def coloured(rng, n, a):
    """AR(1) of unit variance."""
    return lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], rng.standard_normal(n + 200))[200:]


def shares(record_of, seeds=200):
    """Mean shares inside the bands over seeds: with itself, with each input."""
    tests = [residual_test(*record_of(np.random.default_rng([8, seed]))) for seed in range(seeds)]
    return (
        np.mean([t.white for t in tests], axis=0),
        np.mean([t.independent for t in tests], axis=0),
    )


def test_correlations_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    e, u = rng.standard_normal((60, 2)) + 3.0, rng.standard_normal((60, 1)) - 7.0
    test = residual_test(e, u, n_lags=10)
    np.testing.assert_array_equal(test.lags, np.arange(10))
    assert test.auto.shape == (10, 2) and test.cross.shape == (10, 2, 1)
    centred, driving = e - e.mean(axis=0), u - u.mean(axis=0)
    for lag in range(10):
        for j in range(2):
            own = sum(centred[t, j] * centred[t - lag, j] for t in range(lag, 60))
            assert test.auto[lag, j] == pytest.approx(own / (60 * e[:, j].var()))
            cross = sum(centred[t, j] * driving[t - lag, 0] for t in range(lag, 60))
            expected = cross / (60 * e[:, j].std() * u.std())
            assert test.cross[lag, j, 0] == pytest.approx(expected)
    np.testing.assert_allclose(test.auto[0], 1.0)
    np.testing.assert_allclose(test.auto_band, 1.959964 / np.sqrt(60))


def test_white_residuals_stay_inside_their_bands():
    white, independent = shares(lambda rng: rng.standard_normal((2, 600, 2)))
    np.testing.assert_allclose(white, 0.955, atol=0.01)
    np.testing.assert_allclose(independent, 0.955, atol=0.015)


@pytest.mark.parametrize("a, b", [(0.9, 0.9), (0.95, 0.8), (0.9, 0.0), (-0.8, 0.8)])
def test_where_both_are_coloured_the_bands_are_as_wide_as_chance(a, b):
    def record(rng):
        return coloured(rng, 2000, a)[:, None], coloured(rng, 2000, b)[:, None]

    white, independent = shares(record)
    assert independent[0, 0] == pytest.approx(0.95, abs=0.03)
    assert white[0] < 0.9, "the colour of the residual itself is seen"


def test_bands_of_white_noise_would_be_too_narrow_for_both_coloured():
    rng = np.random.default_rng(3)
    e, u = coloured(rng, 2000, 0.9)[:, None], coloured(rng, 2000, 0.9)[:, None]
    test = residual_test(e, u)
    # The variance of a sum of products is that of white noise times (1 + a b) / (1 - a b).
    expected = 1.959964 / np.sqrt(2000) * np.sqrt(1.81 / 0.19)
    assert test.cross_band[0, 0] == pytest.approx(expected, rel=0.2)
    assert test.auto_band[0] == pytest.approx(1.959964 / np.sqrt(2000))


@pytest.mark.parametrize("delay", [0, 7, 30])
def test_what_follows_an_input_is_caught_at_its_delay(delay):
    def record(rng):
        u = rng.standard_normal((1000, 2))
        left = lfilter([0.3], [1.0, -0.7], u[:, 1])
        left = np.concatenate([np.zeros(delay), left[: 1000 - delay]])
        return (left + rng.standard_normal(1000))[:, None], u

    _, independent = shares(record, seeds=50)
    assert independent[0, 0] > 0.92, "the other input is innocent"
    assert independent[0, 1] < 0.93
    test = residual_test(*record(np.random.default_rng(4)))
    caught = np.flatnonzero(np.abs(test.cross[:, 0, 1]) > 2.0 * test.cross_band[0, 1])
    assert caught[0] == delay


def test_lost_samples_neither_hide_nor_invent():
    def losing(signal, share):
        def record(rng):
            u = rng.standard_normal((1200, 1))
            e = rng.standard_normal((1200, 1)) + signal * u
            e[rng.random(1200) < share] = np.nan
            return e, u

        return record

    for share in (0.02, 0.4):
        white, independent = shares(losing(0.0, share))
        assert white[0] > 0.94 and 0.94 < independent[0, 0] < 0.97
        test = residual_test(*losing(1.0, share)(np.random.default_rng(2)))
        assert test.auto[0, 0] == pytest.approx(1.0)
        # The correlation of e = u + noise with u.
        assert test.cross[0, 0, 0] == pytest.approx(np.sqrt(0.5), abs=0.08)


def test_a_constant_or_noisy_input_says_nothing():
    rng = np.random.default_rng(1)
    e = rng.standard_normal((300, 1))
    u = np.stack([np.full(300, 0.1), rng.standard_normal(300), rng.standard_normal(300)], axis=1)
    test = residual_test(e, u, np.array([0.0, 0.2, 0.0]))
    np.testing.assert_array_equal(test.tested, [False, False, True])
    np.testing.assert_array_equal(np.isnan(test.independent[0]), [True, True, False])
    assert np.all(np.isfinite(test.cross)) and np.all(np.isfinite(test.cross_band))


def test_a_band_has_a_width_whatever_the_colours():
    t = np.arange(400.0)
    # The estimated variance of the correlations is negative here.
    test = residual_test(((-1.0) ** t)[:, None], t[:, None])
    assert np.all(test.cross_band > 0.0)


def test_a_model_without_inputs_or_errors_is_tested_for_what_there_is():
    without = residual_test(np.random.default_rng(0).standard_normal((50, 1)), np.zeros((50, 0)))
    assert without.independent.shape == (1, 0) and without.tested.shape == (0,)
    perfect = residual_test(np.zeros((50, 1)), np.arange(50.0)[:, None])
    assert perfect.white[0] == perfect.independent[0, 0] == 1.0


@pytest.mark.parametrize("n, lags", [(2, 2), (3, 2), (9, 2), (40, 10), (1000, 50)])
def test_at_most_a_quarter_of_a_record_is_used(n, lags):
    rng = np.random.default_rng(n)
    test = residual_test(rng.standard_normal((n, 1)), rng.standard_normal((n, 1)))
    assert len(test.lags) == len(test.auto) == len(test.cross) == lags
    assert np.all(np.isfinite(test.auto))


def test_an_output_that_was_never_measured_is_no_matter():
    e = np.random.default_rng(0).standard_normal((100, 2))
    e[:, 1] = np.nan
    test = residual_test(e, np.arange(100.0)[:, None])
    assert np.all(np.isfinite(test.auto)) and np.all(np.isfinite(test.cross_band))


@settings(max_examples=30)
@given(
    scale=st.floats(1e-6, 1e6),
    shift=st.floats(-1e3, 1e3),
    flip=st.booleans(),
    seed=st.integers(0, 9),
)
def test_units_and_offsets_matter_to_nothing(scale, shift, flip, seed):
    rng = np.random.default_rng(seed)
    e, u = rng.standard_normal((80, 1)), rng.standard_normal((80, 1))
    sign = -1.0 if flip else 1.0
    plain = residual_test(e, u)
    other = residual_test(e * scale, sign * (u + shift) * scale)
    np.testing.assert_allclose(other.auto, plain.auto, atol=1e-9)
    np.testing.assert_allclose(other.cross, sign * plain.cross, atol=1e-9)
    np.testing.assert_allclose(other.cross_band, plain.cross_band, rtol=1e-9)


@pytest.mark.parametrize("a, b", [(0.0, 0.0), (0.9, 0.95), (0.97, 0.97)])
def test_correlations_at_all_lags_together_are_seldom_so_large_by_chance(a, b):
    def chances(left):
        for seed in range(200):
            rng = np.random.default_rng([9, seed])
            e, u = coloured(rng, 2000, a), coloured(rng, 2000, b)
            yield residual_test((e + left * u)[:, None], u[:, None]).chance[0, 0]

    alone = np.array([*chances(0.0)])
    assert 0.005 < np.mean(alone < 0.05) < 0.11
    assert np.mean(alone < 1e-3) < 0.02
    assert np.mean(np.array([*chances(1.0)]) < 1e-3) > 0.8
