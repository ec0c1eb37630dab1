"""``rig tune``: a torque controller for identified parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from daq.cli import completion, options, terminal

if TYPE_CHECKING:
    from daq.tuning import Tuning


def tune(
    settings: Annotated[
        str,
        Argument(
            metavar="TORQUE.yaml",
            help="The controller's settings; a bare name not in this folder means the shipped one.",
        ),
    ],
    parameters: Annotated[
        Path | None,
        Option(metavar="PARAMETERS.yaml", help="Result of an identification, or its folder."),
    ] = None,
    model: Annotated[
        str | None,
        Option(
            metavar="NAME",
            help="In place of a result a model at its own values.",
            autocompletion=completion.models,
        ),
    ] = None,
    out: Annotated[Path, Option(metavar="FILE.yaml", help="Where the controller goes.")] = Path(
        "controller.yaml"
    ),
    json: options.AsJson = False,
) -> None:
    """Make a torque controller of identified parameters.

    Experiments name its file. It says what the controller rests on, and how well that is known.
    """
    from daq.tuning import tune as make

    with terminal.watching(json) as watch:
        tuning = make(settings, parameters, model=model, watch=watch)
    tuning.save(out)
    if json:
        terminal.print_json({**tuning.document, "file": out})
        return
    _show(tuning)
    print(f"Controller: {out}")
    terminal.print_next(
        f"write 'torque_controller: {out}' into an experiment, such as torque_tracking.yaml"
    )


def _show(tuning: Tuning) -> None:
    number = terminal.number
    rows = [
        [
            fact.name,
            number(fact.value),
            "-" if fact.interval is None else " .. ".join(map(number, fact.interval)),
            fact.unit,
            fact.meaning,
        ]
        for fact in tuning.facts
    ]
    head = ["quantity", "value", "95 % of draws", "unit", "what it is"]
    title = f"{tuning.control.controller} controller for {tuning.source}"
    terminal.print_table(title, head, rows, text=["unit", "what it is"])
    rows = [
        [p.branch, number(p.brake_current), number(p.stiffness, 3), number(p.damping, 3)]
        for p in tuning.operating_points()
    ]
    head = ["branch of the hysteresis", "brake [A]", "stiffness [N*m/rad]", "damping [N*m*s/rad]"]
    terminal.print_table("The shaft by operating point", head, rows, text=head[:1])
    for key, (before, after) in tuning.changes.items():
        if isinstance(after, list):
            terminal.print_text(f"{key}: {len(after)} numbers are set, for all of them at once.")
            continue
        text = f"{key} is {number(after)} in place of {number(before)}: no more is safe with every"
        terminal.print_text(f"{text} actuator, and every hand, that must be reckoned with.")
    if not len(tuning.draws):
        print("No uncertainty is known of these parameters.")
    if tuning.uncertain:
        terminal.print_text(
            f"Without an interval, and taken as they are: {', '.join(tuning.uncertain)}."
        )
