"""What people and machines read: tables and progress on a terminal, plain lines, or JSON."""

from __future__ import annotations

import functools
import json
import math
import re
import shutil
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from contextvars import ContextVar
from enum import IntEnum
from typing import Any, Protocol, TextIO

from daq import notation
from daq.notes import Note

number, digits = notation.number, notation.digits  # pages and tables print numbers alike


class Volume(IntEnum):
    """How much a command says."""

    QUIET = 0
    """Results, warnings and errors."""
    NORMAL = 1
    """Progress and what to do next as well."""
    VERBOSE = 2
    """Which files and plugins are used as well, and progress as it goes."""


_volume: ContextVar[Volume] = ContextVar("volume", default=Volume.NORMAL)
_documents: ContextVar[TextIO | None] = ContextVar("documents", default=None)
_VERBOSE_PERIOD = 1.0  # s between lines of progress
_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
# A power would be of the prefix as well: mm^2 is no thousandth of m^2.
_PREFIXABLE = re.compile(r"(V|A|ohm|H|F|N|W|J|s|Hz|Pa|T|Wb|m|rad)(?![\w^])")
_PLAIN = (0.1, 1000.0)


@contextmanager
def volume(level: Volume) -> Iterator[None]:
    """Within it, commands say as much as this."""
    token = _volume.set(level)
    try:
        yield
    finally:
        _volume.reset(token)


@contextmanager
def documents_alone(asked: bool) -> Iterator[None]:
    """Within it, where asked, standard output is for documents: what else is printed, such as by a
    user's own protocol, goes to standard error."""
    token = _documents.set(sys.stdout if asked else None)
    try:
        with redirect_stdout(sys.stderr) if asked else nullcontext():
            yield
    finally:
        _documents.reset(token)


class Bar(Protocol):
    """A progress display: ``update`` as often as one likes."""

    def update(self, title: str, done: float, total: float, note: str) -> None:
        """Show ``done`` of ``total`` under a title."""


def report_error(message: str) -> None:
    """An error message on standard error, the cure included; one line for each mistake."""
    for line in message.splitlines():
        sys.stderr.write(f"rig: {line}\n")


def report_warning(message: str) -> None:
    """One line on standard error of what a user must know, however quiet."""
    sys.stderr.write(f"rig: warning: {message}\n")


def report(note: Note) -> None:
    """What a use case tells meanwhile, as loud as it is meant."""
    _REPORTS[note.level](note.text)


def report_note(message: str) -> None:
    """One line of notice on standard error."""
    if _volume.get() >= Volume.NORMAL:
        sys.stderr.write(f"rig: note: {message}\n")


def report_detail(message: str) -> None:
    """One line on standard error for those who want to know more."""
    if _volume.get() >= Volume.VERBOSE:
        sys.stderr.write(f"rig: {message}\n")


_REPORTS = {"detail": report_detail, "note": report_note, "warning": report_warning}


def print_next(*commands: str) -> None:
    """Which commands a user may want now."""
    if _volume.get() >= Volume.NORMAL:
        for word, command in zip(["Next", *["Then"] * len(commands)], commands, strict=False):
            print_line(f"{word}: {command}")


def print_json(document: Any) -> None:
    """One JSON document; numbers JSON cannot hold become null."""
    out = _documents.get() or sys.stdout
    out.write(json.dumps(plain(document), indent=2) + "\n")
    out.flush()


def print_line(text: str = "") -> None:
    """One line of result on standard output."""
    sys.stdout.write(text + "\n")


def print_text(text: str) -> None:
    """Sentences: on a terminal wrapped between words, its indent kept, in a pipe one line."""
    if sys.stdout.isatty():
        indent = " " * (len(text) - len(text.lstrip()))
        text = textwrap.fill(
            text.strip(), shutil.get_terminal_size().columns, initial_indent=indent,
            subsequent_indent=indent, break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
    print_line(text)


def print_table(
    title: str, head: Sequence[str], rows: Sequence[Sequence[str]], text: Sequence[str] = ()
) -> None:
    """A table: with rules on a terminal, in a pipe a line for each row however long.

    The first column and those named in ``text`` are text, the others numbers. On a narrow terminal
    heads and text are wrapped between words; nothing is cut.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    # A unit in brackets is no markup, nor is text between colons an emoji.
    make = functools.partial(Console, file=sys.stdout, highlight=False, markup=False, emoji=False)
    console = make()
    words = [index == 0 or name in text for index, name in enumerate(head)]
    columns = [[name, *(row[index] for row in rows)] for index, name in enumerate(head)]
    whole = [max(map(len, column)) for column in columns]
    narrow = console.is_terminal and sum(whole) + 3 * len(head) > console.width
    room = console.width - 2 * len(head)
    widths = _narrowed(columns, words, room) if narrow else whole
    table = Table(
        header_style="bold", pad_edge=False, padding=(0, 1, 0, 0) if narrow else (0, 1),
        box=box.SIMPLE_HEAD if console.is_terminal else box.SIMPLE,
    )  # fmt: skip
    for name, width, is_text in zip(head, widths, words, strict=True):
        table.add_column(
            _folded(name, width), width=width, justify="left" if is_text else "right",
            overflow="fold",
        )  # fmt: skip
    for row in rows:
        table.add_row(*row)
    # Where even the longest words have no room, the terminal breaks the lines.
    console = make(
        width=max(console.width, sum(widths) + 3 * len(head)),
        no_color=None if console.is_terminal else True,
    )
    # Above the table rather than in it, where a long title would wrap to the table's width.
    console.print(title, style="bold", soft_wrap=True)
    console.print(table)


def _narrowed(columns: Sequence[Sequence[str]], words: Sequence[bool], room: int) -> list[int]:
    """Widths of columns, heads first, that together take no more than the room, if they can.

    Numbers stay whole, and words of text: what is left goes to text first, which takes a line for
    each row it is wrapped in, heads only one in all.
    """
    widths = []
    for cells, is_text in zip(columns, words, strict=True):
        parts = " ".join(cells[1:]).split() if is_text else list(cells[1:])
        widths.append(max(map(len, [*parts, *_parts(cells[0])]), default=0))
    for index in sorted(range(len(columns)), key=lambda i: not words[i]):
        spare = max(room - sum(widths), 0)
        widths[index] += min(spare, max(map(len, columns[index])) - widths[index])
    return widths


def _parts(head: str) -> list[str]:
    """Where a head may be wrapped: between words, and of a name behind an underscore."""
    return [part for part in re.split(r"(?<=_)| +", head) if part]


def _folded(head: str, width: int) -> str:
    """A head on lines no wider than that, as far as its parts allow."""
    if len(head) <= width:
        return head
    lines = [""]
    for part in _parts(head):
        between = "" if lines[-1].endswith("_") or not lines[-1] else " "
        if len(lines[-1] + between + part) <= width or not lines[-1]:
            lines[-1] += between + part
        else:
            lines.append(part)
    return "\n".join(lines)


@contextmanager
def progress(quiet: bool = False) -> Iterator[Bar]:
    """A progress bar on a terminal; one plain line per finished step otherwise."""
    if quiet or _volume.get() == Volume.QUIET:
        yield _Silent()
    elif sys.stderr.isatty():
        with _terminal_bar() as bar:
            yield bar
    else:
        plain = _Plain(_volume.get() == Volume.VERBOSE)
        yield plain
        plain.finish()


def engineering(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit in which a value has one to three digits before the point, as 0.54 mH.

    The factor is 1 from a tenth to a thousand, and for units that take no prefix (kg, 1/s, m^2).
    """
    size = abs(value)
    if not _PREFIXABLE.match(unit) or not math.isfinite(value) or _PLAIN[0] <= size < _PLAIN[1]:
        return 1.0, unit
    power = 3 * math.floor(math.log10(size) / 3) if size else 0
    prefix = _PREFIXES.get(power)
    return (1.0, unit) if prefix is None else (10.0**-power, f"{prefix}{unit}")


class _Silent:
    def update(self, title: str, done: float, total: float, note: str) -> None:
        """Show nothing."""


class _Plain:
    """One line per step, when it is finished."""

    def __init__(self, verbose: bool) -> None:
        self._title = ""
        self._text = ""
        self._started = self._told = time.perf_counter()
        self._verbose = verbose

    def update(self, title: str, done: float, total: float, note: str) -> None:
        if title != self._title:
            self.finish()
            self._title, self._started = title, time.perf_counter()
        self._text = f"{title}: {note}"
        now = time.perf_counter()
        if self._verbose and now - self._told > _VERBOSE_PERIOD:
            self._told = now
            sys.stderr.write(f"{self._text} ...\n")

    def finish(self) -> None:
        if self._title:
            seconds = time.perf_counter() - self._started
            sys.stderr.write(f"{self._text} ({seconds:.2f} s)\n")
        self._title = ""


@contextmanager
def _terminal_bar() -> Iterator[Bar]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TextColumn("[dim]left"),
        Remaining(),
    )
    with Progress(*columns, console=Console(file=sys.stderr)) as shown:
        tasks: dict[str, Any] = {}

        class Bars:
            def update(self, title: str, done: float, total: float, note: str) -> None:
                if title not in tasks:
                    tasks[title] = shown.add_task(title, total=total, note=note)
                shown.update(tasks[title], completed=done, total=total, note=note)

        yield Bars()


def plain(value: Any) -> Any:
    """A document as JSON can hold it: numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, str | int | float | bool) or value is None:
        return value
    return str(value)
