"""``rig analyse``: what a protocol concludes from its run."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument

from daq import notation
from daq.cli import options, terminal
from daq.identification.rows import QuantityRow

if TYPE_CHECKING:
    from daq.findings import Findings, Number


def analyse(
    run: Annotated[Path, Argument(metavar="RUN", help="Capture folder.")],
    trust: options.Trust = False,
    json: options.AsJson = False,
) -> None:
    """Conclude from a log what its protocol is for.

    Tables, figures and numbers, as at the end of the run; for a log of whatever age.
    """
    from daq.recording import analysis

    with terminal.watching(json) as watch:
        result = analysis.analyse(run, trust=trust, watch=watch)
    if json:
        terminal.print_json(result.document)
        return
    show_findings(result.findings, run)
    terminal.print_next(*next_commands(run))


def next_commands(folder: Path) -> list[str]:
    """What serves after a run: the identification from it, or one in the ranges of its findings.

    A protocol that concludes something itself was not meant to excite everything.
    """
    from daq.logs.capture import LOG_NAME, read_record
    from daq.recording.analysis import RESULTS

    results = folder / RESULTS
    if not results.exists():
        return [f"rig identify {shlex.quote(str(folder))}"]
    ranges = results / "ranges.yaml"
    if not ranges.exists():
        return []
    rig_file = (read_record(folder / LOG_NAME) or {}).get("rig_file")
    on_rig = options.on_rig(rig_file) if rig_file else ""
    return [f"rig run prbs.yaml{on_rig} --identify --config {shlex.quote(str(ranges))}"]


def show_findings(findings: Findings, folder: Path) -> None:
    """Tables and remarks on standard output."""
    from daq.recording.analysis import RESULTS

    if findings.numbers:
        head = ["quantity", "value", "95 % interval", "unit", "meaning"]
        numbers = [_number_row(number) for number in findings.numbers]
        terminal.print_table("Results", head, numbers, text=["unit", "meaning"])
    for table in filter(lambda table: table.printed, findings.tables):
        units = {name: f" [{unit}]" for name, unit in table.units.items()}
        heads = [f"{name}{units.get(name, '')}" for name in table.columns]
        rows = zip(*(values.tolist() for values in table.columns.values()), strict=True)
        terminal.print_table(table.title, heads, [list(map(_plain, row)) for row in rows])
    for remark in findings.remarks:
        terminal.print_text(remark)
    print(f"Results: {folder / RESULTS}")


def _number_row(number: Number) -> list[str]:
    interval = None
    low, high = number.low, number.high
    if low is not None and high is not None and math.isfinite(high - low):
        interval = low, high
    row = QuantityRow(number.name, number.value, number.unit, interval)
    scale, unit = row.engineering

    def write(value: float) -> str:
        return row.text(value, scale) if interval else _plain(scale * value)

    ends = row.interval_text(write, between=" .. ", empty="-")
    return [number.name, write(number.value), ends, unit, number.meaning]


def _plain(value: float) -> str:
    """A number that nothing says the precision of: four digits, or as few as it has."""
    return min(terminal.number(value), notation.shortest(value), key=len)
