"""Numbers for people: the unit's prefix, and the digits that an uncertainty supports."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.config.units import factor
from daq.identification.rows import ParameterRow, QuantityRow
from daq.notation import digits, engineering, number


@settings(deadline=None)  # the first conversion loads a library
@given(
    st.floats(1e-9, 9e8),
    st.sampled_from(["H", "V", "ohm", "N*m", "N*m*s/rad", "N*m*s/(rad*A)", "V/A", "rad/s"]),
)
def test_a_prefix_changes_the_unit_and_not_the_quantity(value, unit):
    scale, shown = engineering(value, unit)
    assert scale * value * factor(shown, unit) == pytest.approx(value, rel=1e-12)
    assert 0.1 <= scale * value < 1000.0


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (5.45e-4, "H", "545 µH"),
        (0.0123, "N*m", "12.3 mN*m"),
        (0.143, "N*m/A", "0.143 N*m/A"),
        (12_000.0, "V/A", "12.0 kV/A"),
        (-0.02, "V", "-20.0 mV"),
        (0.0, "V", "0 V"),
        (6e-5, "kg*m^2", "6.00e-5 kg*m^2"),
        (0.002, "m^2", "0.00200 m^2"),
        (0.002, "1/s", "0.00200 1/s"),
        (0.002, "mm", "0.00200 mm"),
        (0.002, "", "0.00200 "),
        (1e-14, "A", "1.00e-14 A"),
    ],
)
def test_units_that_take_a_prefix_get_one_and_others_do_not(value, unit, text):
    scale, shown = engineering(value, unit)
    assert f"{number(scale * value, 3)} {shown}" == text
    assert engineering(np.nan, unit) == (1.0, unit)


@pytest.mark.parametrize(
    ("value", "shown", "text"),
    [(1264.0, 2, "1300"), (11510.0, 2, "12000"), (820.4, 2, "820"), (-545.0, 4, "-545.0"),
     (99960.0, 3, "100000"), (123456.0, 3, "1.23e5")],
)  # fmt: skip
def test_large_numbers_have_no_more_digits_than_asked_for(value, shown, text):
    assert number(value, shown) == text


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e3))
def test_the_last_digit_is_the_second_of_the_uncertainty_at_most(value, ratio):
    std = value / ratio
    shown = digits(value, std)
    step = 10.0 ** (np.floor(np.log10(value)) - shown + 1)
    assert 2 <= shown <= 7
    if 2 < shown < 7:
        assert 0.01 * std <= step <= std


@pytest.mark.parametrize(
    ("value", "ends", "written"),
    [
        (1.0, (0.988, 1.012), ("1.000", "0.988 .. 1.012")),
        (9.99e-4, (9.5e-4, 1.05e-3), ("9.99e-4", "9.50e-4 .. 0.001050")),
        (0.0061, (0.0014, 0.025), ("0.0061", "0.0014 .. 0.0250")),
        (122.0, (105.1, 141.7), ("122", "105 .. 142")),
        (-0.02, (-0.5, 0.46), ("-0.02", "-0.50 .. 0.46")),
        (22.0, (7.2, 27.0), ("22", "7.2 .. 27")),
        (1.0, (1.0 - 1e-12, 1.0 + 1e-12), ("1.000000", "± 1.0e-12")),
        (0.011, (None, 0.0371), ("0.011", "< 0.037")),
        (0.0, (-1.0, 1.0), ("0", "-1.00 .. 1.00")),
    ],
)
def test_a_value_and_the_ends_of_its_interval_end_at_one_decimal_place(value, ends, written):
    row = QuantityRow("a", value, "1", ends)
    assert (row.text(value), row.interval_text(row.text, " .. ", "-")) == written


@given(st.floats(1e-9, 1e9), st.floats(1e-5, 5.0))
def test_no_end_of_an_interval_is_rounded_by_more_than_it_can_bear(value, relative):
    low, high = value - relative * value, value + relative * value
    row = QuantityRow("a", value, "1", (low, high))
    if not row.narrow:
        assert abs(float(row.text(high)) - high) <= 0.14 * (high - low)
        assert abs(float(row.text(low)) - low) <= 0.14 * (high - low)


def test_what_was_given_is_written_as_it_was_given():
    def text(value, scale=1.0):
        return ParameterRow("a", value, "1").text(value, scale)

    assert [text(-1.0), text(0.5), text(1.18e-3, 1e3), text(126.0)] == ["-1", "0.5", "1.18", "126"]
