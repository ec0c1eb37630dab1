from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sysid import Constraint, ModelError, Parameter, SearchSpace
from sysid.gassi import PRESETS, GeneticSearch
from tests.sysid.support import lag


def space(constraints=(), **how):
    parameters = (
        Parameter("a", "1", 1.0, 0.1, 10.0, "log"),
        Parameter("b", "1", 1.0, 0.0, 4.0),
        Parameter("c", "1", 1.0, 0.0, 4.0),
    )
    return SearchSpace.of(lag(parameters=parameters, constraints=constraints), **how)


def search(preset="default", where=None, population=60, generations=40, seed=0, **settings):
    preset = PRESETS[preset]
    where = where or space(use_log=preset.log_scale)
    rng = np.random.default_rng(seed)
    return GeneticSearch(where, preset, population, generations, rng, **settings)


GOAL = np.array([3.0, 1.0, 2.5])


def bowl(rows):
    return np.sqrt(np.sum((rows - GOAL) ** 2, axis=1))


def run(found, function=bowl):
    while not found.done:
        found.tell(function(found.ask()))
    return found


@pytest.mark.parametrize(
    ("preset", "near"), [("default", 0.05), ("thesis", 0.1), ("cega", 0.1), ("classic", 0.5)]
)
def test_it_closes_in_on_the_minimum(preset, near):
    errors = [run(search(preset, seed=seed)).elite_error for seed in range(5)]
    assert np.median(errors) < near
    first = np.median([bowl(search(preset, seed=seed).ask()).min() for seed in range(5)])
    assert np.median(errors) < 0.7 * first


@pytest.mark.parametrize("preset", PRESETS)
def test_history_never_rises_and_ends_with_the_elite(preset):
    found = run(search(preset))
    assert len(found.history) == 40
    assert np.all(np.diff(found.history) <= 0.0)
    assert found.history[-1] == found.elite_error == bowl(found.elite[None])[0]


def test_the_elite_is_in_the_next_generation():
    found = search(elite_percent=10.0)
    for _ in range(5):
        found.tell(bowl(found.ask()))
        copies = np.all(np.isclose(found.ask(), found.elite, rtol=1e-12), axis=1).sum()
        assert copies >= 6


def test_the_default_stays_in_range_and_the_thesis_may_leave_it():
    def run_watching(preset):
        found, rows = search(preset), []
        while not found.done:
            rows.append(found.ask())
            found.tell(bowl(rows[-1]))
        return np.concatenate(rows)

    where = space()
    low, high = where.lower * (1 - 1e-12), where.upper * (1 + 1e-12)
    inside = run_watching("default")
    assert np.all((inside >= low) & (inside <= high))
    assert not np.all((run_watching("thesis") >= low) & (run_watching("thesis") <= high))


def test_seeds_decide():
    assert run(search(seed=1)).history == run(search(seed=1)).history
    assert run(search(seed=1)).history != run(search(seed=2)).history


# --- termination (4.10), (4.11) -------------------------------------------------------------


def told(history, **settings):
    """How many generations of made-up best errors are taken, and whether that was the rule."""
    found = search(generations=len(history), **settings)
    for best in history:
        if found.done:
            break
        found.tell(np.full(60, best))
    return len(found.history), found.converged


def test_the_rule_takes_the_mean_of_the_best_since_it_first_changed():
    history = [8.0, 8.0, 4.0, 4.0, 2.0, 2.0, 2.0, 1.0]
    # First change in generation 2 (of 0, 1, ...). Running means from there on:
    # 4, 4, 10/3, 3, 14/5, 15/6; as shares of 8: 0.5, 0.5, 0.417, 0.375, 0.35, 0.3125.
    assert told(history, termination_ratio=0.5) == (3, True)
    assert told(history, termination_ratio=0.42) == (5, True)
    assert told(history, termination_ratio=0.35) == (7, True)
    assert told(history, termination_ratio=0.34) == (8, True)
    assert told(history, termination_ratio=0.3) == (8, False)
    assert told(history) == (8, False)


def test_the_rule_waits_for_the_minimum_of_generations():
    history = [8.0, 4.0, 4.0, 4.0, 4.0, 4.0]
    assert told(history, termination_ratio=0.9) == (2, True)
    # i > i_min: generation 4 is the fifth.
    assert told(history, termination_ratio=0.9, minimum_generations=3) == (5, True)


def test_the_rule_never_applies_before_a_change():
    assert told([8.0] * 6, termination_ratio=0.99) == (6, False)


def test_failed_first_generations_do_not_end_the_search():
    history = [np.inf, np.inf, 8.0, 8.0, 7.0, 1.0]
    # The first error there is counts: 8; the mean of 7 and 1 is half of it.
    assert told(history, termination_ratio=0.4) == (6, False)
    assert told(history, termination_ratio=0.5) == (6, True)


# --- failures and constraints ---------------------------------------------------------------


def test_failed_simulations_are_survived():
    def failing(rows):
        return np.where(rows[:, 1] > 1.5, np.nan, bowl(rows))

    found = run(search(), failing)
    assert found.elite[1] <= 1.5
    assert found.elite_error < 0.1


def test_nothing_but_failures_leaves_no_elite():
    found = run(search(generations=3), lambda rows: np.full(len(rows), np.inf))
    assert found.elite is None
    assert found.history == [np.inf] * 3


LIMIT = Constraint("b >= 2", lambda p: 2.0 - p[1])


def test_a_feasible_elite_is_preferred_to_a_better_infeasible_one():
    found = search("default", space((LIMIT,)), population=4, generations=3)
    found._coded[:, 1] = [0.0, 1.0, 3.0, 3.5]
    found.tell(np.array([1.0, 0.5, 9.0, 7.0]))
    assert found.elite_feasible
    assert found.elite_error == 7.0
    assert found.elite[1] == pytest.approx(3.5)
    found._coded[:, 1] = [0.0, 1.0, 3.0, 3.5]
    found.tell(np.array([0.1, 0.5, 8.0, 9.0]))
    assert found.elite_error == 7.0


def test_without_a_feasible_one_the_elite_is_the_lowest_error_until_one_comes():
    found = search("default", space((LIMIT,)), population=4, generations=3)
    found._coded[:, 1] = [0.0, 1.0, 0.5, 0.1]
    found.tell(np.array([1.0, 0.5, 9.0, 7.0]))
    assert not found.elite_feasible
    assert found.elite_error == 0.5
    found._coded[:, 1] = [0.0, 3.0, 0.5, 0.1]
    found.tell(np.array([0.1, 6.0, 9.0, 7.0]))
    assert found.elite_feasible
    assert found.elite_error == 6.0


@pytest.mark.parametrize("preset", ["default", "thesis"])
def test_the_penalty_leads_to_the_constrained_minimum(preset):
    where = space((LIMIT,), use_log=PRESETS[preset].log_scale)
    found = [run(search(preset, where, seed=seed)) for seed in range(5)]
    assert all(f.elite_feasible and f.elite[1] >= 2.0 for f in found)
    # The nearest feasible point to the goal is 1 away.
    assert np.median([f.elite_error for f in found]) < 1.15


def test_without_penalty_the_elite_is_the_best_and_says_that_it_is_infeasible():
    found = run(search("cega", space((LIMIT,), use_log=False)))
    assert found.elite_error < 0.5
    assert not found.elite_feasible


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"population": 1}, "population is 1"),
        ({"generations": 0}, "generations is 0"),
        ({"elite_percent": 100.0}, "elite_percent"),
        ({"elite_percent": -1.0}, "elite_percent"),
    ],
)
def test_settings_that_make_no_sense(settings, message):
    with pytest.raises(ModelError, match=message):
        search(**settings)


# --- a population that has collapsed --------------------------------------------------------


def two_basins(rows):
    """A wide basin with a raised floor, and a narrow deeper one that is seldom hit at first."""
    wide = 0.3 + np.sqrt(np.sum((rows - [6.0, 3.0, 0.5]) ** 2, axis=1))
    narrow = 4.0 * np.sqrt(np.sum((rows - GOAL) ** 2, axis=1))
    return np.minimum(wide, narrow)


def test_a_collapsed_population_starts_anew_over_the_whole_box_and_keeps_the_elite():
    found = search(population=60, generations=80)
    spreads = []
    while not found.done:
        rows = found.ask()
        spreads.append(np.mean(found.space.encode(rows).std(axis=0)))
        elite = found.elite_error
        found.tell(bowl(rows))
        assert found.elite_error <= elite
    spreads = np.array(spreads) / spreads[0]
    again = np.flatnonzero((spreads[1:] > 0.8) & (spreads[:-1] < 0.1)) + 1
    assert len(again) >= 2
    assert spreads[:-1].min() < 0.1
    # A start of its own: the elite is not in it, or it would fall back to where it was.
    assert np.all(spreads[again] > 0.8)


@pytest.mark.soak
def test_starting_anew_finds_more_than_one_basin():
    def best(preset):
        runs = [
            run(GeneticSearch(space(), preset, 60, 120, np.random.default_rng(seed)), two_basins)
            for seed in range(10)
        ]
        return np.array([found.elite_error for found in runs])

    default = PRESETS["default"]
    once = best(replace(default, collapse=0.0))
    assert np.sum(best(default) < 0.2) > np.sum(once < 0.2)


def test_promising_chromosomes_lie_apart_and_begin_with_the_elite():
    found = run(search(generations=12))
    rows = found.promising(5)
    np.testing.assert_allclose(rows[0], found.elite)
    assert 2 <= len(rows) <= 5
    where = space()
    width = where.encode(where.upper) - where.encode(where.lower)
    coded = where.encode(rows) / width
    for i, row in enumerate(coded):
        for other in coded[:i]:
            assert np.sqrt(np.mean((row - other) ** 2)) > 0.1
    assert np.all(np.diff(bowl(rows)) >= 0.0)
