from __future__ import annotations

import math

import numpy as np
import pytest

from sysid import Constraint, Input, ModelError, Output, Parameter, ProcessModel, State
from tests.sysid.support import lag, outputs_of


def build(**changes):
    return lag(**changes)


@pytest.mark.parametrize(
    ("kind", "items"),
    [
        ("states", (State("y", "1"), State("y", "1"))),
        ("inputs", (Input("u", "1"), Input("u", "1"))),
        ("outputs", (Output("y", "1"), Output("y", "1"))),
        (
            "parameters",
            (Parameter("gain", "1", 1.0, 0.5, 2.0), Parameter("gain", "1", 1.0, 0.5, 2.0)),
        ),
    ],
)
def test_repeated_names_are_named_in_the_error(kind, items):
    with pytest.raises(ModelError, match=rf"{kind} repeat the name '{items[0].name}'"):
        build(**{kind: items})


def test_a_forgotten_comma_is_named():
    with pytest.raises(ModelError, match=r"outputs is one Output, not several; write \(Output\("):
        lag(outputs=(Output("y", "m")))


@pytest.mark.parametrize("kind", ["states", "outputs", "parameters"])
def test_a_model_needs_states_outputs_and_parameters(kind):
    with pytest.raises(ModelError, match=f"it has no {kind}"):
        build(**{kind: ()})


def test_an_output_that_is_no_state_needs_an_output_function():
    with pytest.raises(ModelError, match=r"output 'speed' is not a state.*\(y\)"):
        build(outputs=(Output("speed", "1"),))
    model = build(outputs=(Output("speed", "1"),), output=lambda x, u, p: (2.0 * x[0],))
    assert model.output_states is None
    assert outputs_of(model, (3.0,), (0.0,), (1.0, 1.0)) == (6.0,)


@pytest.mark.parametrize("values", [(), (0.0, 0.0)])
def test_wrong_number_of_derivatives(values):
    with pytest.raises(ModelError, match=f"derivative.* returns {len(values)} values, expected 1"):
        build(derivative=lambda x, u, p: values)


def test_wrong_number_of_outputs():
    with pytest.raises(ModelError, match=r"output\(x, u, p\) returns 2 values, expected 1"):
        build(output=lambda x, u, p: (x[0], x[0]))


def test_a_derivative_that_is_no_tuple():
    with pytest.raises(ModelError, match="must return a tuple, not list"):
        build(derivative=lambda x, u, p: [0.0])


def test_a_derivative_that_raises_is_reported_with_its_cause():
    with pytest.raises(ModelError, match=r"derivative.*fails.*IndexError"):
        build(derivative=lambda x, u, p: (x[5],))
    with pytest.raises(ModelError, match="divides by zero"):
        build(derivative=lambda x, u, p: (1.0 / x[0],))


def test_a_constraint_that_raises_is_named():
    with pytest.raises(ModelError, match="constraint 'gain small'"):
        build(constraints=(Constraint("gain small", lambda p: p[7]),))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((1.0, 2.0, 1.0), "low end at or above"),
        ((1.0, 1.0, 1.0), "low end at or above"),
        ((1.0, 0.0, math.inf), "not finite"),
        ((1.0, math.nan, 1.0), "not finite"),
        ((1.0, 0.0, 2.0, "log"), "log scale needs a positive range"),
        ((-1.0, 0.5, 2.0), "nominal value -1.0 is outside its physical limits"),
        ((math.nan, 0.5, 2.0), "nominal value nan is no finite number"),
        (("1", 0.5, 2.0), "nominal value '1' is no finite number"),
        ((1.0, 0.5, "2"), r"range \[0.5, '2'\] is not finite"),
        ((1.0, 0.5, 2.0, "logarithmic"), "scale 'logarithmic' is none of linear, log"),
    ],
)
def test_bad_parameters(settings, message):
    with pytest.raises(ModelError, match=message):
        Parameter("R", "ohm", *settings)


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        (lambda: State("y", "V", initial="estimate"), "'estimate' is no finite number; what is to"),
        (lambda: State("y", "V", initial=math.nan), "state y: initial nan is no finite number"),
        (lambda: State("y", "V", initial_range=(1.0,)), "initial_range is no pair"),
        (lambda: State("y", "V", initial_range=5.0), "initial_range is no pair"),
        (lambda: Input("u", "V", hold="ZOH"), "hold 'ZOH' is none of zoh, foh, spline"),
    ],
)
def test_bad_signals(declared, message):
    with pytest.raises(ModelError, match=message):
        declared()


def test_a_fixed_parameter_needs_no_range():
    assert Parameter("g", "m/s^2", 9.8, 0.0, 0.0, fixed=True).nominal == 9.8


def test_vector_puts_named_values_in_declared_order():
    model = build()
    assert model.vector({"tau": 0.1}).tolist() == [2.0, 0.1]
    assert model.vector({}).tolist() == model.nominal.tolist()
    with pytest.raises(ModelError, match=r"no parameter 'taw'; it has gain, tau"):
        model.vector({"taw": 0.1})


def test_with_parameters_changes_a_copy_only():
    model = build()
    changed = model.with_parameters(tau={"nominal": 0.2, "fixed": True})
    assert changed.parameter("tau").nominal == 0.2
    assert changed.parameter("tau").fixed
    assert changed.parameter("gain") == model.parameter("gain")
    assert model.parameter("tau").nominal == 0.05
    with pytest.raises(ModelError, match="no parameter 'x'"):
        model.with_parameters(x={"nominal": 1.0})
    with pytest.raises(ModelError, match="low end"):
        model.with_parameters(tau={"lower": 1.0})


def test_lists_serve_as_well_as_tuples():
    as_lists = {
        kind: list(getattr(build(), kind)) for kind in ("states", "inputs", "outputs", "parameters")
    }
    model = build(**as_lists)
    assert model == build()
    assert hash(model) == hash(build())


def test_initial_state_and_names():
    model = ProcessModel(
        name="two",
        states=(State("a", "1", 0.5), State("b", "1", -1.0)),
        inputs=(),
        outputs=(Output("b", "1"),),
        parameters=(Parameter("k", "1", 1.0, 0.5, 2.0),),
        derivative=lambda x, u, p: (-p[0] * x[0], x[0]),
    )
    assert np.array_equal(model.initial_state, [0.5, -1.0])
    assert (model.state_names, model.input_names) == (("a", "b"), ())
    assert model.output_states == (1,)
