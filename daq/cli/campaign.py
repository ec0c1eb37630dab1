"""``rig campaign``: every log with every model and seed."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Exit, Option

from daq.cli import options, terminal

if TYPE_CHECKING:
    from daq.identification.campaign import CampaignResult
    from sysid import Spread


def campaign(
    logs: Annotated[list[Path], options.LOGS],
    model: options.ModelNames = None,
    config: options.ConfigFile = None,
    validate: options.Validation = None,
    out: Annotated[
        Path | None, Option(metavar="DIR", help="Where results go; default under campaigns/.")
    ] = None,
    seeds: options.Seeds = None,
    together: Annotated[
        bool, Option("--together", help="One parameter set for all logs, not one for each.")
    ] = False,
    preset: options.Preset = None,
    population: options.Population = None,
    generations: options.Generations = None,
    hold_back: options.HoldBack = None,
    settings: options.Settings = None,
    jobs: options.Jobs = None,
    dask: options.Dask = None,
    json: options.AsJson = False,
) -> None:
    """Identify every log with every model and seed.

    Runs over all cores, or a dask cluster.
    """
    from daq.identification import campaign as use_case
    from daq.identification.request import SettingsRequest

    chosen = SettingsRequest(
        None if config is None else str(config),
        {
            "preset": preset,
            "population": population,
            "generations": generations,
            "hold_back": hold_back,
        },
        settings or [],
    )
    workers = use_case.Workers(jobs, dask)
    request = use_case.CampaignRequest(
        logs, validate or [], model or [], seeds, chosen, together, workers, out
    )
    with terminal.watching(json) as watch:
        result = use_case.campaign(request, watch)
    if json:
        terminal.print_json(result.document)
    else:
        _show(result)
    if result.campaign.interrupted:
        raise Exit(1)


def _show(result: CampaignResult) -> None:
    from daq.lookup.models import trust_option

    runs = result.campaign
    print()
    models = [outcome.run.model for outcome in runs.outcomes]
    units = {output.name: output.unit for model in models for output in model.outputs}
    spreads = runs.spread()
    terminal.print_table_of_differences(
        "Error over seeds: mean over outputs of the RMSE in parts of max|y|",
        ["model", "log", "runs", "best", "median", "worst", "within 1 %", "failed"],
        [[spread.model, *_spread_row(spread)] for spread in spreads],
        once=["model", "runs", "within 1 %", "failed"], text=["log"],
    )  # fmt: skip
    terminal.print_table_of_differences(
        "The best of each: mean fit, and RMSE in the outputs' units",
        ["model", "log", "fit [%]", *(f"{name} [{unit}]" for name, unit in units.items())],
        [[spread.model, *_best_row(spread, result, list(units))] for spread in spreads],
        once=["model"], text=["log"],
    )  # fmt: skip
    for problem in dict.fromkeys(f"{o.run.name}, {o.run.data}: {o.problem}" for o in runs.failed):
        print(f"Failed: {problem}")
    if runs.interrupted:
        print(f"Stopped by Ctrl-C: {len(runs.outcomes)} runs are in the table.")
    for (model, data), path in result.files.items():
        print(f"Best of {model} on {data}: {path}")
    print(f"All runs with their parameters: {result.table}")
    for (model, _), path in list(result.files.items())[:1]:
        terminal.print_next(
            f"rig replay LOG --parameters {shlex.quote(str(path))}{trust_option(model)}"
        )


def _spread_row(spread: Spread) -> list[str]:
    errors = [terminal.number(error) for error in (spread.best, spread.median, spread.worst)]
    return [spread.data, str(spread.runs), *errors, str(spread.agreeing), str(spread.failed)]


def _best_row(spread: Spread, result: CampaignResult, outputs: Sequence[str]) -> list[str]:
    best = result.campaign.best().get((spread.model, spread.data))
    fit = f"{best.row()['fit']:.1f}" if best is not None else "-"
    absolute = best.rmse_absolute if best is not None else {}
    in_units = [terminal.number(absolute.get(name, math.nan), 3) for name in outputs]
    return [spread.data, fit, *in_units]
