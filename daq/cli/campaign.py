"""``rig campaign``: every log with every model and seed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli import terminal
from daq.cli.options import (
    AsJson,
    ConfigFile,
    Dask,
    Generations,
    HoldBack,
    Jobs,
    ModelNames,
    Population,
    Preset,
    Seeds,
    Settings,
    Validation,
)

if TYPE_CHECKING:
    from daq.identification.campaign import CampaignResult
    from sysid import Spread


def campaign(
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN_OR_CSV...", help="Capture folders, CSV logs, or folders of them."
        ),
    ],
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
    from daq.identification import campaign as use_case
    from daq.identification.request import SettingsRequest

    options = {
        "preset": preset,
        "population": population,
        "generations": generations,
        "hold_back": hold_back,
    }
    request = use_case.CampaignRequest(
        logs,
        validate or [],
        model or [],
        seeds,
        SettingsRequest(None if config is None else str(config), options, settings or []),
        together,
        use_case.Workers(jobs, dask),
        out,
    )
    with terminal.Watching(quiet=json) as watch:
        result = use_case.campaign(request, watch)
    if json:
        terminal.print_json(result.document)
    else:
        _show(result)


def _show(result: CampaignResult) -> None:
    runs = result.campaign
    terminal.print_line()
    terminal.print_table(
        "Error over seeds: mean over outputs of the RMSE in parts of max|y|",
        ["model", "log", "runs", "best", "median", "worst", "within 1 %", "fit [%]", "failed"],
        [_spread_row(spread, result) for spread in runs.spread()],
        text=["log"],
    )
    for problem in dict.fromkeys(f"{o.run.name}: {o.problem}" for o in runs.failed):
        terminal.print_line(f"Failed: {problem}")
    if runs.interrupted:
        terminal.print_line(f"Stopped by Ctrl-C: {len(runs.outcomes)} runs are in the table.")
    for (model, data), path in result.files.items():
        terminal.print_line(f"Best of {model} on {data}: {path}")
    terminal.print_line(f"All runs with their parameters: {result.table}")
    if result.files:
        terminal.print_next(f"rig replay LOG --parameters {next(iter(result.files.values()))}")


def _spread_row(spread: Spread, result: CampaignResult) -> list[str]:
    best, number = result.campaign.best().get((spread.model, spread.data)), terminal.number
    return [
        spread.model,
        spread.data,
        str(spread.runs),
        number(spread.best),
        number(spread.median),
        number(spread.worst),
        str(spread.agreeing),
        f"{best.row()['fit']:.1f}" if best is not None else "-",
        str(spread.failed),
    ]
