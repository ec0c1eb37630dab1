"""What is shown: the newest run under a folder, or one that was named, as it grows."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.errors import ConfigError
from daq.logs.capture import LOG_NAME, RUN_NAME, RUNNING
from daq.logs.recording import log_path, read_record
from daq.scope.history import History
from daq.scope.tail import LogTail

_LOOK = 0.2  # s between looks for a new run and for changes of run.json
_QUIET = 3.0  # s without a sample after which a run may have been killed
_POLL = 0.01  # s in which several pages share what one of them has read


@dataclass(frozen=True)
class State:
    """What run.json says of a run.

    status: as in the record; "log" for a lone CSV. details: what to show beside it, by name.
    """

    status: str
    reason: str | None
    details: dict[str, str]
    expected_rows: int | None
    problem: str | None

    @property
    def running(self) -> bool:
        """Whether more samples may come."""
        return self.status == RUNNING


class Recording:
    """One log as it grows, and what its run says of itself.

    Nothing in it raises for what the files hold: what is wrong is told in ``complaints``.
    """

    def __init__(self, log: Path) -> None:
        self.log = log
        self.state = State("log", None, {}, None, None)
        self._state_of: tuple[int, int] | None = None
        self.tail = LogTail(log)
        self.history: History | None = None
        self._grew = time.monotonic()
        self.look()

    @property
    def name(self) -> str:
        """Folder of a run, or file of a lone log."""
        return self.log.resolve().parent.name if self.log.name == LOG_NAME else self.log.name

    @property
    def loading(self) -> float | None:
        """Part of the file that has been read while there is much to read, else None."""
        size = self.tail.size()
        behind = size - self.tail.offset
        return self.tail.offset / size if behind > 1_000_000 else None

    @property
    def quiet_for(self) -> float:
        """Time since the last sample came [s]."""
        return time.monotonic() - self._grew

    def read(self) -> None:
        """Take what has been written since the last time."""
        if self.tail.size() < self.tail.offset:
            # Another file under the same name.
            self.tail, self.history = LogTail(self.log), None
        rows = self.tail.poll()
        if self.history is None and self.tail.columns:
            self.history = History(self.tail.columns, self.tail.read_between)
        if self.history is not None and len(rows.values):
            self.history.add(rows.values, rows.starts)
            self._grew = time.monotonic()

    def look(self) -> None:
        """Read run.json again where it has changed."""
        path = self.log.parent / RUN_NAME
        try:
            now = path.stat()
        except OSError:
            return
        changed = (now.st_mtime_ns, now.st_ino)
        if changed != self._state_of:
            self._state_of = changed
            self.state = _read_state(self.log)

    def complaints(self) -> list[str]:
        """What is wrong with the log or its record, most serious first."""
        said = []
        if self.tail.fault:
            said.append(f"{self.log}: {self.tail.fault}")
        if self.state.problem:
            said.append(self.state.problem)
        problems = self.tail.problems
        said += [f"{self.log.name}: {text}" for text in problems.first]
        if problems.count > len(problems.first):
            said.append(
                f"{self.log.name}: and {problems.count - len(problems.first)} more like these"
            )
        if self.state.running and self.quiet_for > _QUIET and self.history and self.history.n_rows:
            said.append(
                f"no new sample for {self.quiet_for:.0f} s although the run has not ended: "
                "it was killed, or it stalls"
            )
        elif not self.state.running and self.loading is None and self.tail.torn():
            said.append(f"{self.log.name}: its last line was cut and is left out")
        return said


class Watch:
    """What the pages show; they share what has been read.

    named: the run to stay with, or None to follow the newest under ``root``.
    """

    def __init__(self, root: Path, named: Path | None) -> None:
        self.root = root
        self.named = named
        self.recording: Recording | None = None
        if named is not None:
            self.recording = Recording(_log_of(named))
        self._started: dict[str, str] = {}
        self._looked = self._polled = 0.0
        self.poll()

    def poll(self) -> None:
        """Look for a newer run, then for new samples."""
        now = time.monotonic()
        if now - self._polled < _POLL:
            return
        self._polled = now
        if now - self._looked > _LOOK:
            self._looked = now
            self._follow()
            if self.recording is not None:
                self.recording.look()
        if self.recording is not None:
            self.recording.read()

    def _follow(self) -> None:
        if self.named is not None:
            return
        newest = self._newest()
        if newest is not None and (self.recording is None or self.recording.log != newest):
            self.recording = Recording(newest)

    def _newest(self) -> Path | None:
        """Log of the run that began last."""
        try:
            folders = [item for item in self.root.iterdir() if item.is_dir()]
        except OSError:
            return None
        for folder in folders:
            if folder.name not in self._started:
                began = _began(folder)
                if began is not None:
                    self._started[folder.name] = began
        there = {folder.name: folder for folder in folders}
        runs = [(began, name) for name, began in self._started.items() if name in there]
        return there[max(runs)[1]] / LOG_NAME if runs else None


def _log_of(named: Path) -> Path:
    log = log_path(named)
    if named.is_dir() and not log.exists() and not (named / RUN_NAME).exists():
        raise ConfigError(
            f"{named}: this folder holds no run (no {LOG_NAME}); name a run's folder or a CSV, "
            "or follow the newest run of a folder with --out"
        )
    if not named.exists():
        raise ConfigError(f"{named}: there is no such run; name a run's folder or a CSV file")
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


def _read_state(log: Path) -> State:
    try:
        record = read_record(log)
    except ConfigError as error:
        return State("log", None, {}, None, str(error))
    if record is None:
        return State("log", None, {}, None, None)
    experiment = _section(record, "experiment")
    rate, duration = experiment.get("sample_rate"), experiment.get("duration")
    expected = None
    if isinstance(rate, int | float) and isinstance(duration, int | float):
        expected = round(rate * duration)
    details = {
        "rig": _section(record, "rig").get("name"),
        "protocol": experiment.get("protocol"),
        "started": str(record.get("started", ""))[:19].replace("T", " ") + " UTC",
        "sample rate": f"{rate:g} Hz" if isinstance(rate, int | float) else None,
    }
    shown = {name: str(value) for name, value in details.items() if value}
    reason = record.get("reason")
    return State(str(record.get("status")), str(reason) if reason else None, shown, expected, None)


def _section(record: dict[str, Any], name: str) -> dict[str, Any]:
    found = record.get(name)
    return found if isinstance(found, dict) else {}
