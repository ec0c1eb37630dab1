"""A file of rows that is appended to, and that others may truncate, delete or write into."""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_MARK_EVERY = (
    1 << 16
)  # bytes after which the content is fingerprinted; what is lost at most besides


class _Mark(NamedTuple):
    """The SHA-256 of the first ``size`` bytes, which hold so many rows."""

    size: int
    n_rows: int
    digest: bytes


class _Written(NamedTuple):
    """What was appended so far: bytes, rows without the header, the bytes' hash."""

    size: int
    n_rows: int
    content: hashlib._Hash

    def and_then(self, rows: bytes) -> _Written:
        """With further rows."""
        content = self.content.copy()
        content.update(rows)
        return _Written(self.size + len(rows), self.n_rows + rows.count(b"\n"), content)


class Part:
    """A new file that begins with a header; every ``write`` is with the operating system at once.

    first: number of its first row in the run. Raises OSError. The open file
    outlives its name: what was written can be read back where the file was deleted.
    """

    def __init__(self, path: Path, header: bytes, first: int = 0) -> None:
        self.path = path
        self.first = first
        self._written = _Written(0, -1, hashlib.sha256())  # the header is no row
        self._marks: list[_Mark] = []
        # Appending, so that no hole of zeros comes about where the file has been truncated.
        kind = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_BINARY", 0)
        # Unbuffered: what has been written survives the death of this process.
        self._file = io.FileIO(os.open(path, kind, 0o666), "r+")
        try:
            self.write(header)
        except BaseException:
            self.close()
            raise

    @property
    def n_rows(self) -> int:
        """Rows written."""
        return self._written.n_rows

    def write(self, rows: bytes) -> None:
        """Append whole rows; of those that the disk refuses, what was written counts."""
        try:
            done = 0
            while done < len(rows):
                done += self._file.write(rows[done:]) or 0
            self._written = self._written.and_then(rows)
        except BaseException:
            # A signal may raise between the system's writing and our counting: the file knows.
            more = os.fstat(self._file.fileno()).st_size - self._written.size
            self._written = self._written.and_then(rows[: max(more, 0)])
            raise
        if self._written.size - (self._marks[-1].size if self._marks else 0) >= _MARK_EVERY:
            self._mark()

    def resized(self) -> str | None:
        """Whether somebody truncated the file or wrote into it, in a word; takes a microsecond."""
        size = os.fstat(self._file.fileno()).st_size
        if size == self._written.size:
            return None
        return "truncated" if size < self._written.size else "written into"

    def disturbed(self) -> str | None:
        """What became of the file by somebody else's doing, in a word."""
        return self.resized() if self.in_place() else "deleted, moved or replaced"

    def in_place(self) -> bool:
        """Whether the file of that name is still this one."""
        try:
            return os.path.samestat(self.path.stat(), os.fstat(self._file.fileno()))
        except OSError:
            return False

    def changed(self) -> bool:
        """Whether anything in it is not as it was written; reads all of it."""
        return self._intact() < self.n_rows

    def rows(self) -> Iterator[bytes]:
        """The rows that are still as they were written, to the first that may not be."""
        n_rows = self._intact()
        self._file.seek(0)
        reader = io.BufferedReader(self._file)
        try:
            yield from itertools.islice(reader, 1, n_rows + 1)
        finally:
            reader.detach()

    def sync(self) -> None:
        """Have it on the disk itself, where the disk can."""
        with contextlib.suppress(OSError):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Let go of it."""
        self._file.close()

    def _mark(self) -> None:
        size, n_rows, content = self._written
        self._marks.append(_Mark(size, n_rows, content.digest()))

    def _intact(self) -> int:
        """How many rows are certainly as they were written."""
        if not self._marks or self._marks[-1].size < self._written.size:
            self._mark()
        self._file.seek(0)
        content, position, intact = hashlib.sha256(), 0, 0
        for mark in self._marks:
            content.update(self._file.read(mark.size - position) or b"")
            position = mark.size
            if content.digest() != mark.digest:
                break
            intact = mark.n_rows
        return max(intact, 0)
