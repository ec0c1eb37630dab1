"""What an identification was asked for, kept beside its checkpoint until it is done."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from daq.errors import ConfigError
from daq.files import make_folder, write_whole

_CHECKPOINT, _REQUEST = "search.ckpt", "search.json"


@dataclass(frozen=True)
class Asked:
    """What the settings of an identification were made from, all paths absolute.

    options, settings: those of the command, as ``prepare`` takes them.
    """

    config: str | None
    options: dict[str, Any]
    settings: list[str]

    @classmethod
    def of(
        cls, config: Path | None, options: Mapping[str, Any], settings: Sequence[str], model: str
    ) -> Asked:
        """model: whole name of the one that was found."""
        kept = {**options, "model": model}
        if kept.get("datasheet"):
            kept["datasheet"] = _absolute(kept["datasheet"])
        return cls(None if config is None else str(config.resolve()), kept, list(settings))


@dataclass(frozen=True)
class Request:
    """An identification that may be gone on with: what was asked, on which logs."""

    asked: Asked
    training: list[Path]
    validation: list[Path]


def checkpoint(folder: Path) -> Path:
    """Where the search of an identification keeps its state."""
    return folder / _CHECKPOINT


def remember(
    folder: Path, asked: Asked, training: Sequence[Path], validation: Sequence[Path]
) -> None:
    """Write down what is about to be done, in the folder that the results will go to."""
    make_folder(folder)
    content = {
        "asked": asdict(asked),
        "training": _absolute(training),
        "validation": _absolute(validation),
    }
    write_whole(folder / _REQUEST, json.dumps(content, indent=1))


def recall(folder: Path) -> tuple[Path, Request]:
    """The folder with the checkpoint, given or below the given one, and what was asked.

    Raises ConfigError when there is nothing to go on with.
    """
    for place in (folder, folder / "identification"):
        if not (place / _REQUEST).exists():
            continue
        try:
            content = json.loads((place / _REQUEST).read_text(encoding="utf-8"))
            return place, Request(
                Asked(**content["asked"]),
                [Path(path) for path in content["training"]],
                [Path(path) for path in content["validation"]],
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{place / _REQUEST}: cannot be read: {error}") from None
    raise ConfigError(
        f"{folder}: no identification was interrupted there; name the folder that its results "
        "were to go to"
    )


def forget(folder: Path) -> None:
    """Nothing is left to go on with."""
    for name in (_CHECKPOINT, _REQUEST):
        (folder / name).unlink(missing_ok=True)


def command(folder: Path) -> str:
    """What to type to go on."""
    return f"rig identify --resume {shlex.quote(str(folder))}"


def _absolute(paths: Sequence[Path | str]) -> list[str]:
    return [str(Path(path).resolve()) for path in paths]
