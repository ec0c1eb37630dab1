"""The report of an identification: a page, figures, a LaTeX table and a JSON document."""

from __future__ import annotations

import datetime
import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from daq.cli import terminal as console
from daq.cli.models import DEFAULT_MODEL
from daq.figures import style
from daq.figures.picture import Picture
from daq.figures.style import Format
from daq.files import make_folder, write_whole
from daq.identification.baseline import Baseline, beside
from daq.identification.records import Loaded
from daq.identification.request import Asked
from daq.identification.result import NOTES, Identified, errors_of
from daq.identification.settings import Prepared
from daq.logs.recording import read_record
from daq.report import latex as table
from daq.report.explanation import view
from daq.report.page import Drawing, page
from daq.report.pictures import Subject, pictures
from sysid.problem.metrics import Metrics

DATA, FIGURES = "report.json", "figures"
_PAGE, _TABLE = "report.html", "parameters.tex"
# What a report takes, for the progress display; a few figures more or fewer do no harm.
_STEPS = 18


def publish(
    prepared: Prepared,
    result: Identified,
    document: Mapping[str, Any],
    folder: Path,
    quiet: bool,
) -> dict[str, str]:
    """Write the report into a folder; the files by what they are.

    document: as ``reporting.document`` makes it. Raises RunError where the disk refuses.
    """
    with console.progress(quiet) as bar:
        bar.update("Report", 0, _STEPS, "linear baseline")
        linear = beside(result.model, result.training_logs, result.validation_logs)
        whole = console.plain(_whole(prepared, result, document, linear))
        subject = Subject(
            model=result.model,
            document=whole,
            training=result.training_logs,
            validation=result.validation_logs,
            training_runs=result.training_runs,
            validation_runs=result.validation_runs,
            foreign=prepared.mapping is not None,
            baselines={linear.name: linear.runs} if isinstance(linear, Baseline) else {},
        )
        drawings = []
        for one, files in draw(subject, folder / FIGURES, ["svg"]):
            drawings.append(Drawing(one.name, one.topic, one.caption, files["svg"].decode()))
            count = len(drawings)
            bar.update("Report", min(count, _STEPS - 1), _STEPS, f"{count} figures")
        pages = {
            "report": (_PAGE, page(whole, view(result.model, whole), drawings)),
            "data": (DATA, json.dumps(whole, indent=1) + "\n"),
            "latex": (_TABLE, table.latex(whole, NOTES)),
        }
        for name, content in pages.values():
            write_whole(folder / name, content)
        bar.update("Report", _STEPS, _STEPS, f"{len(drawings)} figures")
    return {what: str(folder / name) for what, (name, _) in pages.items()}


def draw(
    subject: Subject, folder: Path, formats: Sequence[Format]
) -> Iterator[tuple[Picture, dict[Format, bytes]]]:
    """Every figure, written to files of the formats; with what is in them."""
    make_folder(folder)
    for picture in pictures(subject):
        contents = {kind: style.render(picture.figure, kind) for kind in formats}
        for kind, content in contents.items():
            write_whole(folder / f"{picture.name}.{kind}", content)
        yield picture, contents


def _whole(
    prepared: Prepared,
    result: Identified,
    document: Mapping[str, Any],
    linear: Baseline | str,
) -> dict[str, Any]:
    """The document with what only the report tells."""
    now = datetime.datetime.now(datetime.UTC)
    meanings = {p.name: p.description for p in result.model.parameters}
    search = {**document["search"], "history": [float(e) for e in result.estimator.history_]}
    return {
        **{key: value for key, value in document.items() if key != "files"},
        "written": f"{now:%Y-%m-%d %H:%M} UTC",
        "parameters": {
            name: {**one, "description": meanings[name]}
            for name, one in document["parameters"].items()
        },
        "search": search,
        "comparison": _comparison(result, linear),
        "reproduction": _reproduction(prepared, result),
    }


def _comparison(result: Identified, linear: Baseline | str) -> dict[str, Any]:
    if isinstance(linear, str):
        return {"left_out": linear}

    def logs(metrics: Sequence[Metrics]) -> list[dict[str, Any]]:
        return [{"outputs": errors_of(result.model, one)} for one in metrics]

    return {
        "name": linear.name,
        "orders": linear.orders,
        "metrics": {"training": logs(linear.training), "validation": logs(linear.validation)},
    }


def _reproduction(prepared: Prepared, result: Identified) -> dict[str, Any]:
    """How to do it again: command, logs with their fingerprints, runs they came from."""
    asked = prepared.asked
    model = asked.options.get("model")
    models = [] if model in (None, DEFAULT_MODEL) else [model]
    seed = ["--seed", str(result.settings.seed)]
    training, validation = result.training_logs, result.validation_logs
    return {
        "command": command_of(asked, training, validation, models, seed),
        "folder": str(Path.cwd()),
        "columns": asked.config if prepared.mapping is not None else None,
        "hold_back": prepared.settings.hold_back,
        "logs": fingerprints(training, validation),
        "runs": [
            _run(record)
            for path in _paths([*result.training_logs, *result.validation_logs])
            if (record := read_record(path)) is not None
        ],
    }


def _paths(logs: Sequence[Loaded]) -> list[Path]:
    """Their files, each once: a log of which a part is held back stands for two."""
    return list(dict.fromkeys(log.path for log in logs))


def command_of(
    asked: Asked,
    training: Sequence[Loaded],
    validation: Sequence[Loaded],
    models: Sequence[str],
    more: Sequence[str],
) -> str:
    """What to type to identify the same again; more: words behind the options that were asked."""
    paths = _paths(training)
    words = ["rig", "identify", *map(str, paths)]
    for path in _paths(validation):
        if path not in paths:
            words += ["--validate", str(path)]
    if asked.config is not None:
        words += ["--config", asked.config]
    words += _option("model", list(models))
    for name, value in asked.options.items():
        if name not in ("seed", "model"):
            words += _option(name, value)
    words += more
    for setting in asked.settings:
        words += ["--set", setting]
    return shlex.join(words)


def fingerprints(training: Sequence[Loaded], validation: Sequence[Loaded]) -> list[dict[str, Any]]:
    """What is said of each log, so that it is known again."""
    uses = (("training", training), ("validation", validation))
    return [_log(log, use) for use, logs in uses for log in logs]


def _option(name: str, value: Any) -> list[str]:
    flag = f"--{name.replace('_', '-')}"
    if value is None or value is False:
        return []
    if value is True:
        return [flag]
    values = value if isinstance(value, list | tuple) else [value]
    return [word for one in values for word in (flag, str(one))]


def _log(log: Loaded, use: str) -> dict[str, Any]:
    return {
        "log": str(log.path),
        "name": log.dataset.name,
        "use": use,
        "samples": log.dataset.n_samples,
        "sample_rate": 1.0 / log.dataset.dt,
        "sha256": hashlib.sha256(log.path.read_bytes()).hexdigest(),
    }


def _run(record: Mapping[str, Any]) -> dict[str, Any]:
    """What is known of a capture's run; a record of another program may lack any of it."""
    experiment, rig = (_section(record, key) for key in ("experiment", "rig"))
    seeds = {
        name: part["seed"]
        for name, part in experiment.items()
        if isinstance(part, dict) and "seed" in part
    }
    return {
        "started": str(record.get("started", "")),
        "experiment": str(experiment.get("name") or experiment.get("protocol", "")),
        "rig": str(rig.get("name", "")),
        "seeds": ", ".join(f"{name} {seed}" for name, seed in seeds.items()),
    }


def _section(record: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = record.get(key)
    return found if isinstance(found, dict) else {}
