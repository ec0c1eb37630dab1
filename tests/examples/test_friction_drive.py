"""The tutorial's drive: from the CSV its script writes to the parameters that made it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.daq.support import rig
from tests.examples.conftest import EXAMPLES


@pytest.fixture
def data(example):
    return example("friction_drive_data")


def test_its_motion_obeys_newton(data):
    """Half a period of sliding by small steps is what the closed form says."""
    mass, viscous, dry, offset = data.TRUTH.values()
    position, velocity, dt = 0.0, 0.2, 1e-6
    for _ in range(100_000):
        force = 20.0 - offset - viscous * velocity - dry
        velocity += dt * force / mass
        position += dt * velocity
    np.testing.assert_allclose(data.advance(0.0, 0.2, 20.0, 0.1), (position, velocity), rtol=1e-5)


def test_it_stands_where_the_force_does_not_overcome_friction(data):
    position, velocity = data.advance(0.0, 0.05, -15.0, 10.0)
    assert velocity == 0.0
    assert data.advance(position, velocity, 16.0, 1.0) == (position, 0.0)
    assert data.advance(position, velocity, 18.0, 1.0)[1] > 0.0


def test_the_tutorial_shows_the_example_as_it_is():
    tutorial = (EXAMPLES.parent / "docs" / "own-model.md").read_text(encoding="utf-8")
    for name, language in (("friction_drive.py", "python"), ("friction_drive.yaml", "yaml")):
        shown = tutorial.split(f"```{language}\n")[1].split("```")[0]
        assert shown in (EXAMPLES / name).read_text(encoding="utf-8")


@pytest.mark.soak
def test_identification_finds_the_drive(data, tmp_path):
    data.save(tmp_path / "training.csv", data.training()[:3000])
    data.save(tmp_path / "validation.csv", data.validation())
    command = ["identify", "training.csv", "--validate", "validation.csv", "--config"]
    command += [EXAMPLES / "friction_drive.yaml", "--population", 60, "--generations", 20]
    result = rig(*command, "--out", "found", "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    found = {name: entry["value"] for name, entry in report["parameters"].items()}
    assert found == pytest.approx(data.TRUTH, rel=0.02)
    (log,) = report["metrics"]["validation"]
    assert log["outputs"]["position"]["fit_percent"] > 99.0
