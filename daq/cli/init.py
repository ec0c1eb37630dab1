"""``rig init``: a folder with an experiment, a rig and settings of an identification to change."""

from pathlib import Path
from typing import Annotated

import typer

from daq.cli import completion, terminal
from daq.cli.options import AsJson


def init(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Where the files go; default this folder.")
    ] = Path(),
    protocol: Annotated[
        str,
        typer.Option(
            "--protocol",
            metavar="NAME",
            help="Shipped experiment to begin with.",
            autocompletion=completion.protocols,
        ),
    ] = "prbs",
    rig: Annotated[
        str,
        typer.Option(
            "--rig",
            metavar="NAME",
            help="Shipped rig to begin with.",
            autocompletion=completion.rig_names,
        ),
    ] = "simulated",
    json: AsJson = False,
) -> None:
    """Write commented YAML files to begin with.

    What is there already stays as it is. Editors complete and check the files by the JSON Schemas
    written beside them.
    """
    from daq.lookup import starter

    files = starter.write_starter(folder, protocol, rig, terminal.report_event)
    if json:
        terminal.print_json(
            {
                "written": list(map(str, files.written)),
                "kept": list(map(str, files.kept)),
                "schemas": str(files.schemas),
            }
        )
        return
    for path in files.written:
        terminal.print_line(f"Written: {path}")
    terminal.print_line(f"Written: {files.schemas}, by which editors check these files")
    for path in files.kept:
        terminal.print_line(f"Kept as it was: {path}")
    there = [] if folder.resolve() == Path.cwd() else [f"cd {folder}"]
    # An experiment without a validation run is mostly not for an identification.
    identify = f" --identify --config {starter.SETTINGS}" if files.validated else ""
    terminal.print_next(
        *there,
        f"rig check {protocol}.yaml --rig {starter.RIG}",
        f"rig run {protocol}.yaml --rig {starter.RIG}{identify}",
    )
