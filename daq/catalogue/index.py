"""All runs of a folder, remembered between two looks in a file that may be deleted any time."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path

from daq.catalogue.entries import RunEntry, captures, from_text, read_entry, to_text
from daq.errors import ConfigError
from daq.progress import Note, Progress, Watch, ignore

INDEX_NAME = ".runs.sqlite"  # in the folder of the runs
_TABLE = "CREATE TABLE IF NOT EXISTS runs (folder TEXT PRIMARY KEY, stamp TEXT, entry TEXT)"
_LAYOUT = 4  # of an entry; an index of another is made anew
_SHOWN = 50  # runs to read from which on it is worth showing progress
_WAIT = 2.0  # s for another program that writes the index

_Row = tuple[str, str, str]  # folder, stamp, entry as text


def catalogue(root: Path, watch: Watch = ignore) -> list[RunEntry]:
    """All runs below a folder, the oldest first. Raises ConfigError where there is no folder.

    Only what has changed since the last look is read. An index that cannot be read or written is
    done without.
    """
    if not root.is_dir():
        cure = "record a run, as rig run prbs.yaml, or name another folder with --in"
        raise ConfigError("there is no such folder of runs", cure=cure, file=root)
    try:
        present = dict(captures(root))
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=error.filename) from None
    with _opened(root / INDEX_NAME, watch) as index:
        entries, changed = {}, []
        for folder, stamp, text in _remembered(index):
            if present.get(folder) == stamp:
                with contextlib.suppress(KeyError, TypeError, ValueError):
                    entries[folder] = from_text(text)
        for folder, entry in _read(root, [f for f in present if f not in entries], watch):
            entries[folder] = entry
            changed.append((folder, present[folder], to_text(entry)))
        _remember(index, present, changed)
    return sorted(entries.values(), key=lambda entry: (entry.started, entry.folder))


def _read(root: Path, folders: list[str], watch: Watch) -> Iterator[tuple[str, RunEntry]]:
    for n_read, folder in enumerate(folders, 1):
        yield folder, read_entry(root, folder)
        if len(folders) >= _SHOWN:
            watch(Progress("Reading runs", n_read, len(folders), f"{n_read}/{len(folders)}"))


@contextlib.contextmanager
def _opened(path: Path, watch: Watch) -> Iterator[sqlite3.Connection | None]:
    """The index; None where there can be none."""
    index = None
    for attempt in ("as it is", "anew"):
        try:
            index = _connected(path)
            break
        except sqlite3.DatabaseError as error:
            if attempt == "anew" or isinstance(error, sqlite3.OperationalError):
                watch(Note("detail", f"{path}: no index of runs ({error}); all are read anew"))
                break
            with contextlib.suppress(OSError):  # it is damaged
                path.unlink()
    try:
        yield index
    finally:
        if index is not None:
            index.close()


def _connected(path: Path) -> sqlite3.Connection:
    index = sqlite3.connect(path, timeout=_WAIT)
    try:
        layout = f"{version('hybrid-rig')}/{_LAYOUT}"
        index.execute("CREATE TABLE IF NOT EXISTS layout (name TEXT)")
        if index.execute("SELECT name FROM layout").fetchall() != [(layout,)]:
            with index:
                index.execute("DELETE FROM layout")
                index.execute("INSERT INTO layout VALUES (?)", (layout,))
                index.execute("DROP TABLE IF EXISTS runs")
        index.execute(_TABLE)
    except BaseException:
        index.close()
        raise
    return index


def _remembered(index: sqlite3.Connection | None) -> list[_Row]:
    if index is None:
        return []
    try:
        return index.execute("SELECT folder, stamp, entry FROM runs").fetchall()
    except sqlite3.DatabaseError:
        return []


def _remember(
    index: sqlite3.Connection | None, present: Mapping[str, str], changed: list[_Row]
) -> None:
    if index is None:
        return
    # A disk that is full, or another program that writes, costs the next look its speed only.
    with contextlib.suppress(sqlite3.DatabaseError), index:
        index.executemany("INSERT OR REPLACE INTO runs VALUES (?, ?, ?)", changed)
        remembered = {folder for (folder,) in index.execute("SELECT folder FROM runs")}
        gone = [(folder,) for folder in remembered - set(present)]
        index.executemany("DELETE FROM runs WHERE folder = ?", gone)
