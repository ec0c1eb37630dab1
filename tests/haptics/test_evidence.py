"""Trials before a run: against theory, against the simulated rig, and what they refuse."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import sim_rig
from daq import record
from daq.config.rig import RigConfig
from daq.errors import InterlockError
from daq.experiment import TripLimits
from daq.lookup.controllers import load_controller
from daq.lookup.experiments import load_experiment
from daq.recording.preview import trip_limits
from haptics import trial
from haptics.dynamics import ActuatorDynamics
from haptics.evidence import (
    HAND,
    HAND_RANGE,
    STIFFEST_HAND,
    Outcomes,
    family_margins,
    run_trials,
    weigh,
)
from haptics.linear_loop import LinearLaw, loop_margins
from haptics.passivity import Hands, Passivity, Tracker
from protocols.analysis.walls import SampledWall
from protocols.control.loop import tracker_gains
from tests.daq.support import rig
from tests.haptics.test_torque_tracking import controller, experiment
from tests.protocols.closed_loop import SHIPPED

LIMITS = TripLimits(2.4, 0.21, 100.0, 3.5, (-5.0, 5.0), (0.0, 0.38), 2.0 * np.pi / 8192.0)
LIGHT = {"K_u": 0.08, "B_u": 0.009}  # half a hand


def walls(folder, path, **changes):
    content = yaml.safe_load((SHIPPED / "virtual_wall.yaml").read_text("utf-8"))
    file = folder / "walls.yaml"
    file.write_text(yaml.safe_dump({**content, "torque_controller": str(path), **changes}))
    return file


@pytest.fixture(scope="module")
def static(tmp_path_factory):
    folder = tmp_path_factory.mktemp("evidence")
    path = controller(folder, "static", allocation="motor")
    return folder, path, load_controller(str(path), folder)


def trials(tuned, file, draws, limits=LIMITS):
    settings = load_experiment(str(file)).experiment
    program = tuned.control.program(tuned.model, tuned.parameters)
    return run_trials(tuned, program, settings.scenes(), limits, draws)


@pytest.mark.soak
def test_soft_walls_rest_and_those_above_the_critical_stiffness_do_not(static):
    """Between the two a light hand bounces off, in and out, where a linear loop would settle."""
    folder, path, tuned = static
    for scale, decided in ((0.1, False), (1.6, True)):
        stiffness = scale * critical_stiffness(0.005)
        file = walls(folder, path, stiffnesses=[stiffness], dampings=[0.005], brake_commands=[0.0])
        outcomes = trials(tuned, file, 40)
        lightest = outcomes.hands[:, 0] < 0.3 * HAND[0]
        assert lightest.sum() > 2
        restless = (outcomes.restless | outcomes.left)[lightest]
        assert restless.all() if decided else not restless.any()


def critical_stiffness(damping):
    """By eigenvalues, in the lightest of hands."""
    body = 1.02e-4, 2e-4 + HAND[1] / 4.0, HAND[0] / 4.0
    return SampledWall(*body, 1.0 / 800.0, 1, 150.0).critical_stiffness(damping)


@pytest.mark.soak
def test_a_limit_ends_the_trials_that_reach_it(static):
    folder, path, tuned = static
    file = experiment(folder, path, duration=4.0)
    free = trials(tuned, file, 12)
    assert free.tripped.sum() == 0 and not free.restless.any()
    fastest = free.results[:, 4]
    low = TripLimits(2.4, 0.21, float(np.median(fastest)), 3.5, (-5, 5), (0, 0.38), LIMITS.count)
    assert trials(tuned, file, 12, low).tripped.tolist() == [0, 0, 6, 0]


def test_trials_end_at_the_first_tenth_that_decides(static):
    folder, path, tuned = static
    scenes = load_experiment(str(experiment(folder, path, duration=4.0))).experiment.scenes()
    program = tuned.control.program(tuned.model, tuned.parameters)
    low = replace(LIMITS, speed=5.0)
    weighed = []

    def enough(outcomes):
        weighed.append(len(outcomes.results))
        return bool(outcomes.failures())

    outcomes = run_trials(tuned, program, scenes, low, 300, enough=enough)
    assert weighed == [32] and len(outcomes.results) == len(outcomes.hands) == 32
    evidence = weigh(outcomes, family_margins(tuned), 300, spread=False)
    assert " of the first 32 simulated trials trip speed" in evidence.refusal
    whole = run_trials(tuned, program, scenes, low, 300)
    assert np.array_equal(whole.results[:32], outcomes.results) and len(whole.results) == 300


def test_a_small_disk_margin_is_explained_and_a_robust_loop_is_not_warned_of(tmp_path):
    """The inverse takes friction off a sample late, which a light hand hardly stands."""
    outcomes = Outcomes(np.zeros((1, trial.RESULT)), np.zeros((1, 2)))
    remarks = {}
    for name in ("static", "feedforward", "lqg"):
        tuned = load_controller(str(controller(tmp_path, name)), tmp_path)
        evidence = weigh(outcomes, family_margins(tuned), 1, spread=True)
        assert not evidence.refusal
        remarks[name] = " ".join(evidence.remarks)
    assert remarks["static"] == remarks["lqg"] == ""
    assert "disk margin of 0.059 (within yield, in a hand of 0.25 times" in remarks["feedforward"]
    # (2 - d) / (2 + d) of the gain, and 2 atan(d / 2) of the phase.
    assert "a gain that is off by 5.7 % or a phase by 3.4 degrees" in remarks["feedforward"]


def test_a_law_that_feeds_nothing_back_has_all_margins(static):
    _, _, tuned = static
    law = LinearLaw.of(tuned.control.program(tuned.model, tuned.parameters), tuned.model)
    margins = loop_margins(law, ActuatorDynamics(tuned.model), "within yield", HAND, 1.0 / 800.0, 1)
    assert margins.stable and margins.sensitivity == pytest.approx(1.0)
    assert margins.disk == pytest.approx(2.0)


@pytest.mark.soak
def test_rig_check_tells_trials_and_refuses_what_trips(static):
    folder, path, _ = static
    file = experiment(folder, path, duration=4.0)
    options = ["--draws", "50", "--rig", "moving_hand.yaml", "--json"]
    done = rig("check", file.name, *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)["trials"]
    assert told["trials"] == 50 and told["tripped"] == 0 and told["disk_margin"] == pytest.approx(2)
    assert "No uncertainty" in told["remarks"][0]
    slow = yaml.safe_load((Path(sim_rig.__file__).parent / "moving_hand.yaml").read_text("utf-8"))
    slow["limits"]["speed"] = 5.0
    (folder / "slow.yaml").write_text(yaml.safe_dump(slow))
    refused = rig("check", file.name, "--draws", "50", "--rig", "slow.yaml", cwd=folder)
    assert (
        refused.returncode == 2 and "of the first 16 simulated trials trip speed" in refused.stderr
    )
    done = rig("check", file.name, "--draws", "0", "--rig", "slow.yaml", cwd=folder)
    assert done.returncode == 0, done.stderr


def test_a_spread_of_the_parameters_is_in_the_trials(static):
    folder, path, _ = static
    content = yaml.safe_load((folder / path).read_text("utf-8"))
    content["covariance"] = {"parameters": ["K_m", "J_m"], "factor": [[0.01, 0.0], [0.0, 1e-5]]}
    (folder / "spread.yaml").write_text(yaml.safe_dump(content))
    tuned = load_controller("spread.yaml", folder)
    drawn = tuned.plausible(400)
    place = tuned.model.parameter_names.index("K_m")
    assert drawn.shape == (400, len(tuned.parameters))
    assert np.std(drawn[:, place]) == pytest.approx(0.01, rel=0.15)
    content["covariance"]["parameters"] = ["K_m", "nonsense"]
    (folder / "spread.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(Exception, match="no covariance of the model's parameters"):
        load_controller("spread.yaml", folder)


@pytest.mark.soak
def test_what_is_refused_trips_on_the_simulated_rig(tmp_path):
    """Walls by the inverse, which takes inertia off: these ring against the current's limit."""
    stiff = {"stiffnesses": [12, 16], "dampings": [0.04, 0.05], "brake_commands": [0.0]}
    file = walls(tmp_path, controller(tmp_path, "feedforward"), **stiff)
    done = rig("check", file.name, "--rig", "hand.yaml", "--draws", "100", cwd=tmp_path)
    assert done.returncode == 2 and "simulated trials trip current_motor" in done.stderr
    ended = 0
    for seed in range(4):
        plant = {"load": "hand", "parameters": LIGHT}
        try:
            record(file, "hand.yaml", tmp_path, options={"seed": seed, "plant": plant})
        except InterlockError:
            ended += 1
    assert ended >= 2


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["feedforward", "lqg"])
def test_what_is_let_through_trips_on_no_fresh_rig(tmp_path, kind):
    path = controller(tmp_path, kind)
    file = experiment(tmp_path, path, duration=2.0)
    words = ["check", file.name, "--rig", "moving_hand.yaml", "--draws", "300"]
    done = rig(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rng = np.random.default_rng(3)
    for seed in range(4):
        grip = float(4.0 ** rng.uniform(-1.0, 1.0))
        plant = {"load": "hand", "parameters": {"K_u": 0.16 * grip, "B_u": 0.0179 * grip}}
        options = {"seed": seed, "plant": plant}
        run = record(file, "moving_hand.yaml", tmp_path / "runs", options=options)
        assert run.record["status"] == "completed"


def test_limits_are_those_of_the_rig():
    limits = trip_limits(RigConfig(backend="simulated"))
    assert (limits.current_brake, limits.speed) == (0.21, float("inf"))
    assert limits.count == pytest.approx(2.0 * np.pi / 8192.0)


@pytest.mark.soak
def test_no_promised_wall_rings_on_hundreds_of_plausible_actuators(static):
    """A wall just below the promise, in hands from 1/4 to 4 times that of (A.2)."""
    folder, path, _ = static
    content = yaml.safe_load((folder / path).read_text("utf-8"))
    names = ["K_m", "J_m", "B_m", "alpha0", "c0", "R_m"]
    spread = np.diag([0.05 * content["parameters"][name] for name in names])
    content["covariance"] = {"parameters": names, "factor": spread.tolist()}
    (folder / "wide.yaml").write_text(yaml.safe_dump(content))
    tuned = load_controller("wide.yaml", folder)
    tracker = Tracker(*tracker_gains(150.0, 1.0 / 800.0))
    actuators = np.concatenate([tuned.parameters[None], tuned.plausible(100)])
    hands = Hands(HAND[1] / HAND_RANGE, STIFFEST_HAND)
    stiffness = Passivity(tuned, tracker, actuators, hands).springs_promised()
    wall = {"stiffnesses": [stiffness], "dampings": [0.0]}
    rest = {"stiffness": stiffness, "damping": 0.0, "time": 0.4}
    file = walls(folder, folder / "wide.yaml", **wall, rest=rest, brake_commands=[0.0])
    outcomes = trials(tuned, file, 300)
    assert not outcomes.restless.any() and not outcomes.left.any()


@pytest.mark.soak
def test_a_wall_by_the_static_controller_is_that_of_volts_by_a_constant(tmp_path):
    """Both give torque by constants alone: the same walls, but for the amplifier's gain."""
    folder, path = tmp_path, controller(tmp_path, "static", allocation="motor")
    few = {"stiffnesses": [2.0], "dampings": [0.01], "brake_commands": [0.0]}
    depths = []
    for chosen in (path, ""):
        file = walls(folder, chosen, **few, calibration={"samples": 400})
        run = record(file, "hand.yaml", folder / "runs", options={"ideal": True})
        depths.append(run.frame.theta.to_numpy())
    n = min(map(len, depths))
    assert n > 1000 and np.abs(depths[0][:n] - depths[1][:n]).max() < 0.02


@pytest.mark.soak
def test_rig_check_tells_which_walls_are_passive(static):
    folder, path, _ = static
    file = walls(folder, path, stiffnesses=[0.2], dampings=[6e-5], brake_commands=[0.0])
    options = ["--draws", "20", "--rig", "hand.yaml", "--json"]
    done = rig("check", file.name, *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    trials_of_check = json.loads(done.stdout)["trials"]
    assert 0.2 < trials_of_check["passive_stiffness"] < 0.24
    assert 2.4 < trials_of_check["held_stiffness"] < 2.6
    assert "in any passive hand" in trials_of_check["remarks"][-2]
    assert "that damps by 0.0045 N*m*s/rad or more" in trials_of_check["remarks"][-1]
