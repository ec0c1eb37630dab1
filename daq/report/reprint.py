"""The figures of a finished identification's report, in other formats."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from daq.config import json_file
from daq.errors import ConfigError
from daq.figures.style import FORMATS
from daq.files import digest
from daq.identification import records
from daq.identification.baseline import refitted
from daq.identification.records import LoggedRecord, Split
from daq.identification.replay import read_parameters
from daq.identification.selection import Selection
from daq.identification.settings import reading_of
from daq.progress import Progress, Watch, ignore
from daq.report.pictures import Subject, pictures
from daq.report.publication import DATA, FIGURES, draw
from daq.second_process import SecondProcess
from sysid import BatchSimulator, ProcessModel, free_run

_AGAIN = "identify again to have a report of it"


def redraw(
    folder: Path,
    kinds: Sequence[str],
    out: Path | None = None,
    watch: Watch = ignore,
    trust: bool = False,
) -> list[Path]:
    """Draw the figures of a report again, from its numbers and logs; the files written.

    folder: of an identification, or of the run that it was made from. kinds: formats by name. out:
    default beside the report. trust: run the Python file of a model that the result names. Raises
    ConfigError.
    """
    for kind in kinds:
        if kind.lower() not in FORMATS:
            written = ", ".join(FORMATS)
            raise ConfigError(f"--format {kind}: figures are written as {written}")
    formats = [kind.lower() for kind in kinds]
    source = _report_in(folder)
    target = out or source.parent / FIGURES
    files: list[Path] = []
    with SecondProcess() as second:
        subject = _subject(source, trust)
        for picture, _ in draw(pictures(subject), target, formats, second):
            files += [target / f"{picture.name}.{kind}" for kind in formats]
            watch(Progress("Figures", len(files), len(files) + 1, f"{len(files)} files"))
    return files


def _report_in(folder: Path) -> Path:
    """The report's document in a folder, or in the identification below a capture folder."""
    for place in (folder / DATA, folder / "identification" / DATA):
        if place.exists():
            return place
    raise ConfigError(
        f"no {DATA} there",
        cure="name the folder of an identification, or of the run that it was made from (rig "
        "identify writes it unless --no-report is given)",
        file=folder,
    )


def _subject(source: Path, trust: bool) -> Subject:
    try:
        return _restored(json_file.load(source, "report", _AGAIN), source, trust)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"not a readable report ({type(error).__name__}: {error})", cure=_AGAIN, file=source
        ) from None


def _restored(document: Mapping[str, Any], source: Path, trust: bool) -> Subject:
    """A report's subject, its free runs simulated again."""
    model, values = read_parameters(source.with_name("parameters.yaml"), trust)
    parts = _logs(document["reproduction"], model)
    simulator, vector = BatchSimulator(model), model.vector(values)
    training, validation = (
        [(log, free_run(simulator, vector, log.dataset)) for log in logs] for logs in parts
    )
    linear = document["comparison"].get("baselines")
    baseline = refitted(linear[0], *parts) if linear else None
    return Subject(model, document, training, validation, baseline)


def _logs(reproduction: Mapping[str, Any], model: ProcessModel) -> Split:
    """The logs as they were used; ConfigError for one that is gone or another now."""
    config = Path(reproduction["columns"]) if reproduction["columns"] else None
    columns, _ = reading_of(config, reproduction.get("settings", []), model)
    selection = Selection.of(reproduction.get("selection", {}))
    root = Path(reproduction["folder"])
    logs: dict[str, dict[Path, LoggedRecord]] = {"training": {}, "validation": {}}
    for entry in reproduction["logs"]:
        path = root / entry["log"]
        for name, sha256 in {entry["log"]: entry["sha256"], **entry.get("merged", {})}.items():
            file = root / name
            if not file.exists():
                raise ConfigError("this log of the report is gone", cure=_AGAIN, file=file)
            if digest(file) != sha256:
                raise ConfigError("this log is another than the report's", cure=_AGAIN, file=file)
        logs[entry["use"]][path] = records.load(path, model, columns, selection)
    training, ends = records.hold_back(list(logs["training"].values()), reproduction["hold_back"])
    # Of a log that is in both, the end was held back.
    others = [log for path, log in logs["validation"].items() if path not in logs["training"]]
    return training, [*ends, *others]
