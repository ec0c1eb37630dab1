"""What an identification was asked for, kept beside its checkpoint until it is finished."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from daq.config import json_file
from daq.errors import ConfigError
from daq.files import make_folder, write_whole

CHECKPOINT = "search.ckpt"  # the search's state, in the folder of its results
FILE = "search.json"
PARAMETERS = "parameters.yaml"  # the result
_ANEW = "delete it and identify anew"


@dataclass(frozen=True)
class SettingsRequest:
    """Where the settings of an identification come from.

    config: a YAML file. options: settings by name that have an option of their own, None for those
    not given. settings: any others, as ``key=value``.
    """

    config: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    settings: Sequence[str] = ()

    def absolute(self, model: str) -> SettingsRequest:
        """The same from any folder; model: whole name of the one that was looked up."""
        options = {**self.options, "model": model}
        for files in ("datasheet", "given"):
            if options.get(files):
                options[files] = _absolute(options[files])
        config = None if self.config is None else _absolute([self.config])[0]
        return SettingsRequest(config, options, list(self.settings))

    @property
    def config_words(self) -> list[str]:
        """Words that name its file again; none without one."""
        return [] if self.config is None else ["--config", from_here(self.config)]

    def words(self, settings: Sequence[str] = (), **options: Any) -> list[str]:
        """Words of ``rig identify`` behind its logs that ask for the same, but for what is given.

        >>> typed = ["robust=true", "population=80"]
        >>> asked = SettingsRequest("drive.yaml", {"guess": True}, typed)
        >>> " ".join(asked.words(["delay.y=2"], model="lag", population=160))
        '--config drive.yaml --model lag --guess --population 160 --set robust=true --set delay.y=2'
        """
        words = self.config_words
        whole = {**self.options, **options}
        for name, value in sorted(whole.items(), key=lambda option: option[0] != "model"):
            for each in value if isinstance(value, list | tuple) else [value]:
                if each is not None and each is not False:
                    words.append(f"--{name.replace('_', '-')}")
                    words += [] if each is True else [from_here(str(each))]
        replaced = {*options, *(setting.partition("=")[0] for setting in settings)}
        kept = [s for s in self.settings if s.partition("=")[0] not in replaced]
        return [*words, *(word for setting in (*kept, *settings) for word in ("--set", setting))]


def remember(
    folder: Path, settings: SettingsRequest, training: Sequence[Path], validation: Sequence[Path]
) -> None:
    """Write a request into the folder that the results will go to."""
    make_folder(folder)
    logs = {"training": _absolute(training), "validation": _absolute(validation)}
    content = {"asked": asdict(settings), **logs}
    write_whole(folder / FILE, json.dumps(content, indent=1))


def recall(folder: Path) -> tuple[Path, SettingsRequest, list[Path], list[Path]]:
    """The folder of a request, this one or ``identification`` below, its settings and logs.

    Logs are those for training, then for validation. Raises ConfigError when there is no request.
    """
    for place in (folder, folder / "identification"):
        if not (place / FILE).exists():
            continue
        try:
            content = json_file.load(place / FILE, "request", _ANEW)
            settings = SettingsRequest(**content["asked"])
            training = [Path(path) for path in content["training"]]
            return place, settings, training, [Path(path) for path in content["validation"]]
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            problem = f"not a readable request ({type(error).__name__}: {error})"
            raise ConfigError(problem, cure=_ANEW, file=place / FILE) from None
    cure = "name the folder that its results were to go to"
    raise ConfigError("no identification was interrupted there", cure=cure, file=folder)


def resume_command(folder: Path) -> str:
    """What to type to continue what was interrupted.

    >>> resume_command(Path("my runs"))
    "rig identify --resume 'my runs'"
    """
    return f"rig identify --resume {shlex.quote(str(folder))}"


def set_options(settings: Sequence[str]) -> str:
    """Settings as further words of a command.

    >>> set_options(["delay.y=4 ms"])
    " --set 'delay.y=4 ms'"
    """
    return "".join(f" --set {shlex.quote(setting)}" for setting in settings)


def from_here(name: str) -> str:
    """An absolute name as one would type it, where it is in the working folder or below."""
    return name.removeprefix(f"{Path.cwd()}{os.sep}")


def forget(folder: Path) -> None:
    """Remove what is needed only to continue."""
    for name in (CHECKPOINT, FILE):
        (folder / name).unlink(missing_ok=True)


def result_file(result: str | Path) -> Path:
    """The ``parameters.yaml`` of an identification, given as it is, as its folder or its run's.

    Raises ConfigError for a folder without any, and for a log.

    >>> result_file("runs/a/parameters.yaml").name
    'parameters.yaml'
    """
    given = Path(result)
    if given.suffix in (".csv", ".mat"):
        problem, cure = "this is a log", f"name its identification's folder, or a {PARAMETERS}"
        raise ConfigError(problem, cure=cure, file=given)
    if not given.is_dir():
        return given
    for place in (given, given / "identification"):
        if (place / PARAMETERS).exists():
            return place / PARAMETERS
    cure = f"identify first: rig identify {shlex.quote(str(given))}"
    raise ConfigError(f"no identification has written a {PARAMETERS} there", cure=cure, file=given)


def _absolute(paths: Sequence[Path | str]) -> list[str]:
    return [str(Path(path).resolve()) for path in paths]
