"""Arguments and options that several commands have."""

from pathlib import Path
from typing import Annotated

import typer

from daq.cli import completion

ExperimentName = Annotated[
    str,
    typer.Argument(
        metavar="EXPERIMENT.yaml",
        help="Experiment file; a bare name not in this folder means the shipped one.",
        autocompletion=completion.experiments,
    ),
]
RigName = Annotated[
    str,
    typer.Option(
        "--rig",
        metavar="RIG.yaml",
        help="Rig file; default the simulated rig.",
        autocompletion=completion.rigs,
    ),
]
RigOfRun = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="RIG.yaml",
        help="Rig file; default what the experiment names, or the simulated rig.",
        autocompletion=completion.rigs,
    ),
]
PortName = Annotated[
    str | None,
    typer.Option(
        "--port",
        metavar="PORT",
        help="Port of a serial rig in place of its file's; see rig ports.",
    ),
]
RunsFolder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Where capture folders go.")]
ModelName = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="NAME|FILE.py:OBJECT",
        help="Process model; see rig models.",
        autocompletion=completion.models,
    ),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="ID.yaml", help="Search settings and column names."),
]
ModelNames = Annotated[
    list[str] | None,
    typer.Option(
        "--model",
        metavar="NAME|FILE.py:OBJECT",
        help="Process model; may be repeated.",
        autocompletion=completion.models,
    ),
]
Validation = Annotated[
    list[Path] | None,
    typer.Option(
        "--validate", metavar="RUN_OR_CSV", help="Log kept for validation; may be repeated."
    ),
]
Preset = Annotated[
    str | None,
    typer.Option(
        "--preset",
        metavar="NAME",
        help="default, thesis, cega or classic.",
        autocompletion=completion.presets,
    ),
]
Population = Annotated[
    int | None, typer.Option("--population", metavar="N", help="Chromosomes per generation.")
]
Generations = Annotated[
    int | None, typer.Option("--generations", metavar="N", help="Generations evaluated.")
]
HoldBack = Annotated[
    float | None,
    typer.Option(
        "--hold-back", metavar="PART", help="Part of each log, its end, kept for validation."
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Any key of the configuration file, such as fixed.R_m=1.18; may be repeated.",
    ),
]
Seeds = Annotated[
    str | None,
    typer.Option("--seeds", metavar="FIRST:END|LIST", help="0:10 for 0 to 9, or 3,5,8."),
]
Jobs = Annotated[
    int | None,
    typer.Option("--jobs", metavar="N", help="Runs at a time; default as many as cores."),
]
Dask = Annotated[
    str | None,
    typer.Option("--dask", metavar="tcp://HOST:PORT", help="Compute on this dask cluster."),
]
WithReport = Annotated[
    bool,
    typer.Option("--report/--no-report", help="Write report.html with its figures as well."),
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]
