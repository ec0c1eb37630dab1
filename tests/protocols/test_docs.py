"""The examples in the documentation, run from its own text."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

import protocols
from daq.config.rig import RigConfig
from daq.lookup.experiments import load_experiment
from daq.plugins import installed

DOCS = Path(protocols.__file__).parents[1] / "docs" / "protocols"
TEXT = (DOCS / "README.md").read_text("utf-8")
OWN = (DOCS.parent / "own-protocol.md").read_text("utf-8")
BLOCK = r"```\w+\n(.*?)```"


@pytest.mark.soak
def test_examples_of_own_protocols_run_as_written(tmp_path, command):
    files = re.findall(rf"<!-- file: (\S+) -->\n{BLOCK}", OWN, re.DOTALL)
    assert {name for name, _ in files} == {
        "square.py", "square.yaml", "angle_step.py", "angle_step.yaml"
    }  # fmt: skip
    for name, content in files:
        (tmp_path / name).write_text(content)
    commands = "\n".join(re.findall(rf"<!-- commands -->\n{BLOCK}", OWN, re.DOTALL)).split("\n")
    for line in filter(None, commands):
        program, *arguments = shlex.split(line)
        assert program == "rig"
        result = command(arguments, tmp_path)
        assert result.returncode == 0, f"{line}\n{result.stderr}"
        assert "Traceback" not in result.stderr
    assert (tmp_path / "square.png").exists() and (tmp_path / "angle_step.png").exists()
    (folder,) = (tmp_path / "runs").glob("*-angle_step")
    found = yaml.safe_load((folder / "results" / "findings.json").read_text("utf-8"))["numbers"]
    assert abs(found["rest_error"]["value"]) < 0.1, "the shaft went where it was sent"
    assert 0.005 < found["rise_time"]["value"] < 1.0


@pytest.mark.parametrize("name", sorted(installed("protocol")))
def test_every_protocol_has_its_file_its_page_and_a_line_in_the_index(name):
    assert (DOCS / f"{name}.md").exists()
    assert f"({name}.md)" in TEXT
    assert load_experiment(f"{name}.yaml").plan(RigConfig()).n_samples > 0


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda path: path.name)
def test_pages_name_files_that_are_there(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text("utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target
