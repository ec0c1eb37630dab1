"""``rig init``: a folder with an experiment, a rig and settings of an identification to change."""

import shlex
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from daq.cli import options, terminal
from daq.cli.completion import protocols, rig_names


def init(
    folder: Annotated[
        Path, Argument(metavar="FOLDER", help="Where the files go; default this folder.")
    ] = Path(),
    protocol: Annotated[
        str | None,
        Option(
            metavar="NAME",
            help="Shipped experiment to begin with; default prbs, on hardware still and tenth.",
            autocompletion=protocols,
        ),
    ] = None,
    rig: Annotated[
        str,
        Option(
            metavar="NAME",
            help="Shipped rig to begin with; serial, quanser or nidaqmx for hardware, at a tenth.",
            autocompletion=rig_names,
        ),
    ] = "simulated",
    json: options.AsJson = False,
) -> None:
    """Write commented YAML files to begin with.

    What is there already stays as it is. Editors complete and check the files by the JSON Schemas
    written beside them.
    """
    from daq.lookup import schemas
    from daq.lookup.starter import DEFAULT_PROTOCOL, RIG, SETTINGS, write_starter

    starter = write_starter(folder, protocol, rig, terminal.report_event)
    schema_folder = folder / schemas.FOLDER
    if json:
        document = {"written": starter.written, "kept": starter.kept, "schemas": schema_folder}
        terminal.print_json(document)
        return
    for path in starter.written:
        print(f"Written: {path}")
    print(f"Written: {schema_folder}, by which editors check these files")
    for path in starter.kept:
        print(f"Kept as it was: {path}")
    there = [] if folder.resolve() == Path.cwd() else [f"cd {shlex.quote(str(folder))}"]
    experiment = f"{protocol or DEFAULT_PROTOCOL}.yaml"
    if starter.hardware:
        terminal.print_next(*there)
        terminal.print_steps(_first_evening(experiment, starter.on_port))
        return
    # An experiment without a validation run is mostly not for an identification.
    identify = f" --identify --config {SETTINGS}" if starter.validated else ""
    terminal.print_next(
        *there,
        f"rig check {experiment} --rig {RIG}",
        f"rig run {experiment} --rig {RIG}{identify}",
    )


def _first_evening(experiment: str, on_port: bool) -> list[tuple[str, str]]:
    """What to do from the port to the experiment, and what each step is for."""
    from daq.lookup.starter import FIRST_EXPERIMENTS, RIG

    zero, first = FIRST_EXPERIMENTS
    doctor = f"rig doctor --rig {RIG}"
    first_steps = [
        ("rig ports", f"who answers where: write the port into {RIG}"),
        (doctor, "zero outputs: do samples and commands come in time?"),
    ]
    if not on_port:
        first_steps = [
            (doctor, "who answers, and what it cannot promise"),
            (f"{doctor} --loopback", f"amplifiers unplugged: write the phase into {RIG}"),
        ]
    return [
        *first_steps,
        (f"rig check {zero}.yaml --rig {RIG}", "reads the files, energises nothing"),
        (f"rig run {zero}.yaml --rig {RIG}", "amplifiers off: what the sensors read"),
        (f"rig run {first}.yaml --rig {RIG}", "no load, a hand at the switch: first commands"),
        ("more", f"raise {RIG} and {first}.yaml by the steps they name, up to {experiment}"),
    ]
