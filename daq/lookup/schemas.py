"""JSON Schemas of every kind of file, as editors read them (draft 7, without references)."""

import inspect
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import yaml
from pydantic import BaseModel

from daq.config.base import Section
from daq.config.identification import DatasheetEntry, IdentificationConfig
from daq.config.question import Question
from daq.config.rig import RigConfig, with_options
from daq.errors import ConfigError
from daq.experiment import Experiment
from daq.files import make_folder, write_whole
from daq.plugins import Kind, installed, load_plugin
from daq.progress import Note, Watch, ignore
from daq.torque import TorqueControl

Schema = dict[str, Any]
FOLDER = "schemas"
_SHIPPED = Path(__file__).resolve().parents[1] / FOLDER
DRAFT = "http://json-schema.org/draft-07/schema#"
# What pydantic calls a bound that it could not put where the number is.
_BOUNDS = {"gt": "exclusiveMinimum", "ge": "minimum", "lt": "exclusiveMaximum", "le": "maximum"}
_FILE_AND_CLASS = {"type": "string", "pattern": r"\.py:\w+$", "description": "FILE.py:CLASS"}


def schema_comment(kind: str, folder: Path | str = FOLDER) -> str:
    """The line by which an editor finds the schema of a file, relative to the file."""
    return f"# yaml-language-server: $schema={Path(folder).as_posix()}/{kind}.json"


def nearest_folder(kind: str, folder: Path) -> Path:
    """Where the schema of a file in a folder lies: above it, relative to it, or the shipped one."""
    there = folder.resolve()
    for up, place in enumerate([there, *there.parents]):
        if (place / FOLDER / f"{kind}.json").exists():
            return Path(*[".."] * up, FOLDER)
    return _SHIPPED


def as_yaml(value: Any) -> str:
    """A value in one line of YAML."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=math.inf, sort_keys=False)
    return text.removesuffix("\n...\n").strip()


def without_schema_comment(text: str) -> str:
    """A file's text without that line."""
    first, _, rest = text.partition("\n")
    return rest if first.startswith("# yaml-language-server") else text


def write_schemas(folder: Path, watch: Watch = ignore) -> list[Path]:
    """One file for each kind of YAML; the paths written. ConfigError when they cannot be."""
    make_folder(folder, cure="name another folder")
    paths = []
    every = documents(protocols(watch), backend_options(watch), controllers(watch))
    for kind, schema in every.items():
        path = folder / f"{kind}.json"
        write_whole(path, json.dumps(schema, indent=1, ensure_ascii=False) + "\n")
        paths.append(path)
    return paths


def protocols(watch: Watch = ignore) -> dict[str, type[Experiment]]:
    """The installed protocols that load, by name."""
    return _loaded("protocol", watch)


def backend_options(watch: Watch = ignore) -> dict[str, type[Section]]:
    """What the installed backends that load take as options, by name."""
    return {name: backend.Options for name, backend in _loaded("backend", watch).items()}


def controllers(watch: Watch = ignore) -> dict[str, type[TorqueControl]]:
    """The installed torque controllers that load, by name."""
    return _loaded("controller", watch)


def documents(
    protocols: Mapping[str, type[Experiment]],
    backends: Mapping[str, type[Section]],
    controllers: Mapping[str, type[TorqueControl]],
) -> dict[str, Schema]:
    """The schemas by kind of file: experiment, rig, identification, question, datasheet, torque."""
    settings = json_schema(IdentificationConfig)
    by_name = {"type": "object", "additionalProperties": json_schema(DatasheetEntry)}
    schemas = {
        "experiment": ("An experiment", experiment_schema(protocols)),
        "rig": ("A rig", rig_schema(backends)),
        "identification": ("Settings of an identification", settings),
        "question": ("A design's question", json_schema(Question)),
        "datasheet": ("A data sheet: parameters by name", by_name),
        "torque": ("Settings of a torque controller", torque_schema(controllers)),
    }
    return {k: {"$schema": DRAFT, "title": title, **s} for k, (title, s) in schemas.items()}


def experiment_schema(protocols: Mapping[str, type[Experiment]]) -> Schema:
    """The union of the protocols' settings, told apart by ``protocol``.

    Of a protocol in a file of one's own only what all have in common is checked.
    """
    named = [
        {"const": name, "description": inspect.getdoc(kind) or ""}
        for name, kind in protocols.items()
    ]
    common = json_schema(Experiment)["properties"]
    common["protocol"] = {**common["protocol"], "oneOf": [*named, _FILE_AND_CLASS]}
    cases = [_when("protocol", name, protocol_schema(kind)) for name, kind in protocols.items()]
    return {"type": "object", "properties": common, "required": ["protocol"], "allOf": cases}


def torque_schema(controllers: Mapping[str, type[TorqueControl]]) -> Schema:
    """The union of the controllers' settings, told apart by ``controller``."""
    common = json_schema(TorqueControl)["properties"]
    named = [
        {"const": name, "description": inspect.getdoc(kind) or ""}
        for name, kind in controllers.items()
    ]
    common["controller"] = {**common["controller"], "oneOf": [*named, _FILE_AND_CLASS]}
    cases = [_when("controller", name, json_schema(kind)) for name, kind in controllers.items()]
    return {"type": "object", "properties": common, "required": ["controller"], "allOf": cases}


def protocol_schema(kind: type[Experiment]) -> Schema:
    """The settings of one protocol; its validation run changes any of them."""
    schema = json_schema(kind)
    changes = partial(schema)
    for name in ("name", "protocol", "validation"):
        changes["properties"].pop(name)
    text = schema["properties"]["validation"]["description"]
    schema["properties"]["validation"] = {**changes, "description": text}
    return schema


def rig_schema(backends: Mapping[str, type[Section]]) -> Schema:
    """A rig, with the options of the backend it names."""
    common = json_schema(RigConfig)
    default = RigConfig.model_fields["backend"].default
    for name in ("backend", "options"):
        common["properties"][name].pop("default", None)
    named = [{"const": name} for name in backends]
    common["properties"]["backend"] |= {"oneOf": [*named, _FILE_AND_CLASS], "default": default}
    common["allOf"] = []
    for name, options in backends.items():
        then = {"properties": {"options": rig_options(options)}}
        common["allOf"].append(_when("backend", name, then, or_absent=name == default))
    return common


def rig_options(options: type[Section]) -> Schema:
    """The options of one backend."""
    schema: Schema = json_schema(with_options(options))["properties"]["options"]
    return schema


def _when(key: str, value: str, then: Schema, or_absent: bool = False) -> Schema:
    condition: Schema = {"properties": {key: {"const": value}}}
    if not or_absent:
        condition["required"] = [key]
    return {"if": condition, "then": then}


def _loaded(kind: Kind, watch: Watch) -> dict[str, Any]:
    plugins = {}
    for name in sorted(installed(kind)):
        try:
            plugins[name] = load_plugin(kind, name)
        except ConfigError as error:
            watch(Note("warning", f"left out: {error}"))
    return plugins


def json_schema(model: type[BaseModel]) -> Schema:
    """The schema of a model's content; a ``description`` ends with the unit, if there is one."""
    raw = model.model_json_schema()
    return cast(Schema, _clean(raw, raw.get("$defs", {})))


def partial(schema: Any) -> Any:
    """The schema of content of which any part may be left out."""
    if isinstance(schema, list):
        return [partial(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    return {key: partial(item) for key, item in schema.items() if key not in {"required", "oneOf"}}


def unit_in(schema: Schema) -> str | None:
    """The unit of the numbers at a key, wherever in its schema it stands."""
    return schema.get("unit") or next(filter(None, map(unit_in, _inner(schema))), None)


def branches(schema: Schema) -> list[Schema]:
    """What may stand at a key, one schema for each kind, without null."""
    return [s for s in schema.get("anyOf", [schema]) if s.get("type") != "null"]


def _clean(node: Any, defs: Mapping[str, Any]) -> Any:
    if isinstance(node, list):
        return [_clean(item, defs) for item in node]
    if not isinstance(node, dict):
        return node
    if "$ref" in node:
        target = defs[node["$ref"].rpartition("/")[2]]
        node = {**target, **{key: value for key, value in node.items() if key != "$ref"}}
    cleaned: Schema = {}
    for key, value in node.items():
        if key == "properties":
            cleaned[key] = {name: _with_unit(_clean(item, defs)) for name, item in value.items()}
        elif key == "prefixItems":
            cleaned["items"] = _clean(value, defs)
        elif key in {"default", "enum", "const", "examples"}:
            cleaned[key] = value
        elif key not in {"title", "$defs", "discriminator"}:
            cleaned[_BOUNDS.get(key, key)] = _clean(value, defs)
    return cleaned


def _with_unit(schema: Schema) -> Schema:
    unit = unit_in(schema)
    if unit in {None, "1"} or "description" not in schema or "properties" in schema:
        return schema
    return {**schema, "description": f"{schema['description']} [{unit}]"}


def _inner(schema: Schema) -> Iterator[Schema]:
    items = schema.get("items", [])
    yield from schema.get("anyOf", [])
    yield from items if isinstance(items, list) else [items]
    if isinstance(schema.get("additionalProperties"), dict):
        yield schema["additionalProperties"]
