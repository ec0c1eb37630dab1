"""``rig replay``: a log's inputs through a model with given parameters."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
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
            help="Result of an identification, or its folder; default the simulated rig's values.",
        ),
    ] = None,
    model: options.ModelsWithValues = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
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
    Several models are drawn together: --model actuator:parameters=A --model actuator:parameters=B.
    """
    from daq.identification.replay import replay as simulate
    from daq.identification.request import set_options

    bounds = _bounds(fail_under or [])
    names: Sequence[str | None] = model or [None]
    results = [
        simulate(log, parameters, rig, config, model=name, settings=settings or [], trust=trust)
        for name in names
    ]
    first = results[0]
    _require_outputs(results, bounds)
    if first.warning is not None:
        terminal.report("warning", first.warning)
    drawn = _draw(results, figure)
    documents = [_document(result, bounds) for result in results]
    if json:
        several = {"models": documents} if len(results) > 1 else documents[0]
        passed = all(document["passed"] for document in documents)
        shared = {"log": first.path, "figure": drawn, "fail_under": bounds, "passed": passed}
        terminal.print_json({**several, **shared})
    else:
        _show(results, documents)
        if drawn is not None:
            print(f"Figure: {drawn}")
        if all(document["passed"] for document in documents):
            columns = f" --config {shlex.quote(str(config))}" if config is not None else ""
            columns += set_options(settings or [])
            trusted = " --trust" if trust else ""
            result = shlex.quote(str(parameters))
            again = f"rig replay ANOTHER_LOG --parameters {result}{columns}{trusted}"
            terminal.print_next(again if parameters else f"rig identify {shlex.quote(str(log))}")
    shortfalls = [
        f"fit of {name} is {result.fit[name]:.1f} %, below {least:g} %"
        + (f" ({result.source})" if len(results) > 1 else "")
        for result in results
        for name, least in result.below(bounds).items()
    ]
    if shortfalls:
        raise RunError(f"{first.path}: {'; '.join(shortfalls)}")


def _require_outputs(results: Sequence[Replay], bounds: Mapping[str, float]) -> None:
    """Raise ConfigError unless all models have the same outputs, and those that have a bound."""
    first = results[0].model
    for result in results[1:]:
        if result.model.output_names != first.output_names:
            outputs, others = (", ".join(m.output_names) for m in (first, result.model))
            problem = f"{results[0].source} has the outputs {outputs}, {result.source} {others}"
            raise ConfigError(problem, cure="choose the same ones", key="--model")
    for name in bounds:
        if name not in first.output_names:
            problem = f"--fail-under {name}: model {first.name} has no such output"
            raise ConfigError(problem, cure=suggestion(name, first.output_names))


def _document(result: Replay, bounds: Mapping[str, float]) -> dict[str, Any]:
    """One model's errors, as JSON can hold them."""
    from daq.identification.result import errors_document

    return {
        "model": result.model_title,
        "parameters": result.source,
        "outputs": errors_document(result.model, result.metrics),
        "passed": not result.below(bounds),
    }


def _show(results: Sequence[Replay], documents: Sequence[Mapping[str, Any]]) -> None:
    from daq.cli.identification import print_errors
    from daq.identification.replay import short_names
    from daq.identification.rows import OutputErrors

    tables = (document["outputs"].items() for document in documents)
    errors = {
        label: {name: OutputErrors.of(each) for name, each in outputs}
        for label, outputs in zip(short_names(results), tables, strict=True)
    }
    titles = " and ".join(result.title for result in results)
    terminal.print_text(f"{results[0].path} through {titles}")
    print_errors(errors, "model" if len(results) > 1 else "")


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


def _draw(results: Sequence[Replay], path: Path | None) -> Path | None:
    """The figure at a path; without one beside the log, if that can be."""
    result = results[0]
    from daq.logs.capture import LOG_NAME
    from daq.report.pictures import draw_replay

    beside = "replay.png" if result.path.name == LOG_NAME else f"{result.path.stem}-replay.png"
    chosen = path or result.path.with_name(beside)
    try:
        draw_replay(results, chosen)
    except RunError as error:
        if path is not None:
            problem, cure = error.mistakes[0].problem, "choose another with --figure FILE.png"
            raise ConfigError(problem, cure=cure, file=chosen) from None
        terminal.report("warning", str(error))
        return None
    return chosen
