"""Measured torques behind which an inertia turns: what they do between their samples."""

from dataclasses import replace

import numpy as np
import pytest

from sysid import GASSI, Dataset, Input, ModelError, Output, Parameter, ProcessModel, State
from sysid.fitting.reactions import with_reactions
from sysid.judging.examination import suspected

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


def log(rng, noise, command=None):
    """Both inertias driven by steps, in closed form."""
    if command is None:
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


def log_of_means(seed):
    """As ``log``, of means of the speed over times that end within samples."""
    rng = np.random.default_rng(seed)
    command = np.repeat(rng.uniform(-1.5, 1.5, N // 2), 2)
    record, drive = log(rng, NOISE, command)
    fall = np.exp(-DT / LAG)
    speed = np.zeros(N)
    for k in range(N - 1):
        area = command[k] * DT + (drive[k] - command[k]) * LAG * (1.0 - fall)
        speed[k + 1] = speed[k] + area / (INERTIA + BEHIND)

    def way(k, time):
        """The angle's change in a time from sample k on."""
        away = (drive[k] - command[k]) * LAG
        whole = 0.5 * command[k] * time**2 + away * (time - LAG * (1.0 - np.exp(-time / LAG)))
        return speed[k] * time + whole / (INERTIA + BEHIND)

    before = np.arange(N - 1)
    begin, end = rng.uniform(0.0, 0.2, N - 1) * DT, rng.uniform(0.4, 0.6, N - 1) * DT
    means = np.append(0.0, (way(before, end) - way(before, begin)) / (end - begin))
    windows = np.zeros((N, 1, 2))
    windows[1:, 0] = np.column_stack([begin, end]) - DT
    means += 1e-5 * rng.standard_normal(N)
    return replace(record, outputs=means[:, None], windows=windows)


@pytest.mark.soak
def test_what_runs_between_samples_is_no_fault_of_a_channel():
    """Torques are no straight lines there, and a speed whose drive steps is no parabola."""
    record = log_of_means(0)
    settings = {"criterion": "innovations", "population": 8, "generations": 1, "random_state": 0}
    estimator = GASSI(rotor(BEHIND), **settings).fit([record])
    assert abs(estimator.parameters_["J"] / INERTIA - 1.0) < 0.002
    suspicion = suspected(estimator, estimator.uncertainty([record]), [record])
    assert suspicion.findings == ()
