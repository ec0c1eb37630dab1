"""``rig export``: what other programs read."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from daq.cli import options, terminal


class Digits(StrEnum):
    """Precision of a program's numbers."""

    DOUBLE = "double"
    SINGLE = "single"


def export_c(
    controller: Annotated[
        Path, Argument(metavar="CONTROLLER.yaml", help="A file that rig tune made.")
    ],
    precision: Annotated[Digits, Option(help="Of all numbers.")] = Digits.DOUBLE,
    out: Annotated[Path, Option(metavar="FOLDER", help="Where NAME.h and NAME.c go.")] = Path(),
    json: options.AsJson = False,
) -> None:
    """Write a torque controller, and its actuator's model, as C99 for a device's firmware.

    Fixed memory, no library beyond math.h; NAME is the controller's file's.
    """
    from daq.device_code import device_code

    code = device_code(controller, precision.value)
    header, source = code.save(out, controller.stem)
    if json:
        terminal.print_json({"header": header, "source": source, "precision": precision.value})
        return
    print(f"Written: {header}, {source}")
    terminal.print_next(f"compile it: cc -std=c99 -O2 -c {source}")
