"""What hangs on the shaft: cable and pulley, hand, lock."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from sim_rig.actuator import actuator
from sim_rig.physics.loads import HAND_DAMPING, HAND_STIFFNESS, LOADS, hand_torque, pulley_torque
from sysid import BatchSimulator, Dataset
from tests.sim_rig.support import Parts, constant, follow

GRAVITY = 9.80665
PULLEY = {p.name: p.nominal for p in LOADS["pulley"].parameters}
MASS, RADIUS, STIFFNESS, LENGTH = (PULLEY[k] for k in ("mass", "radius", "k_cable", "length"))
HANGING = MASS * GRAVITY / STIFFNESS  # stretch under the mass at rest


def path(theta):
    """Cable on the pulley."""
    return RADIUS * (math.hypot(theta, 0.1) - 0.1)


def pulled(theta, omega, height, speed, **changes):
    """Torque on the shaft, and force on the mass beside its weight."""
    p = tuple((PULLEY | changes).values())
    torque, rise, acceleration = pulley_torque(theta, omega, (height, speed), (), p)
    assert rise == speed
    return torque, (acceleration + GRAVITY) * MASS


# --- cable and mass -------------------------------------------------------------------------


@given(
    theta=st.floats(-60.0, 60.0),
    omega=st.floats(-50.0, 50.0),
    slack=st.floats(-0.02, 0.02),
    speed=st.floats(-1.5, 1.5),
)
def test_the_cable_pulls_and_never_pushes(theta, omega, slack, speed):
    torque, force = pulled(theta, omega, path(theta) + slack, speed)
    assert force >= -1e-12
    if slack > 1e-9:
        assert torque == 0.0
        assert force == pytest.approx(0.0, abs=1e-12)
    # The tension acts on a lever no longer than the radius, towards less winding.
    assert torque * theta <= 0.0
    assert abs(torque) <= RADIUS * force + 1e-12


def test_a_taut_cable_by_hand():
    # theta = 3, stretched by 1 mm, getting longer by 0.005*3/hypot(3, 0.1)*8 - 0.01 m/s.
    rate = 0.005 * 3.0 / math.hypot(3.0, 0.1) * 8.0 - 0.01
    tension = 5000.0 * 1e-3 * (1.0 + 4.0 * rate)
    torque, force = pulled(3.0, 8.0, path(3.0) - 1e-3, 0.01)
    assert force == pytest.approx(tension, rel=1e-9)
    assert torque == pytest.approx(-tension * 0.005 * 3.0 / math.hypot(3.0, 0.1), rel=1e-9)
    assert pulled(-3.0, -8.0, path(3.0) - 1e-3, 0.01) == pytest.approx((-torque, force))


@pytest.mark.parametrize("theta", [20.0, -20.0])
def test_the_wound_mass_hangs_in_equilibrium(theta):
    torque, force = pulled(theta, 0.0, path(theta) - HANGING, 0.0)
    assert force == pytest.approx(MASS * GRAVITY, rel=1e-9)
    assert torque == pytest.approx(-math.copysign(MASS * GRAVITY * RADIUS, theta), rel=1e-4)


def test_the_cable_comes_taut_without_a_jump():
    """However fast the mass falls into it."""
    forces = [pulled(5.0, 0.0, path(5.0) - depth, -2.0)[1] for depth in (0.0, 1e-9, 2e-9)]
    assert forces[0] == pytest.approx(0.0, abs=1e-12)
    assert forces[2] == pytest.approx(2.0 * forces[1], rel=1e-3)


def test_a_mass_bounces_in_its_cable_at_the_springs_frequency_and_loses_height():
    """Hung from a locked drum: small oscillations at sqrt(k/m), damped by d k s_0 / m."""
    model = pulley_on()
    start = {"theta": 10.0, "height": path(10.0) - HANGING, "speed": 1e-3}
    found = follow(model, constant(model), 0.4, {"J_m": 1e6}, start, rtol=1e-9, max_step=1e-3)
    offset = found["height"] - (path(10.0) - HANGING)
    crossings = found.t[:-1][np.diff(np.sign(offset)) != 0]
    assert np.diff(crossings).mean() == pytest.approx(
        math.pi / math.sqrt(STIFFNESS / MASS), rel=0.02
    )
    # The loss is d times the tension: at rest d m g, a seventh of critical.
    share = PULLEY["d_cable"] * MASS * GRAVITY / (2.0 * math.sqrt(STIFFNESS * MASS))
    peaks = [
        np.abs(offset[(found.t >= a) & (found.t < b)]).max() for a, b in ((0, 0.1), (0.3, 0.4))
    ]
    omega_n = math.sqrt(STIFFNESS / MASS)
    assert peaks[1] / peaks[0] == pytest.approx(math.exp(-share * omega_n * 0.3), rel=0.35)
    assert share == pytest.approx(1.0 / 7.0, rel=0.05)


def pulley_on():
    return Parts(load="pulley").build(parameters="rig")


FREE = {"alpha0": 0.0, "alpha1": 0.0, "c0": 0.0, "c1": 0.0, "B_m": 0.0, "K_m": 0.0}


def wound(theta, **more):
    """States with so much cable on the pulley, the mass hanging."""
    return {"theta": theta, "height": path(theta) - HANGING} | more


def test_unwinding_past_the_end_winds_the_other_way_and_swings_back():
    model = pulley_on()
    found = follow(model, constant(model), 3.0, FREE, wound(10.0), rtol=1e-6)
    theta, height = found["theta"], found["height"]
    first = np.flatnonzero(theta < 0.0)[0]
    turn = first + np.argmin(theta[first:])
    assert theta.min() < -5.0  # wound up on the other side
    assert theta[turn:].max() > 2.0  # and back
    # Never higher than it began, never below what the cable lets.
    assert height.max() <= wound(10.0)["height"] + 1e-3
    assert height.min() > -0.01


def test_with_friction_the_residual_torque_holds_the_wound_mass():
    model = pulley_on()
    found = follow(model, constant(model), 1.0, None, wound(10.0))
    # A bent bristle's way, then swings on it that die out.
    assert np.ptp(found["theta"]) < 0.3
    assert np.ptp(found["theta"][found.t > 0.7]) < 0.01
    held = -MASS * GRAVITY * RADIUS
    assert found.output("torque") == pytest.approx(held, rel=0.02)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_winding_past_the_cables_length_stops_the_mass_at_the_pulley(sign):
    """The motor winds ten centimetres of cable; the mass stops there, and the shaft with it."""
    model = pulley_on()
    length = 0.1
    inputs = constant(model, applied_voltage_motor=-sign * 2.0)
    changes = {"length": length, "alpha0": 1e-6, "c0": 2e-3}
    found = follow(model, inputs, 1.0, changes, rtol=1e-6)
    current = found["current_motor"][-1]
    tension = abs(current) * model.parameter("K_m").nominal / RADIUS
    rest = length + (tension - MASS * GRAVITY) / STIFFNESS
    assert found["height"].max() < length + 0.02
    assert found["height"][-1] == pytest.approx(rest, abs=1e-5)
    assert path(found["theta"][-1]) == pytest.approx(rest + tension / STIFFNESS, abs=1e-5)
    assert np.sign(found["theta"][-1]) == -sign == np.sign(current)
    # The stop holds far more than the mass's weight.
    assert found.output("torque") == pytest.approx(sign * tension * RADIUS, rel=1e-3)
    assert tension > 10.0 * MASS * GRAVITY


# --- hand -----------------------------------------------------------------------------------


def test_the_hand_pulls_towards_itself():
    p = (10.0, 0.1)
    assert hand_torque(1.0, 2.0, (), (1.0, 1.5, 2.5), p) == (pytest.approx(5.05),)  # (A.1)
    assert hand_torque(1.5, 2.5, (), (1.0, 1.0, 2.0), p) == (pytest.approx(-5.05),)
    assert hand_torque(1.5, 2.5, (), (0.0, 1.0, 2.0), p) == (0.0,)


def test_the_hand_is_a_second_order_system_of_the_given_response():
    """(A.2): J_u (s^2 + 2 xi omega_n s + omega_n^2), xi = 0.707, omega_n = 3/0.237 s."""
    poles = np.roots([1e-3, HAND_DAMPING, HAND_STIFFNESS])
    assert abs(poles[0]) * 0.237 == pytest.approx(3.0)
    assert -poles[0].real / abs(poles[0]) == pytest.approx(0.707)
    rig = Parts().build(parameters="rig")
    rotors = sum(rig.parameter(name).nominal for name in ("J_m", "J_b"))
    assert 9.0 * rotors <= 1e-3 <= 100.0 * rotors  # "an order of magnitude or two"


HAND_ALONE = {"alpha0": 0.0, "alpha1": 0.0, "c0": 0.0, "c1": 0.0, "B_m": 0.0, "K_m": 0.0}


def step_of_the_wrist(times):
    """The shaft with the hand's inertia J_u and nothing else, after the wrist moved by 1 rad."""
    model = Parts(load="hand").build()
    inputs = constant(model, hand_grip=1.0, hand_theta=1.0)
    J_u = {"J_m": 0.9e-3, "J_b": 0.1e-3}
    return follow(model, inputs, times[-1], HAND_ALONE | J_u, times=times, rtol=1e-9)["theta"]


def test_a_shaft_of_the_hands_inertia_answers_as_a2_says():
    times = np.linspace(0.0, 1.0, 2001)
    found = step_of_the_wrist(times)
    xi, omega_n = 0.707, 3.0 / 0.237
    damped = omega_n * math.sqrt(1.0 - xi**2)
    expected = 1.0 - np.exp(-xi * omega_n * times) * (
        np.cos(damped * times) + xi * omega_n / damped * np.sin(damped * times)
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)
    overshoot = math.exp(-math.pi * xi / math.sqrt(1.0 - xi**2))
    assert found.max() - 1.0 == pytest.approx(overshoot, rel=1e-4)
    outside = times[np.abs(found - 1.0) > 0.05]
    assert outside[-1] == pytest.approx(0.237, rel=0.03)  # T_r, omega_n T_r = 3


def test_a_moving_wrist_carries_the_shaft_with_it():
    """hand_theta and hand_omega belong together: the shaft follows a slow wrist closely."""
    model = Parts(load="hand").build()
    period = 2.0 * math.pi / 3.0

    def inputs(t):
        return (0.0, 0.0, 1.0, 0.5 * math.sin(3.0 * t), 1.5 * math.cos(3.0 * t))

    found = follow(model, inputs, 2.0 * period, HAND_ALONE | {"J_m": 0.9e-3, "J_b": 0.1e-3})
    K_u, B_u = HAND_STIFFNESS, HAND_DAMPING
    transfer = (K_u + 3.0j * B_u) / (K_u + 3.0j * B_u - 9.0 * 1e-3)
    late = found.t > period
    expected = np.imag(0.5 * transfer * np.exp(3.0j * found.t[late]))
    np.testing.assert_allclose(found["theta"][late], expected, atol=2e-3)
    assert abs(transfer) == pytest.approx(1.0, abs=0.07)


def test_without_grip_the_hand_does_nothing():
    for kind in ("hand", "pulley+hand"):
        model = Parts(load=kind).build()
        x = tuple(model.initial_state + 0.3)
        p = tuple(model.nominal)
        away = model.derivative(x, (1.0, 0.1, 0.0, 99.0, -50.0), p)
        assert away == model.derivative(x, (1.0, 0.1, 0.0, 0.0, 0.0), p)
        assert away != model.derivative(x, (1.0, 0.1, 1.0, 99.0, -50.0), p)


# --- lock and freedom -----------------------------------------------------------------------


@pytest.mark.parametrize("friction", ["none", "cyclic"])
@pytest.mark.parametrize("sensor", ["load", "between"])
def test_a_locked_shaft_stays_put_and_the_sensor_reads_what_holds_it(sensor, friction):
    model = Parts(load="locked", sensor=sensor, friction=friction).build(parameters="rig")
    inputs = constant(model, applied_voltage_motor=1.0, applied_voltage_brake=0.2)
    found = follow(model, inputs, 0.1, start={"theta": 2.0})
    np.testing.assert_array_equal(found["theta"], 2.0)
    np.testing.assert_array_equal(found["omega"], 0.0)
    np.testing.assert_array_equal(found["z"], 0.0)
    motor = model.parameter("K_m").nominal * found["current_motor"][-1]
    assert motor > 0.05
    # Between motor and brake it is the motor that speeds the brake up; at the load the lock,
    # which resists.
    assert found.output("torque") == pytest.approx(motor if sensor == "between" else -motor)


def test_a_free_shaft_has_nothing_on_its_sensor_at_the_load():
    model = Parts(load="free", friction="stribeck").build(parameters="rig")
    found = follow(model, constant(model, applied_voltage_motor=1.0), 0.1)
    assert abs(found["omega"][-1]) > 1.0
    assert found.output("torque") == 0.0


def test_two_loads_on_one_shaft_add_up():
    both, pulley, hand = LOADS["pulley+hand"], LOADS["pulley"], LOADS["hand"]
    assert [s.name for s in both.states] == ["height", "speed"]
    assert both.parameters == pulley.parameters + hand.parameters
    u, x = (0.5, 2.0, 3.0), (0.01, 0.2)
    p = tuple(parameter.nominal for parameter in both.parameters)
    torque, *rates = both.torque(4.0, 5.0, x, u, p)
    first, *expected = pulley.torque(4.0, 5.0, x, (), p[:6])
    (second,) = hand.torque(4.0, 5.0, (), u, p[6:])
    assert torque == pytest.approx(first + second)
    assert second != 0.0 != first
    assert rates == expected
    assert both.inertia(p) == PULLEY["J_p"]


def test_the_equilibrium_of_mass_and_hand():
    """The hand lifts the mass to where its spring gives the weight's torque."""
    model = Parts(load="pulley+hand").build()
    inputs = constant(model, hand_grip=1.0, hand_theta=12.0)
    found = follow(model, inputs, 2.0, FREE | {"B_u": 0.02}, wound(12.0), rtol=1e-6)
    K_u = HAND_STIFFNESS

    def left(theta):
        lever = RADIUS * theta / math.hypot(theta, 0.1)
        return K_u * (12.0 - theta) - MASS * GRAVITY * lever

    assert found["theta"][-1] == pytest.approx(brentq(left, 1.0, 12.0), abs=1e-3)


@pytest.mark.soak
@pytest.mark.parametrize("hysteresis", ["bouc-wen", "dahl", "lugre"])
def test_a_brake_that_holds_a_wound_load_lets_it_go_softly(hysteresis):
    """No more than the mass's own weight pulls at the shaft, in either direction."""
    model = actuator(hysteresis=hysteresis, load="pulley", turns=5.0)
    blank = Dataset(np.zeros((16, 2)), np.full((16, len(model.outputs)), np.nan), 1.0 / 800.0)
    omega = BatchSimulator(model, accuracy=1e-6).trajectories(model.nominal, blank)[0][
        :, model.output_names.index("omega")
    ]
    values = dict(zip(model.parameter_names, model.nominal, strict=True))
    weight = values["mass"] * GRAVITY * values["radius"]
    free = weight / (values["J_m"] + values["J_b"]) * 15.0 / 800.0
    assert np.all(np.abs(omega) < free)
