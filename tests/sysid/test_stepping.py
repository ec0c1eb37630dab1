from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from sim_rig.actuator import actuator
from sysid import ModelError, Stepper
from sysid.reference import simulate as reference
from tests.sysid.support import blank, lag, motor, motor_inputs, normalised_rms, prbs


def play(stepper, inputs, cuts=()):
    """Outputs at the start of every interval, states of every step, the last state."""
    x = stepper.model.initial_state
    traces, outputs = [], []
    edges = [0, *cuts, len(inputs) - 1]
    for start, end in pairwise(edges):
        trace, out = stepper.advance(x, inputs[start : end + 1])
        traces.append(trace)
        outputs.append(out)
    return np.concatenate(outputs), np.concatenate(traces), x


@pytest.mark.parametrize("model", [motor(), actuator()], ids=lambda m: m.name)
def test_it_follows_scipy(model):
    rng = np.random.default_rng(2)
    dt, n = 1.0 / 800.0, 60
    inputs = motor_inputs(n, dt)
    if len(model.inputs) == 3:
        inputs = np.column_stack(
            [prbs(rng, n, -4, 4), prbs(rng, n, 0, 0.3), prbs(rng, n, -0.1, 0.1)]
        )
    exact = reference(model, model.nominal, blank(model, inputs, dt))
    found, trace, x = play(Stepper(model, model.nominal, dt), inputs)
    assert normalised_rms(found, exact[:-1]).max() < 2e-4
    # Outputs and trace are latched at the start of each interval, the state is left at the end.
    states = [model.state_names.index(name) for name in model.output_names]
    np.testing.assert_array_equal(found, trace[:: len(trace) // (n - 1), states])
    assert np.all(np.abs(x[states] - exact[-1]) < 2e-4 * np.abs(exact).max(axis=0))


def test_more_steps_come_closer():
    model, dt, rng = actuator(), 1.0 / 800.0, np.random.default_rng(5)
    n = 80
    inputs = np.column_stack([prbs(rng, n, -4, 4), prbs(rng, n, 0, 0.3), np.zeros(n)])
    exact = reference(model, model.nominal, blank(model, inputs, dt))[:-1]
    errors = [
        normalised_rms(play(Stepper(model, model.nominal, dt, k), inputs)[0], exact).max()
        for k in (1, 4, 16)
    ]
    assert errors[0] > 4.0 * errors[1] > 16.0 * errors[2] > 0.0


@pytest.mark.parametrize("cuts", [(1,), (37,), (1, 2, 3, 50), tuple(range(1, 79))])
@pytest.mark.parametrize("model", [motor(), actuator()], ids=lambda m: m.name)
def test_where_a_run_is_cut_does_not_change_a_bit(model, cuts):
    inputs = np.random.default_rng(4).uniform(-0.3, 0.3, (80, len(model.inputs)))
    stepper = Stepper(model, model.nominal, 1.0 / 800.0)
    whole, pieces = play(stepper, inputs), play(stepper, inputs, cuts)
    for a, b in zip(whole, pieces, strict=True):
        np.testing.assert_array_equal(a, b)


def test_wrong_number_of_parameters():
    with pytest.raises(ModelError, match="lag has 2 parameters, not 3"):
        Stepper(lag(), np.ones(3), 0.1)
