"""What people and machines read: tables and progress on a terminal, plain lines, or JSON."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol


class Bar(Protocol):
    """A progress display: ``update`` as often as one likes."""

    def update(self, title: str, done: float, total: float, note: str) -> None:
        """Show ``done`` of ``total`` under a title."""


def report_error(message: str) -> None:
    """An error message on standard error, the cure included; one line for each mistake."""
    for line in message.splitlines():
        sys.stderr.write(f"rig: {line}\n")


def report_note(message: str) -> None:
    """One line of notice on standard error."""
    sys.stderr.write(f"rig: note: {message}\n")


def print_json(document: Any) -> None:
    """One JSON document; numbers JSON cannot hold become null."""
    sys.stdout.write(json.dumps(plain(document), indent=2) + "\n")


def print_line(text: str = "") -> None:
    """One line of result on standard output."""
    sys.stdout.write(text + "\n")


def print_table(
    title: str, head: Sequence[str], rows: Sequence[Sequence[str]], text: Sequence[str] = ()
) -> None:
    """A table: with rules on a terminal, aligned plain text otherwise.

    The first column and those named in ``text`` are text, the others numbers.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(file=sys.stdout, highlight=False)
    if not console.is_terminal:
        # A pipe has no width: nothing may be cut.
        console = Console(file=sys.stdout, highlight=False, width=200, no_color=True)
    table = Table(
        header_style="bold",
        box=box.SIMPLE_HEAD if console.is_terminal else box.SIMPLE, pad_edge=False,
    )  # fmt: skip
    for index, name in enumerate(head):
        words = index == 0 or name in text
        table.add_column(name, justify="left" if words else "right", no_wrap=not words)
    for row in rows:
        table.add_row(*row)
    # Above the table rather than in it, where a long title would wrap to the table's width.
    console.print(title, style="bold", soft_wrap=True)
    console.print(table)


@contextmanager
def progress(quiet: bool = False) -> Iterator[Bar]:
    """A progress bar on a terminal; one plain line per finished step otherwise."""
    if quiet:
        yield _Silent()
    elif sys.stderr.isatty():
        with _terminal_bar() as bar:
            yield bar
    else:
        plain = _Plain()
        yield plain
        plain.finish()


def number(value: float, digits: int = 4) -> str:
    """A number with so many significant digits, exponents in steps of three."""
    if not math.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -3 <= exponent < 5:
        return f"{value:.{max(digits - 1 - exponent, 0)}f}"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}e{int(power)}"


class _Silent:
    def update(self, title: str, done: float, total: float, note: str) -> None:
        """Show nothing."""


class _Plain:
    """One line per step, when it is finished."""

    def __init__(self) -> None:
        self._title = ""
        self._text = ""
        self._started = time.perf_counter()

    def update(self, title: str, done: float, total: float, note: str) -> None:
        if title != self._title:
            self.finish()
            self._title, self._started = title, time.perf_counter()
        self._text = f"{title}: {note}"

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
