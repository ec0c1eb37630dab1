"""``rig design`` with structures: which runs tell them apart, on which plants, in whose words."""

import json

import numpy as np
import pytest

from daq.config.yaml_file import TypedSettings
from daq.designs.setup import set_up, set_up_structures
from daq.errors import ConfigError
from tests.daq.support import few_free, rig, write_yaml

QUICK = {"candidates": 3, "generations": 0, "checks": 1, "run": "0.25 s", "time": "0.5 s"}
OPTIONS = {"hysteresis": ["bouc-wen", "dahl"], "friction": ["none", "stribeck"]}


def setups(**question):
    return set_up_structures(TypedSettings.of({**QUICK, **question}))


def test_options_are_combined_each_with_each():
    models = {name: each.problem.model_name for name, each in setups(structures=OPTIONS).items()}
    assert models == {
        "hysteresis bouc-wen, friction none": "actuator:hysteresis=bouc-wen,friction=none",
        "hysteresis bouc-wen, friction stribeck": "actuator:hysteresis=bouc-wen,friction=stribeck",
        "hysteresis dahl, friction none": "actuator:hysteresis=dahl,friction=none",
        "hysteresis dahl, friction stribeck": "actuator:hysteresis=dahl,friction=stribeck",
    }


@pytest.mark.soak
@pytest.mark.parametrize(
    "plant", [{}, {"plant": "actuator:load=pulley,limits=true,turns=5,parameters=rig"}]
)
def test_each_structure_has_a_plant_of_its_own(plant):
    several = setups(structures=["actuator", "actuator:hysteresis=dahl"], **plant)
    commands = np.tile([0.3, 0.1], (200, 1))
    speeds = [
        each.bench.signals(commands, 1.0 / 800.0, each.problem.model.nominal[None])["omega"]
        for each in several.values()
    ]
    assert np.abs(speeds[0] - speeds[1]).max() > 0.1


@pytest.mark.soak
def test_a_model_with_a_load_and_amplifiers_ends_may_be_that_of_the_structures():
    model = "actuator:limits=true,load=pulley,turns=5"
    several = setups(structures={"hysteresis": ["dahl", "lugre"]}, model=model)
    commands = np.tile([0.3, 0.1], (200, 1))
    for each in several.values():
        vectors = each.problem.model.nominal[None]
        (record,) = each.bench.records(commands, 1.0 / 800.0, vectors)
        assert record.inputs.shape == (200, 2)


@pytest.mark.parametrize(
    ("question", "named"),
    [
        ({"structures": ["actuator"]}, "structures: two at least are told apart"),
        ({"structures": {"hysteresis": ["dahl", "preisach"]}}, "hysteresis=preisach"),
        ({"structures": OPTIONS, "precision": "5 %"}, "precision: runs that tell structures apart"),
        ({"structures": OPTIONS, "targets": {"K_m": "1 %"}}, "targets: runs that tell structures"),
    ],
)
def test_mistakes_are_named(question, named):
    with pytest.raises(ConfigError, match=named):
        setups(**question)


def test_a_characterisation_is_of_one_structure():
    with pytest.raises(ConfigError, match="one structure is identified here"):
        set_up(TypedSettings.of({**QUICK, "structures": OPTIONS}))


@pytest.mark.soak
def test_a_design_says_how_surely_it_tells_them_apart(tmp_path):
    write_yaml(tmp_path / "id.yaml", few_free())
    question = {**QUICK, "config": "id.yaml", "structures": {"friction": ["none", "stribeck"]}}
    write_yaml(tmp_path / "question.yaml", question)
    done = rig("design", "question.yaml", "--out", "d", "--json", cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert json.loads((tmp_path / "d" / "design.json").read_text("utf-8")) == document
    assert (tmp_path / "d" / "design.png").stat().st_size > 10_000
    pairs = {(pair["truth"], pair["rival"]): pair for pair in document["pairs"]}
    assert pairs.keys() == {
        ("friction none", "friction stribeck"), ("friction stribeck", "friction none")
    }  # fmt: skip
    assert pairs["friction stribeck", "friction none"]["probability"] > 0.95
    for run in document["runs"]:
        checked = rig("check", run["file"], "--json", cwd=tmp_path)
        assert json.loads(checked.stdout)["samples"] == 200
