"""Reference pages in Markdown: every key of every kind of file, and the command line."""

from __future__ import annotations

import importlib.resources
import inspect
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from daq.config.schema import Schema, branches, unit_in
from daq.experiment import ClosedLoop, Experiment
from daq.files import make_folder, write_whole
from daq.lookup import schemas

_HEAD = "<!-- Made by `rig schema --reference`; what it says stands in the code. Do not edit. -->\n"
_TABLE = "| key | value | unit | default | allowed | meaning |\n|---|---|---|---|---|---|\n"
_UNITS = """\
A number with a unit may be written with one: `0.005`, `5 ms` and `0.005 s` are the same. Keys that
are not in the table are mistakes.
"""
_KINDS = {
    "number": "number",
    "integer": "whole number",
    "string": "text",
    "boolean": "true or false",
    "object": "keys and values",
    "array": "list",
}


def write_reference(folder: Path, app: typer.Typer) -> list[Path]:
    """Write all pages; the paths written. ConfigError when they cannot be."""
    make_folder(folder)
    found = pages(schemas.protocols(), schemas.backend_options(), app)
    for name, text in found.items():
        write_whole(folder / name, text)
    return [folder / name for name in found]


def pages(
    protocols: Mapping[str, type[Experiment]], backends: Mapping[str, Any], app: typer.Typer
) -> dict[str, str]:
    """The text of each page by the name of its file; app: the command line."""
    documents = schemas.documents(protocols, backends)
    made = {f"protocol-{name}.md": _protocol(name, kind) for name, kind in protocols.items()}
    made["rig.md"] = _rig(documents["rig"], backends)
    made["identification.md"] = _page(
        "Identification: keys of the YAML",
        "What `rig identify --config FILE.yaml` and `--set KEY=VALUE` take.",
        _rows_of(documents["identification"]),
    )
    made["datasheet.md"] = _page(
        "Data sheet: keys of the YAML",
        "What `rig identify --datasheet FILE.yaml` takes: for each parameter, by its name:",
        _rows_of(documents["datasheet"]["additionalProperties"], "PARAMETER."),
    )
    made["command-line.md"] = _command_line(app)
    return {"README.md": _index(protocols), **made}


def _index(protocols: Mapping[str, type[Experiment]]) -> str:
    experiments = "".join(
        f"- [`{name}`](protocol-{name}.md): {_first_line(kind)}\n"
        for name, kind in protocols.items()
    )
    return (
        f"{_HEAD}\n# Reference\n\nExperiments, by protocol:\n\n{experiments}\n"
        "Other files and commands:\n\n- [rig](rig.md)\n- [identification](identification.md)\n"
        "- [data sheet](datasheet.md)\n- [command line](command-line.md)\n\n"
        "`rig schema` writes the same as JSON Schemas, by which editors complete and check files.\n"
    )


def _protocol(name: str, kind: type[Experiment]) -> str:
    text = _page(
        f"Protocol `{name}`", inspect.getdoc(kind) or "", _rows_of(schemas.protocol_schema(kind))
    )
    if issubclass(kind, ClosedLoop) and kind.columns:
        text += "\nBeside every sample it logs:\n\n| column | unit |\n|---|---|\n"
        text += "".join(f"| `{column}` | {unit} |\n" for column, unit in kind.columns.items())
    shipped = importlib.resources.files("protocols") / f"{name}.yaml"
    if shipped.is_file():
        content = schemas.without_comment(shipped.read_text(encoding="utf-8"))
        text += f"\nThe shipped `{name}.yaml`:\n\n```yaml\n{content}```\n"
    return text


def _rig(document: Schema, backends: Mapping[str, Any]) -> str:
    text = _page(
        "Rig: keys of the YAML",
        "What `--rig FILE.yaml` takes: the backend that talks to the rig, calibration and limits.",
        _rows_of(document),
    )
    for name, options in backends.items():
        rows = _rows_of(schemas.rig_options(options), "options.")
        text += f"\n## Options of the backend `{name}`\n\n{_TABLE}{''.join(rows)}"
    return text


def _page(title: str, intro: str, rows: Sequence[str]) -> str:
    return f"{_HEAD}\n# {title}\n\n{intro}\n\n{_UNITS}\n{_TABLE}{''.join(rows)}"


def _rows_of(schema: Schema, prefix: str = "") -> list[str]:
    return list(_rows(schema, prefix))


def _rows(schema: Schema, prefix: str) -> Iterator[str]:
    required = schema.get("required", [])
    for name, item in schema.get("properties", {}).items():
        key = f"{prefix}{name}"
        inner = [(f"{key}{step}", part) for step, part in _sections(item)]
        yield _row(key, item, name in required, bool(inner))
        if name != "validation":
            for below, part in inner:
                yield from _rows(part, f"{below}.")


def _sections(item: Schema) -> Iterator[tuple[str, Schema]]:
    """Sections that may stand at a key, each with how it is reached from there."""
    for branch in branches(item):
        items, named = branch.get("items"), branch.get("additionalProperties")
        if "properties" in branch:
            yield "", branch
        elif isinstance(items, dict) and "properties" in items:
            yield "[]", items
        elif isinstance(named, dict) and "properties" in named:
            yield ".NAME", named


def _row(key: str, item: Schema, required: bool, section: bool) -> str:
    unit = unit_in(item) or ""
    text = item.get("description", "")
    if unit:
        text = text.removesuffix(f" [{unit}]")
    if "examples" in item:
        text += f", for example `{schemas.as_yaml(item['examples'][0])}`"
    default = "required" if required else _default(item, section)
    cells = (
        f"`{key}`", _value(item), "" if section or unit == "1" else unit, default, _allowed(item),
        text,
    )  # fmt: skip
    return _line(cells)


def _line(cells: Sequence[str]) -> str:
    """One line of a Markdown table."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _default(item: Schema, section: bool) -> str:
    value = item.get("default")
    if section or value in (None, "", [], {}):
        return ""
    return f"`{_number(value)}`"


def _number(value: Any) -> str:
    """A value as people write it in YAML."""
    if isinstance(value, list):
        return f"[{', '.join(map(_number, value))}]"
    if isinstance(value, float):
        return f"{value:.7g}"
    return value if isinstance(value, str) else json.dumps(value)


def _value(item: Schema) -> str:
    return " or ".join(dict.fromkeys(_kind(branch) for branch in branches(item)))


def _kind(schema: Schema) -> str:
    """What stands at a key, in words."""
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
        same = schema.get("minItems", 0) == schema.get("maxItems")
        whole = f"{schema['minItems']} values" if same else "list"
        return f"{whole}, each {_value(items)}"
    if kind == "object" and isinstance(named, dict):
        return f"by name, each {_value(named)}"
    return _KINDS.get(str(kind), str(kind))


def _allowed(item: Schema) -> str:
    return " or ".join(dict.fromkeys(filter(None, map(_bounds, branches(item)))))


def _bounds(schema: Schema) -> str:
    """Words or bounds of a value, or of those inside it."""
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    low = _bound(schema, "at least", "minimum", "above", "exclusiveMinimum")
    high = _bound(schema, "at most", "maximum", "below", "exclusiveMaximum")
    inner = schema.get("items") or schema.get("additionalProperties")
    if isinstance(inner, list):
        return _allowed(inner[0])
    if not isinstance(inner, dict) or "properties" in inner:
        return ", ".join(filter(None, [low, high, _length(schema)]))
    return ", ".join(filter(None, [_length(schema), _allowed(inner)]))


def _length(schema: Schema) -> str:
    """How many values, where that is not one number."""
    if "items" not in schema or schema.get("minItems", 0) == schema.get("maxItems"):
        return ""
    least = _bound(schema, "at least", "minItems")
    return f"{least} of them" if least else ""


def _bound(schema: Schema, word: str, key: str, other: str = "", strict: str = "") -> str:
    if key in schema:
        return f"{word} {_number(schema[key])}"
    return f"{other} {_number(schema[strict])}" if strict in schema else ""


def _first_line(kind: type[Any]) -> str:
    return (inspect.getdoc(kind) or "").partition("\n")[0]


def _command_line(app: typer.Typer) -> str:
    command: Any = typer.main.get_command(app)
    text = (
        f"{_HEAD}\n# Command line\n\n`rig COMMAND --help` says the same. Exit status: 0 done, 1 "
        "the run failed or an interlock tripped, 2 wrong usage or configuration.\n"
    )
    for name, sub in command.commands.items():
        text += f"\n## rig {name}\n\n{inspect.cleandoc(sub.help or '')}\n\n"
        if sub.epilog:
            text += f"    {sub.epilog.removeprefix('Example:').strip()}\n\n"
        text += "| argument or option | value | default | meaning |\n|---|---|---|---|\n"
        text += "".join(_option(param) for param in sub.params)
    return text


def _option(param: Any) -> str:
    names = ", ".join(f"`{name}`" for name in param.opts)
    if param.param_type_name == "argument":
        names = f"`{param.metavar or param.name.upper()}`"
    flag = getattr(param, "is_flag", False)
    value = "" if flag or param.param_type_name == "argument" else param.metavar or "VALUE"
    default = "required" if param.required else "" if flag else param.default
    shown = "" if default in (None, "", ()) else str(default)
    cells = (names, value, shown, param.help or "")
    return _line(cells)
