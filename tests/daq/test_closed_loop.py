"""Closed-loop protocols of a user's own file: every sample answered, alignment, ends, findings."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pandas as pd
import pytest
import yaml

from tests.daq.support import only_capture, record_of, rig, write_rig
from tests.soak import mostly_soak

PROTOCOL = '''
import numpy as np
from daq.experiment import Answer, ClosedLoop, Plan
from daq.findings import Axis, Chart, Findings, Number, Series, Table


class Spring(ClosedLoop):
    """Pulls the shaft towards an angle that rises."""

    columns = {"theta_ref": "rad"}

    stiffness: float
    ends_at: int = 100
    most: int = 200
    fails_at: int = -1

    def plan(self):
        return Plan(self.most, np.array([-1.0, 0.0]), np.array([1.0, 0.0]))

    def controller(self):
        return Control(self)

    def findings(self, samples, extra):
        if len(samples) < 50:
            raise ValueError("fewer than 50 samples")
        table = Table("angle", "Angle", {"time": samples.time, "theta": samples.theta},
                      {"time": "s", "theta": "rad"})
        series = Series("measured", samples.time, samples.theta)
        error = float(np.mean(samples.theta - extra["theta_ref"]))
        return Findings(
            (Number("error", error, "rad"), Number("stiffest", 12.0, "N*m/rad")), (table,),
            (Chart("angle", "Angle", Axis("time", "s"), Axis("angle", "rad"), (series,)),),
            {"K_m": (0.1, 0.2)},
        )


class Control:
    def __init__(self, settings):
        self.settings = settings

    def answer(self, sample):
        if sample.tick == self.settings.fails_at:
            raise KeyError("oops")
        if sample.tick >= self.settings.ends_at:
            return None
        reference = 0.001 * sample.tick
        pull = self.settings.stiffness * (reference - sample.theta)
        return Answer(min(max(pull, -1.0), 1.0), 0.0, (reference,))
'''


@pytest.fixture
def run(tmp_path):
    (tmp_path / "spring.py").write_text(PROTOCOL)
    write_rig(tmp_path / "rig.yaml")

    def run(*options, **changes):
        content = {"protocol": "spring.py:Spring", "sample_rate": 800, "stiffness": 2.0,
                   "calibration": {"samples": 16}} | changes  # fmt: skip
        (tmp_path / "spring.yaml").write_text(yaml.safe_dump(content))
        return rig("run", "spring.yaml", "--rig", "rig.yaml", *options, cwd=tmp_path)

    return run


def log_of(root):
    return pd.read_csv(only_capture(root) / "log.csv")


@pytest.mark.parametrize("ahead", mostly_soak([3, 1]))
def test_every_sample_is_answered_so_many_ticks_later(run, tmp_path, ahead):
    result = run(ahead=ahead)
    assert result.returncode == 0, result.stderr
    log = log_of(tmp_path)
    assert log["tick"].tolist() == list(range(101))
    np.testing.assert_allclose(log["theta_ref"][:100], 0.001 * np.arange(100))
    answers = np.clip(2.0 * (log["theta_ref"] - log["theta"]), -1.0, 1.0)
    np.testing.assert_allclose(log["cmd_voltage_motor"][ahead:100], answers[: 100 - ahead])
    assert not log["cmd_voltage_motor"][:ahead].any()
    assert log["theta"].iloc[-1] > 0.01, "the shaft has followed"
    assert not log["flags"].any()


def test_no_answer_is_planned_further_ahead_than_the_device_can_hold(run, tmp_path):
    (tmp_path / "small.py").write_text(
        "import dataclasses\nfrom sim_rig.backend import SimulatedDevice\n\n\n"
        "class Small(SimulatedDevice):\n    def open(self):\n"
        "        return dataclasses.replace(super().open(), queue=2)\n"
    )
    write_rig(tmp_path / "rig.yaml", backend="small.py:Small")
    result = run(ahead=3)
    assert result.returncode == 1 and "set ahead to 2 or less" in " ".join(result.stderr.split())
    assert len(log_of(tmp_path)) == 0


def test_the_plan_bounds_a_controller_that_does_not_end(run, tmp_path):
    assert run(ends_at=10_000).returncode == 0
    assert len(log_of(tmp_path)) == 200


def test_a_protocol_that_fails_leaves_its_log_and_says_where(run, tmp_path):
    result = run(fails_at=40)
    assert result.returncode == 1
    assert "spring.py:Spring" in result.stderr
    assert "sample 40" in result.stderr
    assert "KeyError" in result.stderr
    assert "Traceback" not in result.stderr
    record = record_of(only_capture(tmp_path))
    assert record["status"] == "failed"
    assert "sample 40" in record["reason"]
    assert len(log_of(tmp_path)) == 40


def test_what_the_protocol_concludes_is_written_and_shown(run, tmp_path):
    document = json.loads(run("--json").stdout)
    log = log_of(tmp_path)
    error = np.mean(log["theta"] - log["theta_ref"])
    assert document["findings"]["numbers"]["error"]["value"] == pytest.approx(error)
    results = only_capture(tmp_path) / "results"
    table = pd.read_csv(results / "angle.csv")
    np.testing.assert_array_equal(table["theta"], log["theta"])
    assert (results / "angle.png").stat().st_size > 1000
    assert yaml.safe_load((results / "ranges.yaml").read_text())["ranges"] == {"K_m": [0.1, 0.2]}
    folder = only_capture(tmp_path).relative_to(tmp_path)
    again = rig("analyse", folder, "--trust", "--json", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout) == document["findings"]
    printed = rig("analyse", folder, "--trust", cwd=tmp_path).stdout
    assert re.search(r"stiffest +12 +- ", printed), "no digits that it does not have"
    rig_file = record_of(tmp_path / folder)["rig_file"]
    assert f"Next: rig run prbs.yaml --rig {rig_file} --identify --config " in printed


def test_a_run_from_which_nothing_follows_says_why(run, tmp_path):
    result = run(ends_at=20)
    assert result.returncode == 0
    assert "fewer than 50 samples" in result.stderr
    assert not (only_capture(tmp_path) / "results").exists()


@pytest.mark.parametrize(
    ("protocol", "message"),
    [
        ("spring.py:Sprung", "did you mean 'Spring'"),
        ("spring.py:Control", "is no protocol"),
        ("absent.py:Spring", "no such protocol file"),
    ],
)
def test_a_protocol_that_is_not_there_is_answered_with_the_line(run, protocol, message):
    result = run(protocol=protocol)
    assert result.returncode == 2
    assert message in result.stderr
    assert "spring.yaml:" in result.stderr


def test_commands_beyond_the_rig_are_refused_before_anything_moves(run, tmp_path):
    write_rig(tmp_path / "rig.yaml", limits={"command": {"motor": [-0.5, 0.5]}})
    result = run()
    assert result.returncode == 2
    assert "motor: the plan asks up to 1 V" in result.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.soak
def test_an_excitation_concludes_nothing(run, tmp_path):
    assert run().returncode == 0
    folder = only_capture(tmp_path)
    record = json.loads((folder / "run.json").read_text("utf-8"))
    assert not math.isnan(record["experiment"]["stiffness"])
    record["experiment"]["protocol"] = "prbs"
    (folder / "run.json").write_text(json.dumps(record))
    result = rig("analyse", folder, cwd=tmp_path)
    assert result.returncode == 2
    assert "run.json" in result.stderr
