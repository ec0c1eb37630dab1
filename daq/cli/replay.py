"""``rig replay``: a log's inputs through a model with given parameters."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.cli import terminal
from daq.cli.options import AsJson, ConfigFile, RigName

if TYPE_CHECKING:
    from daq.identification.replay import Replay


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
    from daq.errors import RunError
    from daq.identification.replay import replay as simulate

    bounds = _bounds(fail_under or [])
    result = simulate(log, parameters, rig, config)
    _require_outputs(bounds, result)
    if result.warning is not None:
        terminal.report_warning(result.warning)
    drawn = _draw(result, figure)
    missed = result.below(bounds)
    if json:
        terminal.print_json(_document(result, drawn, bounds, missed))
    else:
        _show(result, drawn)
        if not missed:
            columns = f" --config {config}" if config is not None else ""
            again = f"rig replay ANOTHER_LOG --parameters {parameters}{columns}"
            terminal.print_next(again if parameters else f"rig identify {log}")
    if missed:
        shortfalls = (
            f"fit of {name} is {result.fit[name]:.1f} %, below {least:g} %"
            for name, least in missed.items()
        )
        raise RunError(f"{result.path}: {'; '.join(shortfalls)}")


def _show(result: Replay, drawn: Path | None) -> None:
    from daq.cli.identification import print_errors
    from daq.identification.rows import OutputErrors

    terminal.print_line(
        f"{result.path} through {result.model.name} with the parameters of {result.source}"
    )
    errors = {
        name: OutputErrors(result.rmse[name], result.msd[name], result.fit[name])
        for name in result.model.output_names
    }
    print_errors(errors, label="replay")
    if drawn is not None:
        terminal.print_line(f"Figure: {drawn}")


def _document(
    result: Replay, drawn: Path | None, bounds: dict[str, float], missed: dict[str, float]
) -> dict[str, Any]:
    return {
        "log": str(result.path),
        "model": result.model.name,
        "parameters": result.source,
        "outputs": {
            name: {
                "rmse": result.rmse[name],
                "msd": result.msd[name],
                "fit_percent": result.fit[name],
            }
            for name in result.model.output_names
        },
        "figure": None if drawn is None else str(drawn),
        "fail_under": bounds,
        "passed": not missed,
    }


def _bounds(texts: list[str]) -> dict[str, float]:
    """``omega=80`` as the least fit [%] of an output."""
    from daq.errors import ConfigError

    bounds = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            bounds[name.strip()] = float(value)
            if not math.isfinite(bounds[name.strip()]):
                raise ValueError
        except ValueError:
            raise ConfigError(
                f"--fail-under {text}: write OUTPUT=PERCENT, for example omega=80"
            ) from None
    return bounds


def _require_outputs(bounds: dict[str, float], result: Replay) -> None:
    from daq.errors import ConfigError, suggestion

    for name in bounds:
        if name not in result.fit:
            raise ConfigError(
                f"--fail-under {name}: model {result.model.name} has no such output",
                cure=suggestion(name, result.model.output_names),
            )


def _draw(result: Replay, path: Path | None) -> Path | None:
    """The figure at a path; without one beside the log, if that can be."""
    from daq.errors import ConfigError, RunError
    from daq.logs.capture import LOG_NAME
    from daq.report.pictures import draw_replay

    beside = "replay.png" if result.path.name == LOG_NAME else f"{result.path.stem}-replay.png"
    chosen = path or result.path.with_name(beside)
    try:
        draw_replay(result, chosen)
    except RunError as error:
        if path is not None:
            raise ConfigError(str(error), cure="or choose another with --figure FILE.png") from None
        terminal.report_warning(str(error))
        return None
    return chosen
