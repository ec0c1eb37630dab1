"""``rig replay``: a log's inputs through a model with given parameters."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from daq.cli import options, terminal
from daq.errors import ConfigError, RunError, suggestion

if TYPE_CHECKING:
    from daq.identification.replay import Replay


def replay(
    log: Annotated[Path, Argument(metavar="RUN_OR_CSV", help="Capture folder or CSV log.")],
    rig: options.RigName = "simulated.yaml",
    parameters: Annotated[
        Path | None,
        Option(
            metavar="PARAMETERS.yaml",
            help="Result of an identification; default the simulated rig's own values.",
        ),
    ] = None,
    config: options.ConfigFile = None,
    figure: Annotated[
        Path | None, Option(metavar="FILE.png|pdf|svg", help="Default beside the log.")
    ] = None,
    fail_under: Annotated[
        list[str] | None,
        Option(
            metavar="OUTPUT=PERCENT", help="Exit status 1 when its fit is below; may be repeated."
        ),
    ] = None,
    trust: options.Trust = False,
    json: options.AsJson = False,
) -> None:
    """Simulate a log's commands, and say how well that fits it.

    The model is given the applied commands and the measured load torque, never the outputs.
    """
    from daq.identification.replay import replay as simulate
    from daq.identification.result import errors_document

    bounds = _bounds(fail_under or [])
    result = simulate(log, parameters, rig, config, trust=trust)
    model = result.model
    for name in bounds:
        if name not in result.fit:
            problem = f"--fail-under {name}: model {model.name} has no such output"
            raise ConfigError(problem, cure=suggestion(name, model.output_names))
    if result.warning is not None:
        terminal.report("warning", result.warning)
    drawn = _draw(result, figure)
    missed = result.below(bounds)
    errors = errors_document(model, result.metrics)
    if json:
        document = {
            "log": result.path,
            "model": model.name,
            "parameters": result.source,
            "outputs": errors,
            "figure": drawn,
            "fail_under": bounds,
            "passed": not missed,
        }
        terminal.print_json(document)
    else:
        through = f"{result.path} through {model.name} with the parameters of {result.source}"
        _show(through, errors, drawn)
        if not missed:
            columns = f" --config {config}" if config is not None else ""
            trusted = " --trust" if trust else ""
            again = f"rig replay ANOTHER_LOG --parameters {parameters}{columns}{trusted}"
            terminal.print_next(again if parameters else f"rig identify {log}")
    if missed:
        shortfalls = (
            f"fit of {name} is {result.fit[name]:.1f} %, below {least:g} %"
            for name, least in missed.items()
        )
        raise RunError(f"{result.path}: {'; '.join(shortfalls)}")


def _show(title: str, errors: dict[str, dict[str, Any]], drawn: Path | None) -> None:
    from daq.cli.identification import print_errors
    from daq.identification.rows import OutputErrors

    print(title)
    shown = {name: OutputErrors.of(each) for name, each in errors.items()}
    print_errors(shown, label="replay")
    if drawn is not None:
        print(f"Figure: {drawn}")


def _bounds(texts: list[str]) -> dict[str, float]:
    """``omega=80`` as the least fit [%] of an output."""
    bounds = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            least = float(value)
        except ValueError:
            least = math.nan
        if not math.isfinite(least):
            raise ConfigError(f"--fail-under {text}: write OUTPUT=PERCENT, for example omega=80")
        bounds[name.strip()] = least
    return bounds


def _draw(result: Replay, path: Path | None) -> Path | None:
    """The figure at a path; without one beside the log, if that can be."""
    from daq.logs.capture import LOG_NAME
    from daq.report.pictures import draw_replay

    beside = "replay.png" if result.path.name == LOG_NAME else f"{result.path.stem}-replay.png"
    chosen = path or result.path.with_name(beside)
    try:
        draw_replay(result, chosen)
    except RunError as error:
        if path is not None:
            raise ConfigError(str(error), cure="or choose another with --figure FILE.png") from None
        terminal.report("warning", str(error))
        return None
    return chosen
