"""The self-adaptive penalty (4.15)-(4.20), worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.gassi.penalty import find_indicators, infeasibility, penalise


def column(*values):
    return np.array(values, dtype=float)[:, None]


def growth(i):
    """The bracket of (4.19)."""
    return (math.exp(2.0 * i) - 1.0) / (math.exp(2.0) - 1.0)


# --- (4.16) ---------------------------------------------------------------------------------


def test_each_constraint_counts_relative_to_its_largest_violation():
    violations = np.array([[0.0, 0.0], [1.0, 0.0], [4.0, 0.5], [2.0, 1.0]])
    # Largest 4 and 1: (0+0)/2, (1/4+0)/2, (1+1/2)/2, (1/2+1)/2.
    assert infeasibility(violations).tolist() == [0.0, 0.125, 0.75, 0.75]


def test_a_constraint_that_nothing_violates_only_dilutes():
    assert infeasibility(np.array([[0.0, 2.0], [0.0, 1.0]])).tolist() == [0.5, 0.25]
    assert infeasibility(np.zeros((3, 2))).tolist() == [0.0, 0.0, 0.0]
    assert infeasibility(np.zeros((3, 0))).tolist() == [0.0, 0.0, 0.0]


def test_an_infinite_violation_does_not_make_finite_ones_feasible():
    scores = infeasibility(column(np.inf, 2.0, 1.0, 0.0))
    assert scores[0] == 1.0
    assert scores[1] > 0.0
    assert scores[2] > 0.0
    assert scores[3] == 0.0


def test_a_tiny_violation_is_still_one():
    scores = infeasibility(column(1e300, 1e-300, 0.0))
    assert scores[1] > 0.0
    assert scores[2] == 0.0


# --- indicators -----------------------------------------------------------------------------


def test_indicators_when_an_infeasible_one_looks_better_than_the_best():
    # Feasible: 0 (3.0), 1 (2.0). Infeasible below 2.0: rows 2, 3, 4; most infeasible 3 and 4.
    errors = np.array([3.0, 2.0, 0.5, 1.5, 1.0, 9.0])
    scores = np.array([0.0, 0.0, 0.2, 0.6, 0.6, 1.0])
    # Of equals the lower error; row 5 is more infeasible but does not look better.
    assert find_indicators(errors, scores) == (1, 4, 5)


def test_indicators_when_every_infeasible_one_looks_worse():
    errors = np.array([1.0, 5.0, 7.0, 6.0, 8.0])
    scores = np.array([0.0, 1.0, 1.0, 0.5, 0.0])
    # Most infeasible, of equals the higher error.
    assert find_indicators(errors, scores) == (0, 2, 4)


def test_indicators_without_a_feasible_one():
    errors = np.array([5.0, 4.0, 3.0, 6.0])
    scores = np.array([0.2, 0.2, 0.9, 1.0])
    # Least infeasible, of equals the lower error.
    assert find_indicators(errors, scores) == (1, 2, 3)


# --- (4.17)-(4.20) --------------------------------------------------------------------------


def test_all_feasible_stay_as_they_are():
    errors = np.array([3.0, 1.0, np.inf])
    np.testing.assert_array_equal(penalise(errors, np.zeros((3, 2))), errors)


def test_both_penalties_when_the_worst_infeasible_looks_better_than_the_best():
    errors = np.array([2.0, 10.0, 1.0, 4.0])
    violations = column(0.0, 0.0, 3.0, 1.5)
    # Best: row 0, 2. Worst infeasible: row 2 (score 1), 1. Highest: 10.
    # (4.17): grades 1 and 1/2. (4.18): 1 + 1 (2 - 1) = 2; 4 + 1/2 (2 - 1) = 4.5.
    # (4.20), first case: (10 - 2)/2 = 4. (4.19): 2 + 4*2*1 = 10; 4.5 + 4*4.5*g(1/2).
    expected = [2.0, 10.0, 10.0, 4.5 + 18.0 * growth(0.5)]
    np.testing.assert_allclose(penalise(errors, violations), expected)


def test_only_the_second_penalty_when_no_infeasible_one_looks_better():
    errors = np.array([1.0, 9.0, 3.0, 2.0])
    violations = column(0.0, 0.0, 4.0, 1.0)
    # Worst infeasible: row 2, 3 > 1, so (4.18) does not apply and (4.20) is (9 - 3)/3 = 2.
    # (4.19): 3 + 2*3*1 = 9; 2 + 2*2*g(1/4).
    expected = [1.0, 9.0, 9.0, 2.0 + 4.0 * growth(0.25)]
    np.testing.assert_allclose(penalise(errors, violations), expected)


def test_no_severity_when_worst_infeasible_and_best_are_equal():
    errors = np.array([2.0, 9.0, 2.0])
    np.testing.assert_array_equal(penalise(errors, column(0.0, 0.0, 1.0)), errors)


def test_without_a_feasible_one_the_grades_start_at_the_least_infeasible():
    errors = np.array([4.0, 1.0, 8.0])
    violations = column(1.0, 2.0, 4.0)  # scores 1/4, 1/2, 1
    # Best row 0; looking better: row 1, so grades 0, (1/2-1/4)/(1/4) = 1, 3 cut to 1.
    # (4.18): 4, 1 + 3 = 4, 8 + 3 = 11. (4.20): (8 - 4)/4 = 1.
    expected = [4.0, 4.0 + 4.0, 11.0 + 11.0]
    np.testing.assert_allclose(penalise(errors, violations), expected)


def test_a_grade_far_beyond_the_worst_stays_finite():
    # Row 2 hardly violates anything but looks better than the best, and so sets the scale.
    found = penalise(np.array([2.0, 9.0, 1.0, 3.0]), column(0.0, 0.0, 1e-6, 6.0))
    # (4.18): 1 + 1 = 2, 3 + 1 = 4. (4.20): (9 - 2)/2 = 3.5.
    np.testing.assert_allclose(found, [2.0, 9.0, 9.0, 4.0 * 4.5])


def test_equally_infeasible_ones_stay_as_they_are():
    errors = np.array([4.0, 1.0, 8.0])
    np.testing.assert_allclose(penalise(errors, column(2.0, 2.0, 2.0)), errors)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_failed_simulation_does_not_switch_the_penalty_off(bad):
    errors = np.array([2.0, 10.0, 1.0, bad])
    found = penalise(errors, column(0.0, 0.0, 3.0, 3.0))
    np.testing.assert_allclose(found[:3], [2.0, 10.0, 10.0])
    np.testing.assert_equal(found[3], bad)


def test_nothing_to_scale_by_when_all_failed():
    errors = np.array([np.nan, np.inf])
    np.testing.assert_array_equal(penalise(errors, column(1.0, 0.0)), errors)


populations = st.lists(
    st.tuples(st.floats(0.01, 100.0), st.one_of(st.just(0.0), st.floats(0.01, 10.0))),
    min_size=2,
    max_size=12,
)


@given(populations)
def test_feasible_ones_never_change_and_infeasible_ones_never_gain(population):
    errors, violations = np.array(population).T
    found = penalise(errors, violations[:, None])
    feasible = violations == 0.0
    np.testing.assert_array_equal(found[feasible], errors[feasible])
    assert np.all(found >= errors * (1.0 - 1e-12))


@given(populations)
def test_what_looked_better_than_the_best_while_most_infeasible_ends_at_the_highest(population):
    errors, violations = np.array(population).T
    scores = infeasibility(violations[:, None])
    if not (violations > 0.0).any() or not (violations == 0.0).any():
        return
    best, worst, _ = find_indicators(errors, scores)
    found = penalise(errors, violations[:, None])
    if errors[worst] != errors[best]:
        assert found[worst] >= errors.max() * (1.0 - 1e-9)
    # Nothing infeasible that looked better than the best feasible one still does, if it was
    # as infeasible as the worst.
    level = (scores >= scores[worst]) & (scores > 0.0)
    assert np.all(found[level] >= errors[best] * (1.0 - 1e-9))
