"""The report of an identification: a page, figures, a LaTeX table and a JSON document."""

import csv
import datetime
import io
import json
import math
import shlex
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from daq.documents import plain
from daq.figures import style
from daq.files import digest, make_folder, write_whole
from daq.identification.baseline import Baseline
from daq.identification.draft import Draft
from daq.identification.records import LoggedRecord, Split
from daq.identification.request import PARAMETERS, SettingsRequest
from daq.identification.result import Identification, errors_document
from daq.logs.capture import read_record, settings_of
from daq.lookup.models import DEFAULT_MODEL
from daq.progress import Progress, Watch, ignore
from daq.report.latex import latex, latex_errors
from daq.report.page import Drawing, Picture, page
from daq.report.pictures import Subject, pictures
from daq.second_process import Job, SecondProcess, done

DATA, FIGURES = "report.json", "figures"
_PAGE, _TABLE = "report.html", "parameters.tex"
_ERRORS_TABLE, _ERRORS = "errors.tex", "errors.csv"
# What a report takes, for the progress display; a few figures more or fewer do no harm.
_STEPS = 18
_AHEAD = 2  # figures that the other process has before it, so that it never waits for one

Files = dict[str, bytes]  # contents by format


def publish(
    result: Identification, folder: Path, watch: Watch = ignore, draft: Draft | None = None
) -> dict[str, str]:
    """Write the report into a folder; the files by what they are.

    draft: what was begun of it, if anything. Raises RunError where the disk refuses.
    """
    if draft is None:
        with SecondProcess() as second:
            return publish(result, folder, watch, Draft(second))
    watch(Progress("Report", 0, _STEPS, "linear baseline"))
    logs = [fitted.log for fitted in result.training], [fitted.log for fitted in result.validation]
    linear = draft.baselines(result.model, logs)
    document = plain(_document(result, logs, linear))
    parts = result.training, result.validation
    training, validation = ([(fitted.log, fitted.run) for fitted in part] for part in parts)
    baseline = None if isinstance(linear, str) else linear[0]
    subject = Subject(result.model, document, training, validation, baseline)
    drawings: list[Drawing] = []
    for picture, files in draw(pictures(subject), folder / FIGURES, ["svg"], draft.second):
        drawings.append((picture, files["svg"]))
        count = len(drawings)
        watch(Progress("Report", min(count, _STEPS - 1), _STEPS, f"{count} figures"))
    pages = {
        "report": (_PAGE, page(result.model, document, subject.rows, drawings)),
        "data": (DATA, json.dumps(document, indent=1) + "\n"),
        "latex": (_TABLE, latex(subject.rows)),
        "latex_errors": (_ERRORS_TABLE, latex_errors(subject.rows)),
        "errors": (_ERRORS, _table(result.rows.errors)),
    }
    for name, content in pages.values():
        write_whole(folder / name, content)
    watch(Progress("Report", _STEPS, _STEPS, f"{len(drawings)} figures"))
    return {kind: str(folder / name) for kind, (name, _) in pages.items()}


def draw(
    figures: Iterable[Picture],
    folder: Path,
    formats: Sequence[str],
    second: SecondProcess | None = None,
) -> Iterator[tuple[Picture, Files]]:
    """Figures, each written to files of the formats; with what is in them.

    second: a process that renders beside this one.
    """
    make_folder(folder)
    for picture, contents in _rendered(figures, formats, second):
        for kind, content in contents.items():
            write_whole(folder / f"{picture.name}.{kind}", content)
        yield picture, contents


def _rendered(
    figures: Iterable[Picture], formats: Sequence[str], second: SecondProcess | None
) -> Iterator[tuple[Picture, Files]]:
    """Figures with what is in their files, in order, by whichever process is free."""
    waiting: deque[tuple[Picture, Job[Files]]] = deque()
    for picture in figures:
        if second is not None and sum(job.pending for _, job in waiting) < _AHEAD:
            job = second.call(style.render_each, picture.figure, formats)
        else:
            job = done(style.render_each(picture.figure, formats))
        waiting.append((picture, job))
        while waiting and not waiting[0][1].pending:
            yield waiting[0][0], waiting.popleft()[1].result()
    for picture, job in waiting:
        yield picture, job.result()


def command_of(
    request: SettingsRequest, logs: Split, models: Sequence[str], more: Sequence[str]
) -> str:
    """What to type to identify the same again; more: words behind the options."""
    training, validation = map(_paths, logs)
    words = ["rig", "identify", *map(str, training)]
    for path in validation:
        words += [] if path in training else ["--validate", str(path)]
    return shlex.join([*words, *request.words(model=list(models), seed=None), *more])


def fingerprints(logs: Split) -> list[dict[str, Any]]:
    """Size and hash of each log, so that it is known again."""
    return [
        {
            "log": str(log.path),
            "name": log.dataset.name,
            "use": use,
            "samples": log.dataset.n_samples,
            "measured": int(np.isfinite(log.dataset.outputs).any(axis=1).sum()),
            "sample_rate": 1.0 / log.dataset.dt,
            "sha256": digest(log.path),
            **({"merged": {str(f): digest(f) for f in log.merged}} if log.merged else {}),
        }
        for use, part in zip(("training", "validation"), logs, strict=True)
        for log in part
    ]


def _table(rows: Sequence[Mapping[str, str | float]]) -> str:
    """Rows as a CSV; nothing for what is no number."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        finite = {k: v for k, v in row.items() if isinstance(v, str) or math.isfinite(v)}
        writer.writerow(finite)
    return text.getvalue()


def _document(
    result: Identification, logs: Split, linear: Sequence[Baseline] | str
) -> dict[str, Any]:
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
        "reproduction": _reproduction(result, logs),
    }


def _comparison(result: Identification, linear: Sequence[Baseline] | str) -> dict[str, Any]:
    if isinstance(linear, str):
        return {"left_out": linear}
    return {"baselines": [_baseline(result, each) for each in linear]}


def _baseline(result: Identification, baseline: Baseline) -> dict[str, Any]:
    metrics = {
        part: [{"outputs": errors_document(result.model, errors)} for errors in logs]
        for part, logs in (("training", baseline.training), ("validation", baseline.validation))
    }
    more = {"more_inputs": list(baseline.inputs)} if baseline.inputs else {}
    return {"name": baseline.name, "orders": baseline.orders, **more, "metrics": metrics}


def _reproduction(result: Identification, logs: Split) -> dict[str, Any]:
    """How to do it again: command, logs with their fingerprints, runs they came from."""
    problem = result.problem
    model = problem.request.options.get("model")
    models = [] if model in (None, DEFAULT_MODEL) else [model]
    seed = ["--seed", str(problem.settings.seed)]
    return {
        "command": command_of(problem.request, logs, models, seed),
        "folder": str(Path.cwd()),
        "parameters": str(result.parameters_file or PARAMETERS),
        "columns": problem.request.config if problem.mapping is not None else None,
        "settings": problem.reading,
        "hold_back": problem.settings.hold_back,
        "selection": problem.selection.document,
        "logs": fingerprints(logs),
        "runs": [
            _run(record)
            for path in _paths([*logs[0], *logs[1]])
            if (record := read_record(path)) is not None
        ],
    }


def _paths(logs: Sequence[LoggedRecord]) -> list[Path]:
    """Their files, each once: a log of which a part is held back stands for two."""
    return list(dict.fromkeys(log.path for log in logs))


def _run(record: Mapping[str, Any]) -> dict[str, Any]:
    """What is known of a capture's run; a record of another program may lack any of it."""
    experiment, rig = settings_of(record)
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
