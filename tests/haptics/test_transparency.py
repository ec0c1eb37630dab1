"""Free motion on the simulated rig: what is left of friction and inertia."""

import pytest
import yaml

from daq import analyse, record
from daq.logs.recording import load
from tests.daq.support import rig
from tests.haptics.test_torque_tracking import controller
from tests.protocols.closed_loop import SHIPPED

TO_AND_FRO = [[0.3 + 0.3 * k, 0.6 * (-1) ** k] for k in range(16)]


def experiment(folder, path, **changes):
    content = yaml.safe_load((SHIPPED / "transparency.yaml").read_text("utf-8"))
    content |= {"torque_controller": str(path), "block": 1.2, "calibration": {"samples": 400}}
    file = folder / "e.yaml"
    file.write_text(yaml.safe_dump({**content, **changes}))
    return file


@pytest.mark.soak
@pytest.mark.parametrize(("kind", "most"), [("feedforward", 35.0), ("lqg", 35.0)])
def test_little_is_left_of_friction_and_inertia(tmp_path, kind, most):
    path = experiment(tmp_path, controller(tmp_path, kind))
    run = record(path, "moving_hand.yaml", tmp_path, options={"hand": TO_AND_FRO})
    numbers = {n.name: n.value for n in analyse(run.path.parent).findings.numbers}
    assert numbers["torque_free"] > 0.005
    assert numbers["torque_left"] < most


@pytest.mark.soak
def test_blocks_without_commands_have_none(tmp_path):
    path = experiment(tmp_path, controller(tmp_path, "feedforward"))
    run = record(path, "moving_hand.yaml", tmp_path, options={"hand": TO_AND_FRO})
    log = load(run.path, ("controlled",)).frame
    # A command stands a tick behind the sample that it answers.
    free = log[(log.controlled == 0.0) & (log.controlled.shift(1, fill_value=0.0) == 0.0)]
    assert len(free) > 800 and not free.cmd_voltage_motor.any()
    assert log.controlled.diff().abs().max() < 0.02  # comes and goes without a jump


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"block": 0.5}, "block: 0.5 s hold no two periods at judged_to; make it 0.8 s"),
        ({"judged_to": 400}, "judged_to: it must be below half the sample rate"),
    ],
)
def test_mistakes_are_named_before_anything_moves(tmp_path, changes, words):
    experiment(tmp_path, "simulated_controller.yaml", **changes)
    done = rig("check", "e.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
