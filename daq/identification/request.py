"""What an identification was asked for, kept beside its checkpoint until it is finished."""

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
class SettingsRequest:
    """Where the settings of an identification come from.

    config: a YAML file. options: settings by name that have an option of their own, None for those
    not given. settings: any others, as ``key=value``.
    """

    config: str | None = None
    options: Mapping[str, Any] | None = None
    settings: Sequence[str] = ()

    @property
    def config_file(self) -> Path | None:
        """The YAML file's path."""
        return None if self.config is None else Path(self.config)

    def option(self, name: str) -> Any:
        """The value of an option; None where it was not given."""
        return (self.options or {}).get(name)

    def absolute(self, model: str) -> SettingsRequest:
        """The same from any folder; model: whole name of the one that was looked up."""
        options = {**(self.options or {}), "model": model}
        if options.get("datasheet"):
            options["datasheet"] = _absolute(options["datasheet"])
        config = self.config_file
        return SettingsRequest(
            None if config is None else str(config.resolve()), options, list(self.settings)
        )


@dataclass(frozen=True)
class InterruptedFit:
    """An identification that can be continued: where its results go, its settings and logs."""

    folder: Path
    settings: SettingsRequest
    training: list[Path]
    validation: list[Path]


def checkpoint(folder: Path) -> Path:
    """Where the search of an identification keeps its state."""
    return folder / _CHECKPOINT


def remember(
    folder: Path, settings: SettingsRequest, training: Sequence[Path], validation: Sequence[Path]
) -> None:
    """Write a request into the folder that the results will go to."""
    make_folder(folder)
    content = {
        "asked": asdict(settings),
        "training": _absolute(training),
        "validation": _absolute(validation),
    }
    write_whole(folder / _REQUEST, json.dumps(content, indent=1))


def recall(folder: Path) -> InterruptedFit:
    """The request in a folder, or in the folder ``identification`` below it.

    Raises ConfigError when there is none.
    """
    for place in (folder, folder / "identification"):
        if not (place / _REQUEST).exists():
            continue
        try:
            content = json.loads((place / _REQUEST).read_text(encoding="utf-8"))
            return InterruptedFit(
                place,
                SettingsRequest(**content["asked"]),
                [Path(path) for path in content["training"]],
                [Path(path) for path in content["validation"]],
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"cannot be read: {error}", file=place / _REQUEST) from None
    raise ConfigError(
        "no identification was interrupted there",
        cure="name the folder that its results were to go to",
        file=folder,
    )


def forget(folder: Path) -> None:
    """Remove what is needed only to continue."""
    for name in (_CHECKPOINT, _REQUEST):
        (folder / name).unlink(missing_ok=True)


def resume_command(folder: Path) -> str:
    """What to type to continue."""
    return f"rig identify --resume {shlex.quote(str(folder))}"


def _absolute(paths: Sequence[Path | str]) -> list[str]:
    return [str(Path(path).resolve()) for path in paths]
