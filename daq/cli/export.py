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


Log = Annotated[Path, Argument(metavar="LOG", help="A capture folder, or a CSV of one.")]
Target = Annotated[
    Path | None, Option(metavar="FILE", help="Default: beside the log, under its name.")
]


def export_mat(log: Log, out: Target = None, json: options.AsJson = False) -> None:
    """Write a log as a MAT file, for MATLAB, Octave and scipy.

    Level 5: a vector for each column, their units, and the record of the run. rig identify reads it
    too.
    """
    _export_log(log, out, "mat", json)


def export_mcap(log: Log, out: Target = None, json: options.AsJson = False) -> None:
    """Write a log as MCAP, for Foxglove and PlotJuggler.

    A message a sample on /samples at its time of day, the record of the run attached. Needs
    hybrid-rig[formats].
    """
    _export_log(log, out, "mcap", json)


def export_parquet(log: Log, out: Target = None, json: options.AsJson = False) -> None:
    """Write a log as Parquet, for pandas, Polars and DuckDB.

    Units are metadata of the columns, the record of the run that of the table. Needs
    hybrid-rig[formats].
    """
    _export_log(log, out, "parquet", json)


def _export_log(log: Path, out: Path | None, kind: str, json: bool) -> None:
    from daq.files import require_target
    from daq.logs.formats import WRITERS
    from daq.logs.recording import load_whole

    if out is not None:
        require_target(out, f".{kind}")
    recording = load_whole(log)
    file = out or recording.path.with_suffix(f".{kind}")
    WRITERS[kind](recording, file)
    if recording.warning:
        terminal.report("warning", recording.warning)
    if json:
        terminal.print_json({"file": file, "format": kind, "samples": recording.n_samples})
        return
    print(f"Written: {file} ({recording.n_samples} samples)")


def export_fmu(
    result: Annotated[
        Path, Argument(metavar="RESULT", help="A parameters.yaml, its folder, or its run's.")
    ],
    out: Annotated[
        Path | None, Option(metavar="FILE", help="Default: MODEL.fmu beside the result.")
    ] = None,
    trust: options.Trust = False,
    json: options.AsJson = False,
) -> None:
    """Write an identified model as an FMU, for other simulators.

    FMI 3.0, co-simulation. Its C source is inside, and on Linux with a compiler (cc) what that
    compiles to; whoever simulates it needs no Python. Parameters and starts can be set, inputs are
    held over a step.
    """
    from daq.files import require_target
    from daq.fmu.export import export
    from daq.identification.request import result_file

    if out is not None:
        require_target(out, ".fmu")
    file = result_file(result)
    unit = export(file, trust=trust)
    path = unit.save(out or file.with_name(f"{unit.identifier}.fmu"))
    binaries = [] if unit.binary is None else [unit.platform]
    if not binaries:
        cure = f"its simulator compiles it, or you: sources/{unit.identifier}.c says how"
        terminal.report("note", f"there is no binary in it; {cure}")
    if json:
        terminal.print_json({"file": path, "model": unit.identifier, "binaries": binaries})
        return
    binary = f" (with a binary for {binaries[0]})" if binaries else ""
    terminal.print_text(f"Written: {path}{binary}")


def export_c(
    controller: Annotated[
        Path, Argument(metavar="CONTROLLER.yaml", help="A file that rig tune made.")
    ],
    precision: Annotated[Digits, Option(help="Of all numbers.")] = Digits.DOUBLE,
    out: Annotated[Path, Option(metavar="FOLDER", help="Where NAME.h and NAME.c go.")] = Path(),
    json: options.AsJson = False,
) -> None:
    """Write a torque controller as C99, for a firmware.

    The model of its actuator is with it. Fixed memory, no library beyond math.h; NAME is the
    controller's file's.
    """
    from daq.device_code import device_code

    code = device_code(controller, precision.value)
    header, source = code.save(out, controller.stem)
    if json:
        terminal.print_json({"header": header, "source": source, "precision": precision.value})
        return
    print(f"Written: {header}, {source}")
    terminal.print_next(f"compile it: cc -std=c99 -O2 -c {source}")
