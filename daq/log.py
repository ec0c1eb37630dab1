"""Logs of samples: written as the run goes, read back however the run ended."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from daq.config.yaml_file import suggestion
from daq.errors import ConfigError, RunError
from daq.hal import FloatArray, IntArray, Samples

if TYPE_CHECKING:
    import pandas as pd

# The first eight are what the lab's existing scripts read; the original program wrote no more.
ORIGINAL_COLUMNS = (
    "t",
    "cmd_voltage_motor",
    "cmd_voltage_brake",
    "current_motor",
    "current_brake",
    "torque",
    "theta",
    "omega",
)
COLUMNS = (*ORIGINAL_COLUMNS, "tick", "applied_voltage_motor", "applied_voltage_brake", "flags")
UNITS = {
    "t": "s",
    "cmd_voltage_motor": "V",
    "cmd_voltage_brake": "V",
    "current_motor": "A",
    "current_brake": "A",
    "torque": "N*m",
    "theta": "rad",
    "omega": "rad/s",
    "applied_voltage_motor": "V",
    "applied_voltage_brake": "V",
}


class LogWriter:
    """Appends samples to a log.csv; every ``append`` is with the operating system at once.

    Use as a context manager. Raises RunError when the disk refuses, naming how many samples
    are safe.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.n_samples = 0
        # Unbuffered: what append has written survives the death of this process.
        self._file = path.open("xb", buffering=0)
        self._write(",".join(COLUMNS) + "\n")

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def append(self, samples: Samples) -> None:
        """Write a block of samples."""
        names = {"t": "time"}
        columns = [getattr(samples, names.get(name, name)).tolist() for name in COLUMNS]
        rows = [",".join(map(repr, row)) for row in zip(*columns, strict=True)]
        self._write("\n".join(rows) + "\n")
        self.n_samples += len(samples)

    def close(self) -> None:
        """Have the log on the disk itself, then let go of it."""
        if self._file.closed:
            return
        try:
            os.fsync(self._file.fileno())
        except OSError:
            pass  # the rows are written; a disk that cannot sync must not hide the run's end
        finally:
            self._file.close()

    def _write(self, text: str) -> None:
        data = memoryview(text.encode("ascii"))
        try:
            while data:
                data = data[self._file.write(data) or 0 :]
        except OSError as error:
            raise RunError(
                f"{self.path}: cannot be written: {error.strerror}; the first {self.n_samples} "
                "samples are in it. Free space on the disk, or choose another with --out"
            ) from None


@dataclass(frozen=True)
class Table:
    """Columns of a CSV as numbers; ``torn`` when its last line was cut and left out."""

    path: Path
    frame: pd.DataFrame
    torn: bool


@dataclass(frozen=True)
class Log:
    """A log in SI units.

    frame: one row per sample with at least the original program's columns and ``tick``,
    ``applied_voltage_motor``, ``applied_voltage_brake``, ``flags``. dt: sample time [s].
    torn: the last line was cut.
    """

    path: Path
    frame: pd.DataFrame
    dt: float
    torn: bool


def read_table(path: Path, columns: Sequence[str] = ()) -> Table:
    """Read a CSV of numbers with a header line.

    Separators may be followed by blanks. A cut last line is left out. Raises ConfigError that
    names file, line and column for anything else that is not a table of finite numbers with
    the given columns.
    """
    import pandas as pd

    text, torn = _complete_lines(path)
    header = [name.strip() for name in text.split("\n", 1)[0].split(",")]
    _check_header(path, header, columns)
    try:
        frame = pd.read_csv(
            io.StringIO(text), skipinitialspace=True, header=0, names=header, index_col=False,
            dtype=str, keep_default_na=False, skip_blank_lines=False, on_bad_lines="error",
        )  # fmt: skip
    except pd.errors.ParserError as error:
        reason = str(error).removeprefix("Error tokenizing data. C error: ").strip()
        raise ConfigError(f"{path}: not a table: {reason}") from None
    wanted = list(columns) or header
    numbers = {name: _numbers(path, name, frame[name]) for name in wanted}
    return Table(path, pd.DataFrame(numbers), torn)


def load_log(path: Path) -> Log:
    """Read a log of this or of the original program.

    Raises ConfigError naming the file, line and column of what is wrong with it.
    """
    first = _complete_lines(path)[0].split("\n", 1)[0]
    present = [name.strip() for name in first.split(",")]
    columns = [name for name in COLUMNS if name in present or name in ORIGINAL_COLUMNS]
    table = read_table(path, columns)
    frame = table.frame
    require_rows(path, len(frame))
    time = frame["t"].to_numpy()
    tick = frame["tick"].to_numpy().astype(np.int64) if "tick" in frame else None
    dt = sample_time(path, time, tick)
    if tick is None:
        frame["tick"] = ticks_of(path, time, dt)
    for channel in ("motor", "brake"):
        # The original program logged only what it asked for.
        if f"applied_voltage_{channel}" not in frame:
            frame[f"applied_voltage_{channel}"] = frame[f"cmd_voltage_{channel}"]
    if "flags" not in frame:
        frame["flags"] = 0
    frame = frame.astype({"tick": np.int64, "flags": np.int64})
    return Log(path, frame, dt, table.torn)


def sample_time(path: Path, time: FloatArray, tick: IntArray | None = None) -> float:
    """Sample time [s] of a log, from its time column and sequence numbers.

    Raises ConfigError, naming the line, when time does not advance.
    """
    steps = np.diff(time) if tick is None else np.diff(time) / np.maximum(np.diff(tick), 1)
    back = np.flatnonzero(~(np.diff(time) > 0.0))
    if len(back):
        line = int(back[0]) + 3
        raise ConfigError(f"{path}:{line}: t: time does not advance from the line before")
    return float(np.median(steps))


def ticks_of(path: Path, time: FloatArray, dt: float) -> IntArray:
    """Sequence numbers of samples from their times; a gap in time stays a gap in number.

    Raises ConfigError, naming the line, when the times fit no common rate.
    """
    exact = (time - time[0]) / dt
    # A rate off by its printed digits drifts slowly; jumps between neighbours are what counts.
    wrong = np.flatnonzero(np.abs(np.diff(exact) - np.round(np.diff(exact))) > 0.3)
    if len(wrong):
        line = int(wrong[0]) + 3
        raise ConfigError(
            f"{path}:{line}: t: samples are {dt:g} s apart elsewhere but "
            f"{time[wrong[0] + 1] - time[wrong[0]]:g} s here; resample the log to a constant rate"
        )
    steps = np.round(np.diff(exact)).astype(np.int64)
    tick: IntArray = np.zeros(len(time), dtype=np.int64)
    tick[1:] = np.cumsum(np.maximum(steps, 1))
    return tick


def require_rows(path: Path, n: int) -> None:
    """Raise ConfigError unless there are samples to work with."""
    if n < 2:
        raise ConfigError(
            f"{path}: it holds {n} sample{'s' * (n != 1)}; at least 2 are needed. "
            "Was the run stopped before it began?"
        )


def _complete_lines(path: Path) -> tuple[str, bool]:
    """The file's text up to its last complete line, and whether something was cut off."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such log") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: this is a folder without a log.csv in it") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ConfigError(f"{path}:{line}: not a text file (byte {error.start})") from None
    text = text.replace("\r\n", "\n")
    if not text.strip():
        raise ConfigError(f"{path}: the log is empty; it must start with a line of column names")
    cut = text.rfind("\n") + 1
    tail = text[cut:]
    # A last line without its newline may lack digits even where it has every column.
    complete = text[:cut] if cut else text
    return complete.rstrip("\n") + "\n", bool(tail.strip())


def _check_header(path: Path, header: list[str], columns: Sequence[str]) -> None:
    if all(_is_number(name) for name in header):
        raise ConfigError(f"{path}:1: the first line holds numbers; it must hold the column names")
    twice = sorted({name for name in header if header.count(name) > 1})
    if twice:
        raise ConfigError(f"{path}:1: column {twice[0]!r} stands twice")
    for name in columns:
        if name not in header:
            raise ConfigError(
                f"{path}:1: column {name!r} is missing; {suggestion(name, header)} "
                f"(the file has {', '.join(header)}). Columns of other programs are named in "
                "the 'columns' section of a file given with --config"
            )


def _numbers(path: Path, name: str, column: pd.Series) -> FloatArray:
    import pandas as pd

    values = pd.to_numeric(column.str.strip(), errors="coerce").to_numpy(dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        row = int(bad[0])
        more = f", and in {len(bad) - 1} more lines" if len(bad) > 1 else ""
        raise ConfigError(
            f"{path}:{row + 2}: {name}: {column.iloc[row]!r} is not a finite number{more}; "
            "mend or remove these lines (removed lines count as lost samples)"
        )
    return values


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
