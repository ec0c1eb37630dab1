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
from daq.lookup.schemas import nearest_folder, schema_comment
from daq.lookup.shipped import find_file, shipped_files
from daq.progress import Progress, Watch
from sysid.experiments import DesignedRun

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
    rig, runs = _from_anywhere(setups[0].rig_name), []
    for k, run in enumerate(chosen, 1):
        path = folder / f"designed-{k}.yaml"
        content = setups[0].families[run.excitation].content(run.settings)
        write_whole(path, _head(folder, k, len(chosen)) + _experiment_text(content, rig))
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


def _from_anywhere(rig: str) -> str:
    """A rig's file by a name that holds in any folder: absolute, or that of a shipped one."""
    path = find_file("backend", rig)
    return rig if path in shipped_files("backend").values() else str(path.resolve())


def _head(folder: Path, number: int, count: int) -> str:
    schema = schema_comment("experiment", nearest_folder("experiment", folder))
    return f"{schema}\n# Run {number} of {count} of a design by rig design.\n"


def _experiment_text(content: Mapping[str, Any], rig: str) -> str:
    file = {"protocol": content["protocol"], "rig": rig, **content}
    return yaml.safe_dump(file, sort_keys=False, default_flow_style=None)
