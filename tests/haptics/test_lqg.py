"""The regulator: its promises of stability against simulated loops, and what it makes of a hand."""

import math

import numpy as np
import pytest

from haptics import laws
from haptics.dynamics import ActuatorDynamics
from haptics.linear_loop import LinearLaw, loop_margins
from haptics.lqg import Lqg, Regulator, TorqueLoop
from sim_rig.actuator import actuator
from sysid import ModelError

MODEL = actuator(parameters="rig")
DYNAMICS = ActuatorDynamics(MODEL)
NO_DRAWS = np.empty((0, len(MODEL.nominal)))
CONTROL = Lqg(controller="lqg")


def regulator_of(control):
    """Its state, and its constants."""
    c = Regulator.of(control, DYNAMICS.inertia).placed([0.0] * laws.CONSTANTS)
    return [0.0] * laws.STATES, c


def swing(control, hand, inertia=1.0, strength=1.0, n=4000):
    """Last speeds of a shaft in a hand under the regulator, by Euler steps of its equations."""
    J, T = DYNAMICS.inertia * inertia, 1.0 / control.sample_rate
    B, K = hand * control.hand_damping, hand * control.hand_stiffness
    shaft, (s, c) = control.shaft_filter(DYNAMICS.inertia), regulator_of(control)
    x, theta, omega, steps = np.zeros(len(shaft.b)), 1e-3, 0.0, 40
    queue, applied, speeds = [0.0] * control.ahead, 0.0, []
    for _ in range(n):
        h = -K * theta - B * omega
        x = shaft.corrected(shaft.predicted(x, applied), theta, h)
        delta = laws.regulate(float(x[2]), float(x[3]), s, c)
        queue.append(delta - float(x[4]))
        applied = queue.pop(0)
        for _ in range(steps):
            omega += T / steps / J * (strength * applied - K * theta - B * omega)
            theta += T / steps * omega
        speeds.append(abs(omega))
        if speeds[-1] > 1e6:
            break
    return max(speeds[-300:])


@pytest.mark.parametrize("hand", [0.25, 1.0, 8.0])
@pytest.mark.parametrize(("effort", "rate"), [(0.03, 1.0), (0.3, 3.0), (3.0, 0.3)])
def test_loops_that_are_called_stable_are(hand, effort, rate):
    control = CONTROL.model_copy(update={"effort": effort, "hand_rate": rate})
    peak = TorqueLoop(control, DYNAMICS).peak_sensitivity(DYNAMICS.inertia, 1.0, hand)
    assert (swing(control, hand) > 1.0) == math.isinf(peak)


def test_the_sensitivity_tells_how_much_stronger_the_motor_may_be():
    """The gain margin is at least S / (S - 1)."""
    peak = TorqueLoop(CONTROL, DYNAMICS).peak_sensitivity(DYNAMICS.inertia, 1.0, 2.0)
    assert 1.2 < peak < 10.0
    assert swing(CONTROL, 2.0, strength=0.95 * peak / (peak - 1.0)) < 1.0


@pytest.mark.parametrize("strength", [1.2, 4.0])
def test_a_stronger_motor_is_reckoned_with(strength):
    peak = TorqueLoop(CONTROL, DYNAMICS).peak_sensitivity(DYNAMICS.inertia, strength, 4.0)
    assert (swing(CONTROL, 4.0, strength=strength) > 1.0) == math.isinf(peak)


def test_tuning_leaves_the_margin_to_every_hand():
    facts = CONTROL.facts(MODEL, MODEL.nominal, NO_DRAWS)
    tuned = CONTROL.tuned(MODEL, MODEL.nominal, facts)
    loop = TorqueLoop(tuned, DYNAMICS)
    for hand in np.geomspace(1.0 / CONTROL.hand_range, CONTROL.hand_range, 5):
        assert loop.peak_sensitivity(DYNAMICS.inertia, 1.0, hand) <= CONTROL.sensitivity


def test_what_no_effort_can_make_stable_is_refused():
    wild = CONTROL.model_copy(update={"hand_range": 50.0, "hand_rate": 30.0, "sensitivity": 1.2})
    facts = wild.facts(MODEL, MODEL.nominal, NO_DRAWS)
    with pytest.raises(ModelError, match=r"no effort keeps the loop's sensitivity within 1\.2"):
        wild.tuned(MODEL, MODEL.nominal, facts)


def test_currents_at_their_limits_wind_nothing_up():
    """A torque beyond the motor's for a second: the error after it is that of another start."""
    s, c = regulator_of(CONTROL)
    for _ in range(800):
        delta = laws.regulate(0.5, 0.0, s, c)
        s[laws.DELTAS] += min(delta, 0.1) - delta
    assert s[laws.DELTAS] == pytest.approx(0.1)
    assert laws.regulate(-0.5, 0.0, s, c) < 0.0


def test_tuning_leaves_the_same_margin_within_the_yield_travel():
    """There friction is a spring, which is taken off late: less of it in a light hand."""
    facts = CONTROL.facts(MODEL, MODEL.nominal, NO_DRAWS)
    tuned = CONTROL.tuned(MODEL, MODEL.nominal, facts)
    assert 0.3 < tuned.yield_share < 1.0

    def peak(control):
        law = LinearLaw.of(control.program(MODEL, MODEL.nominal), MODEL)
        hand = CONTROL.hand_stiffness / 4.0, CONTROL.hand_damping / 4.0
        return loop_margins(law, DYNAMICS, "within yield", hand, 1.0 / 800.0, 1).sensitivity

    assert peak(tuned) <= CONTROL.sensitivity < 0.5 * peak(CONTROL)
