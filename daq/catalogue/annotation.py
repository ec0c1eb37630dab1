"""Notes and tags put on runs that are there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from daq.catalogue.entries import RunEntry
from daq.config.metadata import changes_of
from daq.errors import ConfigError, suggestion
from daq.logs.metadata import amended, read_metadata, write_metadata


def annotate(
    root: Path,
    entries: Sequence[RunEntry],
    notes: Sequence[str],
    tags: Sequence[str] = (),
    untags: Sequence[str] = (),
) -> list[RunEntry]:
    """Change what is noted of runs, each in the ``metadata.yaml`` of its folder; the runs as noted.

    notes: ``KEY=VALUE``, an empty value to forget the key, or text. untags: tags of some of them.
    Raises ConfigError before anything is written, or RunError where the disk refuses.
    """
    present = [tag for entry in entries for tag in entry.metadata.get("tags", ())]
    for tag in untags:
        if tag not in present:
            cure = suggestion(tag, list(dict.fromkeys(present)))
            raise ConfigError(f"there is no tag {tag!r}", cure=cure, key="--untag")
    changed = []
    for entry in entries:
        metadata = amended(read_metadata(root / entry.folder), changes_of(notes))
        kept = [tag for tag in metadata.tags if tag not in untags]
        changed.append(amended(metadata, {"tags": [*kept, *tags]}, "--tag"))
    for entry, metadata in zip(entries, changed, strict=True):
        write_metadata(root / entry.folder, metadata)
    return [
        replace(entry, metadata=metadata.content)
        for entry, metadata in zip(entries, changed, strict=True)
    ]
