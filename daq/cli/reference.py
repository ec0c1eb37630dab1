"""Reference pages in Markdown: every key of every kind of file, and the command line."""

import inspect
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import typer
from typer.cli import get_docs_for_click

from daq.cli import terminal
from daq.experiment import ClosedLoop, Experiment
from daq.files import make_folder, write_whole
from daq.lookup import schemas
from daq.lookup.schemas import Schema, branches, unit_in
from daq.lookup.shipped import shipped_files
from daq.torque import TorqueControl

_HEAD = "<!-- Made by `rig schema --reference`; what it says stands in the code. Do not edit. -->\n"
_TABLE = "| key | value | unit | default | allowed | meaning |\n|---|---|---|---|---|---|\n"
_UNITS = """\
A number with a unit may be written with one: `0.005`, `5 ms` and `0.005 s` are the same. Keys that
are not in the table are mistakes.
"""
_STATUS = (
    "`rig COMMAND --help` says the same. Exit status: 0 done, 1 the run failed, an interlock "
    "tripped or it was stopped, 2 wrong usage or configuration. With `--json` a command that fails "
    "or is stopped prints a document as well: `exit_status`; `errors`, each with `error`, `file`, "
    "`line`, `column`, `key`, `cure`; and `notes`, such as where the log of an interrupted run is."
)
_BOUNDS = {
    "minimum": "at least",
    "exclusiveMinimum": "above",
    "maximum": "at most",
    "exclusiveMaximum": "below",
}
_KINDS = {
    "number": "number",
    "integer": "whole number",
    "string": "text",
    "boolean": "true or false",
    "object": "keys and values",
    "array": "list",
}


def write_reference(folder: Path, command: Any) -> list[Path]:
    """Write all pages; the paths written. ConfigError when they cannot be."""
    make_folder(folder, cure="name another folder")
    watch = terminal.report_event
    controllers = schemas.controllers(watch)
    texts = pages(schemas.protocols(watch), schemas.backend_options(watch), controllers, command)
    for name, text in texts.items():
        write_whole(folder / name, text)
    return [folder / name for name in texts]


def pages(
    protocols: Mapping[str, type[Experiment]],
    backends: Mapping[str, Any],
    controllers: Mapping[str, type[TorqueControl]],
    command: Any,
) -> dict[str, str]:
    """The text of each page by the name of its file. command: the whole command line."""
    documents = schemas.documents(protocols, backends, controllers)
    made = {f"protocol-{name}.md": _protocol(name, kind) for name, kind in protocols.items()}
    made["rig.md"] = _rig(documents["rig"], backends)
    made["identification.md"] = _page(
        "Identification: keys of the YAML",
        "What `rig identify --config FILE.yaml` and `--set KEY=VALUE` take.",
        _rows(documents["identification"]),
    )
    made["question.md"] = _page(
        "Question of a design: keys of the YAML",
        "What `rig design QUESTION.yaml` and `--set KEY=VALUE` take.",
        _rows(documents["question"]),
    )
    made["datasheet.md"] = _page(
        "Data sheet: keys of the YAML",
        "What `rig identify --datasheet FILE.yaml` takes: for each parameter, by its name:",
        _rows(documents["datasheet"]["additionalProperties"], "PARAMETER."),
    )
    made["torque.md"] = _torque(controllers)
    made["command-line.md"] = _command_line(command)
    return {"README.md": _index(protocols), **made}


def _index(protocols: Mapping[str, type[Experiment]]) -> str:
    first_lines = {k: (inspect.getdoc(p) or "").partition("\n")[0] for k, p in protocols.items()}
    links = [f"- [`{name}`](protocol-{name}.md): {line}\n" for name, line in first_lines.items()]
    experiments = "".join(links)
    return (
        f"{_HEAD}\n# Reference\n\nExperiments, by protocol:\n\n{experiments}\n"
        "Other files and commands:\n\n- [rig](rig.md)\n- [identification](identification.md)\n"
        "- [question of a design](question.md)\n- [data sheet](datasheet.md)\n"
        "- [torque controller](torque.md)\n"
        "- [command line](command-line.md)\n\n"
        "`rig schema` writes the same as JSON Schemas, by which editors complete and check files.\n"
    )


def _protocol(name: str, kind: type[Experiment]) -> str:
    rows = _rows(schemas.protocol_schema(kind))
    text = _page(f"Protocol `{name}`", inspect.getdoc(kind) or "", rows)
    if issubclass(kind, ClosedLoop) and kind.columns:
        text += "\nBeside every sample it logs:\n\n| column | unit |\n|---|---|\n"
        text += "".join(f"| `{column}` | {unit} |\n" for column, unit in kind.columns.items())
    shipped = shipped_files("protocol").get(f"{name}.yaml")
    if shipped is not None:
        content = schemas.without_schema_comment(shipped.read_text(encoding="utf-8"))
        text += f"\nThe shipped `{name}.yaml`:\n\n```yaml\n{content}```\n"
    return text


def _rig(document: Schema, backends: Mapping[str, Any]) -> str:
    text = _page(
        "Rig: keys of the YAML",
        "What `--rig FILE.yaml` takes: the backend that talks to the rig, calibration and limits.",
        _rows(document),
    )
    for name, options in backends.items():
        rows = _rows(schemas.rig_options(options), "options.")
        text += f"\n## Options of the backend `{name}`\n\n{_TABLE}{rows}"
    return text


def _torque(controllers: Mapping[str, type[TorqueControl]]) -> str:
    intro = "What `rig tune FILE.yaml` takes, by `controller`."
    text = f"{_HEAD}\n# Torque controller: keys of the YAML\n\n{intro}\n\n{_UNITS}"
    for name, kind in controllers.items():
        rows = _rows(schemas.json_schema(kind))
        text += f"\n## `{name}`\n\n{inspect.getdoc(kind)}\n\n{_TABLE}{rows}"
    return text


def _page(title: str, intro: str, rows: str) -> str:
    return f"{_HEAD}\n# {title}\n\n{intro}\n\n{_UNITS}\n{_TABLE}{rows}"


def _rows(schema: Schema, prefix: str = "") -> str:
    """A line of the table for each key of a schema; a section's keys follow below it."""
    lines = []
    for name, item in schema.get("properties", {}).items():
        sections = list(_sections(item))
        is_required = name in schema.get("required", [])
        lines.append(_row(f"{prefix}{name}", item, is_required, bool(sections)))
        if name != "validation":
            lines += [_rows(section, f"{prefix}{name}{step}.") for step, section in sections]
    return "".join(lines)


def _sections(item: Schema) -> Iterator[tuple[str, Schema]]:
    """Sections that may stand at a key, each with what its keys add to the path: [] or .NAME."""
    for branch in branches(item):
        items, named = branch.get("items"), branch.get("additionalProperties")
        if "properties" in branch:
            yield "", branch
        elif isinstance(items, dict) and "properties" in items:
            yield "[]", items
        elif isinstance(named, dict) and "properties" in named:
            yield ".NAME", named


def _row(key: str, item: Schema, is_required: bool, is_section: bool) -> str:
    unit, default = unit_in(item), item.get("default")
    meaning = item.get("description", "").removesuffix(f" [{unit}]")
    if "examples" in item:
        meaning += f", for example `{schemas.as_yaml(item['examples'][0])}`"
    default_text = "required" if is_required else ""
    if not (is_required or is_section or default in (None, "", [], {})):
        default_text = f"`{_yaml(default)}`"
    cells = (
        f"`{key}`",
        _each(_kind, item),
        "" if is_section or unit in (None, "1") else unit,
        default_text,
        _each(_bounds, item),
        meaning,
    )
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _yaml(value: Any) -> str:
    """A default or bound as people write it in YAML."""
    if isinstance(value, list):
        return f"[{', '.join(map(_yaml, value))}]"
    if isinstance(value, float):
        return f"{value:.7g}"
    return value if isinstance(value, str) else json.dumps(value)


def _each(describe: Callable[[Schema], str], item: Schema) -> str:
    """Descriptions of the kinds of value that a key takes, joined by "or"."""
    return " or ".join(dict.fromkeys(filter(None, map(describe, branches(item)))))


def _kind(schema: Schema) -> str:
    """The kind of a value in words."""
    if "enum" in schema:
        return "word" if isinstance(schema["enum"][0], str) else "number"
    if "properties" in schema:
        return "section"
    kinds = schema.get("type", "anything")
    kind = kinds[0] if isinstance(kinds, list) else kinds
    items, named = schema.get("items"), schema.get("additionalProperties")
    if isinstance(items, list):
        items = items[0]
    if kind == "array" and isinstance(items, dict):
        has_fixed_length = schema.get("minItems", 0) == schema.get("maxItems")
        values = f"{schema['minItems']} values" if has_fixed_length else "list"
        return f"{values}, each {_each(_kind, items)}"
    if kind == "object" and isinstance(named, dict):
        return f"by name, each {_each(_kind, named)}"
    return _KINDS.get(str(kind), str(kind))


def _bounds(schema: Schema) -> str:
    """The words or bounds allowed for a value, or for the values inside it."""
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    inner = schema.get("items") or schema.get("additionalProperties")
    if isinstance(inner, list):
        return _each(_bounds, inner[0])
    bounds = [f"{words} {_yaml(schema[key])}" for key, words in _BOUNDS.items() if key in schema]
    if "items" in schema and schema.get("minItems", 0) not in (0, schema.get("maxItems")):
        bounds.append(f"at least {schema['minItems']} of them")
    if isinstance(inner, dict) and "properties" not in inner:
        bounds.append(_each(_bounds, inner))
    return ", ".join(filter(None, bounds))


def _command_line(command: Any) -> str:
    context = typer.Context(command, info_name="rig")
    texts = [
        get_docs_for_click(obj=each, ctx=context, indent=1, call_prefix="rig")
        for each in command.commands.values()
    ]
    return f"{_HEAD}\n# Command line\n\n{_STATUS}\n\n{''.join(texts)}"
