"""``rig schema``: JSON Schemas of the YAML files, and reference pages."""

import itertools
from pathlib import Path
from typing import Annotated

from typer import Argument, Context, Option

from daq.cli import options, terminal


def schema(
    context: Context,
    folder: Annotated[
        Path, Argument(metavar="FOLDER", help="Where the schemas go; default schemas.")
    ] = Path("schemas"),
    reference: Annotated[
        Path | None, Option(metavar="DIR", help="Write reference pages (Markdown) there as well.")
    ] = None,
    json: options.AsJson = False,
) -> None:
    """Write JSON Schemas of the YAML files, for editors.

    They know the installed protocols and backends.
    """
    from daq.lookup import schemas

    written = {"schemas": schemas.write_schemas(folder, terminal.report_event)}
    if reference is not None:
        from daq.cli.reference import write_reference

        written["reference"] = write_reference(reference, context.find_root().command)
    if json:
        terminal.print_json(written)
        return
    for path in itertools.chain(*written.values()):
        print(f"Written: {path}")
    first = schemas.schema_comment("experiment", folder)
    terminal.print_next(f"begin an experiment's YAML with the line {first}")
