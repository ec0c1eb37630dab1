"""``rig models``: the installed process models, or one in full."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, BadParameter, Option

from daq.cli import completion, options, terminal

if TYPE_CHECKING:
    from daq.identification.structure import Structure
    from sysid import ProcessModel, TiedGroup
    from sysid.problem.model import Parameter, State


def models(
    name: Annotated[
        str | None,
        Argument(
            metavar="[NAME|FILE.py:OBJECT]",
            help="Show this model in full.",
            autocompletion=completion.models,
        ),
    ] = None,
    identifiable: Annotated[
        bool,
        Option("--identifiable", help="Say which parameters its outputs determine, without data."),
    ] = False,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    json: options.AsJson = False,
) -> None:
    """List the installed models, or describe one.

    With its states, signals, parameters, units, ranges and options; or, with --identifiable, what
    no log could tell of its parameters, and what would.
    """
    if identifiable:
        _identifiable(name, config, settings or [], json)
        return
    if config is not None or settings:
        raise BadParameter("--config and --set go with --identifiable")
    from daq.lookup.models import describe, find_model, model_options
    from daq.plugins import installed

    names = [name] if name is not None else sorted(installed("model"))
    installed_models = {key: find_model(key) for key in names}
    if json:
        documents = {
            key: {**describe(model), "options": model_options(key)}
            for key, model in installed_models.items()
        }
        terminal.print_json(documents if name is None else documents[name])
    elif name is None:
        _show_list(installed_models)
    else:
        _show(name, installed_models[name], model_options(name))


def _identifiable(name: str | None, config: Path | None, settings: list[str], json: bool) -> None:
    from daq.identification.request import SettingsRequest
    from daq.identification.structure import examine

    where = None if config is None else str(config)
    if name is None and where is None:
        raise BadParameter("--identifiable needs a model: rig models NAME --identifiable")
    structure = examine(SettingsRequest(where, {"model": name}, settings))
    if json:
        terminal.print_json(structure.document)
    else:
        _show_identifiable(structure)


def _show_identifiable(structure: Structure) -> None:
    model, result = structure.model, structure.identifiability
    print(f"{model.name}: {model.description}")
    measured = f"Measured: {', '.join(result.outputs)}."
    if result.unknown_starts:
        measured += f" Unknown at the start of a record: {', '.join(result.unknown_starts)}."
    fixed = [f"{name} {value:g}" for name, value in structure.fixed.items()]
    fixed += [f"{name} = {expression}" for name, expression in structure.ties.items()]
    if fixed:
        measured += f" Fixed: {', '.join(fixed)}."
    terminal.print_text(measured)
    print()
    names = ", ".join(result.identifiable) or "none"
    terminal.print_text(f"Identifiable by themselves: {names}.")
    if result.unseen:
        terminal.print_text(f"Without effect on any output: {', '.join(result.unseen)}.")
    if not result.tied:
        return
    print()
    head = ["act only together", "determined", "unit"]
    rows = [row for group in result.tied for row in _combination_rows(group)]
    terminal.print_table("What logs can tell of the others, however many", head, rows, text=head)
    for group in result.tied:
        _show_directions(group)
    head = ["to tell apart", "measure otherwise", "or log as well"]
    rows = [_separation_row(group) for group in result.tied]
    terminal.print_table("What would tell them apart", head, rows, text=head)
    terminal.print_text(
        f"What counts as a change of the outputs is at least {result.gap:.0f} decades above what "
        "counts as none."
    )
    terminal.print_next("rig identify LOG --set fixed.NAME=VALUE, with what was measured")


def _combination_rows(group: TiedGroup) -> list[list[str]]:
    rows = [["", c.text, c.unit] for c in group.combinations]
    missing = group.count - len(group.combinations)
    if missing:
        rows.append(["", f"{missing} of no simple form", ""])
    if not rows:
        rows.append(["", "none", ""])
    rows[0][0] = ", ".join(group.parameters)
    return rows


def _show_directions(group: TiedGroup) -> None:
    """The directions of a group of which some combinations have no simple form."""
    if len(group.combinations) == group.count:
        return
    number = terminal.number
    at = ", ".join(f"{name} {number(value)}" for name, value in group.values.items())
    for direction in group.directions:
        steps = (
            f"{name} {number(step)}"
            for name, step in zip(group.parameters, direction, strict=True)
            if step
        )
        terminal.print_text(f"At {at} nothing changes along {', '.join(steps)}.")


def _separation_row(group: TiedGroup) -> list[str]:
    sensors = [
        state if len(names) == len(group.parameters) else f"{state} (for {', '.join(names)})"
        for state, names in group.sensors.items()
    ]
    return [", ".join(group.parameters), " and ".join(group.fix), "; ".join(sensors) or "-"]


def _show_list(models: dict[str, ProcessModel]) -> None:
    head = ["name", "states", "inputs", "outputs", "free parameters", "what it is"]
    rows = [[name, *_sizes(model), model.description] for name, model in models.items()]
    terminal.print_table("Process models", head, rows, text=["what it is"])
    terminal.print_next("rig models NAME, or rig models my_model.py:model for one of your own")


def _sizes(model: ProcessModel) -> list[str]:
    free = [parameter for parameter in model.parameters if not parameter.fixed]
    return [str(len(parts)) for parts in (model.states, model.inputs, model.outputs, free)]


def _show(name: str, model: ProcessModel, options: list[dict[str, Any]]) -> None:
    print(f"{model.name}: {model.description}")
    for equation in model.equations:
        print(f"  {equation}")
    if model.equations:
        print()
    rows = [["state", s.name, s.unit, _start(s)] for s in model.states]
    rows += [["input", s.name, s.unit, s.hold] for s in model.inputs]
    rows += [["output", s.name, s.unit, s.description] for s in model.outputs]
    head = ["kind", "name", "unit", "note"]
    terminal.print_table("Signals", head, rows, text=head)
    number = terminal.number
    head = ["name", "unit", "nominal", "range", "scale", "what it is"]
    rows = [
        [p.name, p.unit, number(p.nominal), *_range(p), p.description] for p in model.parameters
    ]
    terminal.print_table("Parameters", head, rows, text=["unit", "scale", "what it is"])
    for constraint in model.constraints:
        print(f"Constraint: {constraint.text}")
    if options:
        _show_options(name, options)


def _show_options(name: str, options: list[dict[str, Any]]) -> None:
    from daq.lookup.models import name_parts

    head = ["name", "default", "choices", "what it is"]
    rows = [
        [o["name"], _as_text(o["default"]), ", ".join(o["choices"]), o["description"]]
        for o in options
    ]
    terminal.print_table("Options", head, rows, text=head)
    last = options[-1]
    print(
        f"Another combination: rig models {name_parts(name)[0]}:{last['name']}="
        f"{last['choices'][-1]}, with a comma between options; --model takes the same name"
    )


def _start(state: State) -> str:
    if state.initial_range is None:
        return f"starts at {state.initial:g}"
    low, high = state.initial_range
    return f"start estimated from each log, {low:g} .. {high:g}"


def _range(parameter: Parameter) -> tuple[str, str]:
    """Range and scale that are searched."""
    ends = terminal.number(parameter.lower), terminal.number(parameter.upper)
    return ("fixed", "") if parameter.fixed else (" .. ".join(ends), parameter.scale)


def _as_text(value: Any) -> str:
    """A default as one would write it."""
    if isinstance(value, bool):
        return str(value).lower()
    return terminal.number(value) if isinstance(value, float) else str(value)
