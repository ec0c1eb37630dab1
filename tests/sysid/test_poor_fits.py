"""What a model that explains little costs, and where stiffness is that hangs on starts."""

import math

import numpy as np
import pytest

from sysid import (
    GASSI,
    BatchSimulator,
    Dataset,
    Input,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    State,
)
from sysid.fitting.objective import Objective
from sysid.uncertainty import tracer
from tests.sysid.support import pendulum

DT, SAMPLES = 0.02, 400


def record_of(angle):
    torque = np.repeat(np.random.default_rng(1).uniform(-0.3, 0.3, SAMPLES // 20), 20)
    return Dataset(torque, angle, DT)


def objective(model, record):
    return Objective(BatchSimulator(model), SearchSpace.of(model), [record])


@pytest.mark.parametrize(("part", "little"), [(0.51, True), (0.49, False)])
def test_half_of_an_outputs_deviation_is_the_bound(part, little):
    angle = 3.0 + np.random.default_rng(0).normal(size=SAMPLES)
    angle[5] = np.nan
    target = objective(pendulum(), record_of(angle))
    deviation = np.nanstd(angle) / np.nanmax(np.abs(angle))
    assert target.explains_little(np.array([part * deviation])) == little


@pytest.mark.parametrize("explained", [False, True])
def test_ends_of_intervals_take_few_fits_where_a_model_explains_little(explained, monkeypatch):
    rng = np.random.default_rng(2)
    model = pendulum()
    record = record_of(np.cumsum(rng.normal(0.0, 0.1, SAMPLES)))  # no pendulum's
    if explained:
        angle = BatchSimulator(model).trajectories(model.nominal[None], record)[0, :, 0]
        record = record_of(angle + rng.normal(0.0, 0.01, SAMPLES))
    rounds = []
    refined = tracer.refine_each
    monkeypatch.setattr(
        tracer, "refine_each", lambda *args, **kwargs: rounds.append(1) or refined(*args, **kwargs)
    )
    fitted = GASSI(model, population=100, generations=10, random_state=0).fit(record)
    found = fitted.uncertainty(record)
    assert len(rounds) <= 3 * tracer._FEW
    assert not (explained and rounds), "and none where slopes tell"
    assert [estimate.name for estimate in found.parameters[:3]] == ["inertia", "viscous", "weight"]


def tank_derivative(x, u, p):
    flow, outlet = p
    return (flow * u[0] - outlet * math.sqrt(max(x[0], 1e-9)),)


def test_steps_are_those_of_the_start_that_is_estimated_and_not_of_the_declared_one():
    """An empty tank is stiff; one that is declared empty and begins full is not."""
    model = ProcessModel(
        "tank", (State("level", "m", initial_range=(0.0, 1.0)),), (Input("pump", "V", "zoh"),),
        (Output("level", "m"),),
        (
            Parameter("flow", "m/(V*s)", 0.05, 0.005, 0.5, "log"),
            Parameter("outlet", "m^0.5/s", 0.1, 0.01, 1.0, "log"),
        ),
        tank_derivative,
    )  # fmt: skip
    record = Dataset(np.full(200, 2.0), np.full(200, 0.9), 2.0)
    space = SearchSpace.of(model).with_starts([record])
    target = Objective(BatchSimulator(model), space, [record])
    full, empty = (np.array([[0.05, 0.1, level]]) for level in (0.8, 1e-9))
    assert target.steps_needed(full)[0, 0] <= 4
    assert target.steps_needed(empty)[0, 0] > 100
    # The same vector again, known by now, from the other start.
    assert target.steps_needed(np.concatenate([empty, full]))[:, 0].argmin() == 1
