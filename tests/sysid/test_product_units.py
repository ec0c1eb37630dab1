"""Units of products, against a library that knows units."""

import pint
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.problem.expressions import product_unit

KNOWN = pint.UnitRegistry()
UNITS = ["1", "A", "1/rad", "N*m/A", "N*m*s/(rad*A)", "kg*m^2", "ohm", "H", "1/s", "V/A"]


@given(st.lists(st.tuples(st.sampled_from(UNITS), st.sampled_from([-2, -1, 1, 2])), max_size=4))
def test_the_unit_of_a_product_is_the_product_of_the_units(factors):
    expected = KNOWN.Quantity(1.0)
    for unit, power in factors:
        expected = expected * KNOWN.Quantity(1.0, unit) ** power
    found = KNOWN.Quantity(1.0, product_unit(factors))
    assert (found / expected).to_base_units().magnitude == pytest.approx(1.0)
    assert found.dimensionality == expected.dimensionality


@pytest.mark.parametrize(
    ("factors", "unit"),
    [
        ([("1/rad", 1), ("N*m/A", 1)], "N*m/(rad*A)"),
        ([("ohm", 1), ("H", -1)], "1/s"),
        ([("A", 1), ("A", -1)], "1"),
        ([("V/A", 1), ("ohm", -1)], "1"),
        ([("kg*m^2", 1), ("N*m*s/rad", -1)], "s*rad"),
        ([("m s^-1", 1), ("A", 1)], ""),
        ([("A", 0.5)], ""),
    ],
)
def test_units_are_written_as_parameters_have_them(factors, unit):
    assert product_unit(factors) == unit
