"""Commands of ``rig``: arguments and help texts. The work is imported inside each command."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from daq.cli import completion as completing
from daq.cli.command_line import CommandLine

app = CommandLine(
    name="rig",
    help=(
        "Excite a hybrid haptic actuator (DC motor and magnetorheological brake), log every "
        "sample, and identify its parameters.\n\n"
        "Start with:  rig run prbs.yaml --identify"
    ),
    no_args_is_help=True,
    # Frames are for people: in a pipe help and errors are plain lines.
    rich_markup_mode="rich" if sys.stderr.isatty() else None,
    pretty_exceptions_enable=False,
    add_completion=True,
)

ExperimentName = Annotated[
    str,
    typer.Argument(
        metavar="EXPERIMENT.yaml",
        help="Experiment file; a bare name not in this folder means the shipped one.",
        autocompletion=completing.experiments,
    ),
]
RigName = Annotated[
    str,
    typer.Option(
        "--rig",
        metavar="RIG.yaml",
        help="Rig file; default the simulated rig.",
        autocompletion=completing.rigs,
    ),
]
RigOfRun = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="RIG.yaml",
        help="Rig file; default what the experiment names, or the simulated rig.",
        autocompletion=completing.rigs,
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
Logs = Annotated[
    list[Path],
    typer.Argument(metavar="RUN_OR_CSV...", help="Capture folders, CSV logs, or folders of them."),
]
ModelName = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="NAME|FILE.py:OBJECT",
        help="Process model; see rig models.",
        autocompletion=completing.models,
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
        autocompletion=completing.models,
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
        autocompletion=completing.presets,
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
Version = Annotated[bool, typer.Option("--version", help="Print the version and exit.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


@app.callback(invoke_without_command=True)
def program(version: Version = False) -> None:
    """Nothing but its version, without a command."""
    if version:
        from importlib.metadata import version as installed

        print(f"hybrid-rig {installed('hybrid-rig')}")
        raise typer.Exit


@app.command(epilog="Example:  rig run prbs.yaml --identify")
def run(
    experiment: ExperimentName,
    rig: RigOfRun = None,
    port: PortName = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where capture folders go.")
    ] = Path("runs"),
    identify: Annotated[
        bool,
        typer.Option(
            "--identify", help="Record a validation run as well, then identify the model."
        ),
    ] = False,
    model: ModelName = None,
    config: ConfigFile = None,
    realtime: Annotated[
        bool,
        typer.Option("--realtime", help="Keep a simulated rig at the pace of the clock."),
    ] = False,
    report: WithReport = True,
    json: AsJson = False,
) -> None:
    """Run an experiment on a rig and log every sample."""
    from daq.cli.run import run_command

    run_command(experiment, rig, port, out, identify, model, config, realtime, report, json)


@app.command(epilog="Example:  rig check prbs.yaml --plot check.png")
def check(
    experiment: ExperimentName,
    rig: RigOfRun = None,
    port: PortName = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            "--plot", metavar="FILE.png|pdf|svg", help="Draw waveforms and spectra there."
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Say what an experiment will do, and energise nothing.

    It is checked against the rig's limits as before a run: duration, peaks, spectrum.
    """
    from daq.cli.check import check_command

    check_command(experiment, rig, port, plot, json)


@app.command(epilog="Example:  rig analyse runs/20260101T120000Z-constant_velocity")
def analyse(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Capture folder.")],
    json: AsJson = False,
) -> None:
    """Conclude from a log what its protocol is for.

    Tables, figures and numbers, as at the end of the run; for a log of whatever age.
    """
    from daq.cli.analyse import analyse_command

    analyse_command(run, json)


@app.command(epilog="Example:  rig identify runs/20260101T120000Z-prbs --validate other_log.csv")
def identify(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="RUN_OR_CSV...", help="Capture folders, CSV logs, or folders of them."
        ),
    ] = None,
    model: ModelNames = None,
    config: ConfigFile = None,
    validate: Validation = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where results go; default beside the log."),
    ] = None,
    preset: Preset = None,
    population: Population = None,
    generations: Generations = None,
    seed: Annotated[
        int | None, typer.Option("--seed", metavar="N", help="One seed gives one result.")
    ] = None,
    hold_back: HoldBack = None,
    profile: Annotated[
        list[str] | None,
        typer.Option(
            "--profile",
            metavar="PARAMETER",
            help="Trace how the fit worsens as this one moves; may be repeated.",
        ),
    ] = None,
    guess: Annotated[
        bool, typer.Option("--guess", help="Starting ranges from the logs, where none are given.")
    ] = False,
    datasheet: Annotated[
        list[str] | None,
        typer.Option(
            "--datasheet", metavar="FILE.yaml", help="Data-sheet values; may be repeated."
        ),
    ] = None,
    settings: Settings = None,
    arx: Annotated[bool, typer.Option("--arx", help="Compare with an ARX model.")] = False,
    armax: Annotated[bool, typer.Option("--armax", help="Compare with an ARMAX model.")] = False,
    seeds: Seeds = None,
    jobs: Jobs = None,
    dask: Dask = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume", metavar="DIR", help="Go on with what was interrupted, as it was asked."
        ),
    ] = None,
    report: WithReport = True,
    json: AsJson = False,
) -> None:
    """Identify a model's parameters from one or more logs.

    All logs together have one parameter set. Several models, or linear ones, are ranked: which
    explains the validation data best, by more than chance, and with how many parameters.
    """
    if resume is not None:
        others = (
            logs, model, config, validate, out, preset, population, generations, seed, hold_back,
            profile, guess, datasheet, settings, arx, armax, seeds, jobs, dask,
        )  # fmt: skip
        if any(others):
            raise typer.BadParameter(
                "--resume goes on as it was asked; give nothing but --json or --no-report"
            )
        from daq.cli.identify import resume_command

        resume_command(resume, report, json)
        return
    if not logs:
        raise typer.BadParameter("name the logs to identify from, or a folder with --resume")
    options = {
        "preset": preset,
        "population": population,
        "generations": generations,
        "seed": seed,
        "hold_back": hold_back,
        "guess": guess or None,
        "datasheet": datasheet,
        "profile": profile,
    }
    baselines = [name for name, asked in (("ARX", arx), ("ARMAX", armax)) if asked]
    if len(model or []) > 1 or baselines or seeds is not None:
        from daq.cli.campaign import Workers
        from daq.cli.compare import Ask, compare_command

        compare_command(
            logs, validate or [], Ask(model or [], baselines, seeds), config, out, options,
            settings or [], Workers(jobs, dask), report, json,
        )  # fmt: skip
        return
    from daq.cli.identify import identify_command

    options["model"] = model[0] if model else None
    identify_command(logs, validate or [], config, out, options, settings or [], report, json)


@app.command(
    epilog="Example:  rig campaign runs/* --model actuator --model actuator:hysteresis=dahl "
    "--seeds 0:5"
)
def campaign(
    logs: Logs,
    model: ModelNames = None,
    config: ConfigFile = None,
    validate: Validation = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where results go; default under campaigns/."),
    ] = None,
    seeds: Seeds = None,
    together: Annotated[
        bool, typer.Option("--together", help="One parameter set for all logs, not one for each.")
    ] = False,
    preset: Preset = None,
    population: Population = None,
    generations: Generations = None,
    hold_back: HoldBack = None,
    settings: Settings = None,
    jobs: Jobs = None,
    dask: Dask = None,
    json: AsJson = False,
) -> None:
    """Identify every log with every model and seed.

    Runs over all cores, or a dask cluster.
    """
    from daq.cli.campaign import Workers, campaign_command

    options = {
        "preset": preset,
        "population": population,
        "generations": generations,
        "hold_back": hold_back,
    }
    campaign_command(
        logs, validate or [], model or [], config, out, options, settings or [], seeds, together,
        Workers(jobs, dask), json,
    )  # fmt: skip


@app.command(
    epilog="Example:  rig replay runs/20260101T120000Z-prbs "
    "--parameters runs/20260101T120000Z-prbs/identification/parameters.yaml"
)
def replay(
    log: Annotated[Path, typer.Argument(metavar="RUN_OR_CSV", help="Capture folder or CSV log.")],
    rig: RigName = "simulated.yaml",
    parameters: Annotated[
        Path | None,
        typer.Option(
            "--parameters",
            metavar="PARAMETERS.yaml",
            help="Result of an identification; default the simulated rig's own values.",
        ),
    ] = None,
    config: ConfigFile = None,
    figure: Annotated[
        Path | None,
        typer.Option("--figure", metavar="FILE.png|pdf|svg", help="Default beside the log."),
    ] = None,
    fail_under: Annotated[
        list[str] | None,
        typer.Option(
            "--fail-under",
            metavar="OUTPUT=PERCENT",
            help="Exit status 1 when its fit is below; may be repeated.",
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Simulate a log's commands, and say how well that fits it.

    The model is given the applied commands and the measured load torque, never the outputs.
    """
    from daq.cli.replay import replay_command

    replay_command(log, rig, parameters, config, figure, fail_under or [], json)


@app.command(epilog="Example:  rig figures runs/20260101T120000Z-prbs --format pdf --format png")
def figures(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Capture folder, or that of an identification.")
    ],
    kinds: Annotated[
        list[str] | None,
        typer.Option("--format", help="pdf, png or svg; may be repeated. Default pdf and png."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where they go; default beside the report."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Draw an identification's figures for papers and slides."""
    from daq.cli.figures import figures_command

    figures_command(run, kinds or ["pdf", "png"], out, json)


@app.command(epilog="Example:  rig init my_rig")
def init(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Where the files go; default this folder.")
    ] = Path(),
    protocol: Annotated[
        str,
        typer.Option(
            "--protocol",
            metavar="NAME",
            help="Shipped experiment to begin with.",
            autocompletion=completing.protocols,
        ),
    ] = "prbs",
    rig: Annotated[
        str,
        typer.Option(
            "--rig",
            metavar="NAME",
            help="Shipped rig to begin with.",
            autocompletion=completing.rig_names,
        ),
    ] = "simulated",
    json: AsJson = False,
) -> None:
    """Write commented YAML files to begin with.

    What is there already stays as it is. Editors complete and check the files by the JSON Schemas
    written beside them.
    """
    from daq.cli.init import init_command

    init_command(folder, protocol, rig, json)


@app.command(epilog="Example:  rig schema schemas")
def schema(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Where the schemas go; default schemas.")
    ] = Path("schemas"),
    reference: Annotated[
        Path | None,
        typer.Option(
            "--reference", metavar="DIR", help="Write reference pages (Markdown) there as well."
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Write JSON Schemas of the YAML files, for editors.

    They know the installed protocols and backends.
    """
    from daq.cli.schema import schema_command

    schema_command(folder, reference, app, json)


@app.command(epilog="Example:  rig models actuator --json")
def models(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME|FILE.py:OBJECT]",
            help="Show this model in full.",
            autocompletion=completing.models,
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """List the installed models, or describe one.

    With its states, signals, parameters, units, ranges and options.
    """
    from daq.cli.models import models_command

    models_command(name, json)


@app.command(epilog="Example:  rig emulate --fault drop=0.01 --fault disconnect@run+0.5")
def emulate(
    rig: RigName = "simulated.yaml",
    link: Annotated[
        Path | None,
        typer.Option("--link", metavar="PATH", help="A name for the pty that stays the same."),
    ] = None,
    tcp: Annotated[
        int | None,
        typer.Option(
            "--tcp",
            metavar="NUMBER",
            help="Serve a loopback TCP port in place of a pty; 0 for any. Default on Windows.",
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="NAME[=VALUE][@PHASE[+SECONDS]]",
            help="What goes wrong; may be repeated. 'help' lists the faults.",
        ),
    ] = None,
    drift: Annotated[
        float, typer.Option("--drift", metavar="PPM", help="Of the device's clock.")
    ] = 0.0,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Of the faults' chances.")] = 0,
    journal: Annotated[
        Path | None,
        typer.Option("--journal", metavar="FILE", help="Log of what became of the outputs, JSON."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Put the simulated rig behind the serial protocol.

    It serves in real time until Ctrl-C, and prints the port that rig run --rig serial.yaml --port
    takes.
    """
    from daq.cli.emulate import emulate_command

    emulate_command(rig, link, tcp, fault or [], drift, seed, journal, json)


@app.command(epilog="Example:  rig scope")
def scope(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RUN_OR_CSV]", help="Capture folder or log; default the newest run."
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where the runs are that it follows.")
    ] = Path("runs"),
    port: Annotated[
        int | None,
        typer.Option("--port", min=0, max=65535, help="Of the page; default 5006, 0 for any."),
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open a browser on the page.")
    ] = True,
    json: AsJson = False,
) -> None:
    """Show a run in the browser, also while it is recorded."""
    from daq.cli.scope import scope_command

    scope_command(run, out, port, browser, json)


@app.command(epilog="Example:  rig ports")
def ports(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PORT...]", help="Device names or URLs; default all that exist."),
    ] = None,
    unasked: Annotated[
        bool, typer.Option("--list", help="Send nothing: list the ports without asking.")
    ] = False,
    baud: Annotated[int, typer.Option("--baud", help="Of UARTs; USB does not care.")] = 2_000_000,
    json: AsJson = False,
) -> None:
    """List serial ports, and who answers there."""
    from daq.cli.ports import ports_command

    ports_command(names or [], unasked, baud, json)


@app.command(epilog="Example:  rig doctor /dev/ttyACM0")
def doctor(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PORT...]", help="Device names; default all that exist."),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where capture folders go.")
    ] = Path("runs"),
    json: AsJson = False,
) -> None:
    """Check whether this computer suits a rig in real time.

    What does not is told with its cure.
    """
    from daq.cli.doctor import doctor_command

    doctor_command(names or [], out, json)
