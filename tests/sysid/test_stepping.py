from __future__ import annotations

import functools
import math
import time
from itertools import pairwise

import numpy as np
import pytest

from sim_rig.actuator import actuator
from sysid import Input, ModelError, Output, Parameter, ProcessModel, State, Stepper
from tests.soak import mostly_soak
from tests.sysid.reference import simulate as reference
from tests.sysid.support import blank, lag, motor, motor_inputs, outputs_of, prbs

DT = 1.0 / 800.0


def pendulum_derivative(x, u, p):
    return x[1], -p[0] * p[0] * math.sin(x[0]) - 0.2 * x[1] + u[0]


def pendulum():
    return ProcessModel(
        name="pendulum",
        states=(State("angle", "rad", 2.0), State("speed", "rad/s")),
        inputs=(Input("push", "1", "foh"),),
        outputs=(Output("height", "1"), Output("energy", "1")),
        parameters=(Parameter("frequency", "rad/s", 200.0, 1.0, 1e3),),
        derivative=pendulum_derivative,
        output=lambda x, u, p: (
            -math.cos(x[0]),
            (0.5 * x[1] * x[1]) / (p[0] * p[0]) - math.cos(x[0]),
        ),
    )


def stiff_derivative(x, u, p):
    return -p[0] * math.tanh(50.0 * (x[0] - u[0])) - x[0], x[0] - x[1] * abs(x[1])


def stiff():
    return ProcessModel(
        name="stiff",
        states=(State("a", "1", 1.0), State("b", "1")),
        inputs=(Input("u", "1"),),
        outputs=(Output("a", "1"), Output("b", "1")),
        parameters=(Parameter("rate", "1", 2000.0, 1.0, 1e4),),
        derivative=stiff_derivative,
    )


def actuator_inputs(n):
    rng = np.random.default_rng(2)
    return np.column_stack([prbs(rng, n, -4, 4), prbs(rng, n, 0, 0.3), prbs(rng, n, -0.1, 0.1)])


N = 60
CASES = {
    "pendulum": (pendulum(), np.sin(np.arange(N))[:, None] * 5e3),
    "motor": (motor(), motor_inputs(N, DT)),
    "actuator": (actuator(), actuator_inputs(N)),
    "stiff": (stiff(), prbs(np.random.default_rng(3), N, -1, 1)[:, None]),
}


def play(stepper, inputs, cuts=()):
    """Outputs at the start of every interval, states of every base step, the last state."""
    x = stepper.model.initial_state
    traces, outputs = [], []
    edges = [0, *cuts, len(inputs) - 1]
    for start, end in pairwise(edges):
        trace, out = stepper.advance(x, inputs[start : end + 1])
        traces.append(trace)
        outputs.append(out)
    return np.concatenate(outputs), np.concatenate(traces), x


@functools.cache
def solved(name):
    model, inputs = CASES[name]
    return reference(model, model.nominal, blank(model, inputs, DT))


def sizes(model, inputs):
    """Largest value of every state, from a coarse run."""
    return np.abs(play(Stepper(model, model.nominal, DT), inputs)[1]).max(axis=0)


@pytest.mark.parametrize("accuracy", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("name", mostly_soak(list(CASES)))
def test_it_follows_scipy_as_closely_as_asked(name, accuracy):
    model, inputs = CASES[name]
    exact = solved(name)
    scale = sizes(model, inputs)
    stepper = Stepper(model, model.nominal, DT, scale=scale, accuracy=accuracy)
    found, _, x = play(stepper, inputs)
    error = np.abs(found - exact[:-1]) / np.abs(exact).max(axis=0)
    # Errors of successive steps add up in a pendulum's phase.
    assert error.max() < 10.0 * accuracy
    assert np.sqrt(np.mean(error**2)) < 2.0 * accuracy
    # Outputs are latched at the start of each interval, the state is left at the end.
    last = np.array(outputs_of(model, x, inputs[-1], model.nominal))
    assert np.all(np.abs(last - exact[-1]) < 10.0 * accuracy * np.abs(exact).max(axis=0))


def test_the_trace_has_the_state_at_every_base_step():
    model, inputs = CASES["pendulum"]
    fine = Stepper(model, model.nominal, DT / 5, accuracy=1e-9)
    steps = np.arange(5 * (N - 1) + 1) / 5
    between = np.interp(steps, np.arange(N), inputs[:, 0])[:, None]
    expected = play(fine, between)[1][:: fine.n_steps]
    _, trace, _ = play(Stepper(model, model.nominal, DT, n_steps=5, accuracy=1e-9), inputs)
    assert trace.shape == (5 * (N - 1), 2)
    np.testing.assert_allclose(trace, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("cuts", [(1,), (37,), (1, 2, 3, 50), tuple(range(1, N - 1))])
@pytest.mark.parametrize("name", mostly_soak(list(CASES)))
def test_where_a_run_is_cut_does_not_change_a_bit(name, cuts):
    model, inputs = CASES[name]
    stepper = Stepper(model, model.nominal, DT)
    whole, pieces = play(stepper, inputs), play(stepper, inputs, cuts)
    for a, b in zip(whole, pieces, strict=True):
        np.testing.assert_array_equal(a, b)


def test_two_steppers_of_one_model_do_not_meet():
    model, inputs = CASES["pendulum"]
    first = Stepper(model, model.nominal, DT)
    before = play(first, inputs)[2]
    other = Stepper(model, 1.5 * model.nominal, DT, n_steps=7)
    assert np.any(play(other, inputs)[2] != before)
    np.testing.assert_array_equal(play(first, inputs)[2], before)


@pytest.mark.parametrize("name", mostly_soak(["pendulum", "actuator", "stiff"]))
def test_what_is_not_a_number_stays_so_and_takes_no_longer(name):
    model, inputs = CASES[name]
    stepper = Stepper(model, model.nominal, DT)
    stepper.advance(model.initial_state, inputs[:2])
    lost = np.tile(inputs, (50, 1))
    lost[3] = math.nan
    x = model.initial_state
    start = time.perf_counter()
    _, outputs = stepper.advance(x, lost)
    assert time.perf_counter() - start < 1.0
    assert np.isfinite(outputs[:3]).all()
    assert np.isnan(x).any()


def test_a_state_that_grows_without_bound_ends_in_infinity():
    model = lag(
        name="blow_up",
        states=(State("y", "1", 1.0),),
        derivative=lambda x, u, p: (x[0] * x[0] * 1e3 + u[0],),
    )
    stepper = Stepper(model, model.nominal, DT)
    stepper.advance(np.zeros(1), np.zeros((2, 1)))
    x = model.initial_state
    start = time.perf_counter()
    stepper.advance(x, np.zeros((1000, 1)))
    assert time.perf_counter() - start < 1.0
    assert not np.isfinite(x).any()


def test_settings_that_do_not_fit():
    with pytest.raises(ModelError, match="lag has 2 parameters, not 3"):
        Stepper(lag(), np.ones(3), 0.1)
    with pytest.raises(ModelError, match="scale must be 1 positive numbers"):
        Stepper(lag(), np.ones(2), 0.1, scale=np.zeros(1))
    with pytest.raises(ModelError, match="n_steps is 0"):
        Stepper(lag(), np.ones(2), 0.1, n_steps=0)
    with pytest.raises(ModelError, match="accuracy"):
        Stepper(lag(), np.ones(2), 0.1, accuracy=0.0)
    stepper = Stepper(lag(), np.ones(2), 0.1)
    with pytest.raises(ModelError, match="1 states and 1 inputs"):
        stepper.advance(np.zeros(2), np.zeros((2, 1)))
    with pytest.raises(ModelError, match="1 states and 1 inputs"):
        stepper.advance(np.zeros(1), np.zeros((2, 2)))
