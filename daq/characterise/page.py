"""The page that tells a characterisation: intervals over rig time, round by round."""

import datetime
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from daq.characterise.rounds import Round
from daq.documents import plain
from daq.figures.history import narrowing
from daq.files import write_whole
from daq.provenance import software_versions
from daq.report.page import Picture, rendered
from daq.report.publication import FIGURES, draw

_PAGE, _DATA = "characterise.html", "rounds.json"


def write_page(
    root: Path, rounds: Sequence[Round], reason: str, precision: float | None = None
) -> Path:
    """Write the page, its figure and its numbers; the page's path.

    reason: why there are no more rounds; empty where there are. precision: half width that is
    wanted [%], None for as narrow as they get. Raises RunError where the disk
    refuses.
    """
    histories = [each.intervals() for each in rounds]
    seconds = np.cumsum([each.seconds for each in rounds])
    document = plain(
        {
            "model": rounds[-1].model,
            "assumptions": rounds[-1].result.get("assumptions", []),
            "ended": reason,
            "logged_seconds": float(seconds[-1]),
            "wanted_percent": precision,
            "missed": [
                interval.name
                for interval in histories[-1]
                if precision is not None and not interval.is_within(precision)
            ],
            "verdict": rounds[-1].result["verdict"],
            "rounds": [
                {
                    "number": each.number,
                    "seconds": each.seconds,
                    "runs": [run["protocol"] for run in each.design["runs"]],
                    "quantities": [asdict(interval) for interval in history],
                }
                for each, history in zip(rounds, histories, strict=True)
            ],
            "unknown": rounds[-1].design["unknown"],
            "otherwise": rounds[-1].design.get("otherwise"),
            "software": software_versions(),
        }
    )
    names = [interval.name for interval in histories[0]]
    widths = np.array(
        [[np.nan if i.width is None else 100.0 * i.width for i in history] for history in histories]
    )
    picture = Picture(
        "narrowing",
        "parameters",
        "Half widths of the 95 % intervals over the logged time, in per cent of the values.",
        narrowing(seconds, names, widths),
    )
    drawings = [(each, files["svg"]) for each, files in draw([picture], root / FIGURES, ["svg"])]
    now = datetime.datetime.now(datetime.UTC)
    variables = {"written": f"{now:%Y-%m-%d %H:%M} UTC"}
    write_whole(root / _DATA, json.dumps(document, indent=1) + "\n")
    page = root / _PAGE
    write_whole(page, rendered("characterise.html.j2", document, variables, drawings))
    return page
