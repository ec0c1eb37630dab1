"""Starting ranges from data: what becomes of what a model's own function says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid import GASSI, Dataset, Guess, ModelError, Parameter, guess_ranges
from sysid.problem.guesses import regression
from tests.sysid.support import MOTOR, lag, motor, motor_record

RECORD = Dataset(np.ones(20), np.linspace(0.0, 2.0, 20), 0.1, "bench")


def telling(**guesses):
    """A lag whose function says this, gain in 0.2 .. 20 and tau in 0.005 .. 0.5."""
    return replace(lag(), guesses=lambda records, known: {
        name: Guess(*ends, "a look at it") for name, ends in guesses.items()
    })  # fmt: skip


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ((1.0, 3.0), (1.0, 3.0)),
        ((0.1, 3.0), (0.2, 3.0)),
        ((None, 3.0), (0.2, 3.0)),
        ((1.0, None), (1.0, 20.0)),
        ((1.23456, 2.34567), (1.23, 2.35)),  # three digits, outwards
        ((30.0, 40.0), (30.0, 40.0)),  # the data say that the model's range is wrong
        ((50.0, None), (50.0, 500.0)),
        ((None, 0.1), (0.01, 0.1)),
        ((-3.0, 0.1), (0.0, 0.1)),  # a gain below zero is physically impossible
    ],
)
def test_a_guess_narrows_or_replaces_the_models_range(told, expected):
    found = guess_ranges(telling(gain=told), [RECORD])
    assert found == {"gain": Guess(*map(pytest.approx, expected), "a look at it")}


@pytest.mark.parametrize("told", [(None, None), (0.1, 30.0), (None, -5.0), (-3.0, -2.0)])
def test_what_tells_nothing_leaves_the_models_range(told):
    assert guess_ranges(telling(gain=told), [RECORD]) == {}


@given(
    st.one_of(st.none(), st.floats(-1e3, 1e3)), st.one_of(st.none(), st.floats(1e-6, 1e3)),
    st.floats(0.21, 19.9),
)  # fmt: skip
def test_a_truth_in_both_ranges_is_in_what_comes_of_them(low, width, truth):
    """Whatever is told, a value that model and guess allow stays allowed."""
    high = None if width is None else (truth if low is None else max(low, truth)) + width
    low = None if low is None else min(low, truth)
    found = guess_ranges(telling(gain=(low, high)), [RECORD]).get("gain", Guess(0.2, 20.0, ""))
    assert 0.2 <= found.low <= truth <= found.high <= 20.0


def test_what_is_said_of_a_parameter_goes_before_a_guess():
    model = telling(gain=(1.0, 3.0), tau=(0.01, 0.02))
    assert set(guess_ranges(model, [RECORD])) == {"gain", "tau"}
    assert set(guess_ranges(model, [RECORD], {"gain": (0.5, None)})) == {"tau"}
    assert set(guess_ranges(model, [RECORD], fixed={"gain": 2.0})) == {"tau"}
    assert set(guess_ranges(model, [RECORD], tied={"tau": "0.1 * gain"})) == {"gain"}


def test_the_function_sees_signals_by_name_and_what_is_known():
    seen = {}

    def look(records, known):
        (record,) = records
        seen.update(known)
        assert "u" in record and "y" in record and "torque" not in record
        np.testing.assert_array_equal(record["u"], np.ones(20))
        np.testing.assert_array_equal(record["y"], np.linspace(0.0, 2.0, 20))
        assert (record.name, record.dt) == ("bench", 0.1)
        with pytest.raises(ModelError, match="bench: model lag has no signal 'torque'"):
            record["torque"]
        return {}

    model = replace(lag(), guesses=look)
    guess_ranges(model, [RECORD], {"gain": (1.0, None)}, tied={"tau": "0.01 * gain"})
    assert seen == {"gain": (1.0, 20.0), "tau": (0.01, 0.2)}
    guess_ranges(model, [RECORD], fixed={"gain": 3.0})
    assert seen == {"gain": (3.0, 3.0), "tau": (0.005, 0.5)}


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (lag(), "model lag cannot guess ranges from data; give it a 'guesses' function"),
        (telling(speed=(1.0, 2.0)), "no parameter 'speed'"),
        (telling(gain=(2.0, 1.0)), r"gives \[2.0, 1.0\] for gain; it must be finite, low before"),
        (telling(gain=(np.nan, 1.0)), "must be finite"),
        (replace(lag(), guesses=lambda records, known: 1 / 0), "fails: ZeroDivisionError"),
        (replace(lag(), guesses=lambda records, known: 3), "fails: TypeError"),
        (
            replace(lag(), guesses=lambda records, known: {"gain": 3.0}),
            r"gives 3.0 for gain; return Guess\(low",
        ),
    ],
)
def test_functions_that_make_no_sense(model, message):
    with pytest.raises(ModelError, match=message):
        guess_ranges(model, [RECORD])


def test_a_search_starts_where_the_data_suggest():
    def look(records, known):
        return {"resistance": Guess(0.9, 1.2, "an ohmmeter")}

    model = replace(motor(), guesses=look)
    found = GASSI(model, guess=True, population=60, generations=8).fit(motor_record())
    assert found.guesses_ == {"resistance": Guess(0.9, 1.2, "an ohmmeter")}
    assert (found.space_.lower[0], found.space_.upper[0]) == (0.9, 1.2)
    assert found.space_.upper[1] == 10 * MOTOR["inductance"]
    plain = GASSI(model, population=4, generations=1, preset="thesis").fit(motor_record())
    assert plain.guesses_ == {} and plain.space_.upper[0] == 10.0
    with pytest.raises(ModelError, match="cannot guess"):
        GASSI(motor(), guess=True).fit(motor_record())


def test_a_regression_is_the_least_squares_one():
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.normal(size=80), 1e6 * rng.normal(size=80), np.ones(80)])
    target = table @ [2.0, -3e-6, 0.5] + 0.1 * rng.normal(size=80)
    target[7] = table[11, 1] = np.nan
    kept = np.isfinite(target) & np.isfinite(table).all(axis=1)
    coefficients, covariance = regression(target, list(table.T))
    exact, squares, _, _ = np.linalg.lstsq(table[kept], target[kept])
    np.testing.assert_allclose(coefficients, exact, rtol=1e-9)
    gram = np.linalg.inv(table[kept].T @ table[kept])
    np.testing.assert_allclose(covariance, gram * squares[0] / (78 - 3), rtol=1e-6)


@pytest.mark.parametrize(
    "columns", [[np.ones(20), np.ones(20)], [np.zeros(20)], [np.arange(20.0)] * 2]
)
def test_columns_that_cannot_be_told_apart_give_no_regression(columns):
    assert regression(np.arange(20.0), columns) is None
    assert regression(np.arange(3.0), [np.ones(3)]) is None


def test_a_guess_of_a_parameter_without_limits_may_have_any_sign():
    parameters = (
        Parameter("gain", "1", 2.0, -5.0, 5.0, minimum=-np.inf),
        Parameter("tau", "s", 0.05, 0.005, 0.5, "log"),
    )
    model = replace(telling(gain=(-9.0, -7.0)), parameters=parameters)
    assert guess_ranges(model, [RECORD])["gain"] == Guess(-9.0, -7.0, "a look at it")
