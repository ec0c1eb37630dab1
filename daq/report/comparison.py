"""The page of a comparison of models, with its figures."""

import datetime
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from daq.documents import plain
from daq.figures import style
from daq.figures.picture import Picture
from daq.figures.rankings import Ratio, ratios
from daq.figures.responses import Response, responses
from daq.files import make_folder, write_whole
from daq.identification.comparison import ComparisonResult
from daq.report.page import Drawing, comparison_page
from daq.report.publication import FIGURES, command_of, fingerprints

_PAGE = "comparison.html"


def publish_comparison(result: ComparisonResult) -> str:
    """Write the page and its figures into the comparison's folder; the page's path.

    Raises RunError where the disk refuses.
    """
    document, folder, group = plain(_with_files(result)), result.folder, result.group
    make_folder(folder / FIGURES)
    drawings = []
    for picture in _pictures(document, result):
        content = style.render(picture.figure, "svg")
        write_whole(folder / FIGURES / f"{picture.name}.svg", content)
        drawings.append(Drawing(picture.name, picture.topic, picture.caption, content.decode()))
    now = datetime.datetime.now(datetime.UTC)
    preferred = next(row for row in document["structures"] if row["name"] == document["preferred"])
    fitted = {row["name"] for row in document["structures"] if "parameters_file" in row}
    models = [candidate.name for candidate in result.candidates if candidate.name in fitted]
    logs = group.training, group.validation
    variables = {
        "written": f"{now:%Y-%m-%d %H:%M} UTC",
        "outputs": result.outputs,
        "preferred_file": preferred.get("parameters_file"),
        "reproduction": {
            "command": command_of(group.problem.request, *logs, models, result.request_words),
            "folder": str(Path.cwd()),
            "logs": fingerprints(*logs),
        },
    }
    write_whole(folder / _PAGE, comparison_page(document, variables, drawings))
    return str(folder / _PAGE)


def _with_files(result: ComparisonResult) -> dict[str, Any]:
    return {**result.document, "files": {"comparison": str(result.file)}}


def _pictures(document: Mapping[str, Any], result: ComparisonResult) -> Iterator[Picture]:
    rows = document["structures"]
    others = [
        Ratio(row["name"], ratio["value"], *ratio["interval_95"])
        for row in rows
        if (ratio := row.get("squared_errors_relative")) is not None
    ]
    if others:
        yield Picture(
            "ratios",
            "comparison",
            "Squared errors of the free runs in validation, in parts of the best model's, with "
            "95 % intervals.",
            ratios(rows[0]["name"], others),
        )
    if result.group.validation:
        yield _first_log(document, result)


def _first_log(document: Mapping[str, Any], result: ComparisonResult) -> Picture:
    """The preferred model and the best other one, over the first validation log."""
    runs = {candidate.name: candidate.validation[0] for candidate in result.candidates}
    ranked = [row["name"] for row in document["structures"] if row["name"] in runs]
    names = [document["preferred"], *(n for n in ranked if n != document["preferred"])][:2]
    log = result.group.validation[0].dataset
    panels = [
        Response(
            output.name,
            output.unit,
            log.outputs[:, j],
            {name: runs[name][:, j] for name in names},
        )
        for j, output in enumerate(result.group.problem.model.outputs)
    ]
    return Picture(
        "validation",
        "comparison",
        f"Validation ({log.name}): measured outputs, {' and '.join(names)} simulated freely from "
        "the inputs alone, and below each the residual, measured minus simulated.",
        responses(log.time, panels),
    )
