"""``rig figures``: the figures of a finished identification's report, in other formats."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from daq.cli import terminal as console
from daq.cli.replay import columns_of, read_parameters
from daq.errors import ConfigError
from daq.figures.style import Format
from daq.identification import records as datasets
from daq.identification.baseline import Baseline, beside
from daq.identification.records import Loaded
from daq.report.pictures import Subject
from daq.report.publication import DATA, FIGURES, draw
from sysid import BatchSimulator, free_run
from sysid.problem.model import ProcessModel

_AGAIN = "identify again to have a report of it"


def figures_command(folder: Path, kinds: Sequence[str], out: Path | None, as_json: bool) -> None:
    """Draw the figures of a report again, from its numbers and logs, in formats by their names."""
    formats = [_format(kind) for kind in kinds]
    source = _found(folder)
    subject = _subject(source)
    target = out or source.parent / FIGURES
    files: list[str] = []
    with console.progress(as_json) as bar:
        for picture, _ in draw(subject, target, formats):
            files += [str(target / f"{picture.name}.{kind}") for kind in formats]
            bar.update("Figures", len(files), len(files) + 1, f"{len(files)} files")
    if as_json:
        console.print_json({"figures": files})
    else:
        console.print_line(f"Figures: {target} ({len(files)} files)")


def _format(kind: str) -> Format:
    for known in get_args(Format):
        if kind.lower() == known:
            return known  # type: ignore[no-any-return]
    raise ConfigError(f"--format {kind}: figures are written as {', '.join(get_args(Format))}")


def _found(folder: Path) -> Path:
    """The report's document in a folder, or in the identification below a capture folder."""
    for place in (folder / DATA, folder / "identification" / DATA):
        if place.exists():
            return place
    raise ConfigError(
        f"{folder}: no {DATA} there; name the folder of an identification, or of the run that it "
        "was made from (rig identify writes it unless --no-report is given)"
    )


def _subject(source: Path) -> Subject:
    try:
        document = json.loads(source.read_text(encoding="utf-8"))
        return _restored(document, source)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{source}: not a readable report ({type(error).__name__}: {error}); {_AGAIN}"
        ) from None


def _restored(document: Mapping[str, Any], source: Path) -> Subject:
    """A report's subject, its free runs simulated again."""
    model, values = read_parameters(source.with_name("parameters.yaml"))
    made = document["reproduction"]
    training, validation = _logs(made, model)
    simulator, vector = BatchSimulator(model), model.vector(values)
    runs = {id(log): free_run(simulator, vector, log.dataset) for log in (*training, *validation)}
    linear = None
    if "metrics" in document["comparison"]:
        linear = beside(model, training, validation)
    return Subject(
        model=model,
        document=document,
        training=training,
        validation=validation,
        training_runs=[runs[id(log)] for log in training],
        validation_runs=[runs[id(log)] for log in validation],
        foreign=bool(made["columns"]),
        baselines={linear.name: linear.runs} if isinstance(linear, Baseline) else {},
    )


def _logs(made: Mapping[str, Any], model: ProcessModel) -> tuple[list[Loaded], list[Loaded]]:
    """The logs as they were used; ConfigError for one that is gone or another now."""
    columns = columns_of(Path(made["columns"]) if made["columns"] else None, model)
    root = Path(made["folder"])
    loaded: dict[Path, Loaded] = {}
    uses: dict[str, list[Path]] = {"training": [], "validation": []}
    for log in made["logs"]:
        path = root / log["log"]
        if not path.exists():
            raise ConfigError(f"{path}: this log of the report is gone; {_AGAIN}")
        if hashlib.sha256(path.read_bytes()).hexdigest() != log["sha256"]:
            raise ConfigError(f"{path}: this log is another than the report's; {_AGAIN}")
        loaded[path] = datasets.load(path, model, columns)
        uses[log["use"]].append(path)
    training, ends = datasets.hold_back(
        [loaded[path] for path in uses["training"]], made["hold_back"]
    )
    # Of a log that is in both, the end was held back.
    others = [loaded[path] for path in uses["validation"] if path not in uses["training"]]
    return training, [*ends, *others]
