"""``rig replay`` as a gate, its figure, and the pytest plugin that labs use."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from daq import replay
from sim_rig.actuator import actuator
from sim_rig.plant import Plant
from tests.daq.support import environment, forked_rig, only_capture, write_experiment, write_rig
from tests.soak import mostly_soak

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "testing.md"


@pytest.fixture(scope="module")
def rig():
    with forked_rig() as run:
        yield lambda *args, cwd: run(args, cwd)


@pytest.fixture(scope="module")
def capture(tmp_path_factory, rig):
    root = tmp_path_factory.mktemp("captured")
    write_experiment(
        root / "my_prbs.yaml", duration=1.25, homing={"turns": 5}, calibration={"samples": 3200}
    )
    assert rig("run", "my_prbs.yaml", cwd=root).returncode == 0
    return only_capture(root)


def test_a_fit_below_its_bound_ends_with_status_1(rig, capture, tmp_path):
    asked = ["--fail-under", "omega=20", "--fail-under", "current_brake=99.9"]
    result = rig("replay", capture, *asked, cwd=tmp_path)
    assert result.returncode == 1
    assert re.search(r"fit of current_brake is \d\d\.\d %, below 99.9 %", result.stderr)
    assert "omega" not in result.stderr
    assert "current_motor" in result.stdout, "the metrics are shown all the same"


def test_a_gate_that_is_met_passes_and_says_so(rig, capture, tmp_path):
    figure = tmp_path / "both.pdf"
    result = rig("replay", capture, "--fail-under", "omega=20", "--figure", figure, "--json",
                 cwd=tmp_path)  # fmt: skip
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    assert document["passed"] is True
    assert document["fail_under"] == {"omega": 20.0}
    assert document["outputs"]["omega"]["fit_percent"] > 20.0
    assert document["figure"] == str(figure)
    assert figure.read_bytes().startswith(b"%PDF")


@pytest.mark.soak
def test_the_figure_is_written_beside_the_log(rig, capture, tmp_path):
    assert rig("replay", capture, cwd=tmp_path).returncode == 0
    assert (capture / "replay.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "message"),
    mostly_soak(
        [
            (["--fail-under", "omga=80"], "did you mean 'omega'"),
            (["--fail-under", "omega"], "write OUTPUT=PERCENT"),
            (["--fail-under", "omega=high"], "write OUTPUT=PERCENT"),
            (["--fail-under", "omega=nan"], "write OUTPUT=PERCENT"),
            (["--figure", "absent/figure.png"], "choose another with --figure"),
            (["--figure", "figure.docx"], "figures are written as"),
        ],
        always=4,
    ),
)
def test_a_mistake_is_answered_with_the_cure(rig, capture, tmp_path, options, message):
    result = rig("replay", capture, *options, cwd=tmp_path)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr


SHAFT = """
from sysid import Input, Output, Parameter, ProcessModel, State

model = ProcessModel(
    "shaft", (State("omega", "rad/s"),), (Input("applied_voltage_motor", "V"),),
    (Output("omega", "rad/s"),), (Parameter("tau", "s", 0.1, 0.01, 1.0),),
    lambda x, u, p: ((u[0] - x[0]) / p[0],),
)
"""

# --- models at their own values ---------------------------------------------------------------


def test_rows_of_a_table_side_by_side(rig, capture, tmp_path):
    sets = [f"actuator:parameters={name}" for name in "AC"]
    options = [word for name in sets for word in ("--model", name)]
    result = rig("replay", capture, *options, "--figure", "both.svg", "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    assert [each["parameters"] for each in document["models"]] == sets
    fits = [each["outputs"]["current_motor"]["fit_percent"] for each in document["models"]]
    # The rig's motor driver is of the order of row C; row A's settles with a fifth of its gain.
    assert fits[0] < 80.0 < fits[1] and document["passed"]
    figure = (tmp_path / "both.svg").read_text("utf-8")
    assert figure.count("<!-- A -->") == figure.count("<!-- C -->") == 1
    gate = ("--fail-under", "current_motor=80")
    failed = rig("replay", capture, *options, *gate, cwd=tmp_path)
    assert failed.returncode == 1 and failed.stderr.count("below 80 %") == 1
    assert f"({sets[0]})" in failed.stderr


@pytest.mark.soak
def test_the_model_and_fixed_values_of_a_configuration_count(rig, capture, tmp_path):
    model = actuator(parameters="rig")
    values = dict(zip(model.parameter_names, model.nominal.tolist(), strict=True))
    changed = values | {"L_m": 3e-3, "R_b": 100.0 * values["R_m"]}
    by_hand = {"model": "actuator", "parameters": changed}
    (tmp_path / "parameters.yaml").write_text(yaml.safe_dump(by_hand))
    settings = {"model": "actuator:parameters=rig", "fixed": {"L_m": "3 mH"},
                "tied": {"R_b": "100 * R_m"}}  # fmt: skip
    (tmp_path / "id.yaml").write_text(yaml.safe_dump(settings))
    expected, named, plain = (
        json.loads(rig("replay", capture, *options, "--json", cwd=tmp_path).stdout)
        for options in (("--parameters", "parameters.yaml"), ("--config", "id.yaml"), ())
    )
    assert named["outputs"] == expected["outputs"] != plain["outputs"]
    assert named["parameters"] == "actuator:parameters=rig"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--model", "actuator", "--parameters", "p.yaml"],
         "--model: a result names its own model; give --parameters or --model"),
        pytest.param(
            ["--model", "actuator", "--model", "shaft.py:model"],
            "shaft.py:model omega; choose the same ones",
            marks=pytest.mark.soak,  # another kernel
        ),
        (["--model", "actuator:parameters=Q"], "parameters=Q"),
        (["--config", "wrong.yaml"], "wrong.yaml:2:9: fixed.R_x: model actuator has no such name"),
    ],
)  # fmt: skip
def test_a_mistaken_model_is_answered_with_the_cure(rig, capture, tmp_path, options, message):
    (tmp_path / "wrong.yaml").write_text("model: actuator\nfixed: {R_x: 1}\n")
    (tmp_path / "shaft.py").write_text(SHAFT)
    result = rig("replay", capture, *options, cwd=tmp_path)
    assert result.returncode == 2 and "Traceback" not in result.stderr
    assert message in " ".join(result.stderr.split())


# --- faults of the connection -----------------------------------------------------------------


HOLD = '''
import numpy as np
from daq.experiment import Answer, ClosedLoop, Plan


class Count(ClosedLoop):
    """A command that tells which sample it answers."""

    def plan(self):
        return Plan(800, np.zeros(2), np.array([1.0, 0.0]))

    def controller(self):
        return self

    def answer(self, sample):
        return Answer(1e-3 * sample.tick, 0.0)
'''


def played(rig, tmp_path, limits=(), **faults):
    (tmp_path / "count.py").write_text(HOLD)
    content = {"protocol": "count.py:Count", "calibration": {"samples": 16}}
    (tmp_path / "count.yaml").write_text(yaml.safe_dump(content))
    write_rig(tmp_path / "rig.yaml", options={"faults": faults}, limits=dict(limits))
    assert rig("run", "count.yaml", "--rig", "rig.yaml", cwd=tmp_path).returncode == 0
    return pd.read_csv(only_capture(tmp_path) / "log.csv")


def test_late_commands_are_held_and_flagged_and_no_other_is_moved(rig, tmp_path):
    log = played(rig, tmp_path, late=0.05)
    held = (log["flags"] & 2) != 0
    assert 20 < held.sum() < 65  # of 800, a share of 5 % give or take four deviations
    asked, applied = log["cmd_voltage_motor"], log["applied_voltage_motor"]
    np.testing.assert_allclose(asked[1:], 1e-3 * np.arange(799))
    np.testing.assert_allclose(applied[~held], asked[~held], atol=1e-3)  # the converter's step
    before = applied.shift(1)
    np.testing.assert_array_equal(applied[held], before[held])


def test_lost_samples_leave_a_gap_that_is_flagged(rig, tmp_path):
    log = played(rig, tmp_path, {"lost": 0.1}, lost=0.05)
    gaps = np.diff(log["tick"], prepend=-1) > 1
    assert 20 < 800 - len(log) < 65
    np.testing.assert_array_equal((log["flags"] & 4) != 0, gaps)


# --- the plugin -------------------------------------------------------------------------------


def run_pytest(folder, *options):
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options],
        cwd=folder, env=environment(), capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


@pytest.fixture
def lab(tmp_path, capture):
    """A lab's folder with the example of the documentation."""
    (example,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL)
    (tmp_path / "test_my_rig.py").write_text(example)
    write_experiment(tmp_path / "my_prbs.yaml")
    (tmp_path / "log.csv").write_bytes((capture / "log.csv").read_bytes())
    truth = Plant().process_model()
    values = dict(zip(truth.parameter_names, truth.nominal.tolist(), strict=True))
    (tmp_path / "parameters.yaml").write_text(
        yaml.safe_dump({"model": "actuator", "parameters": values})
    )
    return tmp_path


@pytest.mark.soak
def test_the_documented_example_passes(lab):
    result = run_pytest(lab)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "2 passed" in result.stdout


@pytest.mark.soak
def test_a_rig_that_is_another_fails_and_the_seed_is_told(lab):
    values = yaml.safe_load((lab / "parameters.yaml").read_text("utf-8"))
    values["parameters"]["K_m"] *= 2.0
    (lab / "parameters.yaml").write_text(yaml.safe_dump(values))
    (lab / "test_my_rig.py").write_text(
        (lab / "test_my_rig.py").read_text("utf-8")
        + "\n\ndef test_that_fails(simulated_rig):\n"
        + "    run = simulated_rig.run('my_prbs.yaml')\n"
        + "    assert run.findings is not None\n"
    )
    result = run_pytest(lab, "--rig-seed", "5")
    assert result.returncode == 1
    assert "2 failed, 1 passed" in result.stdout
    assert "--rig-seed 5" in result.stdout


def test_a_model_of_a_file_is_replayed_at_its_own_values_and_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("lag.py").write_text("from sysid.examples import lag\nmodel = lag()\n")
    Path("fixed.yaml").write_text("model: lag.py:model\nfixed: {gain: 2.5}\n")
    table = pd.DataFrame({"t": 0.01 * np.arange(50), "u": np.ones(50), "y": np.linspace(0, 3, 50)})
    own = replay(table, model="lag.py:model")
    assert own.title == "lag at its own values"
    given = replay(table, config="fixed.yaml")
    assert given.title == "lag with values of fixed.yaml"
    assert given.simulated[-1] == pytest.approx(1.25 * own.simulated[-1])
