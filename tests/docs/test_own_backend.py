"""The backend of the documentation, from its own text, on the shipped experiment."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.daq.support import only_capture, rig, write_experiment

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "own-backend.md"


@pytest.fixture
def lab(tmp_path):
    text = DOCUMENT.read_text(encoding="utf-8")
    code, suite = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (settings,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "my_board.py").write_text(code)
    (tmp_path / "test_my_board.py").write_text(suite)
    (tmp_path / "my_rig.yaml").write_text(settings)
    write_experiment(tmp_path / "e.yaml")
    return tmp_path


def test_it_runs_and_its_rows_are_latched_before_they_are_applied(lab):
    result = rig("run", "e.yaml", "--rig", "my_rig.yaml", "--json", cwd=lab)
    assert result.returncode == 0, result.stderr
    log = pd.read_csv(only_capture(lab) / "log.csv")
    assert len(log) == 400 and not log["flags"].any()
    keep, per_volt = np.exp(-1.0 / (800.0 * 0.005)), 0.5  # the rig's default A per volt
    applied, current = log["applied_voltage_motor"], log["current_motor"] / per_volt
    predicted = keep * current + (1.0 - keep) * applied
    np.testing.assert_allclose(current[1:], predicted[:-1], atol=1e-12)
    assert json.loads((only_capture(lab) / "run.json").read_text("utf-8"))["device"] == "my board"


def test_it_passes_what_every_backend_passes(lab):
    command = [sys.executable, "-m", "pytest", "-n", "0", "-rs", "test_my_board.py"]
    result = subprocess.run(command, cwd=lab, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout
    skipped = re.findall(r"SKIPPED .*: (.*)", result.stdout)
    assert set(skipped) == {"my board watches no encoder"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("my_board.py:Board", "my_board.py:Bored", "did you mean 'Board'"),
        (
            "my_board.py:Board",
            "my_board.py:Settings",
            "is no backend; make it a class with Options",
        ),
        ("my_board.py:Board", "his_board.py:Board", "there is no such backend file"),
        ("5 ms", "5 mV", "time_constant"),
    ],
)
def test_a_mistake_in_naming_it_is_answered(lab, old, new, message):
    path = lab / "my_rig.yaml"
    path.write_text(path.read_text("utf-8").replace(old, new))
    result = rig("check", "e.yaml", "--rig", "my_rig.yaml", cwd=lab)
    assert result.returncode == 2
    assert message in result.stderr
    assert "my_rig.yaml:" in result.stderr and "Traceback" not in result.stderr
