"""Two channels that have changed places in the log are named, where the model hides it well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete

from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.gassi import GASSI
from sysid.judging.examination import suspected, verdict_of

TRUTH = {"motor": 1e-3, "load": 2e-3, "stiffness": 20.0, "inner": 2e-3, "outer": 5e-3}
DT, N, NOISE = 2e-3, 750, 0.05


def parameter(name, unit):
    value = TRUTH[name]
    return Parameter(name, unit, 2.0 * value, value / 10.0, 10.0 * value, "log")


def rates(x, u, p):
    motor, load, stiffness, inner, outer = p
    shaft = stiffness * x[2] + inner * (x[0] - x[1])
    return ((u[0] - shaft - outer * x[0]) / motor, shaft / load, x[0] - x[1])


TWO_MASSES = ProcessModel(
    name="two masses",
    states=(State("omega_motor", "rad/s"), State("omega_load", "rad/s"), State("twist", "rad")),
    inputs=(Input("torque", "N*m"),),
    outputs=(Output("omega_motor", "rad/s"), Output("omega_load", "rad/s")),
    parameters=(
        parameter("motor", "kg*m^2"),
        parameter("load", "kg*m^2"),
        parameter("stiffness", "N*m/rad"),
        parameter("inner", "N*m*s/rad"),
        parameter("outer", "N*m*s/rad"),
    ),
    derivative=rates,
)


def record(seed, name):
    """By the exact discretisation of the linear equations."""
    p, rng = tuple(TRUTH.values()), np.random.default_rng(seed)
    a = np.array([rates(x, (0.0,), p) for x in np.eye(3)]).T
    b = np.array(rates((0.0, 0.0, 0.0), (1.0,), p))[:, None]
    step, push, *_ = cont2discrete((a, b, np.eye(3), np.zeros((3, 1))), DT)
    torque = np.repeat(rng.uniform(-0.5, 0.5, N // 25), 25)
    x = np.zeros((N, 3))
    for k in range(N - 1):
        x[k + 1] = step @ x[k] + push[:, 0] * torque[k]
    return Dataset(torque[:, None], x[:, :2] + NOISE * rng.standard_normal((N, 2)), DT, name)


def fitted(log):
    return GASSI(TWO_MASSES, population=60, generations=12).fit(log)


@pytest.mark.soak
def test_exchanged_speeds_are_named_with_what_the_parameters_become():
    logs = [record(seed, name) for seed, name in ((1, "training"), (2, "validation"))]
    training, validation = (replace(log, outputs=log.outputs[:, ::-1]) for log in logs)
    estimator = fitted(training)
    assert estimator.score(training) > 0.7 and estimator.parameters_["motor"] > 1.5 * TRUTH["motor"]
    verdict = verdict_of(estimator, [training], [validation])
    (reason, *_) = verdict.parameters.reasons
    assert reason.startswith("omega_motor and omega_load have changed places in the log")
    suspicion = suspected(estimator, estimator.uncertainty(training), [training])
    (finding,) = suspicion.findings
    became = {m.quantity.name: m.quantity.value + m.change for m in finding.moves}
    assert became["motor"] == pytest.approx(TRUTH["motor"], rel=0.02)


def test_speeds_in_their_places_are_left_there():
    training = record(1, "training")
    assert verdict_of(fitted(training), [training], [record(2, "validation")]).trust == "good"
