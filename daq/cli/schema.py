"""``rig schema``: JSON Schemas of the YAML files, and reference pages."""

from pathlib import Path
from typing import Annotated

import typer

from daq.cli import terminal
from daq.cli.options import AsJson


def schema(
    context: typer.Context,
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Where the schemas go; default schemas.")
    ] = Path("schemas"),
    reference: Annotated[
        Path | None,
        typer.Option(
            "--reference", metavar="DIR", help="Write reference pages (Markdown) there as well."
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Write JSON Schemas of the YAML files, for editors.

    They know the installed protocols and backends.
    """
    from daq.lookup import schemas

    watch = terminal.report_event
    written = {"schemas": schemas.write_schemas(folder, watch)}
    if reference is not None:
        from daq.cli.reference import write_reference

        written["reference"] = write_reference(reference, context.find_root().command)
    if json:
        terminal.print_json({key: list(map(str, paths)) for key, paths in written.items()})
        return
    for paths in written.values():
        for path in paths:
            terminal.print_line(f"Written: {path}")
    first = schemas.schema_comment("experiment", folder)
    terminal.print_next(f"begin an experiment's YAML with the line {first}")
