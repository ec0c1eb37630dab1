"""The page of a comparison of models, with its figures."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from daq.cli import terminal as console
from daq.cli.campaign import Group
from daq.figures import style
from daq.figures.picture import Picture
from daq.figures.rankings import Ratio, ratios
from daq.figures.responses import Response, responses
from daq.files import make_folder, write_whole
from daq.report.page import Drawing, comparison_page
from daq.report.publication import FIGURES, command_of, fingerprints
from sysid import Candidate

_PAGE = "comparison.html"


def publish_comparison(
    document: Mapping[str, Any],
    group: Group,
    candidates: Sequence[Candidate],
    asked: Sequence[str],
    folder: Path,
) -> str:
    """Write the page and its figures into a folder; the page's path.

    document: as ``comparison.yaml`` holds it. group: the logs, as its first model used them.
    candidates: with their free runs. asked: what the command named besides models and logs.
    Raises RunError where the disk refuses.
    """
    whole = console.plain(document)
    make_folder(folder / FIGURES)
    drawings = []
    for picture in _pictures(whole, group, candidates):
        content = style.render(picture.figure, "svg")
        write_whole(folder / FIGURES / f"{picture.name}.svg", content)
        drawings.append(Drawing(picture.name, picture.topic, picture.caption, content.decode()))
    now = datetime.datetime.now(datetime.UTC)
    preferred = next(row for row in whole["structures"] if row["name"] == whole["preferred"])
    fitted = {row["name"] for row in whole["structures"] if "parameters_file" in row}
    models = [one.name for one in candidates if one.name in fitted]
    view = {
        "written": f"{now:%Y-%m-%d %H:%M} UTC",
        "outputs": group.prepared.model.output_names,
        "preferred_file": preferred.get("parameters_file"),
        "reproduction": {
            "command": command_of(
                group.prepared.asked, group.training, group.validation, models, asked
            ),
            "folder": str(Path.cwd()),
            "logs": fingerprints(group.training, group.validation),
        },
    }
    write_whole(folder / _PAGE, comparison_page(whole, view, drawings))
    return str(folder / _PAGE)


def _pictures(
    document: Mapping[str, Any], group: Group, candidates: Sequence[Candidate]
) -> Iterator[Picture]:
    rows = document["structures"]
    others = [
        Ratio(row["name"], told["value"], *told["interval_95"])
        for row in rows
        if (told := row.get("squared_errors_relative")) is not None
    ]
    if others:
        yield Picture(
            "ratios", "comparison",
            "Squared errors of the free runs in validation, in parts of the best model's, with "
            "95 % intervals.",
            ratios(rows[0]["name"], others),
        )  # fmt: skip
    if group.validation:
        yield _first_log(document, group, candidates)


def _first_log(
    document: Mapping[str, Any], group: Group, candidates: Sequence[Candidate]
) -> Picture:
    """The preferred model and the best other one, over the first validation log."""
    runs = {one.name: one.validation[0] for one in candidates}
    ranked = [row["name"] for row in document["structures"] if row["name"] in runs]
    names = [document["preferred"], *(n for n in ranked if n != document["preferred"])][:2]
    log = group.validation[0].dataset
    return Picture(
        "validation", "comparison",
        f"Validation ({log.name}): measured outputs, {' and '.join(names)} simulated freely from "
        "the inputs alone, and below each the residual, measured minus simulated.",
        responses(log.time, [
            Response(
                output.name, output.unit, log.outputs[:, j],
                {name: runs[name][:, j] for name in names},
            )
            for j, output in enumerate(group.prepared.model.outputs)
        ]),
    )  # fmt: skip
