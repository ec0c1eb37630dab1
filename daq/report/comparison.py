"""The page of a comparison of models, with its figures."""

import datetime
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from daq.documents import plain
from daq.figures.parameters import ratios
from daq.figures.responses import responses
from daq.figures.signals import Panel, closer_sentence
from daq.files import write_whole
from daq.identification.comparison import ComparisonResult
from daq.lookup.models import trust_option
from daq.report.page import Picture, rendered
from daq.report.publication import FIGURES, command_of, draw, fingerprints
from sysid.judging.comparison import AS_GOOD

_PAGE = "comparison.html"


def publish_comparison(result: ComparisonResult) -> str:
    """Write the page and its figures into the comparison's folder; the page's path.

    Raises RunError where the disk refuses.
    """
    folder, group = result.folder, result.group
    document = plain({**result.document, "files": {"comparison": str(result.file)}})
    drawings = [
        (picture, files["svg"])
        for picture, files in draw(_pictures(document, result), folder / FIGURES, ["svg"])
    ]
    now = datetime.datetime.now(datetime.UTC)
    preferred = next(row for row in document["structures"] if row["name"] == document["preferred"])
    logs = group.training, group.validation
    variables = {
        "written": f"{now:%Y-%m-%d %H:%M} UTC",
        "outputs": result.outputs,
        "units": {output.name: output.unit for output in group.problem.model.outputs},
        "as_good": AS_GOOD,
        "preferred_file": preferred.get("parameters_file"),
        "trust_option": trust_option(preferred["name"]),
        "reproduction": {
            "command": command_of(
                group.problem.request, logs, [*result.models.values()], result.request_words
            ),
            "folder": str(Path.cwd()),
            "logs": fingerprints(logs),
        },
    }
    text = rendered("comparison.html.j2", document, variables, drawings)
    write_whole(folder / _PAGE, text)
    return str(folder / _PAGE)


def _pictures(document: Mapping[str, Any], result: ComparisonResult) -> Iterator[Picture]:
    rows = document["structures"]
    others = {
        row["name"]: (ratio["value"], *ratio["interval_95"])
        for row in rows
        if (ratio := row.get("squared_errors_relative")) is not None
    }
    if others:
        yield Picture(
            "ratios",
            "comparison",
            "Squared errors of the free runs in validation, in parts of the best model's, with "
            "95 % intervals.",
            ratios([rows[0]["name"], *others], np.array([(1.0, 1.0, 1.0), *others.values()])),
        )
    if result.group.validation:
        yield _first_log(document, result)


def _first_log(document: Mapping[str, Any], result: ComparisonResult) -> Picture:
    """The preferred model and the best other one, over the first validation log."""
    runs = {candidate.name: candidate.validation[0] for candidate in result.candidates}
    ranked = [row["name"] for row in document["structures"] if row["name"] in runs]
    names = [document["preferred"], *(n for n in ranked if n != document["preferred"])][:2]
    log = result.group.validation[0].dataset
    shown = {"measured": log.outputs} | {name: runs[name] for name in names}
    panels = [
        Panel(output.name, output.unit, {name: lines[:, j] for name, lines in shown.items()})
        for j, output in enumerate(result.group.problem.model.outputs)
    ]
    return Picture(
        "validation",
        "comparison",
        f"Validation ({log.name}): measured outputs, {' and '.join(names)} simulated freely from "
        "the inputs alone, and below each the residual, measured minus simulated."
        f"{closer_sentence(panels)}",
        responses(log.time, panels),
    )
