"""Rounds of a characterisation, as they stand on the disk.

One folder holds all of it: the request, and for each round its design, its runs and the
identification from all runs until then. Each part is written whole, its last file last, so that
after a kill what is there is done, and the rest is done anew.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from daq.config import json_file, yaml_file
from daq.designs.files import DATA
from daq.errors import ConfigError
from daq.files import make_folder, write_whole
from daq.identification.earlier_fit import EarlierFit
from daq.identification.request import PARAMETERS
from daq.logs.capture import COMPLETED, INTERLOCK, RUN_NAME
from daq.lookup.models import without_folders
from sysid import EarlierMinima
from sysid.experiments import is_as_narrow

_REQUEST = "characterise.json"
_RUNS, _IDENTIFICATION = "runs", "identification"
_STOPS = 2  # by limits, from which on an experiment is left out; after one its cause is sought


@dataclass(frozen=True)
class Request:
    """What was asked for; rig, model, plant and config as they are found from any folder.

    time: logged, of all runs together [s]. precision: half width of the 95 % intervals [%], None
    for as narrow as the time allows. settings: further keys of the designs, as ``key=value``.
    ask: whether a person changes the mounting where another one tells more.
    """

    rig: str
    time: float
    precision: float | None = None
    model: str | None = None
    plant: str | None = None
    config: str | None = None
    settings: tuple[str, ...] = ()
    ask: bool = False

    def save(self, folder: Path) -> None:
        """Write it into the folder of the rounds. Raises ConfigError for one with another in it."""
        make_folder(folder)
        file = folder / _REQUEST
        if file.exists():
            cure = (
                f"go on with it: rig characterise --resume {folder}, or choose another with --out"
            )
            raise ConfigError("a characterisation has begun there", cure=cure, file=folder)
        self.rewrite(folder)

    def rewrite(self, folder: Path) -> None:
        """Write it over the one that is there."""
        write_whole(folder / _REQUEST, json.dumps(asdict(self), indent=1) + "\n")

    def changed(self, time: float | None, precision: float | None) -> Request:
        """The same with another time or precision, None for the one that it has."""
        return replace(
            self,
            time=self.time if time is None else time,
            precision=self.precision if precision is None else precision,
        )

    @classmethod
    def load(cls, folder: Path) -> Request:
        """The request in a folder. Raises ConfigError where there is none."""
        file = folder / _REQUEST
        if not file.exists():
            cure = "name the folder that rig characterise made"
            raise ConfigError("no characterisation has begun there", cure=cure, file=folder)
        try:
            content = json_file.load(file, "request", "characterise anew")
            return cls(**{**content, "settings": tuple(content["settings"])})
        except (KeyError, TypeError) as error:
            raise ConfigError(
                f"not a request: {error}", cure="characterise anew", file=file
            ) from None


@dataclass(frozen=True)
class Interval:
    """A quantity after a round: its value, and half width of its 95 % interval in parts of it.

    expected: the half width that the design predicted; None where it is not in the design. width
    is None where the runs determine no interval with two ends. low, high: the ends, which need not
    be alike far from the value; None where the runs set none.
    """

    name: str
    unit: str
    value: float
    width: float | None
    expected: float | None
    low: float | None = None
    high: float | None = None

    def is_within(self, percent: float) -> bool:
        """Whether its interval is as narrow as that, as printed."""
        return self.width is not None and is_as_narrow(self.width, percent / 100.0)


@dataclass(frozen=True)
class Round:
    """A round, by its number from 1, in the folder of all."""

    root: Path
    number: int

    @property
    def folder(self) -> Path:
        """Where it stands."""
        return self.root / f"round-{self.number}"

    @property
    def identification(self) -> Path:
        """Where its result stands."""
        return self.folder / _IDENTIFICATION

    @property
    def runs(self) -> Path:
        """Where its captures go."""
        return self.folder / _RUNS

    @property
    def is_designed(self) -> bool:
        """Whether its design is there."""
        return (self.folder / DATA).exists()

    def discard_design(self) -> None:
        """Delete a design of which nothing has been run."""
        if self.is_designed and not self.runs.exists():
            for experiment in self.experiments:
                experiment.unlink(missing_ok=True)
            (self.folder / DATA).unlink()

    @property
    def is_identified(self) -> bool:
        """Whether its result is there."""
        return (self.identification / PARAMETERS).exists()

    @property
    def design(self) -> dict[str, Any]:
        """The design's document."""
        return json_file.load(self.folder / DATA, "design", "delete its folder and go on")

    @property
    def experiments(self) -> list[Path]:
        """Its experiments' files, in order."""
        return [self.folder / Path(run["file"]).name for run in self.design["runs"]]

    @property
    def rig(self) -> str:
        """The rig's file, as it is mounted for the round."""
        return str(self.design["rig"])

    @property
    def seconds(self) -> float:
        """Logged time of its runs, also of those that are left out [s]."""
        return float(self.design["duration_seconds"])

    def captures(self, experiment: Path) -> list[Path]:
        """Folders of an experiment's runs that were completed."""
        return self._ended(experiment, COMPLETED)

    def is_left_out(self, experiment: Path) -> bool:
        """Whether limits have stopped an experiment so often that nobody has mended why."""
        if self.captures(experiment):
            return False
        return self.stops(experiment) >= _STOPS

    def stops(self, experiment: Path) -> int:
        """How often limits have stopped an experiment."""
        return len(self._ended(experiment, INTERLOCK))

    @property
    def logs(self) -> list[Path]:
        """Folders of its runs, one of each experiment that was completed."""
        captures = map(self.captures, self.experiments)
        return [completed[0] for completed in captures if completed]

    def _ended(self, experiment: Path, status: str) -> list[Path]:
        """Folders of an experiment's runs that ended so."""
        # A second run within a second has a number behind the name.
        named = re.compile(rf".*-{re.escape(experiment.stem)}(-\d+)?")
        return [
            record.parent
            for record in sorted(self.runs.glob(f"*-{experiment.stem}*/{RUN_NAME}"))
            if named.fullmatch(record.parent.name)
            if json_file.load(record, "record", "delete its folder").get("status") == status
        ]

    @property
    def result(self) -> dict[str, Any]:
        """The result's document."""
        return yaml_file.load(self.identification / PARAMETERS).content

    @property
    def model(self) -> str:
        """The model's name, as one types it where its file is."""
        name = str(self.result["model"])
        return without_folders([name])[name]

    def intervals(self, result: Mapping[str, Any] | None = None) -> list[Interval]:
        """All that experiments can tell, after this round; result: one not yet written."""
        result = result or self.result
        entries: dict[str, Mapping[str, Any]] = dict(result["parameters"])
        for ambiguity in result.get("ambiguities") or ():
            entries |= {entry["name"]: entry for entry in ambiguity["determined"]}
        return [
            _interval(quantity, entries.get(quantity["name"], {}))
            for quantity in self.design["quantities"]
        ]

    @property
    def as_earlier_fit(self) -> EarlierFit:
        """Where an identification with more logs begins."""
        result, intervals = self.result, self.intervals()
        values = {name: float(entry["value"]) for name, entry in result["parameters"].items()}
        ends = {
            i.name: (i.low, i.high) for i in intervals if i.low is not None if i.high is not None
        }
        rivals = [rival["parameters"] for rival in result.get("rivals") or ()]
        noise = result["criterion"].get("noise") or {}
        poor = result["verdict"]["parameters"]["trust"] == "poor"
        nowhere = any(i.low is None and i.high is None for i in intervals)
        settled = not (poor or rivals or nowhere)
        return EarlierFit(EarlierMinima([values, *rivals], noise, settled), ends)


def _interval(quantity: Mapping[str, Any], entry: Mapping[str, Any]) -> Interval:
    value = entry.get("value", quantity["value"])
    low, high = entry.get("interval") or (None, None)
    width = None
    if low is not None and high is not None and value:
        width = 0.5 * abs((high - low) / value)
    return Interval(quantity["name"], quantity["unit"], value, width, quantity["after"], low, high)


def rounds_of(folder: Path) -> list[Round]:
    """Rounds with a result, in order."""
    numbers = range(1, 1 + len(list(folder.glob("round-*"))))
    return [each for n in numbers if (each := Round(folder, n)).is_identified]
