"""Runs that a search has chosen, as experiments' files."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from daq.config.question import Question
from daq.designs.result import PlannedRun
from daq.designs.setup import Setup
from daq.files import make_folder, write_whole
from daq.lookup.schemas import schema_comment
from daq.progress import Progress, Watch
from sysid.experiments import DesignedRun

DATA, FIGURE = "design.json", "design.png"
_ALL = 2.0  # simulated runs for each one that a search asks for: what passes a limit is tried again


def write_runs(
    setups: Sequence[Setup], chosen: Sequence[DesignedRun], folder: Path
) -> tuple[PlannedRun, ...]:
    """Write experiments into a folder that may be new, and predict what they do.

    setups: of each structure that may be right, whose signals stand one behind the other. Raises
    RunError where the disk refuses.
    """
    make_folder(folder)
    question = setups[0].question
    vectors = [
        each.space.full(
            each.prior.draws(each.space, question.checks, np.random.default_rng(question.seed))
        )
        for each in setups
    ]
    runs = []
    for k, run in enumerate(chosen, 1):
        path = folder / f"designed-{k}.yaml"
        content = setups[0].families[run.excitation].content(run.settings)
        write_whole(path, _experiment_text(content, setups[0].rig_name, k, len(chosen)))
        each = [
            setup.bench.signals(run.inputs, run.dt, of_it)
            for setup, of_it in zip(setups, vectors, strict=True)
        ]
        names = [name for name in each[0] if all(name in signals for signals in each)]
        signals = {name: np.concatenate([s[name] for s in each]) for name in names}
        runs.append(PlannedRun(path, run.excitation, run.settings, signals, run.dt))
    return tuple(runs)


def progress_of(question: Question, watch: Watch) -> Callable[[int, int], None]:
    """What tells a watch how far the search for a question's runs is."""
    expected = question.candidates + _ALL * question.generations * question.offspring

    def report(attempts: int, kept: int) -> None:
        status = f"{attempts} runs simulated, {kept} within the limits"
        watch(Progress("Choosing runs", min(attempts, expected), expected, status))

    return report


def _experiment_text(content: Mapping[str, Any], rig: str, number: int, count: int) -> str:
    head = f"{schema_comment('experiment')}\n# Run {number} of {count} of a design by rig design.\n"
    file = {"protocol": content["protocol"], "rig": rig, **content}
    return head + yaml.safe_dump(file, sort_keys=False, default_flow_style=None)
