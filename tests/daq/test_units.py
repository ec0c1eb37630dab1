"""Numbers with units in configuration files."""

from typing import Annotated

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, ValidationError

from daq.config.base import Section
from daq.config.identification import Column
from daq.config.units import Hertz, Part, RadiansPerSecond, Unit, Volts, factor, unit_of
from daq.errors import ConfigError
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from sim_rig.plant import Plant


class Example(Section):
    """Every place a number with a unit can stand in."""

    single: Volts = Field(1.0, ge=-10.0, le=10.0, description="one")
    optional: Hertz | None = Field(None, gt=0.0, description="one or none")
    several: list[RadiansPerSecond] = Field(default_factory=list, description="any number")
    named: dict[str, Annotated[float, Unit("kg*m^2")]] = Field(
        default_factory=dict, description="by name"
    )
    share: Part = Field(0.0, description="a part")
    bare: float = Field(0.0, description="of no unit")


@pytest.mark.parametrize(
    ("given_", "wanted"),
    [
        ({"single": "5 V"}, {"single": 5.0}),
        ({"single": "500mV"}, {"single": 0.5}),
        ({"single": "-1e3 mV"}, {"single": -1.0}),
        ({"optional": "1.5 kHz"}, {"optional": 1500.0}),
        ({"several": ["60 rpm", 2, "180 deg/s"]}, {"several": [2 * np.pi, 2.0, np.pi]}),
        ({"named": {"J": "2 g·cm^2"}}, {"named": {"J": 2e-7}}),
        ({"share": "20 %"}, {"share": 0.2}),
        ({"single": "5"}, {"single": 5.0}),
    ],
)
def test_a_quantity_is_the_number_it_stands_for(given_, wanted):
    made = Example.model_validate(given_)
    for key, value in wanted.items():
        assert getattr(made, key) == pytest.approx(value, rel=1e-12)


@given(st.floats(-10.0, 10.0))
def test_any_number_survives_being_written_with_its_unit(value):
    assert Example.model_validate({"single": f"{value!r} V"}).single == value


@pytest.mark.parametrize(
    ("content", "place", "said"),
    [
        ({"single": "5 A"}, ("single",), "'A' does not convert to 'V'"),
        ({"single": "11000 mV"}, ("single",), "less than or equal to 10"),
        ({"single": "5 parrots"}, ("single",), "'parrots' is not understood"),
        ({"single": "5,0 V"}, ("single",), "valid number"),
        ({"several": [1, "1 Hz"]}, ("several", 1), "turns or radians"),
        ({"optional": "0 Hz"}, ("optional",), "greater than 0"),
        ({"bare": "5 V"}, ("bare",), "valid number"),
    ],
)
def test_what_does_not_convert_is_refused_where_it_stands(content, place, said):
    with pytest.raises(ValidationError) as caught:
        Example.model_validate(content)
    (error,) = caught.value.errors()
    assert error["loc"] == place and said in error["msg"]


def test_the_unit_of_a_field_is_found_wherever_it_stands():
    units = {
        name: unit_of(field.annotation, field.metadata)
        for name, field in Example.model_fields.items()
    }
    assert units == {
        "single": "V",
        "optional": "Hz",
        "several": "rad/s",
        "named": "kg*m^2",
        "share": "1",
        "bare": None,
    }


def test_factors_are_those_of_the_si():
    assert factor("mN*m", "N*m") == pytest.approx(1e-3)
    assert factor("1/min", "Hz") == pytest.approx(1 / 60)
    assert factor("V", "V") == 1.0


def test_numbers_of_a_model_are_taken_in_its_units(tmp_path):
    config = tmp_path / "id.yaml"
    config.write_text(
        "ranges: {L_m: [0.2 mH, 3 mH], K_m: [100 mN*m/A, 0.2], R_b: [null, 0.1 kohm]}\n"
        "initial: {omega: 60 rpm}\n"
        "datasheet: sheet.yaml\n"
    )
    (tmp_path / "sheet.yaml").write_text(
        "R_m: {value: 1180 mohm, fixed: true}\nL_b: {range: [100 mH, 0.2 H]}\n"
        "alpha0: {value: 10 mN*m, tolerance: 20 %}\n"
    )
    prepared = problem_of(SettingsRequest(str(config), settings=["fixed.K_dm=0.1 kV/A"]))
    settings = prepared.settings
    assert settings.ranges == {
        "L_m": pytest.approx((2e-4, 3e-3)),
        "K_m": pytest.approx((0.1, 0.2)),
        "R_b": (None, pytest.approx(100.0)),
        "L_b": pytest.approx((0.1, 0.2)),
        "alpha0": pytest.approx((0.008, 0.012)),
    }
    assert settings.fixed == {"K_dm": pytest.approx(100.0), "R_m": pytest.approx(1.18)}
    states = {state.name: state for state in prepared.model.states}
    assert states["omega"].initial == pytest.approx(2 * np.pi)


def test_the_plants_parameters_are_taken_in_its_units():
    plant = Plant.model_validate({"load": "free", "parameters": {"L_m": "2 mH", "R_m": 1.0}})
    assert plant.parameters == {"L_m": pytest.approx(2e-3), "R_m": 1.0}


def test_a_constant_column_may_have_its_unit_with_it():
    column = Column.model_validate({"constant": "3 mm"})
    assert (column.constant, column.unit) == (3.0, "mm")


def test_values_that_no_such_part_can_have_are_told_each_at_its_key(tmp_path):
    text = "fixed:\n  R_m: -5\n  K_m: -0.1\ntied:\n  L_m: 0.5*nothing\n"
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError) as error:
        problem_of(SettingsRequest(str(tmp_path / "c.yaml")))
    keys = [mistake.key for mistake in error.value.mistakes]
    assert keys == ["fixed.R_m", "fixed.K_m", "tied.L_m"]
    assert [mistake.line for mistake in error.value.mistakes] == [2, 3, 5]
