"""Which outputs count and how inputs run between samples, chosen on a finished model."""

from __future__ import annotations

import numpy as np
import pytest

from sysid import BatchSimulator, Dataset, ModelError, Output
from tests.soak import mostly_soak
from tests.sysid.reference import simulate as reference
from tests.sysid.support import lag, motor, motor_inputs


def power(x, u, p):
    """Electrical power and twice the speed: one output of inputs and states, one of states."""
    return u[0] * x[0], 2.0 * x[1]


def measured_by_function():
    from dataclasses import replace

    return replace(
        motor(2.0), outputs=(Output("power", "W"), Output("double", "rad/s")), output=power
    )


NAMES = [("omega", "current", "power"), ("double",)]


@pytest.mark.soak
@pytest.mark.parametrize("names", NAMES)
def test_chosen_outputs_follow_scipy(names):
    model = measured_by_function().with_outputs(names)
    assert model.output_names == names
    assert [o.unit for o in model.outputs] == [
        {"power": "W", "current": "A"}.get(name, "rad/s") for name in names
    ]
    record = Dataset(motor_inputs(60), np.full((60, len(names)), np.nan), 0.01)
    simulated = BatchSimulator(model, accuracy=1e-6).trajectories(model.nominal, record)[0]
    exact = reference(model, model.nominal, record)
    np.testing.assert_allclose(simulated, exact, atol=1e-4 * np.abs(exact).max())


def test_without_a_function_outputs_stay_states():
    model = motor().with_outputs(["omega"])
    assert model.output is None and model.output_states == (1,)
    assert lag().with_outputs(("y",)) == lag()
    assert motor().with_outputs(["current"]).with_outputs(["omega"]) == model


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["powr"], "no output or state 'powr'; it has current, omega, power, double"),
        (["power", "power"], "outputs repeat the name 'power'"),
        ([], "it has no outputs"),
    ],
)
def test_outputs_that_cannot_be(names, message):
    with pytest.raises(ModelError, match=message):
        measured_by_function().with_outputs(names)


def test_a_hold_is_changed_for_one_input():
    model = motor()
    assert [u.hold for u in model.inputs] == ["foh", "foh"]
    assert [u.hold for u in model.with_holds({"load": "zoh"}).inputs] == ["foh", "zoh"]
    with pytest.raises(ModelError, match="no input 'lod'; it has voltage, load"):
        model.with_holds({"lod": "zoh"})


@pytest.mark.parametrize("hold", mostly_soak(["zoh", "foh"]))
def test_an_input_is_held_or_interpolated_as_told(hold):
    model = lag("foh" if hold == "zoh" else "zoh").with_holds({"u": hold})
    ramp = np.arange(5.0)[:, None]
    record = Dataset(ramp, np.zeros((5, 1)), 0.1)
    found = BatchSimulator(model, accuracy=1e-6).trajectories(np.array([1.0, 0.05]), record)[0]
    # tau y' = u - y from rest: a ramp lags by tau, a held sample is approached exponentially.
    t, decay = 0.1 * np.arange(5), np.exp(-0.1 / 0.05)
    exact = 10.0 * (t - 0.05 * (1.0 - np.exp(-t / 0.05)))
    if hold == "zoh":
        exact = np.zeros(5)
        for k in range(4):
            exact[k + 1] = k + (exact[k] - k) * decay
    np.testing.assert_allclose(found[:, 0], exact, atol=1e-4)
