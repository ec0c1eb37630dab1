"""Reading a log that is still being written: the readable cells of its complete lines."""

import io
import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from daq.hal import FloatArray, IntArray
from daq.logs.columns import ORIGINAL_COLUMNS
from daq.logs.table import COMMENTS, Layout, layout_of

CHUNK = 2_000_000  # bytes read at a time: some 20 ms of parsing, so that the page stays alive
_HEAD = 65_536  # bytes in which a header must have ended
_BULK = 50_000  # bytes from which pandas is quicker than parsing line by line
_KEPT = 5  # problems described; further ones are counted


TailRows = tuple[FloatArray, IntArray]
"""Samples in the order of the file, (n, n_columns), NaN where a cell holds no finite number; and
the bytes at which their lines begin, and the one after the last, (n + 1,)."""


@dataclass
class Problems:
    """Problems of a log: the first few described, all counted."""

    first: list[str] = field(default_factory=list)
    count: int = 0

    def note(self, text: str) -> None:
        """Add a problem."""
        self.count += 1
        if len(self.first) < _KEPT:
            self.first.append(text)


class LogTail:
    """The rows of a log as they are written.

    columns: names, known once the header has been read. fault: why nothing can be read, or None.
    problems: what was left out. offset: bytes read. No content of the file raises an error.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.columns: tuple[str, ...] = ()
        self.fault: str | None = None
        self.problems = Problems()
        self.offset = 0
        self._layout: Layout | None = None
        self._places: list[int] = []
        self._line = 0  # lines before offset
        self._last_time = -math.inf

    def size(self) -> int:
        """Bytes in the file now; 0 when there is none yet."""
        try:
            return self.path.stat().st_size
        except OSError:
            return 0

    def poll(self) -> TailRows:
        """TailRows written since the last call, in up to ``CHUNK`` bytes."""
        data = self._whole_lines()
        if data and self._layout is None:
            data = self._take_header(data)
        if not data or not self.columns:
            return np.empty((0, len(self.columns))), np.array([self.offset])
        values, starts = self._parse(data, self.problems)
        self._line += data.count(b"\n")
        self.offset += len(data)
        return self._rows_that_advance(values, starts)

    def read_between(self, start: int, end: int) -> FloatArray:
        """Read again the rows whose lines stand in these bytes, (n, n_columns)."""
        try:
            with self.path.open("rb") as file:
                file.seek(start)
                data = file.read(end - start)
        except OSError:
            data = b""
        values, _ = self._parse(data[: data.rfind(b"\n") + 1], Problems())
        # As in poll, rows in which time does not advance are left out.
        return values[_advances(values[:, self.columns.index("t")], -math.inf)]

    def torn(self) -> bool:
        """Whether the file ends in an incomplete line."""
        return self._layout is not None and self.size() > self.offset and not self._whole_lines()

    def _whole_lines(self) -> bytes:
        try:
            with self.path.open("rb") as file:
                file.seek(self.offset)
                data = file.read(CHUNK)
        except FileNotFoundError:
            return b""
        except OSError as error:
            self.fault = f"cannot be read: {error.strerror}"
            return b""
        whole = data[: data.rfind(b"\n") + 1]
        # No line of a log is as long as a chunk: a chunk without an end of line is skipped whole.
        return whole if whole or len(data) < CHUNK else data

    def _take_header(self, data: bytes) -> bytes:
        """Read the header once it is complete; the data after it."""
        head = data[:_HEAD]
        text = head[: head.rfind(b"\n") + 1].decode("utf-8-sig", errors="replace")
        lines = text.replace("\r\n", "\n").split("\n")
        if all(not line.strip() or line.lstrip().startswith(COMMENTS) for line in lines):
            if len(data) > _HEAD:
                self.fault = "it has no line of column names"
            return b""
        layout = layout_of("\n".join(lines))
        self.fault = _header_fault(layout)
        if self.fault:
            return b""
        named = [(name, place) for place, name in enumerate(layout.names) if name]
        first_places = dict(reversed(named))  # of columns with the same name the first stays
        self._layout = layout
        self._places = sorted(first_places.values())
        self.columns = tuple(layout.names[place] for place in self._places)
        at = f"line {layout.line}"
        for name in sorted({name for name, _ in named if layout.names.count(name) > 1}):
            self.problems.note(f"{at}: column {name!r} stands twice; the first counts")
        missing = [name for name in ORIGINAL_COLUMNS if name not in first_places]
        if missing:
            self.problems.note(f"{at}: without column {', '.join(missing)}")
        self._line = layout.line
        self.offset = _line_starts(data)[layout.line]
        return data[self.offset :]

    def _parse(self, data: bytes, problems: Problems) -> TailRows:
        assert self._layout is not None
        starts = self.offset + np.array(_line_starts(data), dtype=np.int64)
        if len(data) > _BULK:
            values = _parse_bulk(data, self._layout, self._places)
            if values is not None and len(values) == len(starts) - 1:
                return values, starts
        return self._parse_lines(data, starts, problems)

    def _parse_lines(self, data: bytes, starts: IntArray, problems: Problems) -> TailRows:
        """Rows line by line; lines of other lengths are left out, other cells become NaN."""
        assert self._layout is not None
        names, separator = self._layout.names, self._layout.separator
        kept: list[int] = []
        values: list[list[float]] = []
        lines = data.decode("utf-8", errors="replace").split("\n")
        for index, line in enumerate(lines[: len(starts) - 1]):
            at = f"line {self._line + index + 1}"
            cells = line.split(separator)
            if len(cells) != len(names):
                if line.strip():
                    problems.note(f"{at}: {len(cells)} cells instead of {len(names)}; left out")
                continue
            row = []
            for place in self._places:
                row.append(_number(cells[place], separator))
                if math.isnan(row[-1]):
                    cell = cells[place].strip()[:20]
                    problems.note(f"{at}: {names[place]}: {cell!r} is no number")
            kept.append(index)
            values.append(row)
        table = np.array(values, dtype=np.float64).reshape(len(values), len(self.columns))
        return table, np.append(starts[kept], starts[-1])

    def _rows_that_advance(self, values: FloatArray, starts: IntArray) -> TailRows:
        """The rows in which time advances."""
        time = values[:, self.columns.index("t")]
        kept = _advances(time, self._last_time)
        if not kept.all():
            n_left_out = int(np.count_nonzero(~kept))
            plural = "s" if n_left_out != 1 else ""
            self.problems.note(
                f"before line {self._line + 1}: time does not advance in {n_left_out} "
                f"row{plural}; left out"
            )
        if kept.any():
            self._last_time = float(time[kept][-1])
        return values[kept], np.append(starts[:-1][kept], starts[-1])


def _advances(time: FloatArray, last: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which times are later than all before them, and than ``last``."""
    finite = np.where(np.isfinite(time), time, -np.inf)
    before = np.maximum.accumulate(np.concatenate([[last], finite]))[:-1]
    return finite > before


def _line_starts(data: bytes) -> list[int]:
    """Byte at which each line begins, and the length of the data."""
    ends = np.flatnonzero(np.frombuffer(data, dtype=np.uint8) == ord("\n")) + 1
    starts = [0, *ends.tolist()]
    return starts if starts[-1] == len(data) else [*starts, len(data)]


def _header_fault(layout: Layout) -> str | None:
    names = [name for name in layout.names if name]
    if "t" in names:
        return None
    if names and all(not math.isnan(_number(name, layout.separator)) for name in names):
        return f"line {layout.line}: numbers where the column names should be"
    listed = ", ".join(names)[:200]
    return f"line {layout.line}: column 't' (time in s) is missing; there are {listed}"


def _number(cell: str, separator: str) -> float:
    try:
        value = float(cell if separator == "," else cell.replace(",", "."))
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _parse_bulk(data: bytes, layout: Layout, places: list[int]) -> FloatArray | None:
    """All rows at once by pandas; None if any row does not fit the header or is not finite."""
    import pandas as pd

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            frame = pd.read_csv(
                io.BytesIO(data), sep=layout.separator, header=None, index_col=False,
                names=list(range(len(layout.names))), usecols=places, dtype=np.float64,
                decimal="." if layout.separator == "," else ",", skipinitialspace=True,
                skip_blank_lines=False,
            )  # fmt: skip
    except (ValueError, pd.errors.ParserWarning, pd.errors.ParserError):
        return None
    values: FloatArray = frame.to_numpy(dtype=np.float64)
    return values if np.isfinite(values).all() else None
