"""The run that is shown: the newest under a folder, or a named one, as it grows."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from daq.errors import ConfigError
from daq.logs.capture import LOG_NAME, RUN_NAME, RUNNING, read_record, settings_of
from daq.logs.recording import log_path
from daq.process import RunProcess
from daq.scope.history import History
from daq.scope.tail import LogTail

_LOOK = 0.2  # s between looks for a new run and for changes of run.json
_QUIET = 3.0  # s without a sample after which a run may have been killed
_POLL = 0.01  # s in which several pages share what the first of them has read
_MUCH = 1_000_000  # bytes to read that take a while


@dataclass(frozen=True)
class RunState:
    """State of a run by its run.json.

    status: as in the record; "log" for a lone CSV. details: what to show beside it, by name.
    problem: what is wrong with the record. limits: values of the rig's limits, by quantity.
    process: that the run is in, where it can be told from others.
    """

    status: str = "log"
    reason: str | None = None
    details: dict[str, str] = field(default_factory=dict)
    expected_rows: int | None = None
    problem: str | None = None
    limits: dict[str, list[float]] = field(default_factory=dict)
    process: RunProcess | None = None

    @property
    def running(self) -> bool:
        """Whether more samples may come."""
        return self.status == RUNNING

    @classmethod
    def of(cls, log: Path) -> Self:
        """The state of the run that a log is of."""
        try:
            record = read_record(log)
        except ConfigError as error:
            return cls(problem=str(error))
        if record is None:
            return cls()
        experiment, rig = settings_of(record)
        rate, duration = (experiment.get(key) for key in ("sample_rate", "duration"))
        expected_rows = None
        if isinstance(rate, int | float) and isinstance(duration, int | float):
            expected_rows = round(rate * duration)
        details = {
            "rig": rig.get("name"),
            "protocol": experiment.get("protocol"),
            "started": str(record.get("started", ""))[:19].replace("T", " ") + " UTC",
            "sample rate": f"{rate:g} Hz" if isinstance(rate, int | float) else None,
        }
        return cls(
            status=str(record.get("status")),
            reason=str(record["reason"]) if record.get("reason") else None,
            details={name: str(value) for name, value in details.items() if value},
            expected_rows=expected_rows,
            limits=_limits(rig.get("limits")),
            process=RunProcess.of(record.get("process")),
        )


class FollowedLog:
    """A log as it grows, and the state of its run.

    Nothing in it raises for what the files hold: problems stand in ``complaints``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.state = RunState()
        self._record_version: tuple[int, int] | None = None
        self.tail = LogTail(path)
        self.history: History | None = None
        self._grew = time.perf_counter()
        self.look()

    @property
    def name(self) -> str:
        """Folder of a run, or file of a lone log."""
        return self.path.resolve().parent.name if self.path.name == LOG_NAME else self.path.name

    @property
    def n_rows(self) -> int:
        """Samples read so far."""
        return self.history.n_rows if self.history else 0

    @property
    def loading(self) -> float | None:
        """Part of the file that has been read while there is much to read, else None."""
        size = self.tail.size()
        return self.tail.offset / size if size - self.tail.offset > _MUCH else None

    def read(self) -> None:
        """Read the rows written since the last call."""
        if self.tail.size() < self.tail.offset:
            # Another file under the same name.
            self.tail, self.history = LogTail(self.path), None
        values, starts = self.tail.poll()
        if self.history is None and self.tail.columns:
            self.history = History(self.tail.columns, self.tail.read_between)
        if self.history is not None and len(values):
            self.history.add(values, starts)
            self._grew = time.perf_counter()

    def look(self) -> None:
        """Read run.json again where it has changed."""
        try:
            stat = (self.path.parent / RUN_NAME).stat()
        except OSError:
            return
        version = stat.st_mtime_ns, stat.st_ino
        if version != self._record_version:
            self._record_version = version
            self.state = RunState.of(self.path)

    def complaints(self) -> list[str]:
        """Problems of the log and its record, most serious first."""
        file, problems = self.path.name, self.tail.problems
        texts = [f"{self.path}: {self.tail.fault}"] if self.tail.fault else []
        if self.state.problem:
            texts.append(self.state.problem)
        texts += [f"{file}: {text}" for text in problems.first]
        if problems.count > len(problems.first):
            texts.append(f"{file}: and {problems.count - len(problems.first)} more like these")
        quiet = time.perf_counter() - self._grew
        if self.state.running and quiet > _QUIET and self.n_rows:
            texts.append(
                f"no new sample for {quiet:.0f} s although the run has not ended: "
                "it was killed, or it stalls"
            )
        elif not self.state.running and self.loading is None and self.tail.torn():
            texts.append(f"{file}: its last line was cut and is left out")
        return texts


class Watch:
    """The log that all pages show; it is read once for all of them.

    named: the run to stay with, or None to follow the newest under ``root``; others: runs to lay
    behind it. Raises ConfigError where there is no such run.
    """

    def __init__(self, root: Path, named: Path | None, others: Sequence[Path] = ()) -> None:
        self.root = root if named is None or not named.is_dir() else named.resolve().parent
        self.followed = FollowedLog(_log_of(named)) if named is not None else None
        self.others = {path.name: _log_of(path) for path in map(Path.absolute, others)}
        self._stays = named is not None
        self._started: dict[str, str] = {}
        self._looked = self._polled = 0.0
        self.logs: dict[str, Path] = dict(self.others)  # of all runs that can be laid behind
        self.poll()

    def poll(self) -> None:
        """Look for a newer run, then for new samples."""
        now = time.perf_counter()
        if now - self._polled < _POLL:
            return
        self._polled = now
        if now - self._looked > _LOOK:
            self._looked = now
            runs = self._runs()
            newest = None if self._stays or not runs else self.root / runs[0] / LOG_NAME
            if newest is not None and (self.followed is None or self.followed.path != newest):
                self.followed = FollowedLog(newest)
            logs = {name: self.root / name / LOG_NAME for name in runs}
            self.logs = {**self.others, **logs, **self.others}
            if self.followed is not None:
                self.followed.look()
        if self.followed is not None:
            self.followed.read()

    def _runs(self) -> list[str]:
        """Folders of runs, that which began last first."""
        try:
            folders = {item.name: item for item in self.root.iterdir() if item.is_dir()}
        except OSError:
            return []
        for name in folders.keys() - self._started.keys():
            began = _began(folders[name])
            if began is not None:
                self._started[name] = began
        runs = [(began, name) for name, began in self._started.items() if name in folders]
        return [name for _, name in sorted(runs, reverse=True)]


def _limits(limits: Any) -> dict[str, list[float]]:
    """Where a rig's limits are, by the quantity that they are of; of a record that may lack any."""
    if not isinstance(limits, dict):
        return {}
    ends: dict[str, Any] = {"omega": limits.get("speed"), "torque": limits.get("torque")}
    for channel in ("motor", "brake"):
        for kind, quantity in (("current", "current"), ("command", "voltage")):
            section = limits.get(kind)
            if isinstance(section, dict):
                ends[f"{quantity}_{channel}"] = section.get(channel)
    ends["theta"] = limits.get("travel")
    lines = {}
    for quantity, end in ends.items():
        values = end if isinstance(end, list) else [] if end is None else [end, _negative(end)]
        numbers = [float(v) for v in values if isinstance(v, int | float) and math.isfinite(v)]
        numbers = [v for v in numbers if v != 0.0]  # an end at rest is none to come near to
        if numbers:
            lines[quantity] = numbers
    return lines


def _negative(value: Any) -> Any:
    return -value if isinstance(value, int | float) else None


def _log_of(named: Path) -> Path:
    log = log_path(named)
    if named.is_dir() and not log.exists() and not (named / RUN_NAME).exists():
        cure = "name a run's folder or a CSV, or follow the newest run of a folder with --out"
        raise ConfigError(f"this folder holds no run (no {LOG_NAME})", cure=cure, file=named)
    if not named.exists():
        cure = "name a run's folder or a CSV file"
        raise ConfigError("there is no such run", cure=cure, file=named)
    return log


def _began(folder: Path) -> str | None:
    """When a run began, as text that sorts by time; None for a folder that is no run."""
    log = folder / LOG_NAME
    if not (folder / RUN_NAME).exists() and not log.exists():
        return None
    try:
        started = str((read_record(log) or {}).get("started", ""))
    except ConfigError:
        started = ""
    # Without a record the folder's name, which begins with the time, has to do.
    name = folder.name
    return started or f"{name[:4]}-{name[4:6]}-{name[6:11]}:{name[11:13]}:{name[13:15]}"
