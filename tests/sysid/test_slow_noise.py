"""Noise with a slow part that few samples do not show: intervals hold, and whitening is its own."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from sysid.judging.whitener import Whitener
from sysid.uncertainty.colour import Autoregression, colour, record_rows, score_covariance
from sysid.uncertainty.slow_noise import SlowFilter, SlowNoise, first_rows, slow_noise

POLE, ZERO = 0.95, 0.7
SLOW = SlowNoise(POLE, ZERO)


def first_order(rng, n, samples):
    """Noise of unit variance that forgets in so many samples, (n,)."""
    pole = np.exp(-1.0 / samples)
    start = rng.standard_normal()
    white = np.sqrt(1.0 - pole**2) * rng.standard_normal(n)
    return lfilter([1.0], [1.0, -pole], white, zi=[pole * start])[0]


def stationary(n):
    """Covariance (n, n) of the noise of an ARMA(1, 1) with innovations of unit variance."""
    new = (POLE - ZERO) * (1.0 - POLE * ZERO) / POLE
    return ZERO / POLE * np.eye(n) + new / (1.0 - POLE**2) * toeplitz(POLE ** np.arange(n))


@pytest.mark.parametrize("lost", [(), (3, 20, 21)])
def test_its_innovations_are_white_from_the_first_sample_on_and_across_lost_ones(lost):
    n = 60
    seen = np.ones(n, dtype=bool)
    seen[list(lost)] = False
    kalman = SlowFilter.of(SLOW, seen, first_rows([n]))
    of_samples = kalman.innovations(np.eye(n))[np.ix_(seen, seen)]
    whitened = of_samples @ stationary(n)[np.ix_(seen, seen)] @ of_samples.T
    np.testing.assert_allclose(whitened, np.eye(len(whitened)), atol=1e-9)


@pytest.mark.parametrize("lengths", [(80,), (50, 30)])
def test_the_covariance_of_a_score_is_that_of_the_dense_noise(lengths):
    rng, n = np.random.default_rng(0), sum(lengths)
    seen = rng.uniform(size=(n, 1)) > 0.1
    slopes = np.where(seen[..., None], rng.standard_normal((n, 1, 3)), 0.0)
    model = Autoregression(np.zeros((0, 1, 1)), np.array([[0.25]]), (SLOW,))
    parts = [slopes[rows, 0] for rows in record_rows(lengths)]
    expected = sum(part.T @ (0.25 * stationary(len(part))) @ part for part in parts)
    found = score_covariance(slopes, seen, lengths, model)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_back_is_the_transpose_of_whitening():
    rng, lengths, n = np.random.default_rng(0), (40, 30), 70
    seen = rng.uniform(size=(n, 2)) > 0.1
    model = Autoregression(np.array([np.diag([0.3, -0.2])]), np.eye(2), (SLOW, None))
    kept = seen.all(axis=1) & np.append(False, seen.all(axis=1)[:-1])
    kept[[0, 40]] = False
    decorrelate, filters = np.array([[1.0, 0.2], [0.2, 1.0]]), model.filters(seen, lengths)
    whitener = Whitener(model, lengths, kept, decorrelate, filters)
    for rows in record_rows(lengths):
        columns = rng.standard_normal((rows.stop - rows.start, 2, 3))
        places, white = whitener.rows_of(rows), np.zeros((2 * int(kept.sum()), 4))
        white[places] = rng.standard_normal((places.stop - places.start, 4))
        forward = white[places].T @ whitener.of_record(rows, columns)
        backward = whitener.back(rows, white).T @ columns.reshape(-1, 3)
        np.testing.assert_allclose(forward, backward, atol=1e-12)


def test_what_an_autoregression_of_few_samples_tells_has_no_slow_part():
    rng, n = np.random.default_rng(0), 4000
    seen = np.ones(n, dtype=bool)
    white = rng.standard_normal(n)
    for poles in ([1.0], [1.0, -0.8], [1.0, -1.5, 0.7]):
        assert slow_noise(lfilter([1.0], poles, white), seen, [n], 12) is None
    hidden = slow_noise(white + first_order(rng, n, 200.0) / 3.0, seen, [n], 12)
    assert hidden is not None
    assert 50.0 < -1.0 / np.log(hidden.pole) < 800.0


@pytest.mark.parametrize("samples", [60.0, 200.0, 600.0])
def test_intervals_hold_under_white_noise_with_a_slow_part_below_it(samples):
    """A gain under random levels: without the slow part 70 to 88 of 100 intervals held."""
    n, repetitions, held = 2000, 200, 0
    for k in range(repetitions):
        rng = np.random.default_rng(k)
        levels = np.repeat(rng.uniform(-1.0, 1.0, n // 50), 50)
        e = rng.standard_normal(n) + first_order(rng, n, samples) / 3.0
        gain = levels @ e / (levels @ levels)
        seen = np.ones((n, 1), dtype=bool)
        noise = colour((e - gain * levels)[:, None], seen, [n])
        variance = score_covariance(levels[:, None, None], seen, [n], noise)[0, 0]
        held += abs(gain) * (levels @ levels) < 1.96 * np.sqrt(variance)
    assert 0.91 * repetitions <= held <= 0.99 * repetitions
