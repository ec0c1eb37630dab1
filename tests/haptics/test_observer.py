"""What the observer makes of an encoder, against the motion that moved it."""

import math

import numpy as np
import pytest

from haptics import laws
from haptics.dynamics import ActuatorDynamics
from haptics.feedforward import Feedforward
from haptics.observer import Hand, SensorNoise, ShaftFilter
from haptics.program import law_functions
from sim_rig.actuator import actuator
from sysid import Stepper

T = 1.0 / 800.0
COUNT = 2.0 * math.pi / 8192.0
MODEL = actuator(parameters="rig", outputs=("current_motor", "current_brake", "omega"))


@pytest.fixture(scope="module")
def motion():
    """States of a shaft that a hand pushes to and fro, (n, n_states), and its torque, (n,)."""
    time = np.arange(2400) * T
    hand = 0.05 * np.sin(2.0 * np.pi * 3.0 * time) + 0.03 * np.sin(2.0 * np.pi * 0.7 * time)
    stepper = Stepper(MODEL, MODEL.nominal, T, n_steps=1)
    commands = np.stack([0.3 * np.sin(2.0 * np.pi * 5.0 * time), np.full(2400, 0.02), hand], 1)
    x = MODEL.initial_state
    x[MODEL.state_names.index("z")] = 1.0  # which the observer does not know
    states, _ = stepper.advance(x, np.vstack([commands, commands[-1:]]))
    return states, hand


def observed(states, hand, noise, hand_model=Hand(0.01), lost=()):  # noqa: B008
    shaft = ShaftFilter.of(ActuatorDynamics(MODEL).inertia, T, noise, hand_model)
    control = Feedforward(controller="feedforward")
    c = shaft.placed(control.constants(ActuatorDynamics(MODEL)))
    s, p, functions = [0.0] * laws.STATES, MODEL.nominal.tolist(), law_functions(MODEL)
    names, waiting = MODEL.state_names, 0
    i_m, theta = (names.index(n) for n in ("current_motor", "theta"))
    c[laws.BRAKE_DECAY] = 0.0
    rows = []
    for k, (x, torque) in enumerate(zip(states, hand, strict=True)):
        if k in lost:
            waiting += 1
        else:
            angle = math.floor(x[theta] / COUNT) * COUNT
            s[laws.COMING : laws.COMING + 2] = [x[names.index("current_brake")]] * 2
            functions.observe(angle, torque, x[i_m], waiting, s, c, p)
            waiting = 0
        rows.append((s[laws.SPEED], s[laws.Z], s[laws.HAND]))
    return np.array(rows).T


@pytest.mark.parametrize("torque_noise", [math.inf, 0.007])
def test_speed_hysteresis_and_hand_are_observed(motion, torque_noise):
    states, hand = motion
    noise = SensorNoise(COUNT / math.sqrt(12.0), torque_noise)
    omega, z, push = observed(states, hand, noise)
    later = slice(400, None)  # the hysteresis has forgotten where it began
    true_omega, true_z = (states[:, MODEL.state_names.index(n)] for n in ("omega", "z"))
    assert np.sqrt(np.mean((omega - true_omega)[later] ** 2)) < 0.2
    assert np.sqrt(np.mean((z - true_z)[later] ** 2)) < 0.05
    assert np.sqrt(np.mean((push - hand)[later] ** 2)) < 0.01


def test_samples_that_do_not_arrive_leave_no_jump(motion):
    states, hand = motion
    noise = SensorNoise(COUNT / math.sqrt(12.0))
    omega, _, _ = observed(states, hand, noise, lost=range(1000, 1010))
    true_omega = states[:, MODEL.state_names.index("omega")]
    assert np.abs(omega - true_omega)[1010:1060].max() < 2.0
