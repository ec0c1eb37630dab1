"""Capture folders: one run, one folder, with everything needed to understand it later."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import importlib.metadata
import json
import math
import platform
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.errors import ConfigError, RunError
from daq.logs.log import Log, load_log

if TYPE_CHECKING:
    import pandas as pd

LOG_NAME = "log.csv"
RUN_NAME = "run.json"

_RESERVE = ".reserve"  # room for the last run.json on a disk that the log has filled
_RESERVED = 64 * 1024  # bytes

RUNNING = "running"
COMPLETED = "completed"


@dataclass
class Capture:
    """A folder being written by a run; ``record`` is what run.json holds."""

    folder: Path
    record: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def create(cls, root: Path, name: str, record: dict[str, Any]) -> Capture:
        """Make ``<root>/<UTC time>-<name>/`` and note in it that the run has begun."""
        now = datetime.datetime.now(datetime.UTC)
        stem = f"{now:%Y%m%dT%H%M%SZ}-{_file_name(name)}"
        folder = _new_folder(root, stem)
        capture = cls(
            folder,
            {
                "status": RUNNING,
                "reason": None,
                "started": now.isoformat(timespec="milliseconds"),
                **record,
                "software": software_versions(),
                "host": {"system": platform.platform(), "node": platform.node()},
            },
        )
        capture.save()
        capture.reserve()
        return capture

    @property
    def log_path(self) -> Path:
        """Where the samples go."""
        return self.folder / LOG_NAME

    def save(self) -> None:
        """Write run.json so that a reader sees the old or the new one, never half of it."""
        write_whole(self.folder / RUN_NAME, json.dumps(self.record, indent=2) + "\n")

    def reserve(self) -> None:
        """Take the room on the disk that ``finish`` will need. Raises RunError without any."""
        path = self.folder / _RESERVE
        try:
            path.write_bytes(bytes(_RESERVED))
        except OSError as error:
            cure = "free space on the disk, or choose another with --out"
            raise RunError(f"cannot be written: {error.strerror}", cure=cure, file=path) from None

    def finish(self, status: str, reason: str | None, **facts: Any) -> None:
        """Note how the run ended, and the fingerprint of its log.

        Raises RunError when the disk refuses. What ends it in between leaves a record that lacks
        no more than the fingerprint.
        """
        self.record.update(status=status, reason=reason, **facts)
        (self.folder / _RESERVE).unlink(missing_ok=True)
        self.save()
        if self.log_path.exists():
            with self.log_path.open("rb") as log:
                digest = hashlib.file_digest(log, "sha256").hexdigest()
            self.record["log"] = {"file": LOG_NAME, "sha256": digest}
            self.save()


@dataclass(frozen=True)
class Recording:
    """A log with what is known of its run.

    warning: None for a run that completed, else one line that says how it ended.
    """

    log: Log
    record: dict[str, Any] | None
    warning: str | None

    @property
    def name(self) -> str:
        """Folder name of a capture, or file name of a lone log."""
        path = self.log.path
        return path.parent.name if path.name == LOG_NAME else path.stem

    @property
    def frame(self) -> pd.DataFrame:
        """The samples as a table; columns and units are those of ``daq.logs.log``."""
        return self.log.frame

    @property
    def folder(self) -> Path:
        """Where the log stands."""
        return self.log.path.parent

    def noise(self, channel: str) -> tuple[float, float]:
        """Standard deviations of a channel's noise and of its zero, as the calibration found them.

        Zeros for a channel that was not calibrated, and without a run record.
        """
        found = (self.record or {}).get("calibration", {})
        try:
            deviation = float(found.get("noise", {}).get(channel, 0.0))
            samples = int(found.get("samples", 1))
            if not (math.isfinite(deviation) and deviation >= 0.0 and samples > 0):
                raise ValueError
        except (AttributeError, OverflowError, TypeError, ValueError):
            raise ConfigError(
                f"'calibration' must hold 'samples' and, for {channel}, a 'noise' of 0 or more",
                cure="delete it to go without",
                file=self.folder / RUN_NAME,
            ) from None
        return deviation, deviation / math.sqrt(samples)


def load(path: str | Path) -> Recording:
    """Read a capture folder, its log.csv, or a lone CSV in either program's format.

    Raises ConfigError when there is no readable log.
    """
    csv = log_path(Path(path))
    log = load_log(csv)
    return Recording(log, read_record(csv), describe_end(csv, log.torn))


def log_path(path: Path) -> Path:
    """The CSV that a folder or file name given by a user means."""
    return path / LOG_NAME if path.is_dir() else path


def read_record(csv: Path) -> dict[str, Any] | None:
    """run.json beside a log.csv; None when there is none. ConfigError when it is malformed."""
    path = csv.parent / RUN_NAME
    if csv.name != LOG_NAME or not path.exists():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        problem = f"not a readable run record ({error})"
        raise ConfigError(problem, cure="move it away to use the log alone", file=path) from None
    if not isinstance(record, dict):
        cure = "move it away to use the log alone"
        raise ConfigError("not a run record", cure=cure, file=path)
    return record


def describe_end(csv: Path, torn: bool) -> str | None:
    """One line on a run that did not complete, or None."""
    record = read_record(csv) or {}
    cut = "; its last line is incomplete and is left out" if torn else ""
    status = record.get("status", COMPLETED)
    if status == RUNNING:
        return f"{csv}: the run was interrupted (killed, or still running){cut}"
    if status != COMPLETED:
        return f"{csv}: the run ended early: {status}: {record.get('reason')}{cut}"
    return f"{csv}: the log was interrupted{cut}" if torn else None


def software_versions() -> dict[str, Any]:
    """Versions of this program, Python and the libraries that shape a result."""
    names = ("hybrid-rig", "numpy", "scipy", "numba", "pandas")
    versions: dict[str, Any] = {"python": sys.version.split()[0]}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    versions["commit"] = _git_commit()
    return versions


def write_whole(path: Path, content: str | bytes) -> None:
    """Replace a file's content in one step. Raises RunError when the disk refuses."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        folder = path.parent
        reason = (
            error.strerror if folder.is_dir() else f"there is no folder {folder}, make it first"
        )
        raise RunError(f"cannot be written: {reason}", file=path) from None


def _git_commit() -> str | None:
    """Commit of the checkout this program runs from, marked when files differ from it."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        return subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True, text=True, timeout=5, check=True,
        ).stdout.strip()  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None


def make_folder(folder: Path, exist_ok: bool = True) -> None:
    """Make a folder and what leads to it; ConfigError with the cure when that is impossible.

    Raises FileExistsError where it must be new and is not.
    """
    try:
        folder.mkdir(parents=True, exist_ok=exist_ok)
    except FileExistsError:
        if not exist_ok:
            raise
        raise _no_folder(folder, "File exists") from None
    except OSError as error:
        raise _no_folder(folder, error.strerror) from None


def _no_folder(folder: Path, reason: str | None) -> ConfigError:
    cure = "choose a folder with --out"
    return ConfigError(f"cannot be created: {reason}", cure=cure, file=folder)


def _new_folder(root: Path, stem: str) -> Path:
    for attempt in range(1, 1000):
        folder = root / (stem if attempt == 1 else f"{stem}-{attempt}")
        try:
            make_folder(folder, exist_ok=False)
        except FileExistsError:
            if root.exists() and not root.is_dir():
                break
            continue
        return folder
    problem = "no capture folder can be made here"
    raise ConfigError(problem, cure="choose another with --out", file=root)


def _file_name(name: str) -> str:
    kept = "".join(c if c.isalnum() or c in "-_." else "-" for c in name).strip("-.")
    return kept or "run"
