"""What people and machines read: tables and progress on a terminal, plain lines, or JSON."""

import json
import re
import shutil
import sys
import textwrap
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, redirect_stdout
from contextvars import ContextVar
from enum import IntEnum
from typing import Any, TextIO

from daq import notation
from daq.documents import plain
from daq.errors import Mistake
from daq.progress import Event, Level, Note, Progress, Watch, ignore

number = notation.number  # pages and tables print numbers alike


class Volume(IntEnum):
    """How much a command says."""

    QUIET = 0  # results, warnings and errors
    NORMAL = 1  # progress and what to do next as well
    VERBOSE = 2  # which files and plugins are used as well, and progress as it goes


_volume: ContextVar[Volume] = ContextVar("volume", default=Volume.NORMAL)
_documents: ContextVar[TextIO | None] = ContextVar("documents", default=None)
_has_document: ContextVar[bool] = ContextVar("has_document", default=False)
_VOLUMES = {"warning": Volume.QUIET, "note": Volume.NORMAL, "detail": Volume.VERBOSE}
_VERBOSE_PERIOD = 1.0  # s between lines of progress
_SPACE = r" +"
_JOINT, _JOINT_OF_HEADS = rf"(?<=[{notation.JOINTS}])| +", r"(?<=[-_])| +"
_BESIDE_BAR = 70  # columns of a progress line beside its bar: name, status, time


@contextmanager
def output(level: Volume, documents_alone: bool) -> Iterator[None]:
    """Within it commands say as much as this; standard output may be for documents only.

    What else is printed, such as by a user's own protocol, then goes to standard error.
    """
    before = _volume.set(level), _documents.set(sys.stdout if documents_alone else None)
    _has_document.set(False)
    try:
        with (
            warnings.catch_warnings(),
            redirect_stdout(sys.stderr) if documents_alone else nullcontext(),
        ):
            warnings.showwarning = _show_warning
            yield
    finally:
        _volume.reset(before[0])
        _documents.reset(before[1])


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """A library's words to the user as the program's own; others with their place, as usual."""
    if category is UserWarning:
        report("warning", str(message))
    else:
        text = warnings.formatwarning(message, category, filename, lineno, line)
        (file or sys.stderr).write(text)


def report_error(message: str) -> None:
    """An error message on standard error, the cure included; one line for each mistake."""
    for line in message.splitlines():
        sys.stderr.write(f"{_wrapped(f'rig: {line}', sys.stderr)}\n")


def report(level: Level, text: str) -> None:
    """One line on standard error, where that level is to be heard."""
    if _volume.get() >= _VOLUMES[level]:
        mark = "" if level == "detail" else f"{level}: "
        sys.stderr.write(f"{_wrapped(f'rig: {mark}{text}', sys.stderr)}\n")


def wait_for(text: str) -> bool:
    """Say what is to be done, and wait for Enter; False where nobody can answer."""
    sys.stderr.write(f"rig: {text} ")
    sys.stderr.flush()
    return bool(sys.stdin.readline())


def report_event(event: Event) -> None:
    """A note as loud as it is meant, without showing progress: a ``watch`` for what is quick."""
    if isinstance(event, Note):
        report(event.level, event.text)


def print_next(*commands: str, purpose: str = "") -> None:
    """Which commands a user may want now, and what the first is for."""
    if _volume.get() >= Volume.NORMAL:
        if purpose:
            print_text(purpose)
        for index, command in enumerate(commands):
            # A command is copied from one line, however the terminal shows it; a sentence is read.
            show = print if command.startswith("rig ") else print_text
            show(f"{'Then' if index else 'Next'}: {command}")


def print_steps(steps: Sequence[tuple[str, str]]) -> None:
    """What to do in this order, and what each is for, a numbered line each.

    On a terminal too narrow for that, what each is for stands below it.
    """
    if _volume.get() < Volume.NORMAL:
        return
    width = max(len(action) for action, _ in steps)
    lines = [f"{k}. {action:<{width}}  {purpose}" for k, (action, purpose) in enumerate(steps, 1)]
    if not sys.stdout.isatty() or max(map(len, lines)) <= shutil.get_terminal_size().columns:
        print(*lines, sep="\n")
        return
    for k, (action, purpose) in enumerate(steps, 1):
        print(f"{k}. {action}")
        print_text(f"   {purpose}")


def print_json(document: Any) -> None:
    """One JSON document; numbers JSON cannot hold become null."""
    out = _documents.get() or sys.stdout
    _has_document.set(True)
    out.write(json.dumps(plain(document), indent=2) + "\n")
    out.flush()


def print_json_error(mistakes: Iterable[Mistake], notes: Sequence[str], status: int) -> None:
    """The document of a command that failed, where one is asked for and it has printed none.

    Looked for among the words typed: a signal may end the command before they are understood.
    """
    if "--json" not in sys.argv or _has_document.get():
        return
    errors = [
        {
            "error": mistake.problem,
            "file": None if mistake.file is None else str(mistake.file),
            "line": mistake.line,
            "column": mistake.column,
            "key": mistake.key or None,
            "cure": mistake.cure or None,
        }
        for mistake in mistakes
    ]
    print_json({"exit_status": status, "errors": errors, "notes": notes})


def print_json_usage_error(error: Any) -> None:
    """The document of a command line that makes no sense; error: of Typer's, with its message."""
    parameter, context = getattr(error, "param", None), getattr(error, "ctx", None)
    key = getattr(error, "option_name", None) or getattr(parameter, "name", None)
    cure = "" if context is None else f"see {context.command_path} --help"
    mistake = Mistake(error.format_message(), cure, key=key or "")
    print_json_error([mistake], [], error.exit_code)


def print_text(text: str) -> None:
    """Sentences: on a terminal wrapped between words, its indent kept, in a pipe one line."""
    print(_wrapped(text, sys.stdout))


def _wrapped(text: str, stream: TextIO) -> str:
    if not stream.isatty():
        return text
    indent = " " * (len(text) - len(text.lstrip()))
    return textwrap.fill(
        text.strip(), shutil.get_terminal_size().columns, initial_indent=indent,
        subsequent_indent=indent, break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def print_table(
    title: str, head: Sequence[str], rows: Sequence[Sequence[str]], text: Sequence[str] = ()
) -> None:
    """A table: with rules on a terminal, in a pipe a line for each row however long.

    The first column and those named in ``text`` are text, the others numbers. On a narrow terminal
    heads and text are wrapped between words, long names behind a hyphen and such; nothing is cut.
    """
    words = [index == 0 or name in text for index, name in enumerate(head)]
    if not sys.stdout.isatty():
        print(title, *_piped([head, *rows], words), sep="\n")
        return
    from rich import box
    from rich.console import Console
    from rich.table import Table

    # A unit in brackets is no markup, nor is text between colons an emoji.
    console = Console(file=sys.stdout, highlight=False, markup=False, emoji=False)
    columns = [[name, *_lines(row[index] for row in rows)] for index, name in enumerate(head)]
    whole = [max(map(len, column)) for column in columns]
    narrow = sum(whole) + 3 * len(head) > console.width
    room = console.width - 2 * (len(head) - 1) - 1
    widths = _narrowed(columns, words, room) if narrow else whole
    table = Table(
        header_style="bold", pad_edge=False, padding=(0, 1, 0, 0) if narrow else (0, 1),
        box=box.SIMPLE_HEAD, show_edge=not narrow,
    )  # fmt: skip
    for name, width, is_text in zip(head, widths, words, strict=True):
        table.add_column(
            _folded_head(name, width), width=width, overflow="fold",
            justify="left" if is_text else "right",
        )  # fmt: skip
    for row in rows:
        table.add_row(*map(_cell, row, widths))
    # Where even the longest words have no room, the terminal breaks the lines.
    console.width = max(console.width, sum(widths) + 3 * len(head))
    # Above the table rather than in it, where a long title would wrap to the table's width.
    console.print(_wrapped(title, sys.stdout), style="bold", soft_wrap=True)
    blank = "\n" if narrow else ""  # which the edges are otherwise
    console.print(blank, end="")
    console.print(table)
    console.print(blank, end="")


def _piped(rows: Iterable[Sequence[str]], words: Sequence[bool]) -> list[str]:
    """Lines of a table, its head first; words: the columns that are text, the others numbers."""
    columns = []
    for cells, is_text in zip(zip(*rows, strict=True), words, strict=True):
        whole = [" ".join(cell.splitlines()) for cell in cells]
        width = max(map(len, whole))
        columns.append([cell.ljust(width) if is_text else cell.rjust(width) for cell in whole])
    head, *lines = (" " + "   ".join(row).rstrip() for row in zip(*columns, strict=True))
    return ["", head, " " + "─" * (max(map(len, (head, *lines))) - 1), *lines, ""]


def print_table_of_differences(
    title: str, head: Sequence[str], rows: Sequence[Sequence[str]], once: Sequence[str],
    text: Sequence[str] = (), spare: Sequence[str] = (), elsewhere: str = "",
) -> None:  # fmt: skip
    """A table; on a terminal, which has little room, without columns of ``once`` that are alike.

    What they are in all rows is said behind the title. Of the columns of ``spare`` the longest are
    left out there as well, until the others need no folding; elsewhere: what shows them all.
    """
    alike: list[int] = []
    if sys.stdout.isatty():
        columns = [k for k, name in enumerate(head) if name in once]
        alike = [k for k in columns if len({row[k] for row in rows}) == 1]
        title += "".join(f"; {head[k]} {rows[0][k]}" for k in alike)
    kept = [k for k in range(len(head)) if k not in alike]
    if sys.stdout.isatty():
        widths = [max(map(len, _lines(column))) for column in zip(head, *rows, strict=True)]
        left_out = _beyond_width(kept, widths, [k for k in kept if head[k] in spare])
        kept = [k for k in kept if k not in left_out]
        if left_out:
            names = ", ".join(head[k] for k in left_out)
            report("note", f"no room for {names}: {elsewhere}")
    print_table(title, [head[k] for k in kept], [[row[k] for k in kept] for row in rows], text)


def _beyond_width(kept: Sequence[int], widths: Sequence[int], spare: Sequence[int]) -> list[int]:
    """The longest of the spare columns that a terminal has no room for, of those kept."""
    whole, left_out = sum(widths[k] + 3 for k in kept), list[int]()
    for longest in sorted(spare, key=lambda k: -widths[k]):
        if whole <= shutil.get_terminal_size().columns:
            break
        whole -= widths[longest] + 3
        left_out.append(longest)
    return left_out


def _lines(cells: Iterable[str]) -> list[str]:
    return [line for cell in cells for line in cell.split("\n")]


def _narrowed(columns: Sequence[Sequence[str]], words: Sequence[bool], room: int) -> list[int]:
    """Widths of columns, heads first, within the room: numbers and words stay whole if they can.

    Else names are wrapped at their joints, those of heads first, and if that is not enough cells of
    numbers between them.
    """
    joints = [
        (_SPACE, None, _SPACE),
        (_SPACE, None, _JOINT_OF_HEADS),
        (_JOINT, None, _JOINT_OF_HEADS),
        (_JOINT, _SPACE, _JOINT_OF_HEADS),
    ]
    for text, numbers, heads in joints:
        widths = []
        for cells, is_text in zip(columns, words, strict=True):
            joint = text if is_text else numbers
            parts = [part for cell in cells[1:] for part in _parts(cell, joint)]
            widths.append(max(map(len, [*parts, *_parts(cells[0], heads)]), default=0))
        if sum(widths) <= room:
            break
    # What is left goes to text first, which is wrapped in every row, the least lacking before.
    lacking = [max(map(len, cells)) - width for cells, width in zip(columns, widths, strict=True)]
    for index in sorted(range(len(columns)), key=lambda i: (not words[i], lacking[i])):
        widths[index] += min(max(room - sum(widths), 0), lacking[index])
    return widths


def _parts(text: str, joint: str | None) -> list[str]:
    """Pieces of a text, which may be wrapped at this pattern; the whole of it without one."""
    return [text] if joint is None else [part for part in re.split(joint, text) if part]


def _folded(text: str, width: int, joint: str) -> str:
    """A text on lines no wider than that, as far as its parts allow."""
    if len(text) <= width:
        return text
    lines = [""]
    for part in _parts(text, joint):
        between = " " if lines[-1] and lines[-1][-1] not in notation.JOINTS else ""
        if len(lines[-1] + between + part) <= width or not lines[-1]:
            lines[-1] += between + part
        else:
            lines.append(part)
    return "\n".join(lines)


def _folded_head(name: str, width: int) -> str:
    """A head on lines no wider than that, broken at joints only where its words are too long."""
    is_narrow = max(map(len, _parts(name, _SPACE)), default=0) > width
    return _folded(name, width, _JOINT_OF_HEADS if is_narrow else _SPACE)


def _cell(text: str, width: int) -> str:
    """A cell whose long names are wrapped at their joints; its words the table wraps."""
    return re.sub(r"\S+", lambda word: _folded(word[0], width, _JOINT), text)


@contextmanager
def watching(quiet: bool) -> Iterator[Watch]:
    """Shows what a use case says while it works, by the function to give it as ``watch``.

    Progress is a bar on a terminal, one plain line per finished activity otherwise; quiet: notes
    and warnings only. Notes end the bars before them, and each is shown once, however many runs
    of a characterisation give rise to it; an activity that an error ended is not shown as finished.
    """
    update: Callable[[Progress], None] | None = None
    seen: set[Note] = set()

    def show(event: Event) -> None:
        nonlocal update
        if isinstance(event, Progress):
            update = update or display.enter_context(_progress(quiet))
            update(event)
            return
        if event in seen:
            return
        update = None
        display.close()
        if isinstance(event, Note):
            seen.add(event)
            report(event.level, event.text)
        elif not quiet:
            report("note", event.title)

    with ExitStack() as display:
        yield show


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """How far activities are, by a function to call as often as one likes."""
    if quiet or _volume.get() == Volume.QUIET:
        yield ignore
    elif sys.stderr.isatty():
        with _bars() as update:
            yield update
    else:
        lines = _PlainLines()
        yield lines.update
        lines.finish()


class _PlainLines:
    """One line per activity when it is finished, and some meanwhile for those who want more."""

    def __init__(self) -> None:
        self._activity = self._text = ""
        self._started = self._written = time.perf_counter()

    def update(self, step: Progress) -> None:
        now = time.perf_counter()
        if step.activity != self._activity:
            self.finish()
            self._activity, self._started = step.activity, now
        self._text = f"{step.activity}: {step.status}"
        if _volume.get() == Volume.VERBOSE and now - self._written > _VERBOSE_PERIOD:
            self._written = now
            sys.stderr.write(f"{self._text} ...\n")

    def finish(self) -> None:
        if self._activity:
            seconds = time.perf_counter() - self._started
            sys.stderr.write(f"{self._text} ({seconds:.2f} s)\n")
        self._activity = ""


@contextmanager
def _bars() -> Iterator[Callable[[Progress], None]]:
    from rich import progress
    from rich.console import Console
    from rich.text import Text

    class Taken(progress.ProgressColumn):
        """How long an activity takes, or took."""

        def render(self, task: progress.Task) -> Text:
            seconds = task.elapsed if task.finished_time is None else task.finished_time
            minutes, rest = divmod(seconds or 0.0, 60.0)
            return Text(f"{minutes:.0f}:{int(rest):02} min" if minutes else f"{rest:.1f} s")

    console = Console(file=sys.stderr)
    columns = [
        progress.TextColumn("{task.description:<20}"),
        progress.BarColumn(bar_width=max(2, min(30, console.width - _BESIDE_BAR))),
        progress.TextColumn("{task.fields[note]}"),
        Taken(),
    ]
    if console.width >= _BESIDE_BAR + 22:
        columns += [progress.TextColumn("[dim]left"), progress.TimeRemainingColumn()]
    with progress.Progress(*columns, console=console) as bars:
        tasks: dict[str, progress.TaskID] = {}
        latest = ""

        def update(step: Progress) -> None:
            nonlocal latest
            name, total, note = step.activity, step.total, step.status
            if name != latest:
                end()
                if name in tasks:
                    bars.reset(tasks[name])  # what begins anew
                latest = name
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=total, note=note)
            bars.update(tasks[name], completed=step.done, total=total, note=note)

        def end() -> None:
            """One activity is over when the next begins, however early: its bar is full then."""
            if latest:
                bars.update(tasks[latest], total=1, completed=1)

        yield update
        end()
