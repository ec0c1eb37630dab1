"""Somebody else's hardware: measured damper logs through the same command as the actuator's."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "mr_damper"
LOGS = ROOT.parent / "shared" / "data" / "mr_damper"


def identify(logs, tmp_path, *options):
    command = [sys.executable, "-m", "daq.cli", "identify", *map(str, logs)]
    command += ["--config", str(EXAMPLE / "identification.yaml"), "--out", str(tmp_path)]
    command += [*options, "--no-report", "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.soak
@pytest.mark.skipif(not LOGS.is_dir(), reason=f"the measured logs are not at {LOGS}")
def test_one_parameter_set_for_a_folder_of_measured_logs(tmp_path):
    model = f"{EXAMPLE / 'bouc_wen.py'}:model"
    report = identify(
        [LOGS], tmp_path, "--model", model, "--population", "60", "--generations", "8"
    )
    fits = [log["outputs"]["force"]["fit_percent"] for log in report["metrics"]["training"]]
    assert len(fits) == 18
    assert np.mean(fits) > 80.0


def synthetic_log(path, current):
    """A damper log in the example's columns and units, from the better model itself."""
    sys.path.insert(0, str(EXAMPLE))
    try:
        from damper import model
    finally:
        sys.path.remove(str(EXAMPLE))
    from sysid import BatchSimulator, Dataset

    dt, n = 0.005, 400
    t = np.arange(n) * dt
    velocity = 0.1 * np.cos(2.0 * np.pi * t)
    inputs = np.column_stack([velocity, np.full(n, current)])
    force = BatchSimulator(model, accuracy=1e-6).trajectories(
        model.nominal, Dataset(inputs, np.zeros((n, 1)), dt)
    )[0, :, 0]
    table = np.column_stack([t, 1e3 * velocity, force, inputs[:, 1]])
    head = "t_s,velocity_mm_s,force_N,current_A"
    np.savetxt(path, table, delimiter=",", header=head, comments="")


@pytest.mark.soak
def test_the_shipped_model_and_columns_fit_their_own_kind_of_log(tmp_path):
    logs = []
    for current in (0.0, 1.0):
        logs.append(tmp_path / f"{current}A.csv")
        synthetic_log(logs[-1], current)
    report = identify(logs, tmp_path, "--population", "60", "--generations", "6")
    fits = [log["outputs"]["force"]["fit_percent"] for log in report["metrics"]["training"]]
    assert min(fits) > 95.0
