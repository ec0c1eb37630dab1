"""Arguments and options that several commands have."""

import functools
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from daq.cli import completion

LOGS = Argument(metavar="RUN_OR_CSV...", help="Capture folders, CSV logs, or folders of them.")
ExperimentNames = Annotated[
    list[str],
    Argument(
        metavar="EXPERIMENT.yaml...",
        help="Experiment files, or a folder that rig design wrote for all of its; a bare name not "
        "in this folder means the shipped one.",
        autocompletion=completion.experiments,
    ),
]
_rig = functools.partial(Option, metavar="RIG.yaml", autocompletion=completion.rigs)
RigName = Annotated[str, _rig(help="Rig file; default the simulated rig.")]
RigOfRun = Annotated[
    str | None, _rig(help="Rig file; default what the experiment names, or the simulated rig.")
]
RigOfDesign = Annotated[
    str | None, _rig(help="Rig file; default what the question names, or the simulated rig.")
]
PortName = Annotated[
    str | None,
    Option(metavar="PORT", help="Port of a serial rig in place of its file's; see rig ports."),
]
Notes = Annotated[
    list[str] | None,
    Option(
        "--note",
        metavar="TEXT|KEY=VALUE",
        help="Note this of the run, as operator=Ann; may be repeated.",
    ),
]
RunsFolder = Annotated[Path, Option(metavar="DIR", help="Where capture folders go.")]
_model = functools.partial(Option, metavar="NAME|FILE.py:OBJECT", autocompletion=completion.models)
ModelName = Annotated[str | None, _model(help="Process model; see rig models.")]
ModelNames = Annotated[list[str] | None, _model(help="Process model; may be repeated.")]
ModelsWithValues = Annotated[
    list[str] | None,
    _model(help="In place of a result a model at its own values; may be repeated."),
]
PlantName = Annotated[
    str | None,
    Option(metavar="NAME|FILE.py:OBJECT", help="The whole rig as a model, load included."),
]
Precision = Annotated[
    str | None,
    Option(metavar="PERCENT", help="Half width wanted of all intervals, such as 5%."),
]
_time = functools.partial(Option, metavar="SECONDS")
LoggedTime = Annotated[
    str | None,
    _time(
        help="Logged time of all runs, at most; default 60 s. By the clock computing adds minutes."
    ),
]
LoggedTimeOfDesign = Annotated[  # default what the question says
    str | None, _time(help="Logged time of all runs, at most.")
]
ConfigFile = Annotated[
    Path | None, Option(metavar="ID.yaml", help="Search settings and column names.")
]
Validation = Annotated[
    list[Path] | None,
    Option(metavar="RUN_OR_CSV", help="Log kept for validation; may be repeated."),
]
Preset = Annotated[
    str | None,
    Option(
        metavar="NAME", help="default, thesis, cega or classic.", autocompletion=completion.presets
    ),
]
Population = Annotated[int | None, Option(metavar="N", help="Chromosomes per generation.")]
Generations = Annotated[int | None, Option(metavar="N", help="Generations evaluated.")]
HoldBack = Annotated[
    float | None, Option(metavar="PART", help="Part of each log, its end, kept for validation.")
]
_set = functools.partial(Option, "--set", metavar="KEY=VALUE")
Settings = Annotated[
    list[str] | None,
    _set(help="Any key of the configuration file, such as fixed.R_m=1.18; may be repeated."),
]
DesignSettings = Annotated[
    list[str] | None,
    _set(help="A key of the design's question, such as protocols=[prbs]; may be repeated."),
]
Seeds = Annotated[str | None, Option(metavar="FIRST:END|LIST", help="0:10 for 0 to 9, or 3,5,8.")]
Jobs = Annotated[int | None, Option(metavar="N", help="Runs at a time; default as many as cores.")]
Dask = Annotated[
    str | None, Option(metavar="tcp://HOST:PORT", help="Compute on this dask cluster.")
]
Trust = Annotated[
    bool, Option("--trust", help="Run the Python file that the run or result names; look at it.")
]
WithReport = Annotated[
    bool, Option("--report/--no-report", help="Write report.html with its figures as well.")
]
AsJson = Annotated[bool, Option("--json", help="One JSON document on standard output.")]


def experiment_files(names: Sequence[str]) -> list[str]:
    """Experiments by the names that were typed, folders as what is in them.

    Raises ConfigError for a folder without a design.
    """
    if not any(Path(name).is_dir() for name in names):
        return list(names)
    from daq.designs.commands import experiments_of

    return [file for name in names for file in experiments_of(name)]


def next_of_design(files: Sequence[str], out: Path | None) -> list[str]:
    """What serves after runs of a design into a folder, or before them; empty for others."""
    from daq.designs.files import DATA

    if not all(Path(file).with_name(DATA).exists() for file in files):
        return []
    from daq.designs.commands import commands_behind

    return commands_behind(list(map(Path, files)), out)


def rig_words(rig: str | None, port: str | None) -> str:
    """Options that name a rig and its port again, as further words of a command.

    >>> rig_words("my rig.yaml", None)
    " --rig 'my rig.yaml'"
    """
    words = [("--rig", rig), ("--port", port)]
    return "".join(f" {name} {shlex.quote(value)}" for name, value in words if value is not None)


def on_rig(rig_file: str) -> str:
    """The same of a rig by its file, where commands do not take that one by themselves.

    >>> on_rig("simulated.yaml"), on_rig("worn.yaml")
    ('', ' --rig worn.yaml')
    """
    from daq.lookup.rigs import DEFAULT_RIG

    return rig_words(None if rig_file == DEFAULT_RIG else rig_file, None)
