"""Writing of a log while the run goes on."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from daq.errors import RunError
from daq.hal import FloatArray, Samples
from daq.logs.columns import ATTRIBUTES, COLUMNS


class LogWriter:
    """Appends samples to a log.csv; every ``append`` is with the operating system at once.

    extra: names of further columns. Use as a context manager. Raises RunError when the disk
    refuses, naming how many samples are safe.
    """

    def __init__(self, path: Path, extra: Sequence[str] = ()) -> None:
        self.path = path
        self.n_samples = 0
        try:
            # Unbuffered: what append has written survives the death of this process.
            self._file = path.open("xb", buffering=0)
        except OSError as error:
            raise self._refused(error) from None
        try:
            self._write(",".join((*COLUMNS, *extra)) + "\n")
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def append(self, samples: Samples, extra: Sequence[FloatArray] = ()) -> None:
        """Write a block of samples; extra: of each further column, (n,)."""
        columns = [getattr(samples, attribute).tolist() for attribute in ATTRIBUTES.values()]
        columns += [values.tolist() for values in extra]
        rows = [",".join(map(repr, row)) for row in zip(*columns, strict=True)]
        self._write("\n".join(rows) + "\n", counts=True)

    def require_there(self) -> None:
        """Raise RunError if the file is no longer where it was made."""
        try:
            there = os.path.samestat(self.path.stat(), os.fstat(self._file.fileno()))
        except OSError:
            there = False
        if not there:
            raise RunError(
                "it was deleted, moved or replaced while the run was on",
                cure="leave the folder of a run alone until it has ended",
                file=self.path,
            )

    def close(self) -> None:
        """Have the log on the disk itself, then let go of it."""
        if self._file.closed:
            return
        # The rows are written; a disk that cannot sync must not hide the run's end.
        with self._file, contextlib.suppress(OSError):
            os.fsync(self._file.fileno())

    def _write(self, text: str, counts: bool = False) -> None:
        data = text.encode("ascii")
        done = 0
        try:
            while done < len(data):
                done += self._file.write(data[done:]) or 0
        except OSError as error:
            self.n_samples += data[:done].count(b"\n") if counts else 0
            raise self._refused(error) from None
        self.n_samples += data.count(b"\n") if counts else 0

    def _refused(self, error: OSError) -> RunError:
        return RunError(
            f"cannot be written: {error.strerror}; the first {self.n_samples} samples are in it. "
            "Free space on the disk, or choose another with --out",
            file=self.path,
        )
