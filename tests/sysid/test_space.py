from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid import Constraint, ModelError, Parameter, SearchSpace
from sysid.fitting.moves import moved_by
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
        ({"tau": (None, None)}, {}, "at least one end"),
        ({"tau": (None, -1.0)}, {}, "physically possible"),
        ({"tau": (None, 0.0)}, {}, "low end"),
        ({"tau": (0.1, 0.2)}, {"tau": 0.1}, "both a range and a fixed value"),
        ({}, {"gain": 1.0, "tau": 1.0}, "every parameter is fixed"),
        ({}, {"tau": -1.0}, "physical limits"),
        ({}, {"tau": np.nan}, "no finite number"),
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


# --- one-sided ranges -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "start", "bounds"),
    [
        # The far end is the model's, or a decade away where that lies on the wrong side.
        ((0.02, None), (0.02, 0.5), (0.02, np.inf)),
        ((2.0, None), (2.0, 20.0), (2.0, np.inf)),
        ((0.0, None), (0.0, 0.5), (0.0, np.inf)),
        ((None, 0.1), (0.005, 0.1), (0.0, 0.1)),
        ((None, 0.001), (0.0001, 0.001), (0.0, 0.001)),
        ((0.02, 0.1), (0.02, 0.1), (0.02, 0.1)),
    ],
)
def test_a_range_with_one_end(given, start, bounds):
    space = SearchSpace.of(mixed(), {"tau": given})
    assert (space.lower[1], space.upper[1]) == pytest.approx(start)
    assert (space.hard_lower[1], space.hard_upper[1]) == bounds
    assert (space.hard_lower[0], space.hard_upper[0]) == (0.2, 20.0), "others keep their range"


def one(parameter):
    return lag(parameters=(parameter,), derivative=lambda x, u, p: (u[0] - p[0] * x[0],))


def test_the_decade_ends_at_the_physical_limit():
    model = one(Parameter("a", "1", -3.0, -4.0, -2.0, minimum=-10.0, maximum=9.0))
    for ends, start in (
        ((2.0, None), (2.0, 9.0)),
        ((None, -5.0), (-10.0, -5.0)),
        ((0.0, None), (0.0, 1.0)),
        ((-1.5, None), (-1.5, 9.0)),
        ((None, -4.0), (-10.0, -4.0)),
    ):
        space = SearchSpace.of(model, {"a": ends})
        assert (space.lower[0], space.upper[0]) == start
    with pytest.raises(ModelError, match="low end"):
        SearchSpace.of(model, {"a": (9.0, None)})


def test_the_given_end_is_a_limit_and_the_other_none():
    space = SearchSpace.of(mixed(), {"gain": (1.0, None), "tau": (None, 0.1)})
    rows = np.array([[0.5, 0.05], [1e9, 0.05], [2.0, 0.2], [2.0, 1e-9]])
    assert (space.violations(rows) > 0.0).any(axis=1).tolist() == [True, False, True, False]
    lower, upper = space.coded_bounds
    np.testing.assert_array_equal(lower, [0.0, 0.0])
    np.testing.assert_array_equal(upper, [np.inf, 0.1])


def test_only_a_bound_is_something_to_stand_on():
    space = SearchSpace.of(mixed(), {"gain": (1.0, None)})
    for gain, tau, expected in (
        (1.0, 0.1, [True, False]),
        (20.0, 0.5, [False, True]),
        (2e3, 0.005, [False, True]),
    ):
        assert space.on_bound(np.array([gain, tau])).tolist() == expected


def test_a_log_scale_with_an_open_low_end_stops_at_zero():
    space = SearchSpace.of(mixed(), {"gain": (None, 2.0)})
    assert space.log.tolist() == [True, False]
    assert space.coded_bounds[0][0] == -np.inf
    signed = one(Parameter("a", "1", 1.0, 0.5, 2.0, "log", minimum=-1.0))
    assert SearchSpace.of(signed, {"a": (None, 3.0)}).hard_lower.tolist() == [0.0]


# --- scales ---------------------------------------------------------------------------------


def test_a_scale_goes_before_the_models_and_before_the_presets():
    for use_log in (True, False):
        space = SearchSpace.of(mixed(), use_log=use_log, scale={"gain": "linear", "tau": "log"})
        assert space.log.tolist() == [False, True]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scale": {"speed": "log"}}, "no parameter 'speed'"),
        ({"scale": {"held": "log"}}, "held has a scale but is not searched"),
        ({"scale": {"tau": "log"}, "fixed": {"tau": 0.1}}, "tau has a scale but is fixed"),
        ({"scale": {"tau": "log"}, "tied": {"tau": "gain"}}, "tau has a scale but is tied"),
        ({"scale": {"tau": "log"}, "ranges": {"tau": (0.0, 1.0)}}, "needs a positive range"),
        ({"tied": {"speed": "gain"}}, "no parameter 'speed'"),
        ({"tied": {"tau": "speed"}}, "no parameter 'speed'"),
        ({"tied": {"tau": "2 gain"}}, "'2 gain' is no multiple.*0.5 \\* R_m"),
        ({"tied": {"tau": "gain + held"}}, "no multiple"),
        ({"tied": {"tau": "0 * gain"}}, "by zero"),
        ({"tied": {"tau": "gain / 0"}}, "by zero"),
        ({"tied": {"tau": "tau"}}, "circle, tau -> tau"),
        ({"tied": {"tau": "gain", "gain": "2*held", "held": "tau"}}, "in a circle"),
        ({"tied": {"tau": "gain"}, "fixed": {"tau": 1.0}}, "tau has a fixed value but is tied"),
        ({"tied": {"tau": "gain"}, "ranges": {"tau": (0, 1)}}, "tau has a range but is tied"),
        ({"tied": {"tau": "-gain"}}, "tau: tied to gain it would be -20 .. -0.2, outside"),
        ({"tied": {"tau": "gain"}, "fixed": {"gain": 1.0}}, "every parameter is fixed"),
    ],
)
def test_scales_and_ties_that_make_no_sense(settings, message):
    with pytest.raises(ModelError, match=message):
        SearchSpace.of(mixed(), **settings)


# --- ties -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "factor"),
    [
        ("gain", 1.0),
        ("2 * gain", 2.0),
        ("-1.5e-3*gain", -1.5e-3),
        ("gain * .5", 0.5),
        ("gain / 4", 0.25),
        ("3 * gain / 4", 0.75),
    ],
)
def test_ties_as_people_write_them(text, factor):
    parameters = (*MIXED[:2], Parameter("held", "1", 3.0, 0.0, 1.0, fixed=True, minimum=-np.inf))
    space = SearchSpace.of(lag(parameters=parameters), tied={"held": text})
    assert space.names == ("gain", "tau")
    assert space.full(np.array([8.0, 0.1])).tolist() == pytest.approx([8.0, 0.1, 8.0 * factor])


FOUR = tuple(Parameter(name, "1", 1.0, 0.5, 2.0, "log", maximum=60.0) for name in "abcd")
factors = st.floats(0.1, 10.0)


@given(factors, factors, st.permutations("abcd"), st.lists(st.floats(0.5, 2.0), min_size=4))
def test_full_vectors_respect_chains_of_ties(first, second, names, row):
    """Whatever their order, b = first a and c = second b hold in every vector."""
    model = lag(parameters=FOUR)
    a, b, c, d = names
    tied = {c: f"{second!r} * {b}", b: f"{a} * {first!r}"}
    space = SearchSpace.of(model, tied=tied)
    assert set(space.names) == {a, d}
    rows = np.array([row[:2], row[2:4]])
    for chromosome, vector in zip(rows, space.full(rows), strict=True):
        values = dict(zip(model.parameter_names, vector, strict=True))
        assert values[b] == pytest.approx(first * values[a])
        assert values[c] == pytest.approx(second * values[b])
        assert [values[name] for name in space.names] == chromosome.tolist()
    # The physical limit holds for the tied ones too.
    beyond = (space.full(rows) > 60.0).any(axis=1)
    assert ((space.violations(rows) > 0.0).any(axis=1) == beyond).all()


def test_a_tie_may_follow_a_fixed_value():
    space = SearchSpace.of(mixed(), fixed={"gain": 8.0}, tied={"held": "0.5 * gain"})
    assert space.full(np.array([[0.1]])).tolist() == [[8.0, 0.1, 4.0]]


@given(
    st.sampled_from(["linear", "log"]),
    st.tuples(st.floats(0.01, 10.0), st.floats(1.1, 100.0)),
    st.sampled_from(["both", "low", "high"]),
)
def test_what_is_searched_starts_between_its_bounds(scale, ends, which):
    low, high = ends[0], ends[0] * ends[1]
    given_range = {"both": (low, high), "low": (low, None), "high": (None, high)}[which]
    space = SearchSpace.of(mixed(), {"gain": given_range}, scale={"gain": scale})
    assert (space.minimum <= space.lower).all() and (space.upper <= space.maximum).all()
    assert (space.hard_lower <= space.lower).all() and (space.lower < space.upper).all()
    assert (space.upper <= space.hard_upper).all()
    if which != "high":
        assert space.hard_lower[0] == space.lower[0] == low
    if which != "low":
        assert space.hard_upper[0] == space.upper[0] == high
    assert (space.violations(np.stack([space.lower, space.upper])) == 0.0).all()


@pytest.mark.parametrize("upper", [4.0, None])
def test_what_a_change_moves_is_told_of_a_range_with_an_open_end(upper):
    """Residuals are 10 times the logarithm of the gain, and 20 times that of tau."""
    space = SearchSpace.of(lag(), ranges={"gain": (1.0, upper)})
    slopes, change = np.array([[10.0, 0.0], [0.0, 20.0]]), np.array([[3.0], [4.0]])

    def in_noise(chromosomes):
        return (slopes @ space.encode(chromosomes).T)[:, None, :]

    at = np.array([2.0, 0.05])
    assert moved_by(change, in_noise, space, at) == pytest.approx(5.0)
