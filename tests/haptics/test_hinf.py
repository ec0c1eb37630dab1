"""The structured synthesis: its slopes, what it promises over a family, what a file keeps."""

from dataclasses import replace

import numpy as np
import pytest

from daq import tune
from daq.cli.tune import _show as show
from haptics import laws
from haptics.dynamics import ActuatorDynamics
from haptics.hinf import Hinf, LoopFamily, extremes, places
from haptics.linear_loop import LinearLaw, loop_margins
from haptics.minimax import Responses, least_largest
from sim_rig.actuator import actuator
from sysid import ModelError
from tests.haptics.test_tune import write

MODEL = actuator(parameters="rig")
START = Hinf(controller="hinf", yield_share=0.7)


def draws(n):
    """Parameters that are known to 5 %."""
    rng = np.random.default_rng(3)
    free = [MODEL.parameter_names.index(name) for name in ("K_m", "J_m", "J_b", "alpha0", "A")]
    factors = np.ones((n, len(MODEL.nominal)))
    factors[:, free] = np.exp(0.05 * rng.standard_normal((n, len(free))))
    return MODEL.nominal * factors


@pytest.fixture(scope="module")
def tuned():
    return START.tuned_over(MODEL, MODEL.nominal, draws(2))


def largest_sensitivity(control, actuators):
    """Over hands and branches."""
    program = control.program(MODEL, MODEL.nominal)
    by_branch = {
        branch: LinearLaw.of(program, MODEL, branch)
        for branch in ("within yield", "sliding forwards")
    }
    return max(
        loop_margins(
            law, ActuatorDynamics(MODEL, values), branch, (0.16 * hand, 0.018 * hand), 1 / 800, 1
        ).sensitivity
        for values in actuators
        for branch, law in by_branch.items()
        for hand in (0.25, 1.0, 4.0)
    )


@pytest.mark.soak
def test_slopes_of_the_responses_are_those_of_differences():
    loops = LoopFamily(START, MODEL, MODEL.nominal, [MODEL.nominal])
    x, step = 0.01 * np.arange(len(loops.free)), 1e-4
    values = loops.respond(x, True)
    for k in (0, 5, 10, 12, 13):
        unit = step * np.eye(len(x))[k]
        above, below = loops.respond(x + unit, False), loops.respond(x - unit, False)
        for name in ("F", "G"):
            slope = (getattr(above, name) - getattr(below, name)) / (2.0 * step)
            exact = getattr(values, f"{name}_x")[..., k]
            assert np.abs(slope - exact).max() < 1e-4 * max(1.0, np.abs(exact).max())


@pytest.mark.soak
def test_margins_of_actuators_that_it_has_not_seen_are_larger_than_lqgs(tuned):
    unseen = draws(6)[2:]
    before, after = (largest_sensitivity(control, unseen) for control in (START, tuned))
    print(f"largest |S|: {before:.2f} with lqg's gains, {after:.2f}")
    assert after < 0.9 * before


@pytest.mark.soak
def test_errors_are_those_that_are_allowed_and_friction_is_not_taken_off_twice(tuned):
    family = [MODEL.nominal, *extremes(MODEL, draws(2))]
    loops = LoopFamily(START, MODEL, MODEL.nominal, family)
    gains = dict(zip(loops.places, tuned.gains, strict=True))
    start = dict(zip(loops.places, loops.gains(np.zeros(len(loops.free))), strict=True))
    x = np.array([gains[place] / start[place] - 1.0 for place in loops.free])
    assert np.linalg.norm(loops.respond(x, False).G, axis=1).max() < 1.001
    assert gains[laws.YIELD_SHARE] <= 1.0


@pytest.mark.soak
def test_a_file_s_gains_are_those_of_the_program(tuned):
    again = Hinf.model_validate(tuned.model_dump(mode="json"))
    constants = again.program(MODEL, MODEL.nominal).constants
    assert [constants[place] for place in places(1)] == tuned.gains


def test_rig_tune_says_that_gains_are_set(tmp_path, capsys):
    tuning = tune(write(tmp_path / "t.yaml", {"controller": "static"}), model="actuator")
    control = Hinf(controller="hinf", gains=[0.1] * 14)
    show(replace(tuning, requested=START, control=control))
    assert "gains: 14 numbers are set" in capsys.readouterr().out


def test_gains_of_another_delay_are_refused():
    control = Hinf(controller="hinf", gains=[0.1] * 14, ahead=2)
    with pytest.raises(ModelError, match=r"14 numbers, but with ahead: 2 there are 15; tune again"):
        control.program(MODEL, MODEL.nominal)


def test_the_least_largest_of_a_bounded_problem():
    """The larger of |x| and |4 - x_0| with |x_0| <= 1: both pull until the bound holds."""

    def respond(x, slopes):
        F = np.array([x, [4.0 - x[0], 0.0]]) + 0j
        F_x = np.array([np.eye(2), [[-1.0, 0.0], [0.0, 0.0]]])
        return Responses(F, x[None, :1] + 0j, F_x, np.array([[[1.0, 0.0]]]))

    assert least_largest(respond, np.array([-2.0, 2.0]))[0] == pytest.approx(1.0, abs=1e-3)
