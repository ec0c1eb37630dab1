"""JSON Schemas of every kind of file, over the installed protocols and backends."""

import inspect
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from daq.config.base import Section
from daq.config.datasheet import DatasheetEntry
from daq.config.identification import IdentificationConfig
from daq.config.rig import RigConfig, with_options
from daq.config.schema import DRAFT, Schema, json_schema, partial
from daq.errors import ConfigError
from daq.experiment import Experiment
from daq.files import make_folder, write_whole
from daq.plugins import Group, installed, load_plugin
from daq.progress import Note, Watch, ignore

FOLDER = "schemas"

_FILE_AND_CLASS = {"type": "string", "pattern": r"\.py:\w+$", "description": "FILE.py:CLASS"}


def schema_comment(kind: str, folder: Path | str = FOLDER) -> str:
    """The line by which an editor finds the schema of a file, relative to the file."""
    return f"# yaml-language-server: $schema={Path(folder).as_posix()}/{kind}.json"


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
    make_folder(folder)
    paths = []
    for kind, schema in documents(protocols(watch), backend_options(watch)).items():
        path = folder / f"{kind}.json"
        write_whole(path, json.dumps(schema, indent=1, ensure_ascii=False) + "\n")
        paths.append(path)
    return paths


def protocols(watch: Watch = ignore) -> dict[str, type[Experiment]]:
    """The installed protocols that load, by name."""
    return _loaded("rig.protocols", watch)


def backend_options(watch: Watch = ignore) -> dict[str, type[Section]]:
    """What the installed backends that load take as options, by name."""
    return {name: backend.Options for name, backend in _loaded("rig.backends", watch).items()}


def documents(
    protocols: Mapping[str, type[Experiment]], backends: Mapping[str, type[Section]]
) -> dict[str, Schema]:
    """The schemas by kind of file: experiment, rig, identification, datasheet."""
    entry = json_schema(DatasheetEntry)
    return {
        "experiment": _document("An experiment", experiment_schema(protocols)),
        "rig": _document("A rig", rig_schema(backends)),
        "identification": _document(
            "Settings of an identification", json_schema(IdentificationConfig)
        ),
        "datasheet": _document(
            "A data sheet: parameters by name", {"type": "object", "additionalProperties": entry}
        ),
    }


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
    return {
        "type": "object",
        "properties": common,
        "required": ["protocol"],
        "allOf": [_when("protocol", name, protocol_schema(k)) for name, k in protocols.items()],
    }


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
    common["allOf"] = [
        _when(
            "backend",
            name,
            {"properties": {"options": rig_options(options)}},
            or_absent=name == default,
        )
        for name, options in backends.items()
    ]
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


def _document(title: str, schema: Schema) -> Schema:
    # The comment by which a JSON file itself may name its schema is everybody's.
    return {"$schema": DRAFT, "title": title, **schema}


def _loaded(group: Group, watch: Watch) -> dict[str, Any]:
    plugins = {}
    for name in sorted(installed(group)):
        try:
            plugins[name] = load_plugin(group, name)
        except ConfigError as error:
            watch(Note("warning", f"left out: {error}"))
    return plugins
