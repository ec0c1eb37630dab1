"""Logs of samples: written as the run goes, read back however the run ended."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from daq.errors import ConfigError, RunError
from daq.hal import FloatArray, IntArray, Samples
from daq.logs.table import column_names, read_table

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


# Columns that ``Samples`` has under another name.
FIELDS = {"t": "time"}
_UNEVEN = 0.3  # of a sample that a row may stand off its place
BoolArray = npt.NDArray[np.bool_]


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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def append(self, samples: Samples, extra: Sequence[FloatArray] = ()) -> None:
        """Write a block of samples; extra: of each further column, (n,)."""
        columns = [getattr(samples, FIELDS.get(name, name)).tolist() for name in COLUMNS]
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
        try:
            os.fsync(self._file.fileno())
        except OSError:
            pass  # the rows are written; a disk that cannot sync must not hide the run's end
        finally:
            self._file.close()

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


@dataclass(frozen=True)
class Log:
    """A log in SI units.

    frame: one row per sample with at least the original program's columns and ``tick``,
    ``applied_voltage_motor``, ``applied_voltage_brake``, ``flags``. dt: sample time [s].
    torn: the last line was cut, or broken by a measurement that is no number, and left out.
    """

    path: Path
    frame: pd.DataFrame
    dt: float
    torn: bool

    def samples(self) -> Samples:
        """Its rows as the run had them."""
        return Samples(**{FIELDS.get(name, name): self.frame[name].to_numpy() for name in COLUMNS})


def load_log(path: Path, extra: Sequence[str] = ()) -> Log:
    """Read a log of this or of the original program.

    extra: names of further columns wanted, where it has them. Raises ConfigError naming the file,
    line and column of what is wrong with it.
    """
    present = column_names(path)
    columns = [name for name in COLUMNS if name in present or name in ORIGINAL_COLUMNS]
    columns += [name for name in extra if name in present]
    table = read_table(path, columns)
    frame = table.frame
    require_rows(path, len(frame))
    time = frame["t"].to_numpy()
    tick = frame["tick"].to_numpy() if "tick" in frame else None
    frame["tick"], dt = time_base(path, time, tick, first_line=table.first_line)
    for channel in ("motor", "brake"):
        # The original program logged only what it asked for.
        if f"applied_voltage_{channel}" not in frame:
            frame[f"applied_voltage_{channel}"] = frame[f"cmd_voltage_{channel}"]
    if "flags" not in frame:
        frame["flags"] = 0
    uneven = (frame["flags"] % 1.0 != 0.0).to_numpy()
    _refuse(path, uneven, "flags", "it must be a whole number", table.first_line)
    frame = frame.astype({"tick": np.int64, "flags": np.int64})
    return Log(path, frame, dt, table.torn)


def time_base(
    path: Path,
    time: FloatArray,
    tick: FloatArray | None = None,
    *,
    first_line: int = 2,
    column: str = "t",
    cure: str = "resample the log to a constant rate",
) -> tuple[IntArray, float]:
    """Sequence numbers and sample time [s] of a log's rows; gaps in time are gaps in number.

    tick: the log's own sequence numbers, where it has them. first_line: line of the first row.
    column: the name of time in it. cure: for rows at no constant rate.

    Raises ConfigError, naming the line, for time that does not advance, or rows that fit no
    constant rate.
    """
    steps, second = np.diff(time), first_line + 1
    _refuse(path, ~(steps > 0.0), column, "time does not advance from the line before", second)
    if tick is not None:
        _refuse(path, tick != np.round(tick), "tick", "it must be a whole number", first_line)
        stuck = ~(np.diff(tick) > 0.0)
        _refuse(path, stuck, "tick", "it does not advance from the line before", second)
        counted = np.diff(tick)
        dt = float(np.median(steps / counted))
    else:
        dt = float(np.median(steps))
        counted = np.round(steps / dt)
    # A rate off by its printed digits drifts slowly; jumps between neighbours are what counts.
    wrong = np.abs(steps / dt - counted) > _UNEVEN
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ConfigError(
            f"samples are {dt:g} s apart elsewhere but {steps[row]:g} s for {counted[row]:g} of "
            "them here",
            cure=cure,
            file=path,
            line=row + second,
            key=column,
        )
    ticks: IntArray = np.zeros(len(time), dtype=np.int64)
    ticks[1:] = np.cumsum(counted)
    # Times printed with few digits are each a little off; their ends together are not.
    dt = float((time[-1] - time[0]) / ticks[-1])
    return ticks + (0 if tick is None else int(tick[0])), dt


def _refuse(path: Path, wrong: BoolArray, column: str, problem: str, first: int) -> None:
    """Raise ConfigError at the first wrong row; ``first`` is the line of entry 0."""
    if wrong.any():
        line = int(np.argmax(wrong)) + first
        raise ConfigError(problem, file=path, line=line, key=column)


def require_rows(path: Path, n: int) -> None:
    """Raise ConfigError unless there are samples to work with."""
    if n < 2:
        raise ConfigError(
            f"it holds {n} sample{'s' * (n != 1)}; at least 2 are needed. Was the run stopped "
            "before it began?",
            file=path,
        )
