"""``rig tune``: from parameters and their covariance to a controller's file."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import haptics
from daq import tune
from daq.lookup.controllers import load_controller
from sim_rig.actuator import actuator
from tests.daq.support import rig

RIG = actuator(parameters="rig")
SETTINGS = {"controller": "feedforward", "sample_rate": 800}


def write(path, content):
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def result(folder, **rows):
    """A result of an identification whose parameters move together as each row says."""
    values = dict(zip(RIG.parameter_names, RIG.nominal.tolist(), strict=True))
    names = sorted({name for row in rows.values() for name in row})
    factor = [[row.get(name, 0.0) * values[name] for name in names] for row in rows.values()]
    parameters = {name: {"value": value} for name, value in values.items()}
    for name in names:
        parameters[name]["unit"] = RIG.parameter(name).unit
    covariance = {"parameters": names, "factor": factor}
    content = {"model": "actuator", "parameters": parameters, "covariance": covariance}
    return write(folder / "parameters.yaml", content)


def facts(tuning):
    return {fact.name: fact for fact in tuning.facts}


def test_what_acts_only_together_moves_together(tmp_path):
    """J_m up and J_b down by as much: the inertia is as well known as if both were."""
    shares = {"J_m": 0.3, "J_b": -0.3 * 7e-5 / 3.2e-5}
    file = result(tmp_path, tie={key: 0.1 * x for key, x in shares.items()}, K={"K_m": 0.02})
    tuned = facts(tune(write(tmp_path / "t.yaml", SETTINGS), file))
    low, high = tuned["inertia"].interval
    assert high - low < 0.02 * tuned["inertia"].value
    low, high = tuned["motor_constant"].interval
    assert (high - low) / tuned["motor_constant"].value == pytest.approx(4 * 0.02, rel=0.15)


@pytest.mark.soak
def test_operating_points_of_draws_go_to_python_control_with_their_ties(tmp_path):
    pytest.importorskip("control")
    shares = {"J_m": 0.3, "J_b": -0.3 * 7e-5 / 3.2e-5}
    tie = {key: 0.1 * x for key, x in shares.items()}
    tuning = tune(
        write(tmp_path / "torque.yaml", SETTINGS),
        result(tmp_path, tie=tie, spring={"alpha1": 0.05}),
        draws=6,
    )
    J_m, alpha1 = (tuning.draws[:, RIG.parameter_names.index(k)] for k in ("J_m", "alpha1"))
    points = [tuning.operating_points(draw=k) for k in range(6)]
    systems = [each[0].state_space() for each in points]
    omega, torque = (
        systems[0].state_labels.index("omega"),
        systems[0].input_labels.index("torque"),
    )
    inertias = np.array([1.0 / system.B[omega, torque] for system in systems])
    assert np.ptp(J_m) > 0.05 * J_m.mean() and np.ptp(inertias) < 0.01 * inertias.mean()
    # The brake's spring at its largest current, within the yield travel.
    springs = np.array([max(point.stiffness for point in each) for each in points])
    assert np.corrcoef(springs, alpha1)[0, 1] > 0.999


def test_friction_is_taken_off_up_to_the_speed_to_which_it_is_known(tmp_path):
    """A quarter of the residual torque in doubt; a rig that is known well has no such speed."""
    settings = write(tmp_path / "t.yaml", SETTINGS)
    vague = tune(settings, result(tmp_path, B={"B_m": 2.0}))
    low, high = np.percentile(vague.draws[:, RIG.parameter_names.index("B_m")], [2.5, 97.5])
    speed = 0.25 * facts(vague)["residual_torque"].value / (0.5 * (high - low))
    assert vague.control.friction_speed == pytest.approx(speed, rel=1e-3) and speed < 10.0
    for known in (result(tmp_path, K={"K_m": 0.02}), result(tmp_path)):
        assert tune(settings, known).control.friction_speed == 1000.0


@pytest.mark.soak
def test_no_more_inertia_is_taken_off_than_the_least_plausible_one(tmp_path):
    settings = write(tmp_path / "t.yaml", SETTINGS)
    wide = tune(settings, result(tmp_path, J={"J_m": 0.1, "J_b": 0.1}))
    low, _ = facts(wide)["inertia"].interval
    assert wide.control.inertia_share == pytest.approx(0.95 * low / 1.02e-4, rel=1e-3)
    assert wide.changes == {"inertia_share": (0.95, wide.control.inertia_share)}
    narrow = tune(settings, result(tmp_path, J={"J_m": 0.001}))
    assert narrow.control.inertia_share > 0.94


def test_draws_keep_the_models_constraints(tmp_path):
    """Half of the draws would have gamma below beta, which no Bouc-Wen brake of class 1 has."""
    file = result(tmp_path, shape={"gamma": 0.3})
    tuning = tune(write(tmp_path / "t.yaml", SETTINGS), file)
    gamma, beta = (RIG.parameter_names.index(name) for name in ("gamma", "beta"))
    assert 50 < len(tuning.draws) < 195
    assert np.all(tuning.draws[:, gamma] >= tuning.draws[:, beta])


def test_a_result_without_a_covariance_is_tuned_to_as_it_is(tmp_path):
    tuning = tune(write(tmp_path / "t.yaml", SETTINGS), result(tmp_path))
    tuning.save(tmp_path / "c.yaml")
    assert "covariance" not in tuning.document
    assert load_controller("c.yaml", tmp_path).plausible(3).shape == (0, len(RIG.nominal))


def test_a_controller_has_the_covariance_of_its_result(tmp_path):
    tuning = tune(write(tmp_path / "t.yaml", SETTINGS), result(tmp_path, K={"K_m": 0.02}))
    tuning.save(tmp_path / "c.yaml")
    drawn = load_controller("c.yaml", tmp_path).plausible(200)[:, RIG.parameter_names.index("K_m")]
    assert np.std(drawn) == pytest.approx(0.02 * 0.1412, rel=0.15)


def test_the_command_writes_what_it_shows(tmp_path):
    result(tmp_path, K={"K_m": 0.02})
    done = rig("tune", "torque.yaml", "--parameters", "parameters.yaml", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    written = yaml.safe_load((tmp_path / "controller.yaml").read_text("utf-8"))
    assert document.pop("file") == "controller.yaml"
    assert document == written
    assert written["settings"]["controller"] == "feedforward"
    assert written["parameters"]["K_m"] == pytest.approx(0.1412)
    assert "J_m" in written["without_interval"]
    shown = rig("tune", "torque.yaml", "--model", "actuator:parameters=rig", cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    assert "motor_constant" in shown.stdout and "within yield" in shown.stdout
    assert "No uncertainty is known" in shown.stdout


@pytest.mark.parametrize(
    ("content", "options", "words"),
    [
        (SETTINGS, [], "give --parameters PARAMETERS.yaml, or --model"),
        ({"controller": "lqg2"}, ["--model", "actuator"], "unknown controller 'lqg2'"),
        ({"sample_rate": 800}, ["--model", "actuator"], "controller: this key is missing"),
        ({**SETTINGS, "inertia_share": 1.2}, ["--model", "actuator"], "t.yaml:3:1: inertia_share"),
        ({"protocol": "prbs"}, ["--model", "actuator"], "this file holds an experiment"),
        (SETTINGS, ["--parameters", "none.yaml"], "none.yaml"),
    ],
)
def test_mistakes_are_named_with_their_cure(tmp_path, content, options, words):
    write(tmp_path / "t.yaml", content)
    done = rig("tune", "t.yaml", *options, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "controller.yaml").exists()


def test_a_model_that_is_no_actuator_is_refused(tmp_path):
    (tmp_path / "lag.py").write_text("from sysid.examples import lag\nmodel = lag()\n")
    write(tmp_path / "t.yaml", SETTINGS)
    done = rig("tune", "t.yaml", "--model", "lag.py:model", cwd=tmp_path)
    assert done.returncode == 2 and "entry point rig.models" in done.stderr


def test_the_shipped_controller_is_what_tune_makes_for_the_simulated_rig():
    made = tune("torque.yaml", model="actuator:parameters=rig").document
    path = Path(haptics.__file__).parent / "simulated_controller.yaml"
    shipped = yaml.safe_load(path.read_text("utf-8"))
    for document in (made, shipped):
        document.pop("software")
    again = "run: rig tune torque.yaml --model actuator:parameters=rig --out haptics/simulated_..."
    assert shipped == yaml.safe_load(yaml.safe_dump(made)), again
