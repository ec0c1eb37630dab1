"""Equations that switch: dry friction written as a sign, which starts where it jumps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sysid import BatchSimulator, Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.gassi import GASSI
from sysid.problem.space import SearchSpace

MASS, FRICTION, OFFSET = 2.0, 3.0, 0.4


def branching(v):
    return 1.0 if v > 0.0 else -1.0 if v < 0.0 else 0.0


def copied(v):
    return math.copysign(1.0, v)


def limited(v):
    return max(-1.0, min(1.0, v / 1e-5))


def sledge(sign):
    """A mass on rails, pushed by a held force; only its position is measured."""

    def derivative(x, u, p):
        _, v = x
        mass, friction, offset = p
        return (v, (u[0] - offset - friction * sign(v)) / mass)

    return ProcessModel(
        "sledge",
        (State("position", "m"), State("v", "m/s")),
        (Input("force", "N"),),
        (Output("position", "m"),),
        (
            Parameter("mass", "kg", 5.0, 0.5, 20.0, "log"),
            Parameter("friction", "N", 1.0, 0.3, 10.0, "log"),
            Parameter("offset", "N", 0.0, -2.0, 2.0, minimum=-5.0),
        ),
        derivative,
    )


def slide(forces, dt):
    """Positions at the samples in closed form: parabolas from one stop to the next."""
    position = v = 0.0
    positions = []
    for force in forces:
        positions.append(position)
        left, net = dt, force - OFFSET
        while left > 0.0:
            if v == 0.0 and abs(net) <= FRICTION:
                break
            direction = math.copysign(1.0, v if v != 0.0 else net)
            a = (net - direction * FRICTION) / MASS
            stop = -v / a if v * a < 0.0 else math.inf
            time = min(left, stop)
            position += v * time + 0.5 * a * time * time
            v = 0.0 if stop <= left else v + a * time
            left -= time
    return np.array(positions)


def pushed(n=3000, dt=1e-3, seed=2):
    levels = np.random.default_rng(seed).uniform(-9.0, 9.0, n // 150)
    forces = np.repeat(levels, 150)
    return Dataset(forces, slide(forces, dt), dt)


@pytest.mark.soak
@pytest.mark.parametrize("sign", [branching, copied])
def test_a_sign_that_jumps_at_the_start_is_no_endless_rate(sign):
    record = pushed()
    truth = np.array([[MASS, FRICTION, OFFSET]])
    result = BatchSimulator(sledge(sign)).errors(truth, [record])
    rms = math.sqrt(result.sse[0, 0, 0] / record.n_samples)
    assert rms < 2e-3 * np.abs(record.outputs).max()
    assert result.steps[0] <= 4 * record.n_samples


@pytest.mark.soak
def test_beyond_a_narrow_limit_of_a_hidden_state_the_position_is_right():
    record = pushed()
    truth = np.array([[MASS, FRICTION, OFFSET]])
    result = BatchSimulator(sledge(limited)).errors(truth, [record])
    rms = math.sqrt(result.sse[0, 0, 0] / record.n_samples)
    assert rms < 2e-3 * np.abs(record.outputs).max()


@pytest.mark.soak
def test_refinement_sees_past_the_steps_that_switching_makes():
    record = pushed()
    model = sledge(branching)
    target = Objective(BatchSimulator(model), SearchSpace.of(model), [record])
    found = refine(target, np.array([2.4, 2.6, 0.3]))
    np.testing.assert_allclose(found.chromosome, [MASS, FRICTION, OFFSET], rtol=2e-2)


@pytest.mark.soak
def test_dry_friction_is_identified_from_the_whole_box():
    found = GASSI(sledge(copied), population=60, generations=15).fit(pushed())
    expected = {"mass": MASS, "friction": FRICTION, "offset": OFFSET}
    assert found.parameters_ == pytest.approx(expected, rel=1e-2)
