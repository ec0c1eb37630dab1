"""What people and machines read: tables and progress on a terminal, plain lines, or JSON."""

import functools
import json
import re
import shutil
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, redirect_stdout
from contextvars import ContextVar
from enum import IntEnum
from types import TracebackType
from typing import Any, Protocol, TextIO

from daq import notation
from daq.documents import plain
from daq.progress import Event, Note, Progress, Started, Watch

number = notation.number  # pages and tables print numbers alike


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


@contextmanager
def volume(level: Volume) -> Iterator[None]:
    """Within it, commands say as much as this."""
    token = _volume.set(level)
    try:
        yield
    finally:
        _volume.reset(token)


@contextmanager
def documents_alone(wanted: bool) -> Iterator[None]:
    """Within it, where wanted, standard output is for documents only.

    What else is printed, such as by a user's own protocol, goes to standard error.
    """
    token = _documents.set(sys.stdout if wanted else None)
    try:
        with redirect_stdout(sys.stderr) if wanted else nullcontext():
            yield
    finally:
        _documents.reset(token)


def report_error(message: str) -> None:
    """An error message on standard error, the cure included; one line for each mistake."""
    for line in message.splitlines():
        sys.stderr.write(f"rig: {line}\n")


def report_warning(message: str) -> None:
    """One line on standard error of what a user must know, however quiet."""
    sys.stderr.write(f"rig: warning: {message}\n")


def report_event(event: Event) -> None:
    """A note as loud as it is meant, without showing progress: a ``watch`` for what is quick."""
    if isinstance(event, Note):
        _REPORTERS[event.level](event.text)


def report_note(message: str) -> None:
    """One line of notice on standard error."""
    if _volume.get() >= Volume.NORMAL:
        sys.stderr.write(f"rig: note: {message}\n")


def report_detail(message: str) -> None:
    """One line on standard error for those who want to know more."""
    if _volume.get() >= Volume.VERBOSE:
        sys.stderr.write(f"rig: {message}\n")


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


class Watching:
    """Shows what a use case says while it works; within it, the function to give as ``watch``.

    Progress is a bar on a terminal, one plain line per finished activity otherwise; quiet: notes
    and warnings only. Notes end the bars before them.
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._display: Display | None = None
        self._open = ExitStack()

    def __enter__(self) -> Watch:
        return self._show

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # An activity that an error ended is not shown as finished.
        self._open.__exit__(kind, error, trace)

    def _show(self, event: Event) -> None:
        if isinstance(event, Progress):
            if self._display is None:
                self._display = self._open.enter_context(_display(self._quiet))
            self._display.update(event)
            return
        self._close()
        if isinstance(event, Started):
            if not self._quiet:
                report_note(event.title)
        else:
            report_event(event)

    def _close(self) -> None:
        self._display = None
        self._open.close()


class Display(Protocol):
    """Shows how far activities are: ``update`` as often as one likes."""

    def update(self, step: Progress) -> None:
        """Show a step."""


@contextmanager
def _display(quiet: bool) -> Iterator[Display]:
    if quiet or _volume.get() == Volume.QUIET:
        yield _Silent()
    elif sys.stderr.isatty():
        with _terminal_bars() as bars:
            yield bars
    else:
        lines = _PlainLines(_volume.get() == Volume.VERBOSE)
        yield lines
        lines.finish()


class _Silent:
    def update(self, step: Progress) -> None:
        """Show nothing."""


class _PlainLines:
    """One line per activity, when it is finished."""

    def __init__(self, verbose: bool) -> None:
        self._activity = ""
        self._text = ""
        self._started = self._written = time.perf_counter()
        self._verbose = verbose

    def update(self, step: Progress) -> None:
        if step.activity != self._activity:
            self.finish()
            self._activity, self._started = step.activity, time.perf_counter()
        self._text = f"{step.activity}: {step.status}"
        now = time.perf_counter()
        if self._verbose and now - self._written > _VERBOSE_PERIOD:
            self._written = now
            sys.stderr.write(f"{self._text} ...\n")

    def finish(self) -> None:
        if self._activity:
            seconds = time.perf_counter() - self._started
            sys.stderr.write(f"{self._text} ({seconds:.2f} s)\n")
        self._activity = ""


@contextmanager
def _terminal_bars() -> Iterator[Display]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TextColumn("[dim]left"),
        Remaining(),
    )
    with RichProgress(*columns, console=Console(file=sys.stderr)) as shown:
        tasks: dict[str, Any] = {}

        class Bars:
            def update(self, step: Progress) -> None:
                if step.activity not in tasks:
                    tasks[step.activity] = shown.add_task(
                        step.activity, total=step.total, note=step.status
                    )
                shown.update(
                    tasks[step.activity], completed=step.done, total=step.total, note=step.status
                )

        yield Bars()


_REPORTERS = {"warning": report_warning, "note": report_note, "detail": report_detail}
