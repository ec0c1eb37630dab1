"""From a question to a design: what to know, on which rig, from what is known already."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from daq.config import check, yaml_file
from daq.config.yaml_file import TypedSettings
from daq.designs import discrimination
from daq.designs.commands import commands_of, text_of
from daq.designs.discrimination import DiscriminationResult
from daq.designs.files import COMMANDS, DATA, FIGURE
from daq.designs.pictures import draw_design
from daq.designs.result import DesignResult
from daq.designs.runs import progress_of, write_runs
from daq.designs.setup import Setup, set_up, set_up_structures
from daq.documents import plain
from daq.errors import ConfigError
from daq.files import stamp, write_whole
from daq.identification.fit import check_writable
from daq.progress import Note, Watch, ignore
from sysid import Design, ModelError
from sysid import design as choose_runs


def design(
    question: str | Path | None = None,
    out: str | Path | None = None,
    *,
    watch: Watch = ignore,
    **settings: Any,
) -> DesignResult | DiscriminationResult:
    """Design runs for a rig, and write their files; nothing is energised.

    question: a file as for ``rig design``; settings: its keys, which go before it. out: the folder
    of the files, by default a new one under ``designs``. With ``structures`` the runs are those
    that tell these apart. Raises ConfigError.

    >>> from daq import design
    >>> quick = {"candidates": 8, "generations": 0, "draws": 1, "checks": 2}
    >>> result = design(precision="5 %", time="2.5 s", **quick)
    >>> [run.file.name for run in result.runs]
    ['designed-1.yaml', 'designed-2.yaml']
    """
    file = None if question is None else Path(question)
    return design_files(file, settings, (), None if out is None else Path(out), watch)


def design_files(
    question: Path | None,
    options: Mapping[str, Any],
    settings: Sequence[str],
    out: Path | None,
    watch: Watch = ignore,
) -> DesignResult | DiscriminationResult:
    """Design runs as ``rig design`` does.

    options: keys of the question by name, None for those not given; settings: any others, as
    ``key=value``. Raises ConfigError.
    """
    written = None if question is None else yaml_file.load(question)
    if written is not None:
        check.refuse_other_kind(written, "a design's question")
    typed = {key: value for key, value in options.items() if value is not None}
    file = TypedSettings.of(typed, settings, written)
    folder = out or Path("designs") / stamp()
    if file.content.get("structures"):
        setups = set_up_structures(file, watch)
        _check_new(folder)
        return discrimination.write(setups, discrimination.choose(setups, watch), folder)
    setup = set_up(file, watch)
    _check_new(folder)
    return write(setup, choose(setup, watch), folder, commands_of(setup, folder))


def choose(setup: Setup, watch: Watch = ignore) -> Design:
    """The runs that tell most. Raises ConfigError where none can be made."""
    question, settings = setup.question, setup.problem.settings
    try:
        chosen = choose_runs(
            setup.problem.model,
            [family.excitation() for family in setup.families.values()],
            noise=setup.noise,
            runs=question.most_runs,
            targets=setup.targets,
            precision=None if question.precision is None else question.precision / 100.0,
            criterion=question.criterion,
            prior=setup.prior,
            ranges=settings.ranges,
            fixed=setup.problem.fixed,
            tied=settings.tied,
            scale=settings.scale,
            bench=setup.bench,
            draws=question.draws,
            checks=question.checks,
            candidates=question.candidates,
            generations=question.generations,
            offspring=question.offspring,
            accuracy=settings.accuracy,
            seed=question.seed,
            watch=progress_of(question, watch),
        )
    except ModelError as error:
        key = ("targets",) if setup.targets else ("protocols",)
        raise setup.file.error(key, f"{error}{_refusals(setup)}") from None
    if chosen.phantoms:
        problem = "the simulation's error would pass for information"
        cure = "a lower accuracy, such as 1e-4 in --config, makes it less"
        watch(Note("warning", f"{chosen.phantoms} runs are left out: {problem}; {cure}"))
    return chosen


def _refusals(setup: Setup) -> str:
    """How many runs were refused for no limit, and the cures; empty for none."""
    text, bench = "", setup.bench
    if bench.turning:
        text += (
            f" (in {bench.turning} runs the shaft turned round too often for an encoder whose "
            "edges make the speed: other protocols, or more turns of a cable, may keep it turning)"
        )
    if bench.strays:
        text += (
            f" (in {bench.strays} runs the plant did what model {setup.problem.model_name} does "
            "not: name one that is like the plant, as --model actuator:hysteresis=dahl for a rig "
            "of that kind)"
        )
    return text


def write(
    setup: Setup, chosen: Design, folder: Path, commands: tuple[str, ...] = ()
) -> DesignResult:
    """A design's experiments, its figure and its document, in a folder that may be new.

    commands: what to type with them, written as well. The document is the last of them. Raises
    RunError where the disk refuses.
    """
    runs = write_runs([setup], chosen.runs, folder)
    result = DesignResult(
        setup.question, setup.rig_name, runs, setup.noise, folder, folder / FIGURE,
        setup.problem.model, setup.problem.model_name, chosen, commands=commands,
    )  # fmt: skip
    if commands:
        write_whole(folder / COMMANDS, text_of(commands))
    draw_design(result, setup.rig)
    write_whole(folder / DATA, json.dumps(plain(result.document), indent=1) + "\n")
    return result


def _check_new(folder: Path) -> None:
    """Raise ConfigError, before a long search, where no design can be written or there is one."""
    check_writable(folder)
    if (folder / DATA).exists() or any(folder.glob("designed-*.yaml")):
        raise ConfigError("a design is there", cure="choose another with --out", file=folder)
