"""JSON Schemas and reference pages: as the models are, and as editors use them."""

import copy
import json
import re
from pathlib import Path

import jsonschema
import pytest
import typer
import yaml

from daq.cli import reference
from daq.cli.app import app
from daq.lookup import schemas
from tests.daq.support import rig

ROOT = Path(__file__).resolve().parents[2]
REGENERATE = "run: rig schema daq/schemas --reference docs/reference"
PROTOCOLS = {
    name: kind
    for name, kind in schemas.protocols().items()
    if kind.__module__.partition(".")[0] == "protocols"
}
BACKENDS = {
    name: options
    for name, options in schemas.backend_options().items()
    if options.__module__.partition(".")[0] in {"daq", "sim_rig"}
}
CONTROLLERS = schemas.controllers()
DOCUMENTS = schemas.documents(PROTOCOLS, BACKENDS, CONTROLLERS)
SHIPPED = sorted(
    path
    for folder in ("protocols", "sim_rig", "daq", "haptics", "examples")
    for path in (ROOT / folder).rglob("*.yaml")
    if path.name != "simulated_controller.yaml"  # which rig tune made
)
# Numbers in a unit that stands elsewhere: in a model, or beside them.
OF_A_MODEL = re.compile(
    r"^(ranges|fixed|constant|noise|value|range|parameters|initial|process_noise|scale|centre)$"
)


def schema_of(path):
    """The schema that a YAML's first line names, as the editor resolves it."""
    found = re.match(r"# yaml-language-server: \$schema=(\S+)\n", path.read_text("utf-8"))
    assert found, f"{path}: its first line names no schema"
    return (path.parent / found[1]).resolve()


def leaves(schema, key=()):
    """Every key below a schema with its own."""
    for name, item in schema.get("properties", {}).items():
        yield (*key, name), item
        yield from leaves(item, (*key, name))
    inner = [schema.get("additionalProperties"), schema.get("items"), *schema.get("anyOf", [])]
    inner += [part["then"] for part in schema.get("allOf", [])]
    for item in inner:
        if isinstance(item, dict):
            yield from leaves(item, key)


def is_number(schema):
    kinds = schema.get("type", [])
    parts = [*schema.get("anyOf", []), schema.get("items"), schema.get("additionalProperties")]
    return "number" in ([kinds] if isinstance(kinds, str) else kinds) or any(
        is_number(part) for part in parts if isinstance(part, dict)
    )


@pytest.mark.parametrize("kind", DOCUMENTS)
def test_the_shipped_schema_is_up_to_date_and_a_schema(kind):
    shipped = json.loads((ROOT / "daq" / "schemas" / f"{kind}.json").read_text("utf-8"))
    assert shipped == DOCUMENTS[kind], REGENERATE
    jsonschema.Draft7Validator.check_schema(shipped)


def test_the_reference_pages_are_up_to_date():
    folder = ROOT / "docs" / "reference"
    pages = reference.pages(PROTOCOLS, BACKENDS, CONTROLLERS, typer.main.get_command(app))
    # Pages of protocols that are gone would stay.
    made = {path.name for path in folder.glob("protocol-*.md")}
    assert made == {name for name in pages if name.startswith("protocol-")}, REGENERATE
    for name, text in pages.items():
        assert (folder / name).read_text("utf-8") == text, REGENERATE


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_every_shipped_yaml_names_its_schema_and_agrees_with_it(path):
    schema = json.loads(schema_of(path).read_text("utf-8"))
    jsonschema.Draft7Validator(schema).validate(yaml.safe_load(path.read_text("utf-8")))


@pytest.mark.parametrize("kind", DOCUMENTS)
def test_every_key_has_help_and_every_number_a_unit(kind):
    for key, item in leaves(DOCUMENTS[kind]):
        assert item.get("description"), key
        if is_number(item) and "enum" not in item and not OF_A_MODEL.match(key[-1]):
            assert reference.unit_in(item), key


EXPERIMENT, RIG = ROOT / "protocols" / "prbs.yaml", ROOT / "sim_rig" / "simulated.yaml"
SETTINGS = ROOT / "examples" / "friction_drive.yaml"
MISTAKES = [
    (EXPERIMENT, ["protocol"], "prbx"),
    (EXPERIMENT, ["protocol"], None),
    (EXPERIMENT, ["duratoin"], 1.0),
    (EXPERIMENT, ["duration"], None),
    (EXPERIMENT, ["duration"], "long"),
    (EXPERIMENT, ["duration"], True),
    (EXPERIMENT, ["duration"], 0),
    (EXPERIMENT, ["duration"], [1.0]),
    (EXPERIMENT, ["amplitude"], 0.5),
    (EXPERIMENT, ["motor"], [0.75, 0.1]),
    (EXPERIMENT, ["motor", "amplitude"], 11),
    (EXPERIMENT, ["motor", "seed"], 1.5),
    (EXPERIMENT, ["motor", "seed"], "4 V"),
    (EXPERIMENT, ["motor", "duration"], 1.0),
    (EXPERIMENT, ["validation", "motor", "seed"], 0),
    (EXPERIMENT, ["validation", "motor", "sead"], 5),
    (RIG, ["backend"], "simulator"),
    (RIG, ["options", "plan"], {}),
    (RIG, ["options", "plant", "load"], "wheel"),
    (RIG, ["plant"], {"load": "pulley"}),
    (RIG, ["limits", "command", "motor"], [-5.0]),
    (RIG, ["limits", "command", "motor"], [-5.0, 0.0, 5.0]),
    (RIG, ["limits", "current", "motor"], 0),
    (RIG, ["sensors", "torque", "sign"], 2),
    (SETTINGS, ["preset"], "thesys"),
    (SETTINGS, ["initial"], {"position": "last"}),
    (SETTINGS, ["hold"], {"voltage": "soh"}),
    (SETTINGS, ["columns", "time"], {"unit": "ms"}),
    (SETTINGS, ["columns", "time"], {"column": "t", "sample_rate": 800}),
    (SETTINGS, ["columns", "inputs", "voltage"], {"unit": "V"}),
]


@pytest.mark.parametrize(("path", "key", "value"), MISTAKES)
def test_the_schema_refuses_the_mistakes_that_the_program_refuses(path, key, value):
    good = yaml.safe_load(path.read_text("utf-8"))
    checker = jsonschema.Draft7Validator(json.loads(schema_of(path).read_text("utf-8")))
    assert checker.is_valid(good)
    wrong = copy.deepcopy(good)
    section = wrong
    for part in key[:-1]:
        section = section[part]
    if value is None:
        del section[key[-1]]
    else:
        section[key[-1]] = value
    assert not checker.is_valid(wrong)


@pytest.mark.parametrize("value", ["5 ms", "0.005 s", "5e-3 s", 0.005])
def test_the_schema_takes_quantities(value):
    content = yaml.safe_load(EXPERIMENT.read_text("utf-8"))
    content["motor"]["minimum_period"] = value
    jsonschema.Draft7Validator(DOCUMENTS["experiment"]).validate(content)


def test_a_protocol_of_ones_own_is_checked_by_what_all_have_in_common():
    checker = jsonschema.Draft7Validator(DOCUMENTS["experiment"])
    assert checker.is_valid({"protocol": "mine.py:Chirp", "sweep": {"from": 1}})
    assert not checker.is_valid({"protocol": "mine.py:Chirp", "sample_rate": -1})


def test_rig_schema_writes_what_is_installed(tmp_path):
    result = rig("schema", "here", "--reference", "pages", "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    written = json.loads(result.stdout)
    assert {Path(p).name for p in written["schemas"]} == {f"{kind}.json" for kind in DOCUMENTS}
    for path in written["schemas"] + written["reference"]:
        assert (tmp_path / path).stat().st_size > 0
    refused = rig("schema", "here/rig.json", cwd=tmp_path)
    place = Path("here/rig.json")
    assert refused.returncode == 2 and f"{place}: cannot be created" in refused.stderr
