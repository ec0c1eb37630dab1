"""Runs that tell structures apart: chosen, written, and what they would decide."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from daq.designs.commands import commands_of, text_of
from daq.designs.files import COMMANDS, DATA, FIGURE
from daq.designs.pictures import draw_runs
from daq.designs.result import RunsResult
from daq.designs.runs import progress_of, write_runs
from daq.designs.setup import Setup
from daq.documents import plain
from daq.files import write_whole
from daq.progress import Watch, ignore
from daq.views import Lines
from sysid import Discrimination, ModelError, discriminate


@dataclass(frozen=True, repr=False)
class DiscriminationResult(RunsResult):
    """Runs that tell structures apart on a rig, and their files.

    models: names of the structures' models, by what the structures are called.
    """

    models: Mapping[str, str]
    discrimination: Discrimination

    @property
    def headline(self) -> str:
        """What is run, between what it decides, and where its files are."""
        return (
            f"{self.count} between {len(self.models)} structures on {self.rig_name}, {self.folder}"
        )

    def lines(self) -> Lines:
        """Each pair, how far apart it is, and how surely a test tells."""
        rows = [["if right is", "refused is", "chi-square", "probability [%]"]]
        for contest in self.discrimination.contests:
            sure = f"{100.0 * contest.probability:.3g}"
            rows.append([contest.truth, contest.rival, f"{contest.distance:.3g}", sure])
        return rows

    @property
    def document(self) -> dict[str, Any]:
        """The same for machines."""
        return {
            "structures": dict(self.models),
            "pairs": [{**asdict(c), "told": c.told} for c in self.discrimination.contests],
            "nested": [list(pair) for pair in self.discrimination.nested],
            "inseparable": [list(pair) for pair in self.discrimination.inseparable],
            **self.of_runs(self.discrimination),
        }


def choose(setups: Mapping[str, Setup], watch: Watch = ignore) -> Discrimination:
    """The runs that tell structures apart. Raises ConfigError where none can be made."""
    first = next(iter(setups.values()))
    question = first.question
    try:
        return discriminate(
            {name: each.problem.model for name, each in setups.items()},
            [family.excitation() for family in first.families.values()],
            noise=first.noise,
            runs=question.most_runs,
            spaces={name: each.space for name, each in setups.items()},
            priors={name: each.prior for name, each in setups.items()},
            benches={name: each.bench for name, each in setups.items()},
            checks=question.checks,
            candidates=question.candidates,
            generations=question.generations,
            offspring=question.offspring,
            seed=question.seed,
            watch=progress_of(question, watch),
        )
    except ModelError as error:
        raise first.file.error(("structures",), str(error)) from None


def write(
    setups: Mapping[str, Setup], chosen: Discrimination, folder: Path
) -> DiscriminationResult:
    """Its experiments, figure, commands and document, in a folder that may be new.

    The document is the last of them. Raises RunError where the disk refuses.
    """
    first = next(iter(setups.values()))
    runs = write_runs(list(setups.values()), chosen.runs, folder)
    models = {name: each.problem.model_name for name, each in setups.items()}
    commands = commands_of(first, folder, list(models.values()))
    result = DiscriminationResult(
        first.question, first.rig_name, runs, first.noise, folder, folder / FIGURE, models, chosen,
        commands=commands,
    )  # fmt: skip
    write_whole(folder / COMMANDS, text_of(commands))
    draw_runs(runs, first.rig, {}, result.figure)
    write_whole(folder / DATA, json.dumps(plain(result.document), indent=1) + "\n")
    return result
