from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim_rig.plant import (
    GRAVITY,
    MAX_CURRENT,
    PARAMETERS,
    STATES,
    SUPPLY,
    actuator_truth,
    hand_torque,
    hanging_load,
    plant,
    saturate,
)

P = {parameter.name: parameter.nominal for parameter in PARAMETERS}
NAMES = [state.name for state in STATES]
AT = {name: i for i, name in enumerate(NAMES)}
NO_LOAD = {"k_cable": 0.0, "d_cable": 0.0}


def integrate(inputs, duration, changes=None, start=None, max_step=2e-3):
    """States (9, n) of the plant under inputs(t), by SciPy."""
    model = plant()
    p = tuple(model.vector(changes or {}))
    x0 = model.initial_state if start is None else start
    found = solve_ivp(
        lambda t, x: model.derivative(tuple(x), inputs(t), p),
        (0.0, duration), x0, method="BDF", rtol=1e-6, atol=1e-8, max_step=max_step,
    )  # fmt: skip
    assert found.success
    return found


def constant(motor=0.0, brake=0.0):
    return lambda t: (motor, brake, 0.0, 0.0, 0.0)


# --- ratings --------------------------------------------------------------------------------


def test_the_motor_holds_its_rated_torque_at_its_rated_current():
    """At rest the shaft accelerates by what the motor gives: a heavy rotor shows the torque."""
    inertia = 1e6
    found = integrate(constant(motor=5.0), 0.1, {"J_m": inertia, **NO_LOAD, "alpha0": 0.0})
    model = plant()
    x = tuple(found.y[:, -1])
    p = tuple(model.vector({"J_m": inertia, **NO_LOAD, "alpha0": 0.0}))
    torque = model.derivative(x, constant(5.0)(0.1), p)[AT["omega"]] * inertia
    current = x[AT["current_motor"]]
    assert torque / current * 2.5 == pytest.approx(0.353, rel=0.01)
    assert current == pytest.approx(2.5, rel=0.01)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_brake_slides_at_its_rated_torque(direction):
    """Driven at a constant slow speed by a heavily damped hand, the coil at 0.19 A."""
    speed = direction * 1.0
    changes = {"K_u": 0.0, "B_u": 10.0, "B_m": 0.0} | NO_LOAD
    # The rating is the coil's at 24 V: hold it there, whatever the amplifier makes of a command.
    brake = 0.19 / 0.5 / 0.9905

    def inputs(t):
        return (0.0, brake, 1.0, 0.0, speed)

    start = plant().initial_state.copy()
    start[AT["omega"]] = speed
    found = integrate(inputs, 1.0, changes, start)
    x = found.y[:, -1]
    assert x[AT["current_brake"]] == pytest.approx(0.19, rel=0.005)
    assert x[AT["omega"]] * direction > 0.5
    torque = 10.0 * (speed - x[AT["omega"]])
    assert abs(torque) == pytest.approx(0.6779, rel=0.01)
    assert np.sign(torque) == direction


@pytest.mark.parametrize(
    ("channel", "command"), [("motor", 0.4), ("motor", 4.0), ("brake", 0.05), ("brake", 0.3)]
)
def test_both_channels_give_half_an_ampere_per_volt(channel, command):
    # A locked shaft: no back-EMF.
    found = integrate(constant(**{channel: command}), 1.0, {"J_m": 1e6, **NO_LOAD})
    current = found.y[AT[f"current_{channel}"], -1]
    assert current / command == pytest.approx(0.5, rel=0.01)


# --- amplifier ------------------------------------------------------------------------------


def test_saturate():
    assert [saturate(v, 2.0) for v in (-3.0, -2.0, -1.0, 0.0, 1.5, 9.0)] == [
        -2.0, -2.0, -1.0, 0.0, 1.5, 2.0,
    ]  # fmt: skip


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_command_beyond_the_limit_gives_the_current_limit(sign):
    found = integrate(constant(motor=sign * 50.0), 0.2, {"J_m": 1e6, **NO_LOAD})
    assert abs(found.y[AT["current_motor"], -1]) == pytest.approx(MAX_CURRENT, rel=0.011)
    as_much = integrate(constant(motor=sign * 5.0), 0.2, {"J_m": 1e6, **NO_LOAD})
    np.testing.assert_allclose(found.y[:, -1], as_much.y[:, -1], rtol=1e-6, atol=1e-8)


def test_the_windings_never_see_more_than_the_supply():
    # A coil that would need 40 V for its command gets 24 V.
    found = integrate(constant(brake=0.38), 1.0, {"R_b": 40.0 / 0.19, "J_m": 1e6})
    current = found.y[AT["current_brake"]]
    assert current[-1] == pytest.approx(SUPPLY / (40.0 / 0.19), rel=1e-6)
    assert found.y[AT["voltage_brake"], -1] > SUPPLY
    slope = np.gradient(current, found.t)
    assert slope.max() <= SUPPLY / P["L_b"] * 1.001
    # A free motor runs no faster than the supply's back-EMF.
    free = integrate(constant(motor=5.0), 3.0, {**NO_LOAD, "alpha0": 0.0})
    speed = free.y[AT["omega"]].max()
    assert speed < SUPPLY / P["K_m"]
    assert speed > 0.9 * SUPPLY / P["K_m"]


# --- load -----------------------------------------------------------------------------------


def test_the_cable_pulls_and_never_pushes():
    rng = np.random.default_rng(4)
    mass = P["mass"]
    taut = slack = 0
    for _ in range(500):
        theta, omega = rng.normal(0, 10), rng.normal(0, 30)
        height, speed = rng.normal(0, 0.05), rng.normal(0, 0.3)
        torque, lift = hanging_load(theta, omega, height, speed, mass, 0.005, 5000.0, 10.0)
        tension = (lift + GRAVITY) * mass
        assert tension >= -1e-12
        # The torque is the tension on a lever no longer than the radius, towards less winding.
        assert torque * theta <= 0.0
        assert abs(torque) <= 0.005 * tension + 1e-12
        taut, slack = taut + (tension > 0), slack + (tension == 0)
    assert taut > 50
    assert slack > 50


def test_the_wound_mass_hangs_in_equilibrium():
    theta, stretch = 20.0, P["mass"] * GRAVITY / P["k_cable"]
    root = math.hypot(theta, 0.1)
    height = 0.005 * (root - 0.1) - stretch
    torque, lift = hanging_load(theta, 0.0, height, 0.0, P["mass"], 0.005, P["k_cable"], 10.0)
    assert lift == pytest.approx(0.0, abs=1e-9)
    assert torque == pytest.approx(-P["mass"] * GRAVITY * 0.005, rel=1e-4)


FREE = {"alpha0": 0.0, "alpha1": 0.0, "c0": 0.0, "c1": 0.0, "B_m": 0.0}


def wound(theta, speed=0.0):
    x = plant().initial_state.copy()
    x[AT["theta"]], x[AT["omega"]] = theta, speed
    x[AT["height"]] += 0.005 * (math.hypot(theta, 0.1) - 0.1)
    return x


def test_unwinding_past_the_end_winds_the_other_way_and_swings_back():
    found = integrate(constant(), 6.0, FREE | {"K_m": 1e-9}, wound(10.0))
    theta = found.y[AT["theta"]]
    first_pass = np.flatnonzero(theta < 0.0)[0]
    turn = first_pass + np.argmin(theta[first_pass:])
    assert theta.min() < -5.0  # wound up on the other side
    assert theta[turn:].max() > 2.0  # and back
    assert np.all(found.y[AT["height"]] <= wound(10.0)[AT["height"]] + 0.01)


def test_with_friction_the_residual_torque_holds_the_wound_mass():
    found = integrate(constant(), 2.0, None, wound(10.0))
    theta = found.y[AT["theta"]]
    assert abs(theta[-1] - theta[0]) < 1.0
    assert abs(found.y[AT["omega"], -1]) < 0.3


# --- energy ---------------------------------------------------------------------------------


@pytest.mark.parametrize("case", ["driven", "swinging", "hand"])
def test_the_mechanical_power_balance_closes(case):
    """Kinetic and potential energy change by what motor, brake, cable and hand do."""
    model = plant()
    p = tuple(model.nominal)
    inputs = {
        "driven": lambda t: (3.0 * math.sin(9.0 * t), 0.1, 0.0, 0.0, 0.0),
        "swinging": constant(),
        "hand": lambda t: (
            1.0, 0.05, 1.0, 5.0 * math.sin(4.0 * t), 20.0 * math.cos(4.0 * t),
        ),
    }[case]  # fmt: skip
    start = wound(6.0, speed=-40.0)
    J = P["n_c"] ** 2 * P["J_m"] + P["J_b"] + P["J_p"]

    def powers(t, x):
        i_m, i_b, omega, z = (x[AT[n]] for n in ("current_motor", "current_brake", "omega", "z"))
        theta, height, speed = (x[AT[n]] for n in ("theta", "height", "speed"))
        motor = -P["n_c"] * P["K_m"] * i_m * omega
        alpha = P["alpha0"] + P["alpha1"] * abs(i_b)
        c = P["c0"] + P["c1"] * abs(i_b) + P["n_c"] ** 2 * P["B_m"]
        brake = (alpha * z + c * omega) * omega
        _u, _b, grip, hand_theta, hand_omega = inputs(t)
        hand = grip * (P["B_u"] * (hand_omega - omega) + P["K_u"] * (hand_theta - theta)) * omega
        # The cable's length past the pulley, and its rate.
        root = math.sqrt(theta**2 + 0.1**2)
        stretch = P["radius"] * (root - 0.1) - height
        rate = P["radius"] * theta / root * omega - speed
        tension = 0.0
        if stretch > 0.0:
            tension = max(P["k_cable"] * stretch + P["d_cable"] * rate, 0.0)
        return motor - brake + hand, -tension * rate

    def rhs(t, x):
        return np.append(model.derivative(tuple(x[:9]), inputs(t), p), powers(t, x))

    found = solve_ivp(
        rhs, (0.0, 1.0), np.append(start, [0.0, 0.0]), method="LSODA", rtol=1e-9, atol=1e-11,
        max_step=1e-3,
    )  # fmt: skip
    omega, speed, height = (found.y[AT[n]] for n in ("omega", "speed", "height"))
    energy = 0.5 * J * omega**2 + 0.5 * P["mass"] * speed**2 + P["mass"] * GRAVITY * height
    work = found.y[9] + found.y[10]
    scale = np.abs(found.y[9]).max() + np.ptp(energy)
    np.testing.assert_allclose(energy - energy[0], work, atol=1e-5 * scale)
    # The cable stores and loses, and never gives more than it was stretched by.
    root = np.hypot(found.y[AT["theta"]], 0.1)
    stretch = np.maximum(P["radius"] * (root - 0.1) - height, 0.0)
    stored = 0.5 * P["k_cable"] * stretch**2
    taken = -found.y[10]
    assert np.all(np.diff(taken - stored) >= -1e-5 * scale)


def test_the_torque_sensor_sees_the_load_and_the_pulleys_inertia():
    model = plant()
    x = wound(5.0, 3.0)
    u = (1.0, 0.1, 1.0, 5.5, 2.0)
    p = tuple(model.nominal)
    acceleration = model.derivative(tuple(x), u, p)[AT["omega"]]
    cable, _ = hanging_load(
        5.0, 3.0, x[AT["height"]], 0.0, P["mass"], P["radius"], P["k_cable"], P["d_cable"]
    )
    hand = P["B_u"] * (2.0 - 3.0) + P["K_u"] * (5.5 - 5.0)
    outputs = model.evaluate_output(x, u, p)
    assert outputs[2] == pytest.approx(cable + hand - P["J_p"] * acceleration)
    # What it sees is all that acts on the actuator from outside.
    rotor = (P["J_m"] + P["J_b"]) * acceleration
    resisting = P["alpha0"] * x[AT["z"]] + (P["c0"] + P["B_m"]) * 3.0
    assert rotor == pytest.approx(outputs[2] - resisting)
    assert outputs[3:] == (5.0, 3.0)


# --- hand -----------------------------------------------------------------------------------


def test_the_hand_is_a_second_order_system_of_the_given_response():
    """(A.2): J_u (s^2 + 2 xi omega_n s + omega_n^2), xi = 0.707, omega_n = 3/0.237 s."""
    inertia = 1e-3
    poles = np.roots([inertia, P["B_u"], P["K_u"]])
    omega_n = abs(poles[0])
    assert omega_n == pytest.approx(3.0 / 0.237)
    assert -poles[0].real / omega_n == pytest.approx(0.707)
    assert inertia >= 9.0 * (P["J_m"] + P["J_b"])


def test_the_hand_pulls_towards_itself():
    assert hand_torque(1.0, 2.0, 1.5, 2.5, 10.0, 0.1) == pytest.approx(5.05)  # (A.1)
    assert hand_torque(1.5, 2.5, 1.0, 2.0, 10.0, 0.1) == pytest.approx(-5.05)


def test_without_grip_the_hand_does_nothing():
    model = plant()
    x, p = tuple(wound(3.0, 1.0)), tuple(model.nominal)
    away = model.derivative(x, (1.0, 0.1, 0.0, 99.0, -50.0), p)
    assert away == model.derivative(x, (1.0, 0.1, 0.0, 0.0, 0.0), p)
    assert away != model.derivative(x, (1.0, 0.1, 1.0, 99.0, -50.0), p)


def test_the_actuator_inside_is_the_actuator_that_is_identified():
    """With nothing hanging and no limit reached, the plant is the process model."""
    from sim_rig.actuator import actuator

    model, rng = plant(), np.random.default_rng(5)
    inner = actuator()
    p = tuple(model.vector({"J_p": 0.0}))
    q = tuple(inner.vector(actuator_truth()))
    for _ in range(50):
        x = rng.normal(size=7) * [5, 5, 1, 0.1, 5, 1, 0.01]
        command = rng.uniform([-4, 0], [4, 0.3])
        slack = (*x, 1.0, 0.0)  # the mass lies high above
        found = model.derivative(slack, (*command, 0.0, 0.0, 0.0), p)[:7]
        expected = inner.derivative(tuple(x), (*command, 0.0), q)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
