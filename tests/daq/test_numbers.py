"""Numbers for people: the unit's prefix, and the digits that an uncertainty supports."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.config.units import factor
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
