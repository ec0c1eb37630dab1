"""Shaping the reference by the hand: what hands of both ends feel, on the simulated plant."""

import numpy as np
import pytest

from daq.experiment import Sample
from haptics import laws
from haptics.lqg import Lqg
from haptics.program import HAND, ProgramLaw
from sim_rig.actuator import actuator
from sim_rig.plant import Plant, state_sizes
from sysid import Stepper

MODEL = actuator(parameters="rig")
CONTROL = Lqg(controller="lqg")
PERIOD = 1.0 / CONTROL.sample_rate
TIME = np.arange(1600) * PERIOD
REFERENCE = 0.02 * sum(np.sin(2 * np.pi * f * TIME + f * f) for f in np.linspace(0.6, 9.6, 6))


def felt(program, scale):
    """Torque on a hand that is turned to and fro, and the law's state at the end."""
    grip = {"K_u": HAND[0] * scale, "B_u": HAND[1] * scale}
    plant = Plant(load="hand", parameters=grip).build()
    names = [output.name for output in plant.outputs]
    stepper = Stepper(plant, plant.nominal, PERIOD, scale=state_sizes(plant))
    time = np.append(TIME, TIME[-1] + PERIOD)
    hand = np.stack([np.ones_like(time), np.sin(6.0 * time), 6.0 * np.cos(6.0 * time)], axis=1)
    law, x, coming, torques = ProgramLaw(program, MODEL), plant.initial_state.copy(), (0.0, 0.0), []
    for k, reference in enumerate(REFERENCE):
        inputs = np.hstack([np.tile(coming, (2, 1)), hand[k : k + 2]])
        _, outputs = stepper.advance(x, inputs)
        at = dict(zip(names, outputs[0].tolist(), strict=True))
        torques.append(-at["torque"])
        coming = law.volts(
            Sample(k, TIME[k], at["current_motor"], at["current_brake"], at["torque"],
                   at["theta"], at["omega"], 0),
            float(reference),
        )  # fmt: skip
    return np.array(torques), law.state


def error(torque):
    """Behind the first half second, in parts of the reference."""
    return np.std((torque - REFERENCE)[400:]) / np.std(REFERENCE[400:])


def test_a_soft_hand_feels_what_was_asked_for_and_not_half_as_much_again():
    shaped, plain = (
        error(felt(make(MODEL, MODEL.nominal), 0.25)[0])
        for make in (CONTROL.program, CONTROL.loop_program)
    )
    assert shaped < 0.12 and plain > 3.0 * shaped


@pytest.mark.parametrize("scale", [0.5, 1.0, 4.0])
def test_the_hand_is_told_by_the_slope_of_the_reference(scale):
    torque, state = felt(CONTROL.program(MODEL, MODEL.nominal), scale)
    assert state[laws.MOVED] / state[laws.FELT] == pytest.approx(1.0 / scale, rel=0.3)
    assert error(torque) < 0.12


def test_a_sample_that_is_lost_is_no_kink_of_the_reference():
    """A straight line is shaped as one, whichever of its samples come."""
    c, s = list(CONTROL.program(MODEL, MODEL.nominal).constants), [0.0] * laws.STATES
    slope, came = 0.3, 0
    for k in [*range(200), *range(203, 230)]:
        shaped = laws.shape(slope * k * PERIOD, k - came - 1 if k else 0, s, c)
        came = k
    first = c[laws.SHAPE_SLOPE] + c[laws.SHAPE_SLOPE + 1] * laws.mobility(slope, s, c)
    assert shaped == pytest.approx(slope * PERIOD * (k + first), abs=1e-6)
