"""``rig init``: files to begin with that work as they are, and never over somebody's own."""

import json
from pathlib import Path

import jsonschema
import pytest
import yaml

from daq.config.identification import IdentificationConfig
from daq.config.yaml_file import YamlFile
from daq.identification.settings import in_model_units
from daq.lookup.models import find_model
from daq.lookup.shipped import shipped_files
from daq.lookup.starter import settings_text
from tests.daq.support import forked_rig, rig


def test_the_files_work_as_they_are_and_the_next_commands_are_told(tmp_path):
    result = rig("init", "lab", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    told = result.stdout.splitlines()
    assert told[-3:] == [
        "Next: cd lab",
        "Then: rig check prbs.yaml --rig rig.yaml",
        "Then: rig run prbs.yaml --rig rig.yaml --identify --config identification.yaml",
    ]
    lab = tmp_path / "lab"
    checked = rig(*told[-2].split()[2:], cwd=lab)
    assert checked.returncode == 0, checked.stderr
    for name in ("prbs.yaml", "rig.yaml", "identification.yaml"):
        first, content = (lab / name).read_text("utf-8").split("\n", 1)
        schema = lab / first.removeprefix("# yaml-language-server: $schema=")
        jsonschema.validate(yaml.safe_load(content), json.loads(schema.read_text("utf-8")))


@pytest.mark.soak
def test_every_shipped_experiment_can_be_begun_with(tmp_path):
    with forked_rig() as run:
        for name in [path.stem for path in shipped_files("protocol").values()]:
            made = run(["init", name, "--protocol", name], tmp_path)
            assert made.returncode == 0, made.stderr
            words = ["check", f"{name}.yaml", "--rig", "rig.yaml", "--draws", "20"]
            checked = run(words, tmp_path / name)
            assert checked.returncode == 0, checked.stderr


def test_what_is_there_stays(tmp_path):
    (tmp_path / "rig.yaml").write_text("name: mine\n")
    result = rig("init", "--json", cwd=tmp_path)
    assert json.loads(result.stdout)["kept"] == ["rig.yaml"]
    assert json.loads(result.stdout)["written"] == ["prbs.yaml", "identification.yaml"]
    assert (tmp_path / "rig.yaml").read_text("utf-8") == "name: mine\n"
    again = rig("init", cwd=tmp_path)
    assert again.stdout.count("Kept as it was") == 3


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--protocol", "prbx"], "--protocol: no 'prbx' to begin with; did you mean 'prbs'?"),
        (["--rig", "serail"], "--rig: no 'serail' to begin with; did you mean 'serial'?"),
        (["file"], "file: cannot be created: File exists"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, args, said):
    (tmp_path / "file").write_text("")
    result = rig("init", *args, cwd=tmp_path)
    assert result.returncode == 2 and said in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_every_setting_that_stands_as_a_comment_is_one():
    lines = settings_text().splitlines()
    shown = [line.lstrip("#") for line in lines if line[:1] not in {"", "#"} or line[1:2].strip()]
    content = yaml.safe_load("\n".join(shown))
    assert set(content) == set(IdentificationConfig.model_fields)
    file, wrong = in_model_units(YamlFile(Path(), content, {}), [find_model("actuator")])
    assert not wrong
    IdentificationConfig.model_validate(file.content)
