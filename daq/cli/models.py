"""``rig models``: the installed process models, or one in full."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument

from daq.cli import completion, options, terminal

if TYPE_CHECKING:
    from sysid import ProcessModel
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
    json: options.AsJson = False,
) -> None:
    """List the installed models, or describe one.

    With its states, signals, parameters, units, ranges and options.
    """
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
