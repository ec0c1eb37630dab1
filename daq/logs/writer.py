"""Writing of a log while the run goes on, whatever becomes of its file meanwhile."""

from __future__ import annotations

import contextlib
import itertools
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from daq.errors import RunError
from daq.hal import FloatArray, Samples
from daq.logs.columns import ATTRIBUTES, COLUMNS
from daq.logs.part import Part

_LOOK_EVERY = 0.25  # s between two looks at whether the file is still in its place
_RECENT = 1 << 20  # bytes of the last rows that are held in memory: 1 to 10 s of them
_MOST_PARTS = 50


class LogWriter:
    """Appends samples to a log.csv; every ``append`` is with the operating system at once.

    Where somebody truncates, deletes or replaces the file, the run goes on in a part beside it,
    ``log-2.csv``, that begins with the last rows; ``close`` makes one log of all parts again, less
    the rows that nobody has any more. disturbance: what happened and which rows were lost, None
    for a log that was left alone.

    extra: names of further columns. warn: hears of a disturbance at once. Use as a context manager.
    Raises RunError when the disk refuses, naming how many samples are safe.
    """

    def __init__(
        self, path: Path, extra: Sequence[str] = (), warn: Callable[[str], None] = lambda text: None
    ) -> None:
        self.path = path
        self.disturbance: str | None = None
        self._warn = warn
        self._header = (",".join((*COLUMNS, *extra)) + "\n").encode("ascii")
        self._parts: list[Part] = []
        self._recent: deque[tuple[int, bytes]] = deque()  # number of the first row, rows
        self._n_recent = 0  # bytes
        self._next_look = 0.0
        try:
            self._parts.append(Part(path, self._header))
        except OSError as error:
            raise self._refused(error) from None

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def n_samples(self) -> int:
        """Samples that were logged."""
        return self._parts[-1].first + self._parts[-1].n_rows if self._parts else 0

    def append(self, samples: Samples, extra: Sequence[FloatArray] = ()) -> None:
        """Write a block of samples; extra: of each further column, (n,)."""
        columns = [getattr(samples, attribute).tolist() for attribute in ATTRIBUTES.values()]
        columns += [values.tolist() for values in extra]
        rows = [",".join(map(repr, row)) for row in zip(*columns, strict=True)]
        data = ("\n".join(rows) + "\n").encode("ascii")
        self._look()
        self._hold(data)
        try:
            self._parts[-1].write(data)
        except OSError as error:
            raise self._refused(error) from None

    def close(self) -> None:
        """Have the log on the disk itself, whole, then let go of it; never raises."""
        if not self._parts:
            return
        self._parts[-1].sync()
        try:
            problem = self._parts[-1].disturbed()
            if problem is None and self._parts[-1].changed():
                problem = "written into"
            if problem is not None:
                self._go_on(problem)
            if len(self._parts) > 1:
                self._merge()
        except (OSError, RunError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            names = ", ".join(part.path.name for part in self._parts)
            self.disturbance = f"{self.disturbance}; no log can be made of {names}: {reason}"
        for part in self._parts:
            part.close()

    def require_whole(self) -> None:
        """Raise RunError if somebody disturbed the log; once it is closed."""
        if self.disturbance is not None:
            cure = "leave the folder of a run alone until it has ended"
            raise RunError(self.disturbance, cure=cure, file=self.path)

    def _hold(self, data: bytes) -> None:
        """Keep the last rows in memory."""
        self._recent.append((self.n_samples, data))
        self._n_recent += len(data)
        while self._n_recent > _RECENT and len(self._recent) > 1:
            self._n_recent -= len(self._recent.popleft()[1])

    def _look(self) -> None:
        """Go on elsewhere if somebody has disturbed the file."""
        part, now = self._parts[-1], time.perf_counter()
        if now < self._next_look:
            problem = part.resized()
        else:
            self._next_look = now + _LOOK_EVERY
            problem = part.disturbed()
        if problem is not None:
            try:
                self._go_on(problem)
            except OSError as error:
                raise self._refused(error) from None

    def _go_on(self, problem: str) -> None:
        """Begin a part beside the file that was disturbed, with the last rows."""
        was = f"{self._parts[-1].path.name} was {problem} while the run was on"
        self.disturbance = f"it was {problem} while the run was on"
        if len(self._parts) >= _MOST_PARTS:
            raise RunError(f"{was}, for the {_MOST_PARTS}th time", file=self.path)
        first = self._recent[0][0] if self._recent else self.n_samples
        self.path.parent.mkdir(parents=True, exist_ok=True)
        names = (f"{self.path.stem}-{n}{self.path.suffix}" for n in itertools.count(2))
        path = next(p for p in map(self.path.with_name, names) if not p.exists())
        try:
            part = Part(path, self._header, first)
            part.write(b"".join(rows for _, rows in self._recent))
        except BaseException:  # a signal's; the next look begins another part
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            raise
        self._parts.append(part)
        self._warn(f"{was}, at sample {self.n_samples}; the run goes on in {path}")

    def _merge(self) -> None:
        """Make one log of what there is in the parts, and say what is in none of them."""
        ends = [*(part.first for part in self._parts[1:]), self.n_samples]
        temporary = self.path.with_name(self.path.name + ".tmp")
        lost = []
        with temporary.open("wb") as out:
            out.write(self._header)
            for part, end in zip(self._parts, ends, strict=True):
                row = part.first
                for text in itertools.islice(part.rows(), end - row):
                    out.write(text)
                    row += 1
                if row < end:
                    lost.append(f"{row} to {end - 1}")
            out.flush()
            os.fsync(out.fileno())
        strange = self.path.exists() and not self._parts[0].in_place()
        for part in self._parts:
            part.close()  # Windows replaces no file that is open
        if strange:
            aside = self.path.with_name(f"{self.path.name}.stranger")
            self.path.replace(aside)
            self.disturbance = f"{self.disturbance}; what stood in its place is now {aside.name}"
        temporary.replace(self.path)
        for part in self._parts[1:]:
            part.path.unlink(missing_ok=True)
        loss = f"rows {' and '.join(lost)} (from 0) are lost" if lost else "nothing of it is lost"
        self.disturbance = f"{self.disturbance}; {loss}, and it was put together again"

    def _refused(self, error: OSError) -> RunError:
        return RunError(
            f"cannot be written: {error.strerror}; the first {self.n_samples} samples are in it. "
            "Free space on the disk, or choose another with --out",
            file=self.path,
        )
