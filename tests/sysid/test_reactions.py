"""Measured torques behind which an inertia turns: what they do between their samples."""

from dataclasses import replace

import numpy as np
import pytest

from sysid import GASSI, Dataset, Input, ModelError, Output, Parameter, ProcessModel, State
from sysid.fitting.reactions import with_reactions

LAG, INERTIA, BEHIND, DT, NOISE = 1e-3, 2.0, 0.1, 2e-3, 0.005
N = 800


def rotor(reaction):
    """A drive with a lag on an inertia, with a torque measured behind it."""
    return ProcessModel(
        name="rotor",
        states=(State("drive", "N*m"), State("omega", "rad/s")),
        inputs=(
            Input("command", "N*m"),
            Input("torque", "N*m", "foh", reaction=("omega", reaction) if reaction else None),
        ),
        outputs=(Output("omega", "rad/s"),),
        parameters=(Parameter("J", "kg*m^2", 1.5, 0.5, 5.0, "log"),),
        derivative=lambda x, u, p: ((u[0] - x[0]) / LAG, (x[0] + u[1]) / p[0]),
    )


def log(rng, noise):
    """Both inertias driven by steps, in closed form."""
    command = np.resize([1.0, -1.0], N) * rng.uniform(0.5, 1.5, N)
    drive, omega, fall = np.zeros(N), np.zeros(N), np.exp(-DT / LAG)
    for k in range(N - 1):
        away = drive[k] - command[k]
        drive[k + 1] = command[k] + away * fall
        omega[k + 1] = omega[k] + (command[k] * DT + away * LAG * (1.0 - fall)) / (INERTIA + BEHIND)
    torque = -BEHIND / (INERTIA + BEHIND) * drive
    measured = torque + noise * rng.standard_normal(N)
    outputs = omega + 1e-5 * rng.standard_normal(N)
    inputs = np.column_stack([command, measured])
    return Dataset(inputs, outputs, DT, input_noise=np.array([0.0, noise])), drive


def test_means_between_samples_are_those_of_the_load():
    record, drive = log(np.random.default_rng(0), 0.0)
    bent = with_reactions(rotor(BEHIND), record, np.array([INERTIA]), np.zeros(2))
    command = record.inputs[:, 0]
    mean = command + (drive - command) * LAG / DT * (1.0 - np.exp(-DT / LAG))
    means = -BEHIND / (INERTIA + BEHIND) * mean
    lines = 0.5 * (record.inputs[1:, 1] + record.inputs[:-1, 1])
    # Too much by the part that the inertia behind is: the free run is driven by lines.
    bends = (INERTIA + BEHIND) / INERTIA * (means[:-1] - lines)
    np.testing.assert_allclose(bent.between[:-1, 1], bends, atol=1e-5)
    assert np.abs(bends).max() > 0.015
    assert not bent.between[:, 0].any() and not bent.between[-1].any()


def test_an_input_without_a_reaction_stays_a_line():
    record, _ = log(np.random.default_rng(0), 0.0)
    assert with_reactions(rotor(0.0), record, np.array([INERTIA]), np.zeros(2)) is record
    with pytest.raises(ModelError, match="between has shape"):
        replace(record, between=np.zeros(3))


def test_an_inertia_is_right_where_its_torque_reacts():
    record, _ = log(np.random.default_rng(1), NOISE)
    settings = {"criterion": "innovations", "population": 8, "generations": 1, "random_state": 0}
    estimator = GASSI(rotor(BEHIND), **settings).fit([record])
    assert abs(estimator.parameters_["J"] / INERTIA - 1.0) < 0.002  # 0.02 with straight lines
