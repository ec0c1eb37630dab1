"""Tables of numbers in text files, as rigs and other people's programs write them."""

from __future__ import annotations

import io
import warnings
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.errors import ConfigError, suggestion
from daq.hal import FloatArray

if TYPE_CHECKING:
    import pandas as pd

COMMENTS = ("#", "%", "//")
_NOTHING = ("", "nan", "na", "n/a", "null", "none")
_CURE = "mend or remove these lines (removed lines count as lost samples)"
_NO_NUMBERS = ("nan", "inf", "-inf")  # what a broken sensor may end a log with
_HEAD = 1 << 20  # bytes in which a header stands
_PIECE = 1 << 22  # bytes parsed at a time: what pandas makes of them stays in the processor's cache
_TEXT_CONTROLS = b"\t\n\r\f"


@dataclass(frozen=True)
class Table:
    """Columns of a CSV as numbers.

    first_line: the line of the first row. torn: the last line was cut, or broken by a measurement
    that is no number, and is left out.
    """

    path: Path
    frame: pd.DataFrame
    first_line: int
    torn: bool


@dataclass(frozen=True)
class Layout:
    """How a table is written.

    line: of its header, counted from 1. names: in the header. separator: between cells.
    """

    line: int
    names: list[str]
    separator: str


def column_names(path: Path) -> list[str]:
    """Names in a table's header; raises ConfigError for a file without one."""
    layout = layout_of(_complete_lines(path, _HEAD)[0])
    _check_header(path, layout, ())
    return layout.names


def read_table(
    path: Path,
    columns: Sequence[str] = (),
    cure: str = _CURE,
    gaps: Collection[str] = (),
) -> Table:
    """Read a CSV of numbers with a header line.

    cure: what to do about cells that hold no number, for the error's end. gaps: columns that may
    have cells without one, empty or as in ``_NOTHING``; NaN in the table.

    Cells are separated by commas, semicolons or tabs (then decimals may have a comma), and
    separators may be followed by blanks. Lines of comments may stand before the header, or the
    header in the last of them, as NumPy writes it. A cut last line is left out. Raises
    ConfigError that names file, line and column for anything else that is not a table of finite
    numbers with the given columns.
    """
    import pandas as pd

    layout = layout_of(_complete_lines(path, _HEAD)[0])
    header, separator = layout.names, layout.separator
    _check_header(path, layout, columns)
    wanted = list(columns) or [name for name in header if name]
    first = layout.line + 1
    plain = _plain_numbers(path, layout)
    if plain is not None:
        frame, torn = plain
        return Table(path, frame[wanted], first, torn)
    text, torn = _complete_lines(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            frame = pd.read_csv(
                io.StringIO(text), sep=separator, skipinitialspace=True, header=None,
                skiprows=layout.line, names=_apart(header), index_col=False, dtype=str,
                keep_default_na=False, skip_blank_lines=False, on_bad_lines="error",
            )  # fmt: skip
    except pd.errors.ParserWarning:
        lines = text.splitlines()
        rows = range(layout.line, len(lines))
        line = next((i for i in rows if lines[i].count(separator) >= len(header)), 0)
        raise ConfigError(
            f"{lines[line].count(separator) + 1} cells, but line {layout.line} names "
            f"{len(header)} columns",
            cure="separate cells by commas and write decimals with a point, or separate them by "
            "semicolons",
            file=path,
            line=line + 1,
        ) from None
    except pd.errors.ParserError as error:
        reason = str(error).removeprefix("Error tokenizing data. C error: ").strip()
        raise ConfigError(f"not a table: {reason}", file=path) from None
    held = [name for name in wanted if name not in gaps]
    if len(frame) and frame[held].iloc[-1].str.strip().str.lower().isin(_NO_NUMBERS).any():
        frame, torn = frame.iloc[:-1], True
    numbers = {
        name: _numbers(path, name, frame[name], first, separator, cure, name in gaps)
        for name in wanted
    }
    return Table(path, pd.DataFrame(numbers), first, torn)


def _plain_numbers(path: Path, layout: Layout) -> tuple[pd.DataFrame, bool] | None:
    """The table where it is nothing but finite numbers, as a rig writes it, and whether it is torn.

    Many times faster than the long way, and rounded as ``float`` does it. None for any other table:
    the long way says what it is or what is wrong with it.
    """
    import pandas as pd

    if layout.separator != ",":
        return None
    parts, torn = [], False
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            for _ in range(layout.line):
                file.readline()
            while piece := file.read(_PIECE) + file.readline():
                rows = piece[: piece.rfind(b"\n") + 1]
                torn = bool(piece[len(rows) :].strip())
                if len(piece) < _PIECE:
                    rows = rows.rstrip(b"\r\n")  # the file's end: empty lines there are no rows
                if rows:
                    parts.append(_finite_rows(rows, layout))
    except (OSError, ValueError, pd.errors.ParserWarning):
        return None
    return (pd.concat(parts, ignore_index=True), torn) if parts else None


def _finite_rows(rows: bytes, layout: Layout) -> pd.DataFrame:
    """Lines of finite numbers, one for each name; raises ValueError or a warning for others."""
    import pandas as pd

    frame = pd.read_csv(
        io.BytesIO(rows), skipinitialspace=True, header=None, names=_apart(layout.names),
        index_col=False, dtype=np.float64, keep_default_na=False, skip_blank_lines=False,
        on_bad_lines="error", low_memory=False,
    )  # fmt: skip
    if b"\0" in rows or not np.isfinite(frame.to_numpy()).all():
        raise ValueError
    return frame


def layout_of(text: str) -> Layout:
    """Where the header of a table's text stands, the names in it and what is between them."""
    leading, header = [], None
    for line in _lines(text):
        if line.strip() and not line.lstrip().startswith(COMMENTS):
            header = line
            break
        leading.append(line)
    at = len(leading)
    if header is None:
        return Layout(1, leading[:1] or [""], ",")
    numbers = _cells(header, _separator(header))
    if leading and all(map(_is_number, numbers)):
        named = leading[-1].strip().lstrip("#%/").strip()
        if len(_cells(named, _separator(header))) == len(numbers):
            at, header = at - 1, named
    separator = _separator(header)
    return Layout(at + 1, _cells(header, separator), separator)


def _lines(text: str) -> Iterator[str]:
    """The lines one after the other: a long table has its header in front."""
    begin = 0
    while (end := text.find("\n", begin)) >= 0:
        yield text[begin:end]
        begin = end + 1
    yield text[begin:]


def _separator(line: str) -> str:
    return next((s for s in ("\t", ";") if s in line), ",")


def _cells(line: str, separator: str) -> list[str]:
    return [name.strip().strip('"').strip() for name in line.split(separator)]


def _apart(header: list[str]) -> list[str | int]:
    """Columns without a name, as a separator at each line's end makes them, told apart."""
    return [name or place for place, name in enumerate(header)]


def _complete_lines(path: Path, most: int = -1) -> tuple[str, bool]:
    """The file's text up to its last complete line, and whether something was cut off.

    most: bytes to read, -1 for all.
    """
    try:
        with path.open("rb") as file:
            data = file.read(most)
    except FileNotFoundError:
        cure = "name a capture folder or a CSV file"
        raise ConfigError("there is no such log", cure=cure, file=path) from None
    except IsADirectoryError:
        raise ConfigError("this is a folder without a log.csv in it", file=path) from None
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=path) from None
    if len(data) == most:
        # Not in the middle of a character.
        data = data[: data.rfind(b"\n") + 1] or data
    text = _decoded(path, data)
    if "\r" in text:
        text = text.replace("\r\n", "\n")
    if not text or text.isspace():
        cure = "it must start with a line of column names"
        raise ConfigError("the log is empty", cure=cure, file=path)
    cut = text.rfind("\n") + 1
    tail = text[cut:]
    # A last line without its newline may lack digits even where it has every column.
    complete = text[:cut] if cut else text
    if "\0" in complete:
        line = complete[: complete.index("\0")].count("\n") + 1
        raise ConfigError("not a text file: it holds bytes of zero", file=path, line=line)
    if complete.endswith("\n\n") or not complete.endswith("\n"):
        complete = complete.rstrip("\n") + "\n"
    return complete, bool(tail.strip())


def _decoded(path: Path, data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # Measuring programs on Windows write names and units in its older character set.
        controls = bytes(byte for byte in range(32) if byte not in _TEXT_CONTROLS)
        if data.translate(None, controls) != data:
            line = data[: error.start].count(b"\n") + 1
            problem = f"not a text file (byte {error.start})"
            raise ConfigError(problem, file=path, line=line) from None
        return data.decode("cp1252", errors="replace")


def _check_header(path: Path, layout: Layout, columns: Sequence[str]) -> None:
    line, header = layout.line, layout.names
    if all(_is_number(name) for name in header):
        cure = "it must hold the column names"
        raise ConfigError("the first line holds numbers", cure=cure, file=path, line=line)
    named = [name for name in header if name]
    twice = sorted({name for name in named if header.count(name) > 1})
    if twice:
        raise ConfigError(f"column {twice[0]!r} stands twice", file=path, line=line)
    for name in columns:
        if name not in header:
            raise ConfigError(
                f"column {name!r} is missing",
                cure=f"{suggestion(name, named)} (the file has {', '.join(named)}). Columns of "
                "other programs are named in the 'columns' section of a file given with --config",
                file=path,
                line=line,
            )


def _numbers(
    path: Path,
    name: str,
    column: pd.Series,
    first_line: int,
    separator: str,
    cure: str,
    with_gaps: bool,
) -> FloatArray:
    import pandas as pd

    text = column.str.strip()
    if separator != ",":
        text = text.str.replace(",", ".", regex=False)
    values = pd.to_numeric(text, errors="coerce").to_numpy(dtype=np.float64)
    wrong = ~np.isfinite(values)
    if with_gaps:
        wrong &= ~text.str.lower().isin(_NOTHING).to_numpy()
    bad = np.flatnonzero(wrong)
    if len(bad):
        row = int(bad[0])
        more = f", and in {len(bad) - 1} more lines" if len(bad) > 1 else ""
        raise ConfigError(
            f"{column.iloc[row]!r} is not a finite number{more}",
            cure=cure,
            file=path,
            line=row + first_line,
            key=name,
        )
    return values


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
