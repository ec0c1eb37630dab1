"""The actuator's dynamics as controllers see them, against simulations of their own."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from haptics import laws
from haptics.dynamics import ActuatorDynamics
from haptics.operating_points import operating_points
from haptics.program import law_functions
from sim_rig.actuator import actuator
from sysid import ModelError

RIG = actuator(parameters="rig")
VALUES = dict(zip(RIG.parameter_names, RIG.nominal.tolist(), strict=True))
DYNAMICS = ActuatorDynamics(RIG)


def test_constants_are_those_of_the_equations():
    assert DYNAMICS.motor_constant == pytest.approx(VALUES["K_m"])
    assert DYNAMICS.inertia == pytest.approx(VALUES["J_m"] + VALUES["J_b"])
    assert DYNAMICS.sliding == pytest.approx(VALUES["A"] / (VALUES["beta"] + VALUES["gamma"]))
    sliding = (VALUES["alpha0"] + VALUES["alpha1"] * 0.1) * DYNAMICS.sliding
    viscous = VALUES["B_m"] + VALUES["c0"] + VALUES["c1"] * 0.1
    rest = DYNAMICS.rest(0.1, 5.0, DYNAMICS.sliding, 0.0)
    assert -rest == pytest.approx(sliding + 5.0 * viscous)


@pytest.mark.parametrize("channel", ["motor", "brake"])
def test_gain_and_mean_delay_of_a_channel_are_those_of_its_step(channel):
    """The mean delay is the area between a step and its response, in parts of the latter's end."""
    names, u = RIG.state_names, [0.0, 0.0, 0.0]
    u[["motor", "brake"].index(channel)] = 1.0
    shaft = [names.index(name) for name in ("omega", "z", "theta")]
    current = names.index(f"current_{channel}")

    def slopes(_t, x):
        dx = np.array(RIG.derivative(tuple(x), tuple(u), tuple(RIG.nominal)))
        dx[shaft] = 0.0  # held
        return np.append(dx, x[current])[: len(x) + 1]

    end = 0.06
    run = solve_ivp(
        lambda t, x: slopes(t, x[:-1]), (0.0, end), np.zeros(len(names) + 1), rtol=1e-9, atol=1e-12
    )
    final, area = run.y[current, -1], run.y[-1, -1]
    expected = getattr(DYNAMICS, channel)
    assert expected.gain == pytest.approx(final, rel=1e-6)
    assert expected.delay == pytest.approx(end - area / final, rel=2e-3)


@pytest.mark.parametrize("hysteresis", ["bouc-wen", "dahl", "lugre"])
def test_hysteresis_along_an_angle_is_that_of_the_integrated_equation(hysteresis):
    model = actuator(parameters="rig", hysteresis=hysteresis)
    dynamics, functions = ActuatorDynamics(model), law_functions(model)
    constants = {laws.STIFFNESS: dynamics.stiffness}
    omega, z = model.state_names.index("omega"), model.state_names.index("z")

    def rate(_t, y, speed):
        x = [0.0] * len(model.states)
        x[omega], x[z] = speed, y[0]
        return [model.derivative(tuple(x), (0.0,) * 3, tuple(model.nominal))[z]]

    mine = exact = 0.0
    for angle in (0.004, 0.012, -0.003, -0.02, 0.001, 0.05):
        mine = functions.turned(mine, angle, 1.25e-3, constants, tuple(model.nominal))
        span = (0.0, 1.25e-3)
        run = solve_ivp(rate, span, [exact], args=(angle / 1.25e-3,), rtol=1e-10, atol=1e-12)
        exact = run.y[0, -1]
        assert mine == pytest.approx(exact, abs=2e-3 * dynamics.sliding)


def test_within_its_yield_travel_the_brake_is_a_spring():
    points = operating_points(RIG, brake_currents=[0.0, 0.1])
    spring = (VALUES["alpha0"] + VALUES["alpha1"] * 0.1) * VALUES["A"]
    stiffness = {(p.branch, p.brake_current): p.stiffness for p in points}
    assert stiffness["within yield", 0.1] == pytest.approx(spring)
    assert stiffness["sliding forwards", 0.1] == pytest.approx(0.0, abs=1e-5 * spring)
    assert stiffness["sliding backwards", 0.1] == pytest.approx(0.0, abs=1e-5 * spring)


def test_a_linear_model_goes_to_python_control():
    control = pytest.importorskip("control")
    point = operating_points(RIG, brake_currents=[0.1])[0]
    system = point.state_space()
    response = control.frequency_response(
        system["theta", "torque"], 2.0 * math.pi * np.array([1e-3])
    )
    assert np.abs(response.complex).item() == pytest.approx(1.0 / point.stiffness, rel=1e-3)


def test_a_model_of_something_else_is_refused():
    from sysid.examples import lag

    with pytest.raises(ModelError, match=r"has no state current_motor"):
        ActuatorDynamics(lag())


def test_currents_that_do_not_settle_are_refused():
    unstable = actuator(parameters="rig", order_motor=3).with_parameters(
        omega_dm2={"nominal": 1e4}, omega_dm3={"nominal": 1e4}
    )
    with pytest.raises(ModelError, match="do not settle"):
        ActuatorDynamics(unstable).motor  # noqa: B018
