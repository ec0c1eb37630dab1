"""``rig init``: a folder with an experiment, a rig and settings of an identification to change."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from daq.cli import options, terminal
from daq.cli.completion import protocols, rig_names


def init(
    folder: Annotated[
        Path, Argument(metavar="[FOLDER]", help="Where the files go; default this folder.")
    ] = Path(),
    protocol: Annotated[
        str,
        Option(metavar="NAME", help="Shipped experiment to begin with.", autocompletion=protocols),
    ] = "prbs",
    rig: Annotated[
        str,
        Option(metavar="NAME", help="Shipped rig to begin with.", autocompletion=rig_names),
    ] = "simulated",
    json: options.AsJson = False,
) -> None:
    """Write commented YAML files to begin with.

    What is there already stays as it is. Editors complete and check the files by the JSON Schemas
    written beside them.
    """
    from daq.lookup import schemas, starter

    written, kept, validated = starter.write_starter(folder, protocol, rig, terminal.report_event)
    schema_folder = folder / schemas.FOLDER
    if json:
        terminal.print_json({"written": written, "kept": kept, "schemas": schema_folder})
        return
    for path in written:
        print(f"Written: {path}")
    print(f"Written: {schema_folder}, by which editors check these files")
    for path in kept:
        print(f"Kept as it was: {path}")
    there = [] if folder.resolve() == Path.cwd() else [f"cd {folder}"]
    # An experiment without a validation run is mostly not for an identification.
    identify = f" --identify --config {starter.SETTINGS}" if validated else ""
    terminal.print_next(
        *there,
        f"rig check {protocol}.yaml --rig {starter.RIG}",
        f"rig run {protocol}.yaml --rig {starter.RIG}{identify}",
    )
