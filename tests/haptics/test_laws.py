"""The one text of the laws: by Python and by Numba, over samples that get lost."""

import numpy as np
import pytest

from daq.experiment import Sample
from haptics import laws, model_step, trial
from haptics.dynamics import ActuatorDynamics
from haptics.feedforward import Feedforward
from haptics.laws import STATES
from haptics.lqg import Lqg
from haptics.program import compiled_laws
from haptics.static import Static
from sim_rig.actuator import actuator

MODEL = actuator(parameters="rig")
CONTROLS = [
    Static(controller="static"),
    Feedforward(controller="feedforward"),
    Lqg(controller="lqg"),
]


def samples(n=600):
    """A shaft that is turned to and fro; every 50th sample is lost."""
    for k in range(n):
        t = k / 800.0
        if k % 50 != 20:
            theta, omega = 2.0 * np.sin(5.0 * t), 10.0 * np.cos(5.0 * t)
            yield Sample(k, t, 0.3 * np.sin(9.0 * t), 0.0, 0.05 * np.sin(12.0 * t), theta, omega, 0)


def test_the_texts_that_are_compiled_together_share_no_name():
    """Of two numbers or functions of one name the last would be taken for both."""
    names = [
        name
        for module in (laws, model_step, trial)
        for name, item in vars(module).items()
        if getattr(item, "__module__", "") == module.__name__
        or (name.isupper() and name != "TYPE_CHECKING")
    ]
    assert len(names) > 100 and len(names) == len(set(names))


@pytest.mark.parametrize("control", CONTROLS, ids=lambda control: control.controller)
def test_machine_code_answers_as_python_does(control):
    program = control.program(MODEL, MODEL.nominal)
    law, compiled = control.law(MODEL, MODEL.nominal), compiled_laws(MODEL)[program.entry]
    s, c, p = np.zeros(STATES), np.array(program.constants), np.array(program.parameters)
    volts, tick = np.zeros(2), -1
    for sample in samples():
        reference = 0.2 * np.sin(20.0 * sample.time)
        lost = sample.tick - tick - 1 if tick >= 0 else 0
        tick = sample.tick
        compiled(
            sample.theta, sample.omega, sample.torque, sample.current_motor,
            reference, lost, s, c, p, volts,
        )  # fmt: skip
        assert law.volts(sample, reference) == pytest.approx(tuple(volts), abs=1e-9)


@pytest.mark.parametrize(("speed", "counted"), [(4.0, 4.0), (20.0, 6.0), (-20.0, -6.0)])
def test_friction_beyond_the_speed_to_which_it_is_known_is_that_at_it(speed, counted):
    """The motor of a shaft that turns steadily gives what the model has against the motion."""
    control = Feedforward(controller="feedforward", allocation="motor", friction_speed=6.0)
    dynamics, law = ActuatorDynamics(MODEL), control.law(MODEL, MODEL.nominal)
    for k in range(400):
        t = k / control.sample_rate
        volts, _ = law.volts(Sample(k, t, 0.0, 0.0, 0.0, speed * t, speed, 0), 0.0)
    current = dynamics.motor.gain * volts + dynamics.motor.emf * speed
    friction = -dynamics.rest(0.0, counted, np.copysign(dynamics.sliding, speed), 0.0)
    assert dynamics.motor_constant * current == pytest.approx(friction, rel=0.02)
