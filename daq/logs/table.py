"""Tables of numbers in text files, as rigs and other people's programs write them."""

from __future__ import annotations

import codecs
import io
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.errors import ConfigError, suggestion
from daq.hal import FloatArray
from daq.logs import matlab
from daq.logs.capture import is_log
from daq.logs.time_base import refuse_rows

if TYPE_CHECKING:
    import pandas as pd

COMMENTS = ("#", "%", "//")
_NOTHING = ("", "nan", "na", "n/a", "null", "none")
_CURE = "mend or remove these lines (removed lines count as lost samples)"
_NO_NUMBERS = ("nan", "inf", "-inf")  # what a broken sensor may end a log with
_HEAD = 1 << 20  # bytes in which a header stands
_PIECE = 1 << 22  # bytes parsed at a time: what is made of them stays in the processor's cache
_COMPARED = 20  # lines whose decimals tell how a file is written
_AS_TEXT = "export the table as CSV in UTF-8 (a worksheet by 'Save as', 'CSV UTF-8')"
_TEXT_CONTROLS = b"\t\n\r\f"


@dataclass(frozen=True)
class Layout:
    """How a table is written: the line of its header, from 1, the names in it, the separator."""

    line: int
    names: list[str]
    separator: str


def column_names(path: Path) -> list[str]:
    """Names in a table's header, or of a MAT file's columns; ConfigError for a file without."""
    if path.suffix.lower() == matlab.SUFFIX:
        return list(matlab.columns_of(path))
    return _layout_with(path, ()).names


def read_table(
    path: Path, columns: Sequence[str] = (), cure: str = _CURE, gaps: Collection[str] = ()
) -> tuple[dict[str, FloatArray], int, bool]:
    """Read a CSV of numbers with a header line, or a MAT file.

    The columns as numbers, (n_rows,) each, the line of the first row, and whether the last line
    was cut, or broken by a measurement that is no number, and is left out.

    columns: wanted ones, default all. cure: what to do about cells that hold no number. gaps:
    columns that may have cells without one, empty or as in ``_NOTHING``; NaN in the table.

    Cells are separated by commas, semicolons or tabs (then decimals may have a comma), and
    separators may be followed by blanks. Lines of comments may stand before the header, or the
    header in the last of them, as NumPy writes it. Raises ConfigError that names file, line and
    column for anything else that is not a table of finite numbers with the given columns.
    """
    if path.suffix.lower() == matlab.SUFFIX:
        return _matlab_table(path, columns, cure, gaps), 1, False
    layout = _layout_with(path, columns)
    names = list(columns) or [name for name in layout.names if name]
    first_line = layout.line + 1
    plain = _plain_numbers(path, layout)
    if plain is not None:
        table, torn = plain
        return {name: table[layout.names.index(name)] for name in names}, first_line, torn
    text, torn = _complete_lines(path, layout=layout)
    cells = _cells(path, text, layout)
    without_gaps = [name for name in names if name not in gaps]
    if len(cells) and cells[without_gaps].iloc[-1].str.strip().str.lower().isin(_NO_NUMBERS).any():
        cells, torn = cells.iloc[:-1], True
    decimal_comma = layout.separator != ","
    numbers = {
        name: _numbers(path, cells[name], first_line, decimal_comma, cure, name in gaps)
        for name in names
    }
    return numbers, first_line, torn


def _matlab_table(
    path: Path, columns: Sequence[str], cure: str, gaps: Collection[str]
) -> dict[str, FloatArray]:
    """Columns of a MAT file; ConfigError, whose line is the row from 1, as for a CSV."""
    arrays = matlab.columns_of(path)
    names = list(columns) or list(arrays)
    for name in names:
        if name not in arrays:
            problem = f"it has no array {name!r}"
            raise ConfigError(problem, cure=suggestion(name, list(arrays)), file=path)
    lengths = {name: len(arrays[name]) for name in names}
    if len(set(lengths.values())) > 1:
        shown = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        cure = "name arrays of one length in the 'columns' section"
        raise ConfigError(f"its arrays differ in length: {shown}", cure=cure, file=path)
    for name in names:
        wrong = np.isinf(arrays[name]) if name in gaps else ~np.isfinite(arrays[name])
        refuse_rows(path, wrong, "it is not a finite number", 1, name, cure)
    return {name: arrays[name] for name in names}


def _cells(path: Path, text: str, layout: Layout) -> pd.DataFrame:
    """The text of every cell below the header; ConfigError for rows that are too long."""
    import pandas as pd

    # A column without a name, as a separator at each line's end makes it, gets its number.
    names: list[str | int] = [name or place for place, name in enumerate(layout.names)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # of a row that is too long
            return pd.read_csv(
                io.StringIO(text),
                names=names,
                dtype=str,
                sep=layout.separator,
                skiprows=layout.line,
                skipinitialspace=True,
                header=None,
                index_col=False,
                keep_default_na=False,
                skip_blank_lines=False,
                on_bad_lines="error",
            )
    except (pd.errors.ParserWarning, pd.errors.ParserError) as error:
        lines = text.splitlines()
        n_columns = len(layout.names)
        counts = [line.count(layout.separator) + 1 for line in lines]
        longer = [i for i in range(layout.line, len(lines)) if counts[i] > n_columns]
        if longer or isinstance(error, pd.errors.ParserWarning):
            row = longer[0] if longer else 0
            raise ConfigError(
                f"{counts[row]} cells, but line {layout.line} names {n_columns} columns",
                cure="separate cells by commas and write decimals with a point, or separate them "
                "by semicolons",
                file=path,
                line=row + 1,
            ) from None
        reason = str(error).removeprefix("Error tokenizing data. C error: ").strip()
        raise ConfigError(f"not a table: {reason}", file=path) from None


def _plain_numbers(path: Path, layout: Layout) -> tuple[FloatArray, bool] | None:
    """A table of nothing but finite numbers, read quickly, and whether it is torn; else None.

    (n_columns, n_rows).
    """
    if layout.separator != ",":
        return None
    parts, torn = [], False
    try:
        with path.open("rb") as file:
            for _ in range(layout.line):
                file.readline()
            while piece := file.read(_PIECE) + file.readline():
                rows = piece[: piece.rfind(b"\n") + 1]
                torn = bool(piece[len(rows) :].strip())
                if torn and _is_whole(path, piece.decode("latin-1"), layout):
                    rows, torn = piece, False
                if len(piece) < _PIECE:
                    rows = rows.rstrip(b"\r\n")  # the file's end: empty lines there are no rows
                if rows:
                    parts.append(_finite_rows(rows, len(layout.names)).T)
    except (OSError, ValueError):
        return None
    return (np.concatenate(parts, axis=1), torn) if parts else None


def _finite_rows(text: bytes, n_columns: int) -> FloatArray:
    """Lines of so many numbers, a row each; ValueError for any others."""
    lines = text.count(b"\n") + (not text.endswith(b"\n"))
    if b"\0" in text or text.isspace():
        raise ValueError
    rows = np.loadtxt(io.BytesIO(text), delimiter=",", comments=None, ndmin=2)
    if rows.shape != (lines, n_columns) or not np.isfinite(rows).all():  # it skips empty lines
        raise ValueError
    return rows


def layout_of(text: str) -> Layout:
    """Where the header of a table's text stands, the names in it and what is between them."""
    lines = text.split("\n")
    at = 0
    while at < len(lines) and (not lines[at].strip() or lines[at].lstrip().startswith(COMMENTS)):
        at += 1
    if at == len(lines):
        return Layout(1, lines[:1], ",")
    header = lines[at]
    numbers = _names(header, _separator(header))
    if at > 0 and all(map(_is_number, numbers)):
        comment = lines[at - 1].strip().lstrip("#%/").strip()
        if len(_names(comment, _separator(header))) == len(numbers):
            at, header = at - 1, comment
    separator = _separator(header)
    return Layout(at + 1, _names(header, separator), separator)


def _separator(line: str) -> str:
    return next((s for s in ("\t", ";") if s in line), ",")


def _names(line: str, separator: str) -> list[str]:
    return [name.strip().strip('"').strip() for name in line.split(separator)]


def _is_whole(path: Path, text: str, layout: Layout) -> bool:
    """Whether the last line of a text that ends without a newline has lost nothing.

    A capture's log ends with one unless its run was killed. In another file the line is whole when
    it has every column, and no fewer decimals at its end than all lines before.
    """
    *before, last = text.rstrip().rsplit("\n", _COMPARED + 1)[-_COMPARED - 1 :]
    cells = last.split(layout.separator)
    readable = all(_is_number(cell) or cell.strip().lower() in _NOTHING for cell in cells)
    if is_log(path) or len(cells) != len(layout.names) or not (readable and _is_number(cells[-1])):
        return False
    ends = [line.rstrip().rpartition(layout.separator)[2] for line in before]
    decimals = {_decimals(end) for end in ends if _is_number(end)}
    return len(decimals) != 1 or decimals == {_decimals(cells[-1])}


def _decimals(cell: str) -> int:
    """Digits behind the point of a number's text."""
    return len(cell.strip().replace(",", ".").partition(".")[2])


def _complete_lines(
    path: Path, n_bytes: int = -1, layout: Layout | None = None
) -> tuple[str, bool]:
    """Text of a file's first bytes, -1 for all, to its last whole line; whether any was cut off.

    layout: with it, a last line without its newline is kept where it is whole.
    """
    try:
        with path.open("rb") as file:
            data = file.read(n_bytes)
    except FileNotFoundError:
        cure = "name a capture folder or a CSV file"
        raise ConfigError("there is no such log", cure=cure, file=path) from None
    except OSError as error:
        if path.is_dir():
            raise ConfigError("this is a folder without a log.csv in it", file=path) from None
        raise ConfigError(f"cannot be read: {error.strerror}", file=path) from None
    if len(data) == n_bytes:
        # Not in the middle of a character.
        data = data[: data.rfind(b"\n") + 1] or data
    text = _decoded(path, data).replace("\r\n", "\n")
    if not text or text.isspace():
        cure = "it must start with a line of column names"
        raise ConfigError("the log is empty", cure=cure, file=path)
    # A last line without its newline may lack digits even where it has every column.
    cut = text.rfind("\n") + 1
    if layout is not None and text[cut:].strip() and _is_whole(path, text, layout):
        cut = len(text)
    complete = text[:cut] or text
    if "\0" in complete:
        line = complete[: complete.index("\0")].count("\n") + 1
        problem = "not a text file: it holds bytes of zero"
        raise ConfigError(problem, cure=_AS_TEXT, file=path, line=line)
    return complete.rstrip("\n") + "\n", bool(text[cut:].strip())


def _cure_of(data: bytes) -> str:
    """What to do about a file that is no text in UTF-8, by its first bytes."""
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return f"it is UTF-16; {_AS_TEXT}" if wide else _AS_TEXT


def _decoded(path: Path, data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # Measuring programs on Windows write names and units in its older character set.
        controls = bytes(byte for byte in range(32) if byte not in _TEXT_CONTROLS)
        if data.translate(None, controls) != data:
            line = data[: error.start].count(b"\n") + 1
            problem = f"not a text file (byte {error.start})"
            raise ConfigError(problem, cure=_cure_of(data), file=path, line=line) from None
        return data.decode("cp1252", errors="replace")


def _layout_with(path: Path, columns: Sequence[str]) -> Layout:
    """How a file's table is written; ConfigError unless its header names each column once."""
    layout = layout_of(_complete_lines(path, _HEAD)[0])
    line, header = layout.line, layout.names
    if all(_is_number(name) for name in header):
        example = ",".join(f"column{i + 1}" for i in range(len(header)))
        cure = f"it must hold the column names: write a line such as '{example}' above it"
        raise ConfigError("the first line holds numbers", cure=cure, file=path, line=line)
    names = [name for name in header if name]
    repeated = sorted({name for name in names if header.count(name) > 1})
    if repeated:
        raise ConfigError(f"column {repeated[0]!r} stands twice", file=path, line=line)
    for name in columns:
        if name not in header:
            raise ConfigError(
                f"column {name!r} is missing",
                cure=f"{suggestion(name, names)}. Columns of other programs are named in the "
                "'columns' section of a file given with --config",
                file=path,
                line=line,
            )
    return layout


def _numbers(
    path: Path, column: pd.Series, first_line: int, decimal_comma: bool, cure: str, with_gaps: bool
) -> FloatArray:
    """A column's cells as numbers; ConfigError at the first that is none."""
    import pandas as pd

    text = column.str.strip()
    if decimal_comma:
        text = text.str.replace(",", ".", regex=False)
    values = pd.to_numeric(text, errors="coerce").to_numpy(dtype=np.float64)
    wrong = ~np.isfinite(values)
    if with_gaps:
        wrong &= ~text.str.lower().isin(_NOTHING).to_numpy()
    if wrong.any():
        cell, n_more = column.iloc[int(np.argmax(wrong))], int(wrong.sum()) - 1
        more = f", and in {n_more} more lines" if n_more else ""
        problem = f"{cell!r} is not a finite number{more}"
        refuse_rows(path, wrong, problem, first_line, str(column.name), cure)
    return values


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
