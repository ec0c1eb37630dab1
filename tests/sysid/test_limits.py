"""Saturations, dead zones and contacts, in the batch simulator and in the stepper."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from sysid import BatchSimulator, Dataset, Input, Output, Parameter, ProcessModel, State, Stepper
from tests.soak import mostly_soak
from tests.sysid.reference import simulate as reference
from tests.sysid.support import blank, linear_response, prbs

DT = 1.0 / 800.0
GAIN, CUTOFF, RESISTANCE, INDUCTANCE = 100.0, 1000.0, 1.0, 1e-3


def kept_within(value, low, high):
    return min(max(value, low), high)


def current_loop(x, u, p):
    """A fast, lightly damped current controller whose amplifier ends at a voltage."""
    voltage, current = x
    applied = kept_within(voltage, -p[0], p[0])
    return (
        CUTOFF * (GAIN * (u[0] - current) - voltage),
        (applied - RESISTANCE * current) / INDUCTANCE,
    )


def nested(x, u, p):
    """A controller that asks for a limited current, through an amplifier that is limited too."""
    voltage, current = x
    asked = kept_within(3.0 * u[0] - 0.5 * kept_within(current, -0.2, p[0] / 100.0), -0.8, 0.8)
    return (
        CUTOFF * (GAIN * (asked - current) - voltage),
        (max(min(voltage, p[0]), -12.0) - RESISTANCE * current) / INDUCTANCE,
    )


def dead_zone(x, u, p):
    """A mass between two springs that it touches only beyond a gap."""
    position, velocity = x
    beyond = max(position - 0.01 * p[0], 0.0) + min(position + 0.01 * p[0], 0.0)
    return velocity, 40.0 * u[0] - 5.0 * velocity - 9e4 * beyond


def model(derivative, limit=5.0):
    return ProcessModel(
        name=derivative.__name__,
        states=(State("first", "1"), State("second", "1")),
        inputs=(Input("u", "1"),),
        outputs=(Output("first", "1"), Output("second", "1")),
        parameters=(Parameter("limit", "1", limit, 0.1, 1e4),),
        derivative=derivative,
    )


CASES = [
    (current_loop, 5.0, (10.0, 1.0)),
    (current_loop, 1.5, (10.0, 1.0)),
    (nested, 3.0, (10.0, 1.0)),
    (dead_zone, 1.0, (0.02, 1.0)),
]


def commands(n=120, seed=6):
    """Steps of very different height: some swings end just below a limit, some just above."""
    rng = np.random.default_rng(seed)
    return prbs(rng, n, -1.0, 1.0)[:, None] * prbs(rng, n, 0.0, 1.0, 40)[:, None]


@functools.cache
def solved(derivative, limit):
    chosen, inputs = model(derivative, limit), commands()
    return chosen, inputs, reference(chosen, chosen.nominal, blank(chosen, inputs, DT))


def play(stepper, inputs):
    x = stepper.model.initial_state
    trace, _ = stepper.advance(x, inputs)
    return np.vstack([trace[:: stepper.n_steps], x])


@pytest.mark.parametrize(("derivative", "limit", "scale"), mostly_soak(CASES))
@pytest.mark.parametrize(("n_steps", "accuracy"), [(1, 1e-3), (1, 1e-5), (4, 1e-5), (4, 1e-7)])
def test_the_stepper_keeps_its_accuracy(derivative, limit, scale, accuracy, n_steps):
    chosen, inputs, exact = solved(derivative, limit)
    stepper = Stepper(
        chosen,
        chosen.nominal,
        DT,
        n_steps=n_steps,
        scale=np.array(scale),
        accuracy=accuracy,
    )
    error = np.abs(play(stepper, inputs) - exact) / scale
    assert error.max() < 10.0 * accuracy
    assert np.sqrt(np.mean(error**2)) < accuracy


@pytest.mark.parametrize(("derivative", "limit", "scale"), mostly_soak(CASES))
def test_the_batch_simulator_keeps_its_accuracy(derivative, limit, scale):
    chosen, inputs, exact = solved(derivative, limit)
    simulator = BatchSimulator(chosen, accuracy=1e-3)
    size = np.abs(exact).max(axis=0)
    sse = simulator.errors(chosen.nominal, [Dataset(inputs, exact, DT)], [size]).sse[0, 0]
    assert np.sqrt(sse / len(inputs)).max() < 1e-3


def test_within_its_limits_a_row_is_exact():
    """However long the step: a linear model's own solution, to rounding."""
    inputs = 0.1 * commands()
    a = np.array(
        [[-CUTOFF, -CUTOFF * GAIN], [1.0 / INDUCTANCE, -RESISTANCE / INDUCTANCE]],
    )
    exact = linear_response(a, np.array([[CUTOFF * GAIN], [0.0]]), inputs, DT, "zoh")
    chosen = model(current_loop)
    found = BatchSimulator(chosen).trajectories(chosen.nominal, blank(chosen, inputs, DT), 1)[0]
    np.testing.assert_allclose(found, exact, atol=1e-12 * np.abs(exact).max())
    assert np.ptp(exact[:, 0]) > 0.01


def test_a_limit_changes_what_a_current_does():
    """Guards the tests above: their limits matter."""
    free, limited = solved(current_loop, 1e4)[2], solved(current_loop, 5.0)[2]
    assert np.abs(free - limited)[:, 1].max() > 0.1
