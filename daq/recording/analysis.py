"""What a protocol concludes from its run, in numbers, tables and figures."""

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daq.documents import plain
from daq.errors import USER_CODE_ERRORS, ConfigError, RigError, RunError, nearby, raised_in
from daq.experiment import ClosedLoop, Experiment
from daq.files import make_folder, write_whole
from daq.findings import Findings
from daq.logs.capture import LOG_NAME, RUN_NAME, read_record
from daq.logs.recording import end_of_run, load, log_path
from daq.lookup.classes import find_class
from daq.progress import Watch, ignore, warn
from daq.run.protocol import failure
from daq.views import Lines, Shown

RESULTS = "results"


@dataclass(frozen=True, repr=False)
class Analysis(Shown):
    """Findings from a capture folder; they stand in its ``results``, too.

    >>> Analysis(Path("runs/today"), Findings(remarks=("all quiet",))).findings.remarks
    ('all quiet',)
    """

    folder: Path
    findings: Findings

    @property
    def headline(self) -> str:
        """The folder, and what was remarked."""
        return "; ".join((str(self.folder), *self.findings.remarks))

    def lines(self) -> Lines:
        """Its numbers, with their 95 % intervals."""
        rows = [["result", "value", "95 % interval", "unit"]]
        for result in self.findings.numbers:
            ends = ["-" if end is None else f"{end:.4g}" for end in (result.low, result.high)]
            span = "-" if ends == ["-", "-"] else " .. ".join(ends)
            rows.append([result.name, f"{result.value:.4g}", span, result.unit])
        return rows if self.findings.numbers else ()

    @property
    def document(self) -> dict[str, Any]:
        """The same for machines."""
        written = [str(path) for path in sorted((self.folder / RESULTS).iterdir())]
        return {**_contents(self.findings), "files": written}


def analyse(folder: str | Path, *, trust: bool = False, watch: Watch = ignore) -> Analysis:
    """Conclude from a capture what its protocol is for, however old it is.

    trust: run the Python file of a protocol that ``run.json`` names. Raises ConfigError for what is
    no capture, or one of a protocol that only excites; RunError where nothing follows.

    >>> from daq import analyse, record
    >>> analyse(record("prbs.yaml").folder)
    Traceback (most recent call last):
    daq.errors.ConfigError: runs/...: the protocol 'prbs' only excites, and concludes ...
    """
    folder = Path(folder)
    csv = log_path(folder)
    warn(watch, end_of_run(csv, read_record(csv), torn=False))
    experiment = recorded_experiment(folder, trust)
    findings = conclude(experiment, folder)
    if findings is None:
        raise ConfigError(
            f"the protocol {nearby(experiment.protocol)!r} only excites, and concludes nothing by "
            "itself",
            cure=f"rig identify {shlex.quote(str(folder))} finds parameters",
            file=folder,
        )
    return Analysis(folder, findings)


def recorded_experiment(folder: Path, trust: bool = False) -> Experiment:
    """The experiment that a capture folder says was run; ConfigError when it does not.

    trust: run the Python file of its protocol, where it is in one.
    """
    path = folder / RUN_NAME
    record = read_record(log_path(folder))
    if record is None:
        raise ConfigError(
            "there is no such file", cure="give a capture folder that rig run made", file=path
        )
    settings = record.get("experiment")
    if not isinstance(settings, dict) or not isinstance(settings.get("protocol"), str):
        raise ConfigError("experiment.protocol: the name of a protocol is missing", file=path)
    kind: type[Experiment] = find_class(
        "protocol", settings["protocol"], folder, record=None if trust else path
    )
    # Beside the settings stands what the protocol made of them.
    written = {name: value for name, value in settings.items() if name != "excitation"}
    try:
        return kind.model_validate(written)
    except ValueError as error:
        raise ConfigError(f"experiment: {error}", file=path) from None


def conclude_or_warn(experiment: Experiment, folder: Path, watch: Watch) -> Findings | None:
    """What follows from a run that has just ended; a warning says why nothing does."""
    try:
        return conclude(experiment, folder)
    except RigError as error:
        warn(watch, str(error))
        return None


def conclude(experiment: Experiment, folder: Path) -> Findings | None:
    """What an experiment's protocol concludes from a capture, written to its ``results``.

    None of a protocol that only excites. Raises RunError where nothing follows, or the protocol
    has a mistake; a RigError of the protocol's own as it is.
    """
    if type(experiment).findings is Experiment.findings:
        return None
    extra = tuple(experiment.columns) if isinstance(experiment, ClosedLoop) else ()
    log = load(folder / LOG_NAME, extra)
    columns = {name: log.columns[name] for name in extra if name in log.columns}
    try:
        findings = experiment.findings(log.samples(), columns)
        if findings is not None and not isinstance(findings, Findings):
            raise TypeError(f"it returned {findings!r}; return daq.findings.Findings or None")
    except RigError:
        raise  # the protocol's own words
    except ValueError as error:
        at = raised_in(type(experiment), error)
        raise RunError(f"no result: {error}{at}", file=folder) from None
    except USER_CODE_ERRORS as error:
        problem = failure(experiment, "in findings()", error)
        raise RunError(f"no result: {problem}", file=folder) from error
    if findings is not None:
        _write(findings, folder / RESULTS)
    return findings


def _contents(findings: Findings) -> dict[str, Any]:
    return {
        "numbers": {
            n.name: {"value": n.value, "unit": n.unit, "low": n.low, "high": n.high}
            for n in findings.numbers
        },
        "tables": {t.name: {k: v.tolist() for k, v in t.columns.items()} for t in findings.tables},
        "ranges": {name: list(ends) for name, ends in findings.ranges.items()},
        "remarks": list(findings.remarks),
    }


def _write(findings: Findings, folder: Path) -> None:
    """Tables as CSV, figures, and all in findings.json."""
    make_folder(folder)
    for table in findings.tables:
        rows = np.column_stack(list(table.columns.values()))
        lines = [",".join(table.columns), *(",".join(map(repr, row)) for row in rows.tolist())]
        write_whole(folder / f"{table.name}.csv", "\n".join(lines) + "\n")
    if findings.figures:
        _write_figures(findings, folder)
    text = json.dumps(plain(_contents(findings)), indent=2)
    write_whole(folder / "findings.json", text + "\n")
    # Of an earlier analysis with another protocol's text.
    (folder / "ranges.yaml").unlink(missing_ok=True)
    if findings.ranges:
        lines = ["# Starting ranges for rig identify --config", "ranges:"]
        lines += [f"  {k}: [{low:.6g}, {high:.6g}]" for k, (low, high) in findings.ranges.items()]
        write_whole(folder / "ranges.yaml", "\n".join(lines) + "\n")


def _write_figures(findings: Findings, folder: Path) -> None:
    # Imports matplotlib, for which numbers and tables do not wait.
    from daq.figures import style
    from daq.figures.findings import draw

    for chart in findings.figures:
        figure = draw(chart)
        for kind in style.PRINTED:
            write_whole(folder / f"{chart.name}.{kind}", style.render(figure, kind))
