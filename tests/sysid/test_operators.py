from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.gassi import operators

LOWER, UPPER = np.array([0.0, -5.0, 10.0]), np.array([1.0, 5.0, 1000.0])


class Recorder:
    """A generator that remembers the pairs it drew."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.drawn = []

    def random(self, *args):
        return self.rng.random(*args)

    def normal(self, *args):
        return self.rng.normal(*args)

    def integers(self, *args, **kwargs):
        self.drawn.append(self.rng.integers(*args, **kwargs))
        return self.drawn[-1]


def population(seed=0, n=40):
    return operators.uniform(n, LOWER, UPPER, np.random.default_rng(seed))


# --- initialisation -------------------------------------------------------------------------


def test_uniform_start_fills_the_ranges():
    rows = population(n=4000)
    assert rows.shape == (4000, 3)
    assert np.all((rows >= LOWER) & (rows < UPPER))
    np.testing.assert_allclose(rows.mean(axis=0), (LOWER + UPPER) / 2, atol=0.03 * np.ptp(rows))
    np.testing.assert_allclose(rows.std(axis=0), (UPPER - LOWER) / 12**0.5, rtol=0.05)


def test_stratified_start_has_one_chromosome_in_every_part_of_every_range():
    rows = operators.stratified(25, LOWER, UPPER, np.random.default_rng(1))
    parts = np.floor((rows - LOWER) / (UPPER - LOWER) * 25).astype(int)
    for column in parts.T:
        assert sorted(column) == list(range(25))
    # The columns are shuffled apart from each other.
    assert abs(np.corrcoef(rows.T)[0, 1]) < 0.6


# --- Algorithm 3 ----------------------------------------------------------------------------


def test_fitness_by_hand():
    # 1 - e/8: 0.75, 0, 0.5; less the least; over the greatest.
    found = operators.normalised_fitness(np.array([2.0, 8.0, 4.0]), np.zeros(3, dtype=bool))
    np.testing.assert_allclose(found, [1.0, 0.0, 2.0 / 3.0])


@given(st.lists(st.floats(0.0, 1e6), min_size=1, max_size=20), st.integers(0, 2**20))
def test_fitness_is_between_0_and_1_and_orders_as_the_error(values, mask):
    errors = np.array(values)
    flagged = np.array([bool(mask >> i & 1) for i in range(len(errors))])
    errors[flagged] = np.inf
    fitness = operators.normalised_fitness(errors, flagged)
    assert np.all((fitness >= 0.0) & (fitness <= 1.0))
    assert np.all(fitness[flagged] == 0.0)
    good = ~flagged
    if good.any() and np.ptp(errors[good]) > 1e-9 * errors[good].max():
        assert fitness[np.argmin(np.where(good, errors, np.inf))] == 1.0
        assert fitness[good].min() == 0.0
        order = np.argsort(errors[good])
        assert np.all(np.diff(fitness[good][order]) <= 1e-15)


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_equal_errors_get_equal_fitness(value):
    fitness = operators.normalised_fitness(np.full(4, value), np.zeros(4, dtype=bool))
    assert len(set(fitness)) == 1
    assert np.isfinite(fitness).all()


def test_all_flagged_get_none():
    fitness = operators.normalised_fitness(np.full(3, np.nan), np.ones(3, dtype=bool))
    assert fitness.tolist() == [0.0, 0.0, 0.0]


# --- Algorithm 4 ----------------------------------------------------------------------------


def test_crossover_replayed_step_by_step():
    rows, fitness = population(), np.random.default_rng(5).random(40)
    before = rows.copy()
    operators.adaptive_crossover(rows, fitness, np.random.default_rng(6))

    rng = np.random.default_rng(6)
    ratio, pairs = rng.random(), rng.integers(40, size=(40, 2))
    expected = [list(row) for row in before]
    for alpha, beta in pairs:
        fit, unfit = (alpha, beta) if fitness[alpha] > fitness[beta] else (beta, alpha)
        expected[unfit] = [
            ratio * expected[fit][k] + (1.0 - ratio) * expected[unfit][k] for k in range(3)
        ]
    np.testing.assert_allclose(rows, expected, rtol=1e-14)
    assert not np.array_equal(rows, before)


def test_the_fitter_of_a_pair_stays_and_children_lie_between():
    fitness = np.random.default_rng(7).random(40)
    rows, recorder = population(), Recorder(8)
    before = rows.copy()
    operators.adaptive_crossover(rows, fitness, recorder)
    (pairs,) = recorder.drawn
    lost = {int(b if fitness[a] > fitness[b] else a) for a, b in pairs if a != b}
    kept = sorted(set(range(40)) - lost)
    assert np.argmax(fitness) in kept
    np.testing.assert_array_equal(rows[kept], before[kept])
    changed = np.any(rows != before, axis=1)
    assert set(np.flatnonzero(changed)) == lost
    # Convex combinations leave the box of their parents nowhere.
    assert np.all(rows <= before.max(axis=0) + 1e-12)
    assert np.all(rows >= before.min(axis=0) - 1e-12)


def test_one_crossover_is_a_convex_combination():
    rows = np.array([[0.0, 0.0], [1.0, 10.0]])
    before, rng = rows.copy(), np.random.default_rng(9)
    operators.adaptive_crossover(rows, np.array([1.0, 0.0]), rng)
    np.testing.assert_array_equal(rows[0], before[0])
    assert 0.0 <= rows[1, 0] <= 1.0
    assert rows[1, 1] == pytest.approx(10.0 * rows[1, 0])  # one ratio for all parameters


# --- Algorithm 5 ----------------------------------------------------------------------------


def test_mutation_replayed_step_by_step():
    fitness, sigma = np.random.default_rng(10).random(40), np.array([0.1, 1.0, 30.0])
    rows = population()
    before = rows.copy()
    operators.adaptive_mutation(rows, fitness, sigma, np.random.default_rng(21))

    rng = np.random.default_rng(21)
    r, picks = rng.random(), rng.integers(40, size=40)
    expected = before.copy()
    for alpha in picks:
        if fitness[alpha] < r:
            expected[alpha] = expected[alpha] + r * sigma * rng.standard_normal(3)
    np.testing.assert_allclose(rows, expected, rtol=1e-13)
    assert not np.array_equal(rows, before)


@pytest.mark.parametrize("seed", range(5))
def test_only_chromosomes_below_the_threshold_mutate(seed):
    fitness = np.linspace(0.0, 1.0, 40)
    rows, recorder = population(), Recorder(seed)
    before = rows.copy()
    threshold = np.random.default_rng(seed).random()
    operators.adaptive_mutation(rows, fitness, np.ones(3), recorder)
    changed = set(np.flatnonzero(np.any(rows != before, axis=1)))
    (picks,) = recorder.drawn
    assert changed == {int(a) for a in picks if fitness[a] < threshold}
    assert 39 not in changed


def test_mutation_noise_has_the_given_spread_times_the_threshold():
    rows = np.zeros((4000, 2))
    sigma = np.array([0.5, 20.0])
    threshold = np.random.default_rng(12).random()
    operators.adaptive_mutation(rows, np.zeros(4000), sigma, np.random.default_rng(12))
    # 4000 picks of 4000: the variance of a row's sum is that of one draw, on average.
    np.testing.assert_allclose(rows.std(axis=0), threshold * sigma, rtol=0.05)


# --- elitism, (4.2)-(4.4) -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "percent", "count"), [(400, 1.0, 4), (100, 0.5, 1), (50, 0.0, 0), (40, 25.0, 10)]
)
def test_the_elite_replaces_its_share(n, percent, count):
    rows = population(n=n)
    before, elite = rows.copy(), np.array([-1.0, -1.0, -1.0])
    operators.replace_by_elite(rows, elite, percent, np.random.default_rng(13))
    taken = np.all(rows == elite, axis=1)
    assert taken.sum() == count
    np.testing.assert_array_equal(rows[~taken], before[~taken])


def test_selection_is_proportional_to_fitness():
    rows = np.arange(4.0)[:, None].repeat(1000, axis=0)
    fitness = np.repeat([0.0, 1.0, 2.0, 5.0], 1000)
    chosen = operators.roulette(rows, fitness, np.random.default_rng(14))[:, 0]
    shares = np.bincount(chosen.astype(int), minlength=4) / 4000
    assert shares[0] == 0.0
    np.testing.assert_allclose(shares, [0.0, 0.125, 0.25, 0.625], atol=0.03)


def test_selection_without_any_fitness_is_even():
    rows = np.arange(4.0)[:, None].repeat(1000, axis=0)
    chosen = operators.roulette(rows, np.zeros(4000), np.random.default_rng(15))[:, 0]
    np.testing.assert_allclose(np.bincount(chosen.astype(int)) / 4000, 0.25, atol=0.03)


def test_arithmetical_crossover_by_hand():
    rows = np.array([[0.0, 10.0], [1.0, 20.0]])
    operators.arithmetical_crossover(rows, 0.3, 1.0, np.random.default_rng(16))
    # 0.3 of the one and 0.7 of the other, both ways round.
    np.testing.assert_allclose(sorted(rows.tolist()), [[0.3, 13.0], [0.7, 17.0]])


def test_arithmetical_crossover_keeps_sums_and_leaves_the_odd_one():
    rows = population(n=41)
    before = rows.copy()
    operators.arithmetical_crossover(rows, 0.3, 1.0, np.random.default_rng(17))
    np.testing.assert_allclose(rows.sum(axis=0), before.sum(axis=0))
    assert np.all(rows == before, axis=1).sum() == 1
    operators.arithmetical_crossover(before, 0.3, 0.0, np.random.default_rng(18))
    np.testing.assert_array_equal(before, population(n=41))


def test_uniform_mutation_draws_from_the_ranges():
    rows = np.full((2000, 3), -99.0)
    operators.uniform_mutation(rows, LOWER, UPPER, 0.05, np.random.default_rng(19))
    changed = rows != -99.0
    assert changed.mean() == pytest.approx(0.05, abs=0.01)
    drawn = np.where(changed, rows, (LOWER + UPPER) / 2)
    assert np.all((drawn >= LOWER) & (drawn < UPPER))
