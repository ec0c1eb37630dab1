"""What a catalogue knows of a run, read from the files in its folder."""

from __future__ import annotations

import datetime
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from daq.config import json_file, yaml_file
from daq.config.metadata import FACTS
from daq.errors import RigError
from daq.identification.request import PARAMETERS
from daq.identification.rows import ParameterRow, QuantityRow, Rows
from daq.logs.capture import LOG_NAME, RUN_NAME, settings_of
from daq.logs.metadata import METADATA_NAME, read_metadata

JOINT, ALONE = "joint", "identified"  # status of results by themselves: of several logs, of one
_IDENTIFICATION = "identification"  # the folder of a run's own identification
_FILES = (RUN_NAME, METADATA_NAME, f"{_IDENTIFICATION}/{PARAMETERS}")


@dataclass(frozen=True)
class RunEntry:
    """A run: where it is, what it was, what is noted of it, what was identified from it.

    folder: below the catalogue's, with ``/`` between names. started: ISO 8601 in UTC. trust: the
    verdict's word, then of predictions and of parameters. logs: names of those that a result by
    itself was identified from; empty of a run. rows: the fields of ``quantities`` as JSON, read
    when they are asked for: ten thousand runs have a quarter of a million of them. problems: what
    of its files could not be read, and why.
    """

    folder: str
    started: str = ""
    status: str = ""
    reason: str = ""
    protocol: str = ""
    rig: str = ""
    device: str = ""
    model: str = ""
    trust: str = ""
    predictions: str = ""
    parameters: str = ""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    logs: tuple[str, ...] = ()
    rows: str = "[]"
    problems: tuple[str, ...] = ()

    @cached_property
    def values(self) -> dict[str, float]:
        """Identified parameters and combinations by name."""
        return {name: value for name, value, *_ in from_json(self.rows)}

    @property
    def is_run(self) -> bool:
        """Whether it was recorded, and is no result by itself."""
        return self.status not in (JOINT, ALONE)

    @property
    def described(self) -> dict[str, Any]:
        """What is known of it without its identification's numbers, by key."""
        return {**self.metadata, **{key: getattr(self, key) for key in FACTS}}

    @property
    def facts(self) -> dict[str, Any]:
        """Everything that can be asked for, by key: its own, metadata, values of quantities."""
        return {**self.values, **self.described}

    def fact(self, key: str) -> Any:
        """One of the facts; None where it is not known."""
        if key in FACTS:
            return getattr(self, key)
        return self.metadata[key] if key in self.metadata else self.values.get(key)

    @cached_property
    def quantities(self) -> tuple[QuantityRow, ...]:
        """Identified parameters and combinations."""
        return tuple(map(_quantity, from_json(self.rows)))

    @property
    def document(self) -> dict[str, Any]:
        """The same for machines."""
        document = asdict(self)
        rows = from_json(document.pop("rows"))
        return {**document, "quantities": [dict(zip(_FIELDS, row, strict=True)) for row in rows]}

    def quantity(self, name: str) -> QuantityRow | None:
        """An identified parameter or combination; None where it has none of that name."""
        return next((_quantity(row) for row in from_json(self.rows) if row[0] == name), None)


def captures(root: Path) -> Iterator[tuple[str, str]]:
    """Folders of captures and of results below a folder, and what tells that they have changed.

    Each by its name below the folder, in order. What is in a capture is not looked through.
    """
    # Of strings: ten thousand runs take three times as long by Path objects.
    yield from _captures(str(root), "")


def _captures(root: str, below: str) -> Iterator[tuple[str, str]]:
    with os.scandir(f"{root}/{below}") as entries:
        names = sorted(e.name for e in entries if not e.name.startswith(".") and e.is_dir())
    for name in names:
        folder = f"{below}/{name}" if below else name
        stamp = _stamp(f"{root}/{folder}")
        if stamp:
            yield folder, stamp
        else:
            if result := _time_and_size(f"{root}/{folder}/{PARAMETERS}"):
                yield folder, f"{result}|{_time_and_size(f'{root}/{folder}/{METADATA_NAME}')}"
            yield from _captures(root, folder)


def _stamp(folder: str) -> str:
    """Times and sizes of a capture's files; empty of a folder that is none."""
    stamps = [_time_and_size(f"{folder}/{name}") for name in _FILES]
    if not stamps[0] and not _time_and_size(f"{folder}/{LOG_NAME}"):
        return ""
    return "|".join((*stamps, "."))


def _time_and_size(path: str) -> str:
    try:
        facts = os.stat(path)  # noqa: PTH116
    except OSError:
        return ""
    return f"{facts.st_mtime_ns}:{facts.st_size}"


def read_entry(root: Path, folder: str) -> RunEntry:
    """A run or a result from its files; what cannot be read is told in ``problems``."""
    path, problems = root / folder, []
    facts: dict[str, Any] = {}
    is_run = any((path / name).exists() for name in (RUN_NAME, LOG_NAME))
    for read in (_run, _noted, _identified) if is_run else (_result, _noted):
        try:
            facts |= read(path)
        except RigError as error:
            problems.append(str(error))
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            problems.append(f"{path}: not as it was written ({type(error).__name__}: {error})")
    return RunEntry(folder, **facts, problems=tuple(problems))


def _run(folder: Path) -> dict[str, Any]:
    if not (folder / RUN_NAME).exists():
        return {"status": "unknown"}  # a log without its record
    record = json_file.load(folder / RUN_NAME, "run record", "move it away to go without")
    experiment, rig = settings_of(record)
    facts = {
        "started": record.get("started"),
        "status": record.get("status"),
        "reason": record.get("reason"),
        "protocol": experiment.get("protocol"),
        "rig": rig.get("name"),
        "device": record.get("device"),
    }
    if facts["started"] is not None:
        datetime.datetime.fromisoformat(facts["started"])
    return {key: str(value) for key, value in facts.items() if value is not None}


def _noted(folder: Path) -> dict[str, Any]:
    return {"metadata": read_metadata(folder).content}


def _identified(folder: Path) -> dict[str, Any]:
    path = folder / _IDENTIFICATION / PARAMETERS
    return _facts(yaml_file.load(path).content) if path.exists() else {}


def _result(folder: Path) -> dict[str, Any]:
    """Of a result that lies by itself, as that of several runs does."""
    path = folder / PARAMETERS
    document = yaml_file.load(path).content
    logs = tuple(str(log["name"]) for log in document["metrics"]["training"])
    written = datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC)
    status = JOINT if len(logs) > 1 else ALONE
    return {
        "started": written.isoformat(timespec="seconds"),
        "status": status,
        "logs": logs,
        **_facts(document),
    }


def _facts(document: Mapping[str, Any]) -> dict[str, Any]:
    verdict, rows = document["verdict"], Rows.of(document)
    statements = {
        name: verdict[name]["trust"] for name in ("predictions", "parameters") if name in verdict
    }
    searched = [row for row in rows.parameters if isinstance(row, ParameterRow) and row.free]
    return {
        "model": str(document["model"]),
        "trust": str(verdict["trust"]),
        **statements,
        "rows": json.dumps([_plain(row) for row in (*searched, *rows.combinations, *rows.starts)]),
    }


def _plain(row: QuantityRow) -> tuple[Any, ...]:
    """The fields of a row, without those that only a table of parameters shows.

    Raises TypeError or ValueError for what is no number in a file that somebody has edited.
    """
    for number in (row.value, row.std, *(row.interval or ()), *(row.here or ())):
        math.isfinite(0.0 if number is None else number)
    return tuple(getattr(row, name) for name in _FIELDS)


_FIELDS = [f.name for f in fields(QuantityRow)]


def _quantity(row: Sequence[Any]) -> QuantityRow:
    values: list[Any] = [tuple(value) if isinstance(value, list) else value for value in row]
    return QuantityRow(*values)


def to_text(entry: RunEntry) -> str:
    """An entry as one line of JSON."""
    stored = {f.name: getattr(entry, f.name) for f in fields(entry)}
    return json.dumps(stored, separators=(",", ":"))


def from_text(text: str) -> RunEntry:
    """An entry from its line. Raises ValueError, TypeError or KeyError for what is none."""
    document = from_json(text)
    return RunEntry(**{**document, **{k: tuple(document[k]) for k in ("logs", "problems")}})
