"""``rig analyse``: what a protocol concludes from its run, in tables and figures."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from daq.cli import terminal as console
from daq.errors import USER_CODE_ERRORS, ConfigError, RigError, RunError, raised_in
from daq.experiment import ClosedLoop, Experiment
from daq.files import make_folder, write_whole
from daq.findings import Findings, Number, Table
from daq.logs.capture import LOG_NAME, RUN_NAME
from daq.logs.recording import end_of_run, load, log_path, read_record
from daq.lookup.classes import find_protocol
from daq.run.protocol import failure

RESULTS = "results"
_WIDTH = 2 * 1.96  # standard deviations in a 95 % interval


def analyse_command(folder: Path, as_json: bool) -> None:
    """Conclude from a capture again, and show it."""
    csv = log_path(folder)
    warning = end_of_run(csv, read_record(csv), torn=False)
    if warning is not None:
        console.report_warning(warning)
    experiment = recorded_experiment(folder)
    found = _conclude(experiment, folder)
    if found is None:
        raise ConfigError(
            f"{folder}: the protocol {experiment.protocol!r} only excites, and concludes nothing "
            f"by itself; rig identify {folder} finds parameters"
        )
    if as_json:
        console.print_json(as_document(found, folder))
        return
    show_findings(found, folder)
    console.print_next(*next_commands(folder))


def next_commands(folder: Path) -> list[str]:
    """What serves after a run: the identification from it, or one in the ranges that it found.

    A protocol that concludes something itself was not meant to excite everything.
    """
    results = folder / RESULTS
    if not results.exists():
        return [f"rig identify {folder}"]
    ranges = results / "ranges.yaml"
    return [f"rig run prbs.yaml --identify --config {ranges}"] if ranges.exists() else []


def recorded_experiment(folder: Path) -> Experiment:
    """The experiment that a capture folder says was run; ConfigError when it does not."""
    path = folder / RUN_NAME
    record = read_record(log_path(folder))
    if record is None:
        raise ConfigError(f"{path}: there is no such file; give a capture folder that rig run made")
    settings = record.get("experiment")
    if not isinstance(settings, dict) or not isinstance(settings.get("protocol"), str):
        raise ConfigError(f"{path}: experiment.protocol: the name of a protocol is missing")
    kind = find_protocol(settings["protocol"], folder)
    # Beside the settings stands what the protocol made of them.
    written = {name: value for name, value in settings.items() if name != "excitation"}
    try:
        experiment = kind.model_validate(written)
    except ValueError as error:
        raise ConfigError(f"{path}: experiment: {error}") from None
    return experiment


def analyse(experiment: Experiment, folder: Path) -> Findings | None:
    """What follows from a run that has just ended; a warning says why nothing does."""
    try:
        return _conclude(experiment, folder)
    except RigError as error:
        console.report_warning(str(error))
        return None


def _conclude(experiment: Experiment, folder: Path) -> Findings | None:
    """What an experiment's protocol concludes from a capture, written to its ``results``.

    None of a protocol that only excites. Raises RunError where nothing follows, or the protocol
    has a mistake.
    """
    if type(experiment).findings is Experiment.findings:
        return None
    extra = tuple(experiment.columns) if isinstance(experiment, ClosedLoop) else ()
    log = load(folder / LOG_NAME, extra)
    columns = {name: log.frame[name].to_numpy() for name in extra if name in log.frame}
    try:
        found = experiment.findings(log.samples(), columns)
        if found is not None and not isinstance(found, Findings):
            raise TypeError(f"it returned {found!r}; return daq.findings.Findings or None")
    except ValueError as error:
        at = raised_in(type(experiment), error)
        raise RunError(f"{folder}: no result: {error}{at}") from None
    except USER_CODE_ERRORS as error:
        raise RunError(
            f"{folder}: no result: {failure(experiment, 'in findings()', error)}"
        ) from error
    if found is not None:
        _write(found, folder / RESULTS)
    return found


def as_document(found: Findings, folder: Path) -> dict[str, Any]:
    """Findings for machines, and the files they were written to."""
    written = [str(path) for path in sorted((folder / RESULTS).iterdir())]
    return {**_contents(found), "files": written}


def _contents(found: Findings) -> dict[str, Any]:
    return {
        "numbers": {
            n.name: {"value": n.value, "unit": n.unit, "low": n.low, "high": n.high}
            for n in found.numbers
        },
        "tables": {t.name: {k: v.tolist() for k, v in t.columns.items()} for t in found.tables},
        "ranges": {name: list(ends) for name, ends in found.ranges.items()},
        "remarks": list(found.remarks),
    }


def show_findings(found: Findings, folder: Path) -> None:
    """Findings for people."""
    if found.numbers:
        console.print_table(
            "Results",
            ["quantity", "value", "95 % interval", "unit", "meaning"],
            [_number_row(number) for number in found.numbers],
            text=["unit", "meaning"],
        )
    for table in filter(lambda table: table.printed, found.tables):
        heads = [_with_unit(name, table) for name in table.columns]
        rows = zip(*(values.tolist() for values in table.columns.values()), strict=True)
        console.print_table(table.title, heads, [[console.number(v) for v in row] for row in rows])
    for remark in found.remarks:
        console.print_text(remark)
    console.print_line(f"Results: {folder / RESULTS}")


def _number_row(number: Number) -> list[str]:
    scale, unit = console.engineering(number.value, number.unit)
    value, interval, digits = scale * number.value, "-", 4
    if number.low is not None and number.high is not None:
        if math.isfinite(number.high - number.low):
            digits = console.digits(number.value, (number.high - number.low) / _WIDTH)
        ends = (console.number(scale * end, digits) for end in (number.low, number.high))
        interval = " .. ".join(ends)
    return [number.name, console.number(value, digits), interval, unit, number.meaning]


def _with_unit(name: str, table: Table) -> str:
    return f"{name} [{table.units[name]}]" if name in table.units else name


def _write(found: Findings, folder: Path) -> None:
    """Tables as CSV, figures, and all in findings.json."""
    from daq.figures import style
    from daq.figures.findings import draw

    make_folder(folder)
    for table in found.tables:
        rows = np.column_stack(list(table.columns.values()))
        lines = [",".join(table.columns), *(",".join(map(repr, row)) for row in rows.tolist())]
        write_whole(folder / f"{table.name}.csv", "\n".join(lines) + "\n")
    for figure in found.figures:
        drawn = draw(figure)
        for kind in style.PRINTED:
            write_whole(folder / f"{figure.name}.{kind}", style.render(drawn, kind))
    text = json.dumps(console.plain(_contents(found)), indent=2)
    write_whole(folder / "findings.json", text + "\n")
    # Of an earlier analysis with another protocol's text.
    (folder / "ranges.yaml").unlink(missing_ok=True)
    if found.ranges:
        lines = ["# Starting ranges for rig identify --config", "ranges:"]
        lines += [f"  {k}: [{low:.6g}, {high:.6g}]" for k, (low, high) in found.ranges.items()]
        write_whole(folder / "ranges.yaml", "\n".join(lines) + "\n")
