"""The report of an identification: a page, figures, a LaTeX table and a JSON document."""

import datetime
import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from daq.documents import plain
from daq.figures import style
from daq.figures.picture import Picture
from daq.figures.style import Format
from daq.files import make_folder, write_whole
from daq.identification.baseline import Baseline, baseline_of
from daq.identification.records import LoggedRecord
from daq.identification.request import SettingsRequest
from daq.identification.result import Identification, errors_document
from daq.logs.recording import read_record
from daq.lookup.models import DEFAULT_MODEL
from daq.progress import Progress, Watch, ignore
from daq.report.latex import latex
from daq.report.page import Drawing, page
from daq.report.pictures import Subject, pictures
from sysid import Metrics

DATA, FIGURES = "report.json", "figures"
_PAGE, _TABLE = "report.html", "parameters.tex"
# What a report takes, for the progress display; a few figures more or fewer do no harm.
_STEPS = 18


def publish(result: Identification, folder: Path, watch: Watch = ignore) -> dict[str, str]:
    """Write the report into a folder; the files by what they are.

    Raises RunError where the disk refuses.
    """
    watch(Progress("Report", 0, _STEPS, "linear baseline"))
    training = [fitted.log for fitted in result.training]
    validation = [fitted.log for fitted in result.validation]
    linear = baseline_of(result.model, training, validation)
    document = plain(_document(result, linear))
    subject = Subject(
        model=result.model,
        document=document,
        training=training,
        validation=validation,
        training_runs=[fitted.run for fitted in result.training],
        validation_runs=[fitted.run for fitted in result.validation],
        foreign=result.problem.mapping is not None,
        baselines={linear.name: linear.runs} if isinstance(linear, Baseline) else {},
    )
    drawings: list[Drawing] = []
    for picture, files in draw(subject, folder / FIGURES, ["svg"]):
        drawings.append(
            Drawing(picture.name, picture.topic, picture.caption, files["svg"].decode())
        )
        count = len(drawings)
        watch(Progress("Report", min(count, _STEPS - 1), _STEPS, f"{count} figures"))
    pages = {
        "report": (_PAGE, page(result.model, document, subject.rows, drawings)),
        "data": (DATA, json.dumps(document, indent=1) + "\n"),
        "latex": (_TABLE, latex(subject.rows)),
    }
    for name, content in pages.values():
        write_whole(folder / name, content)
    watch(Progress("Report", _STEPS, _STEPS, f"{len(drawings)} figures"))
    return {kind: str(folder / name) for kind, (name, _) in pages.items()}


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


def command_of(
    request: SettingsRequest,
    training: Sequence[LoggedRecord],
    validation: Sequence[LoggedRecord],
    models: Sequence[str],
    more: Sequence[str],
) -> str:
    """What to type to identify the same again; more: words behind the options."""
    paths = _paths(training)
    words = ["rig", "identify", *map(str, paths)]
    for path in _paths(validation):
        if path not in paths:
            words += ["--validate", str(path)]
    if request.config is not None:
        words += ["--config", request.config]
    words += _option("model", list(models))
    for name, value in (request.options or {}).items():
        if name not in ("seed", "model"):
            words += _option(name, value)
    words += more
    for setting in request.settings:
        words += ["--set", setting]
    return shlex.join(words)


def fingerprints(
    training: Sequence[LoggedRecord], validation: Sequence[LoggedRecord]
) -> list[dict[str, Any]]:
    """Size and hash of each log, so that it is known again."""
    uses = (("training", training), ("validation", validation))
    return [_fingerprint(log, use) for use, logs in uses for log in logs]


def _document(result: Identification, linear: Baseline | str) -> dict[str, Any]:
    """The identification's document with what only the report says."""
    now = datetime.datetime.now(datetime.UTC)
    meanings = {p.name: p.description for p in result.model.parameters}
    history = [float(error) for error in result.estimator.history_]
    return {
        **result.document,
        "written": f"{now:%Y-%m-%d %H:%M} UTC",
        "parameters": {
            name: {**entry, "description": meanings[name]}
            for name, entry in result.document["parameters"].items()
        },
        "search": {**result.document["search"], "history": history},
        "comparison": _comparison(result, linear),
        "reproduction": _reproduction(result),
    }


def _comparison(result: Identification, linear: Baseline | str) -> dict[str, Any]:
    if isinstance(linear, str):
        return {"left_out": linear}

    def logs(metrics: Sequence[Metrics]) -> list[dict[str, Any]]:
        return [{"outputs": errors_document(result.model, errors)} for errors in metrics]

    return {
        "name": linear.name,
        "orders": linear.orders,
        "metrics": {"training": logs(linear.training), "validation": logs(linear.validation)},
    }


def _reproduction(result: Identification) -> dict[str, Any]:
    """How to do it again: command, logs with their fingerprints, runs they came from."""
    problem = result.problem
    model = problem.request.option("model")
    models = [] if model in (None, DEFAULT_MODEL) else [model]
    seed = ["--seed", str(problem.settings.seed)]
    training = [fitted.log for fitted in result.training]
    validation = [fitted.log for fitted in result.validation]
    return {
        "command": command_of(problem.request, training, validation, models, seed),
        "folder": str(Path.cwd()),
        "columns": problem.request.config if problem.mapping is not None else None,
        "hold_back": problem.settings.hold_back,
        "logs": fingerprints(training, validation),
        "runs": [
            _run(record)
            for path in _paths([*training, *validation])
            if (record := read_record(path)) is not None
        ],
    }


def _paths(logs: Sequence[LoggedRecord]) -> list[Path]:
    """Their files, each once: a log of which a part is held back stands for two."""
    return list(dict.fromkeys(log.path for log in logs))


def _option(name: str, value: Any) -> list[str]:
    flag = f"--{name.replace('_', '-')}"
    if value is None or value is False:
        return []
    if value is True:
        return [flag]
    values = value if isinstance(value, list | tuple) else [value]
    return [word for item in values for word in (flag, str(item))]


def _fingerprint(log: LoggedRecord, use: str) -> dict[str, Any]:
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
    section = record.get(key)
    return section if isinstance(section, dict) else {}
