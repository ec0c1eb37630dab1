"""Probabilities of score tests by chance, beside how often chance does as much."""

import numpy as np
import pytest

from sysid.judging.regression import Regression
from sysid.judging.whitener import Whitener
from sysid.uncertainty.colour import Autoregression

N, REPETITIONS = 60, 1000


def chances(n_draws: int, n_amplitudes: int) -> np.ndarray:
    """Probabilities of what noise of an input alone has done to residuals, told by some draws."""
    rng = np.random.default_rng(0)
    whitening = Whitener(
        Autoregression(np.zeros((0, 1, 1)), np.eye(1)), (N,), np.ones(N, dtype=bool), np.eye(1)
    )
    chances = []
    for _ in range(REPETITIONS):
        changes, column = rng.standard_normal((2, N, 1, n_amplitudes))
        driven = changes[:, 0] @ rng.standard_normal((n_amplitudes, 1 + n_draws))
        residual = driven[:, :1] + rng.standard_normal((N, 1))
        draws = [(slice(0, N), driven[:, None, 1:] / np.sqrt(n_draws))]
        tested = Regression(whitening, column, np.ones(n_amplitudes), residual, draws)
        result = tested.test(changes, one_sided=False)
        assert result is not None
        chances.append(np.exp(result.log_p))
    return np.array(chances)


@pytest.mark.parametrize(("n_draws", "n_amplitudes"), [(12, 3), (200, 1)])
def test_a_finding_by_chance_is_as_rare_as_its_probability_says_however_few_draws_tell_noise(
    n_draws, n_amplitudes
):
    found = chances(n_draws, n_amplitudes)
    for level in (0.05, 0.01):
        assert 0.5 * level < np.mean(found < level) < 1.6 * level


def test_a_record_of_which_no_sample_has_a_whole_past_tells_nothing():
    """As of an encoder that turns round at every other sample."""
    model = Autoregression(np.full((2, 1, 1), 0.2), np.eye(1))
    seen = np.ones((2 * N, 1), dtype=bool)
    seen[1:N:2] = False
    whitening = Whitener.by(model, seen, (N, N))
    columns = np.random.default_rng(0).standard_normal((2 * N, 1, 3))
    white = whitening(columns)
    np.testing.assert_allclose(white, Whitener.by(model, seen[N:], (N,))(columns[N:]))
    assert not whitening.back(slice(0, N), white).any()


def test_what_no_row_shows_stands_at_zero_and_changes_nothing():
    """As a start of a record of which no sample has a whole past."""
    rng = np.random.default_rng(0)
    whitening = Whitener(
        Autoregression(np.zeros((0, 1, 1)), np.eye(1)), (N,), np.ones(N, dtype=bool), np.eye(1)
    )
    column, change, residual = rng.standard_normal((3, N, 1, 1))
    results = []
    for columns in (column, np.concatenate([column, np.zeros((N, 1, 1))], axis=2)):
        free = np.zeros(columns.shape[2])
        tested = Regression(whitening, columns, free, residual[..., 0], [])
        results.append((tested.coefficients, tested.test(change, one_sided=False)))
    (alone, without), (beside, with_it) = results
    assert beside[0] == pytest.approx(alone[0]) and beside[1] == 0.0
    assert with_it.log_p == pytest.approx(without.log_p, rel=0.05)
