"""Capture folders: one run, one folder, with everything needed to understand it later."""

from __future__ import annotations

import datetime
import hashlib
import json
import platform
import re
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.config import json_file
from daq.config.metadata import Metadata
from daq.errors import ConfigError, RunError
from daq.files import make_folder, stamp, write_whole
from daq.logs.metadata import write_metadata
from daq.process import RunProcess
from daq.provenance import software_versions

LOG_NAME = "log.csv"
VALIDATION = "-validation"  # how the name of a run to validate by ends
RUN_NAME = "run.json"

_RESERVE = ".reserve"  # room for the last run.json on a disk that the log has filled
_RESERVED = 64 * 1024  # bytes

_A_LOG = re.compile(r"log(-\d+)?\.csv")

RUNNING = "running"
COMPLETED = "completed"
INTERLOCK = "interlock"  # ended by a limit


@dataclass
class Capture:
    """A folder being written by a run; ``record`` is what run.json holds."""

    folder: Path
    record: dict[str, Any]

    @classmethod
    def create(
        cls, root: Path, name: str, record: dict[str, Any], metadata: Metadata | None = None
    ) -> Capture:
        """Make ``<root>/<UTC time>-<name>/`` and note in it that the run has begun.

        metadata: what a person says of it.
        """
        now, process = datetime.datetime.now(datetime.UTC), RunProcess.this()
        facts = {
            "status": RUNNING,
            "reason": None,
            "started": now.isoformat(timespec="milliseconds"),
            **record,
            "software": software_versions(),
            "host": {"system": platform.platform(), "node": platform.node()},
            "process": None if process is None else process.document,
        }
        kept = "".join(c if c.isalnum() or c in "-_." else "-" for c in name).strip("-.")
        folder = _new_folder(root, f"{stamp(now)}-{kept or 'run'}")
        capture = cls(folder, facts)
        try:
            capture.save()
            write_metadata(folder, metadata or Metadata())
            capture._reserve()
        except BaseException:
            capture.discard()
            raise
        return capture

    @property
    def log_path(self) -> Path:
        """Where the samples go."""
        return self.folder / LOG_NAME

    def save(self) -> None:
        """Write the record as it stands. Raises RunError when the disk refuses."""
        write_whole(self.folder / RUN_NAME, json.dumps(self.record, indent=2) + "\n")

    def _reserve(self) -> None:
        """Take the room on the disk that ``finish`` will need. Raises RunError without any."""
        path = self.folder / _RESERVE
        try:
            path.write_bytes(bytes(_RESERVED))
        except OSError as error:
            cure = "free space on the disk, or choose another with --out"
            raise RunError(f"cannot be written: {error.strerror}", cure=cure, file=path) from None

    def discard(self) -> None:
        """Remove the folder, in which nothing has been recorded."""
        shutil.rmtree(self.folder, ignore_errors=True)

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


def read_record(csv: Path) -> dict[str, Any] | None:
    """run.json beside a log.csv; None when there is none. ConfigError when it is malformed."""
    path = csv.parent / RUN_NAME
    if not is_log(csv) or not path.exists():
        return None
    return json_file.load(path, "run record", "move it away to use the log alone")


def settings_of(record: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Experiment and rig of a run.json; empty where a record of another program lacks them."""
    sections = [record.get(key) for key in ("experiment", "rig")]
    experiment, rig = (section if isinstance(section, dict) else {} for section in sections)
    return experiment, rig


def is_log(csv: Path) -> bool:
    """Whether a file is a capture's log, or a part in which a disturbed one went on."""
    return _A_LOG.fullmatch(csv.name) is not None


def further_parts(csv: Path) -> list[str]:
    """Names of the parts that a run has left beside its log, which are in order not there."""
    beside = sorted(csv.parent.glob("log-*.csv")) if csv.name == LOG_NAME else []
    return [path.name for path in beside if is_log(path)]


def _new_folder(root: Path, stem: str) -> Path:
    if root.is_file():
        raise ConfigError("this is a file", cure="choose a folder with --out", file=root)
    for attempt in range(1, 1000):
        folder = root / (stem if attempt == 1 else f"{stem}-{attempt}")
        with suppress(FileExistsError):
            make_folder(folder, exist_ok=False)
            return folder
    problem = "no capture folder can be made here"
    raise ConfigError(problem, cure="choose another with --out", file=root)
