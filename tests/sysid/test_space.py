from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid import Constraint, ModelError, Parameter, SearchSpace
from tests.sysid.support import lag

MIXED = (
    Parameter("gain", "1", 2.0, 0.2, 20.0, "log"),
    Parameter("tau", "s", 0.05, 0.005, 0.5),
    Parameter("held", "1", 3.0, 0.0, 1.0, fixed=True),
)


def mixed(**changes):
    return lag(parameters=MIXED, **changes)


def test_fixed_parameters_are_not_searched():
    space = SearchSpace.of(mixed())
    assert space.names == ("gain", "tau")
    assert space.log.tolist() == [True, False]
    assert space.full(np.array([[5.0, 0.1]])).tolist() == [[5.0, 0.1, 3.0]]


def test_ranges_free_and_values_fix():
    space = SearchSpace.of(mixed(), ranges={"held": (1.0, 2.0)}, fixed={"gain": 7.0})
    assert space.names == ("tau", "held")
    assert space.full(np.array([0.1, 1.5])).tolist() == [7.0, 0.1, 1.5]
    assert space.upper.tolist() == [0.5, 2.0]


def test_a_log_range_that_touches_zero_is_searched_linearly():
    assert SearchSpace.of(mixed(), ranges={"gain": (0.0, 1.0)}).log.tolist() == [False, False]
    assert SearchSpace.of(mixed(), use_log=False).log.tolist() == [False, False]


@pytest.mark.parametrize(
    ("ranges", "fixed", "message"),
    [
        ({"speed": (0.0, 1.0)}, {}, "no parameter 'speed'"),
        ({}, {"speed": 1.0}, "no parameter 'speed'"),
        ({"tau": (0.2, 0.1)}, {}, "low end"),
        ({"tau": (-1.0, 0.1)}, {}, "physically possible"),
        ({"tau": (0.1, np.inf)}, {}, "not finite"),
        ({"tau": (0.1, 0.2)}, {"tau": 0.1}, "both a range and a fixed value"),
        ({}, {"gain": 1.0, "tau": 1.0}, "every parameter is fixed"),
        ({}, {"tau": -1.0}, "physical limits"),
        ({}, {"tau": np.nan}, "not finite"),
    ],
)
def test_bad_spaces(ranges, fixed, message):
    with pytest.raises(ModelError, match=message):
        SearchSpace.of(mixed(), ranges, fixed)


values = st.tuples(st.floats(1e-6, 1e6), st.floats(-1e6, 1e6))


@given(st.lists(values, min_size=1, max_size=5), st.booleans())
def test_encode_and_decode_undo_each_other(chromosomes, use_log):
    space = SearchSpace.of(mixed(), use_log=use_log)
    rows = np.array(chromosomes)
    before = rows.copy()
    coded = space.encode(rows)
    np.testing.assert_allclose(space.decode(coded), rows, rtol=1e-12)
    np.testing.assert_array_equal(rows, before)
    np.testing.assert_array_equal(coded[:, 1], rows[:, 1])
    if use_log:
        np.testing.assert_allclose(coded[:, 0], np.log(rows[:, 0]))


def test_violations_are_limits_then_constraints():
    parameters = (
        Parameter("a", "1", 1.0, 0.5, 2.0, minimum=0.0, maximum=3.0),
        Parameter("b", "1", 1.0, 0.5, 2.0, minimum=-1.0),
    )
    model = lag(parameters=parameters, constraints=(Constraint("a <= b", lambda p: p[0] - p[1]),))
    space = SearchSpace.of(model)
    found = space.violations(np.array([[1.0, 1.0], [-0.5, 0.0], [4.0, 1.0], [0.0, -3.0]]))
    # Columns: a below, b below, a above, b above, constraint.
    assert found.tolist() == [
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [0.5, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 3.0],
        [0.0, 2.0, 0.0, 0.0, 3.0],
    ]


def test_a_constraint_may_use_a_fixed_parameter_or_be_constant():
    model = mixed(
        constraints=(
            Constraint("gain <= held", lambda p: p[0] - p[2]),
            Constraint("never", lambda p: 2.0),
        )
    )
    found = SearchSpace.of(model).violations(np.array([[2.0, 0.1], [5.0, 0.1]]))
    assert found[:, -2:].tolist() == [[0.0, 2.0], [2.0, 2.0]]


def test_not_a_number_counts_as_infeasible():
    model = mixed(constraints=(Constraint("sqrt", lambda p: p[0] * np.nan),))
    assert SearchSpace.of(model).violations(np.array([[1.0, 0.1]]))[0, -1] == np.inf
