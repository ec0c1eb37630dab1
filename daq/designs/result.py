"""What a design holds for people and machines: runs, predicted intervals, what stays unknown."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from daq.config.question import Question
from daq.designs.bench import COMMANDED
from daq.hal import FloatArray
from daq.views import Shown
from sysid import Design, ProcessModel
from sysid.experiments import ChosenRuns, PredictedQuantity

_WIDE = 0.5  # half width in parts of the value, from which a quantity counts as hardly known


@dataclass(frozen=True)
class Unknown:
    """What no run of a design tells, why, and what would tell it."""

    names: tuple[str, ...]
    why: str
    cure: str


@dataclass(frozen=True)
class PlannedRun:
    """A run of a design: its file, its protocol and what it is expected to do.

    signals: of the rig by name, commands too, (n_draws, n_samples) each, the first row at the
    likeliest parameters. dt: sample time [s].
    """

    file: Path
    protocol: str
    settings: Mapping[str, float]
    signals: Mapping[str, FloatArray]
    dt: float

    @property
    def commands(self) -> tuple[FloatArray, ...]:
        """Commands of motor and brake, (n_draws, n_samples) each [V]."""
        return tuple(self.signals[name] for name in COMMANDED)

    @property
    def seconds(self) -> float:
        """How long it takes, at most [s]."""
        return len(self.signals["omega"][0]) * self.dt

    @property
    def document(self) -> dict[str, Any]:
        """What it is, for machines."""
        return {
            "file": str(self.file),
            "protocol": self.protocol,
            "seconds": self.seconds,
            "settings": dict(self.settings),
        }


@dataclass(frozen=True, repr=False)
class RunsResult(Shown):
    """Runs chosen for a rig, and their files.

    rig_name: as it is typed. noise: standard deviations that the choice counts on. commands: what
    to type with the files, in order.
    """

    question: Question
    rig_name: str
    runs: tuple[PlannedRun, ...]
    noise: Mapping[str, float]
    folder: Path
    figure: Path
    commands: tuple[str, ...] = field(default=(), kw_only=True)

    @property
    def count(self) -> str:
        """How many runs there are, in words."""
        return f"{len(self.runs)} run{'s' * (len(self.runs) != 1)}"

    def of_runs(self, chosen: ChosenRuns) -> dict[str, Any]:
        """What documents hold of the runs and of how they were chosen."""
        return {
            "rig": self.rig_name,
            "duration_seconds": chosen.duration,
            "runs": [run.document for run in self.runs],
            "noise": dict(self.noise),
            "simulated": chosen.attempts,
            "beyond_limits": chosen.refused,
            "figure": str(self.figure),
            **({"commands": list(self.commands)} if self.commands else {}),
        }


@dataclass(frozen=True, repr=False)
class DesignResult(RunsResult):
    """A design for a rig, and its files.

    model_name: as it is typed.

    >>> from daq import design
    >>> few = {"candidates": 4, "generations": 0, "draws": 1, "checks": 1}
    >>> result = design(precision="50 %", time="1 s", **few)
    >>> [quantity.name for quantity in result.design.quantities][:2]
    ['K_dm', 'omega_dm']
    """

    model: ProcessModel
    model_name: str
    design: Design

    @property
    def headline(self) -> str:
        """What is run, for which model, and where its files are."""
        return f"{self.count} for {self.model_name} on {self.rig_name}, {self.folder}"

    @property
    def unknown(self) -> list[Unknown]:
        """What stays unknown behind these runs."""
        return [*self._of_structure(), *self._of_information()]

    @property
    def otherwise(self) -> str | None:
        """What else may tell all that acts only together, in a sentence."""
        if not self.design.tied:
            return None
        return (
            "Another mounting may tell what acts only together, without a load or with its sensor "
            f"elsewhere: rig models {self.model_name} --identifiable compares."
        )

    @property
    def document(self) -> dict[str, Any]:
        """The same for machines."""
        return {
            "model": self.model_name,
            "met": self.design.met,
            "quantities": [
                {**asdict(quantity), "met": quantity.met} for quantity in self.design.quantities
            ],
            "short": [quantity.name for quantity in self.short],
            "unknown": [asdict(unknown) for unknown in self.unknown],
            "otherwise": self.otherwise,
            **self.of_runs(self.design),
        }

    def _of_structure(self) -> list[Unknown]:
        """What the equations let no experiment tell."""
        unknown = []
        for group in self.design.tied:
            together = ", ".join(combination.text for combination in group.combinations)
            only = f"only {together} of them act" if together else "they act only together"
            fix = " and ".join(group.fix)
            cure = f"measure {fix} by other means and fix it"
            unknown.append(Unknown(group.parameters, f"on what is measured {only}", cure))
        if self.design.unseen:
            cure = "fix it by other means, or measure what it acts on"
            unknown.append(Unknown(self.design.unseen, "it acts on nothing measured", cure))
        return unknown

    @property
    def short(self) -> list[PredictedQuantity]:
        """Quantities that these runs tell, but less closely than was asked for."""
        return [q for q in self.design.quantities if not q.met and q.after <= _WIDE]

    def _of_information(self) -> list[Unknown]:
        """What these runs hardly tell."""
        quantities = [q for q in self.design.quantities if q.target is None or not q.met]
        wide = tuple(quantity.name for quantity in quantities if quantity.after > _WIDE)
        cure = "give more time, or wider limits; or fix it by other means"
        return [Unknown(wide, "these runs hardly feel it", cure)] if wide else []
