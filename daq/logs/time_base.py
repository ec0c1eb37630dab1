"""Sequence numbers and sample time of a log's rows."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from daq.errors import ConfigError
from daq.hal import FloatArray, IntArray

_UNEVEN = 0.3  # of a sample that a row may stand off its place


def time_base(
    path: Path,
    time: FloatArray,
    tick: FloatArray | None = None,
    *,
    first_line: int = 2,
    column: str = "t",
    cure: str = "resample the log to a constant rate",
) -> tuple[IntArray, float]:
    """Sequence numbers (n,) and sample time [s] of a log's rows; gaps in time are gaps in number.

    time: (n,) [s]. tick: (n,), the log's own sequence numbers, where it has them. first_line: line
    of the first row. column: the name of time in it. cure: for rows at no constant rate.

    Raises ConfigError, naming the line, for time that does not advance, or rows that fit no
    constant rate.

    >>> time_base(Path("log.csv"), np.array([0.0, 0.1, 0.2, 0.5]))
    (array([0, 1, 2, 5]), 0.1)
    """
    steps, second_line = np.diff(time), first_line + 1
    stuck = "time does not advance from the line before"
    refuse_rows(path, ~(steps > 0.0), stuck, second_line, column)
    if tick is not None:
        refuse_rows(path, tick != np.round(tick), "it must be a whole number", first_line, "tick")
        stuck = "it does not advance from the line before"
        refuse_rows(path, ~(np.diff(tick) > 0.0), stuck, second_line, "tick")
        counts = np.diff(tick)
        dt = float(np.median(steps / counts))
    else:
        dt = float(np.median(steps))
        counts = np.round(steps / dt)
    # A rate off by its printed digits drifts slowly; jumps between neighbours are what counts.
    uneven = (np.abs(steps / dt - counts) > _UNEVEN) | (counts < 1)
    row = int(np.argmax(uneven))
    count = max(int(counts[row]), 1)
    jump = f"samples are {dt:g} s apart elsewhere but {steps[row]:g} s for {count} of them"
    refuse_rows(path, uneven, f"{jump} here", second_line, column, cure)
    ticks: IntArray = np.zeros(len(time), dtype=np.int64)
    ticks[1:] = np.cumsum(counts)
    # Times printed with few digits are each a little off; their ends together are not.
    dt = float((time[-1] - time[0]) / ticks[-1])
    return ticks + (0 if tick is None else int(tick[0])), dt


def refuse_rows(
    path: Path,
    wrong: npt.NDArray[np.bool_],
    problem: str,
    first_line: int,
    column: str,
    cure: str = "",
) -> None:
    """Raise ConfigError at the first wrong row, if any; first_line: of entry 0."""
    if wrong.any():
        line = int(np.argmax(wrong)) + first_line
        raise ConfigError(problem, cure=cure, file=path, line=line, key=column)


def require_rows(path: Path, n: int) -> None:
    """Raise ConfigError unless there are samples to work with."""
    if n < 2:
        problem = f"it holds {n} sample{'s' * (n != 1)}"
        cure = "at least 2 are needed. Was the run stopped before it began?"
        raise ConfigError(problem, cure=cure, file=path)
