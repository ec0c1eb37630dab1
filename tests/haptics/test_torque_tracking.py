"""A torque at a moving hand: what controllers make of it on the simulated rig."""

import pytest
import yaml

from daq import analyse, record, tune
from tests.daq.support import rig
from tests.protocols.closed_loop import SHIPPED

MOTION = [[0.4, 1.0], [0.9, -1.0], [1.5, 1.5], [2.0, 0.5]]
MODEL = "actuator:parameters=rig"


def controller(folder, kind, **settings):
    file = folder / f"{kind}_settings.yaml"
    file.write_text(yaml.safe_dump({"controller": kind, **settings}))
    path = folder / f"{kind}.yaml"
    tune(file, model=MODEL).save(path)
    return path


def experiment(folder, path, **changes):
    content = yaml.safe_load((SHIPPED / "torque_tracking.yaml").read_text("utf-8"))
    content |= {"torque_controller": str(path), "duration": 2.0, "calibration": {"samples": 400}}
    file = folder / "e.yaml"
    file.write_text(yaml.safe_dump({**content, **changes}))
    return file


def results(folder, path, grip=1.0, **changes):
    """Results of a run by name; grip: the hand's stiffness and damping in parts of (A.2)'s."""
    hand = {"K_u": 0.1602 * grip, "B_u": 0.0179 * grip}
    options = {"plant": {"load": "hand", "parameters": hand}, "hand": MOTION}
    run = record(experiment(folder, path, **changes), "moving_hand.yaml", folder, options=options)
    return {number.name: number.value for number in analyse(run.path.parent).findings.numbers}


@pytest.fixture(scope="module")
def static_error(tmp_path_factory):
    folder = tmp_path_factory.mktemp("static")
    return results(folder, controller(folder, "static"))["error_rms"]


@pytest.mark.soak
@pytest.mark.parametrize("allocation", ["heating", "stiction", "motor"])
def test_the_inverse_errs_less_than_half_of_the_static_one(tmp_path, static_error, allocation):
    path = controller(tmp_path, "feedforward", allocation=allocation)
    inverse = results(tmp_path, path)
    assert inverse["speed"] > 5.0
    assert inverse["error_rms"] < 0.5 * static_error


@pytest.mark.soak
def test_a_brake_saves_the_motor_current_and_gives_the_same_torque(tmp_path):
    logs = {}
    for name in ("heating", "motor"):
        path = controller(tmp_path, "feedforward", allocation=name)
        options = {"hand": MOTION, "ideal": True}
        run = record(experiment(tmp_path, path), "moving_hand.yaml", tmp_path, options=options)
        logs[name] = run.frame
    heat = {
        name: (1.18 * log.current_motor**2 + 126.0 * log.current_brake**2).mean()
        for name, log in logs.items()
    }
    assert logs["motor"].cmd_voltage_brake.max() == 0.0
    assert logs["heating"].cmd_voltage_brake.min() >= 0.0
    assert heat["heating"] < 0.97 * heat["motor"]


def test_a_run_of_the_command_logs_reference_and_torque(tmp_path):
    controller(tmp_path, "feedforward")
    path = experiment(tmp_path, "feedforward.yaml", duration=1.0, fade=0.2)
    done = rig("run", path.name, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (log,) = tmp_path.glob("runs/*/log.csv")
    assert log.read_text("utf-8").partition("\n")[0].endswith("torque_ref")


def test_a_sensor_that_is_listened_to_is_said_to_be_no_judge(tmp_path):
    for kind in ("feedforward", "lqg"):
        controller(tmp_path, kind)
        experiment(tmp_path, f"{kind}.yaml")
        done = rig("check", "e.yaml", "--draws", "0", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert ("listens to the torque sensor" in done.stdout) == (kind == "lqg")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sample_rate": 400}, "sample_rate: 400, but feedforward.yaml was tuned for 800"),
        ({"ahead": 2}, "ahead: 2, but feedforward.yaml was tuned for 1"),
        ({"torque_controller": "none.yaml"}, "none.yaml: there is no such file; make it with rig"),
        ({"torque_controller": "e.yaml"}, "settings: this key is missing; no file that rig tune"),
        ({"band": [0.1, 500]}, "band: [0.1, 500] Hz"),
        ({"fade": 1.0}, "fade: twice 1 s is no less than the duration"),
    ],
)
def test_mistakes_are_named_before_anything_moves(tmp_path, changes, words):
    controller(tmp_path, "feedforward")
    experiment(tmp_path, "feedforward.yaml", **changes)
    done = rig("check", "e.yaml", cwd=tmp_path)
    assert done.returncode == 2, done.stdout
    assert words in done.stderr and "Traceback" not in done.stderr
