"""What to type with a design's files: check the runs, make them, identify from all of them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from daq.config import json_file
from daq.designs.files import DATA
from daq.designs.setup import Setup, beside
from daq.errors import ConfigError
from daq.identification.request import from_here, result_file
from daq.identification.stages import load
from daq.logs.capture import LOG_NAME

_ANEW = "design anew"


def commands_of(setup: Setup, folder: Path, models: Sequence[str] = ()) -> tuple[str, ...]:
    """Commands for a design that goes into a folder, in their order.

    models: that are told apart; without any the one that the design is for.
    """
    experiments, runs = folder.as_posix(), (Path("runs") / folder.resolve().name).as_posix()
    identify = ["rig", "identify", *_earlier(setup, runs, bool(models))]
    config = beside(setup.file, "config", setup.question.config)
    if config is not None:
        identify += ["--config", Path(from_here(config)).as_posix()]
    if not models and (setup.question.model or setup.question.parameters):
        models = [setup.problem.model_name]
    for model in models:
        identify += ["--model", model]
    check = ["rig", "check", experiments]
    run = ["rig", "run", experiments, "--out", runs]
    return tuple(map(shlex.join, (check, run, identify)))


def text_of(commands: Sequence[str]) -> str:
    """The commands as a file beside the experiments."""
    head = f"# In this order, in the folder {Path.cwd()}:\n# what each run does; all runs; one "
    return f"{head}result from all their logs together.\n" + "\n".join([*commands, ""])


def experiments_of(name: str) -> list[str]:
    """The experiments that a folder of a design stands for; a file stands for itself.

    Raises ConfigError for a folder without a design.
    """
    folder = Path(name)
    if not folder.is_dir():
        return [name]
    if not (folder / DATA).exists():
        cure = "name an experiment's file, or a folder that rig design wrote"
        raise ConfigError("no design was written there", cure=cure, file=folder)
    return [str(folder / file) for file in _files(_design(folder), folder)]


def commands_behind(experiments: Sequence[Path], out: Path | None) -> list[str]:
    """What serves after runs of a design, into a folder: the identification from all of them.

    Before they are run, out None, and after a part of them: all runs and then that. Empty where
    they are of no single design, or where its commands are for another working folder.
    """
    folders = {experiment.parent for experiment in experiments}
    folder = folders.pop()
    if folders or not (folder / DATA).exists():
        return []
    design = _design(folder)
    commands: list[str] = design.get("commands") or []
    files = _files(design, folder)
    names = {experiment.name for experiment in experiments}
    is_here = Path(design["runs"][0]["file"]).resolve() == (folder / files[0]).resolve()
    if not commands or not is_here or not names <= set(files):
        return []
    if out is None or names != set(files):
        return commands[1:]
    runs = shlex.split(commands[1])[-1]
    words = [out.as_posix() if word == runs else word for word in shlex.split(commands[2])]
    return [shlex.join(words)]


def _design(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json_file.load(folder / DATA, "design", _ANEW)
    return document


def _files(design: Mapping[str, Any], folder: Path) -> list[str]:
    """Names of a design's experiments, in order."""
    try:
        return [Path(run["file"]).name for run in design["runs"]]
    except (KeyError, TypeError) as error:
        raise ConfigError(f"not a design: {error!r}", cure=_ANEW, file=folder / DATA) from None


def _earlier(setup: Setup, runs: str, several: bool) -> list[str]:
    """Logs to identify from: those of the result from which a design starts, and its runs.

    Where a log is not there any more the result itself is kept.
    """
    parameters = beside(setup.file, "parameters", setup.question.parameters)
    if parameters is None:
        return [runs]
    content = load([Path(parameters)])[0].content
    entries = (content.get("metrics") or {}).get("training") or ()
    logs = [Path(entry["log"]) for entry in entries]
    if logs and all(log.exists() for log in logs):
        folders = [log.parent if log.name == LOG_NAME else log for log in logs]
        return [*(folder.as_posix() for folder in folders), runs]
    return (
        [runs]
        if several
        else [runs, "--given", Path(from_here(str(result_file(parameters)))).as_posix()]
    )
