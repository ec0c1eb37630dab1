"""``rig schema``: JSON Schemas for editors, and reference pages."""

from __future__ import annotations

from pathlib import Path

import typer

from daq.cli import terminal as console
from daq.cli.reference import write_reference
from daq.lookup.schemas import schema_comment, write_schemas


def schema_command(folder: Path, reference: Path | None, app: typer.Typer, as_json: bool) -> None:
    """Write the schemas, and the reference pages into a folder of theirs if there is one."""
    written = {"schemas": write_schemas(folder, console.report)}
    if reference is not None:
        written["reference"] = write_reference(reference, app)
    if as_json:
        console.print_json({key: list(map(str, paths)) for key, paths in written.items()})
        return
    for paths in written.values():
        for path in paths:
            console.print_line(f"Written: {path}")
    line = schema_comment("experiment", folder)
    console.print_next(f"begin an experiment's YAML with the line {line}")
