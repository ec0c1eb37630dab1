"""``rig identify``: parameters from logs, or several structures compared on them."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from typer import BadParameter, Context, Exit, Option

from daq.cli import options, terminal
from daq.cli.identification import drafting, show_comparison, show_identification

_WITH_RESUME = {"resume", "trust", "report", "json", "quiet", "verbose"}


def identify(
    context: Context,
    logs: Annotated[list[Path] | None, options.LOGS] = None,
    model: options.ModelNames = None,
    config: options.ConfigFile = None,
    validate: options.Validation = None,
    out: Annotated[
        Path | None,
        Option(metavar="DIR", help="Where results go; default in the run, or under runs."),
    ] = None,
    preset: options.Preset = None,
    population: options.Population = None,
    generations: options.Generations = None,
    seed: Annotated[int | None, Option(metavar="N", help="One seed gives one result.")] = None,
    hold_back: options.HoldBack = None,
    profile: Annotated[
        list[str] | None,
        Option(
            metavar="PARAMETER",
            help="Trace how the fit worsens as this one moves; may be repeated.",
        ),
    ] = None,
    guess: Annotated[
        bool, Option("--guess", help="Starting ranges from the logs, where none are given.")
    ] = False,
    datasheet: Annotated[
        list[str] | None, Option(metavar="FILE.yaml", help="Data-sheet values; may be repeated.")
    ] = None,
    given: Annotated[
        list[str] | None,
        Option(
            metavar="RESULT",
            help="Keep what an earlier identification found, with its covariance; may be repeated.",
        ),
    ] = None,
    settings: options.Settings = None,
    arx: Annotated[bool, Option("--arx", help="Compare with an ARX model.")] = False,
    armax: Annotated[bool, Option("--armax", help="Compare with an ARMAX model.")] = False,
    oe: Annotated[
        bool,
        Option("--oe", help="Compare with output-error models: the best linear free run."),
    ] = False,
    seeds: options.Seeds = None,
    jobs: options.Jobs = None,
    dask: options.Dask = None,
    resume: Annotated[
        Path | None, Option(metavar="DIR", help="Go on with what was interrupted, as it was asked.")
    ] = None,
    trust: options.Trust = False,
    report: options.WithReport = True,
    json: options.AsJson = False,
) -> None:
    """Identify a model's parameters from one or more logs.

    All logs together have one parameter set. Several models, or linear ones, are ranked: which
    explains the validation data best, by more than chance, and with how many parameters.
    """
    from daq.identification import fit
    from daq.identification.request import SettingsRequest

    if resume is not None:
        words = [
            "LOG" if name == "logs" else f"--{name.replace('_', '-')}"
            for name, value in context.params.items()
            if value and name not in _WITH_RESUME
        ]
        if words:
            raise BadParameter(
                "--resume goes on as it was asked, with --json, --no-report or --trust at most; "
                f"leave out {' and '.join(words)}"
            )
        with drafting(report) as draft:
            with terminal.watching(json) as watch:
                result = fit.resume(resume, watch, trust=trust, draft=draft)
            document = show_identification(result, report, json, draft=draft)
        _finish(document, json, result.interrupted)
        return
    if not logs:
        raise BadParameter("name the logs to identify from, or a folder with --resume")
    chosen = {
        "preset": preset,
        "population": population,
        "generations": generations,
        "seed": seed,
        "hold_back": hold_back,
        "guess": guess or None,
        "datasheet": datasheet,
        "given": given,
        "profile": profile,
    }
    request = SettingsRequest(None if config is None else str(config), chosen, settings or [])
    baselines = [name for name, wanted in (("ARX", arx), ("ARMAX", armax), ("OE", oe)) if wanted]
    if len(model or []) > 1 or baselines or seeds is not None:
        from daq.identification.campaign import Workers
        from daq.identification.comparison import ComparisonRequest, compare

        wanted = ComparisonRequest(
            logs, validate or [], model or [], baselines, seeds, request, Workers(jobs, dask), out
        )
        with terminal.watching(json) as watch:
            compared = compare(wanted, watch)
        _finish(show_comparison(compared, report, json), json, compared.campaign.interrupted)
        return
    request = replace(request, options={**chosen, "model": model[0] if model else None})
    with drafting(report) as draft:
        with terminal.watching(json) as watch:
            result = fit.identify_files(logs, validate or [], request, out, watch, draft)
        document = show_identification(result, report, json, draft=draft)
    _finish(document, json, result.interrupted)


def _finish(document: dict[str, Any], json: bool, stopped: bool) -> None:
    if json:
        terminal.print_json(document)
    if stopped:
        raise Exit(1)
