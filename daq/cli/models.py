"""``rig models``: the installed process models, or one in full."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, BadParameter, Option

from daq.cli import completion, options, terminal

if TYPE_CHECKING:
    from daq.identification.structure import Structure
    from sysid import ProcessModel, TiedGroup
    from sysid.problem.model import Parameter, State

_DECADES = 100.0  # between what acts and what does not, beyond which the latter is nothing at all


def models(
    name: Annotated[
        str | None,
        Argument(
            metavar="NAME|FILE.py:OBJECT",
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
    terminal.print_text(f"{structure.title}: {model.description}")
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
    for group in result.tied:
        print()
        _show_group(group)
    for assumption in model.assumptions:
        print()
        terminal.print_text(assumption)
    if result.tied:
        print()
        if math.isfinite(result.gap):
            terminal.print_text(
                "No case is doubtful: the least effect that counts as one is "
                f"1e{result.gap:.0f} times the largest that does not."
                if result.gap < _DECADES
                else "No case is doubtful: what does not act has no effect at all."
            )
        terminal.print_next("rig identify LOG --set fixed.NAME=VALUE, with what was measured")


def _show_group(group: TiedGroup) -> None:
    terminal.print_text(f"{', '.join(group.parameters)} act only together. Outputs determine")
    width = max((len(c.text) for c in group.combinations), default=0)
    for combination in group.combinations:
        print(f"    {combination.text:<{width}}  {combination.unit}".rstrip())
    missing = group.count - len(group.combinations)
    if missing:
        _show_directions(group, missing)
    elif not group.count:
        print("    nothing of them")
    terminal.print_text(f"  {_separation(group)}")


def _show_directions(group: TiedGroup, missing: int) -> None:
    """How the members move where some combinations have no simple form."""
    number = terminal.number
    at = ", ".join(f"{name} {number(value)}" for name, value in group.values.items())
    several = "combination" if missing == 1 else "combinations"
    terminal.print_text(f"    {missing} {several} of no simple form. At {at} nothing changes along")
    for direction in group.directions:
        steps = zip(group.parameters, direction, strict=True)
        moved = ", ".join(f"{name} {number(step)}" for name, step in steps if step)
        terminal.print_text(f"      {moved}")


def _separation(group: TiedGroup) -> str:
    """What tells the members of a group apart."""
    values = [name for name in group.fix if not name.endswith("(0)")]
    starts = [name for name in group.fix if name.endswith("(0)")]
    keys = ["'fixed'"] * bool(values) + ["'initial'"] * bool(starts)
    pronoun = "it" if len(group.fix) == 1 else "them"
    text = f"To tell them apart, measure {_listed(group.fix, 'and')} by other means and give "
    text += f"{pronoun} under {_listed(keys, 'and')}"
    whole = [state for state, names in group.sensors.items() if names == group.parameters]
    text += f", or log {_listed(whole, 'or')} as well" if whole else ""
    for state, names in group.sensors.items():
        if state not in whole:
            text += f"; {state}, logged as well, tells {_listed(names, 'and')}"
    return f"{text}."


def _listed(names: Sequence[str], word: str) -> str:
    """``a, b and c``."""
    return f" {word} ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def _show_list(models: dict[str, ProcessModel]) -> None:
    head = ["name", "states", "inputs", "outputs", "free parameters", "what it is"]
    rows = [[name, *_sizes(model), model.description] for name, model in models.items()]
    terminal.print_table("Process models", head, rows, text=["what it is"])
    terminal.print_next("rig models NAME, or rig models my_model.py:model for one of your own")


def _sizes(model: ProcessModel) -> list[str]:
    free = [parameter for parameter in model.parameters if not parameter.fixed]
    return [str(len(parts)) for parts in (model.states, model.inputs, model.outputs, free)]


def _show(name: str, model: ProcessModel, options: list[dict[str, Any]]) -> None:
    from daq.lookup.models import title_of

    terminal.print_text(f"{title_of(name, model)}: {model.description}")
    for equation in model.equations:
        terminal.print_text(f"  {equation}")
    for assumption in model.assumptions:
        terminal.print_text(assumption)
    if model.equations or model.assumptions:
        print()
    rows = [["state", s.name, s.unit, _start(s, model)] for s in model.states]
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
    last = next((o for o in reversed(options) if len(o["choices"]) > 1), options[-1])
    terminal.print_text(
        f"Another combination: rig models {name_parts(name)[0]}:{last['name']}="
        f"{last['choices'][-1]}, with a comma between options; --model takes the same name"
    )


def _start(state: State, model: ProcessModel) -> str:
    if state.initial_range is None and state.first_sample and state.name in model.output_names:
        return f"starts at its first sample, else at {state.initial:g}"
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
