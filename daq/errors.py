"""Errors that a user can meet: what is wrong, where it stands, and the cure.

The parts of a message are fields of a ``Mistake``; its text is made once, where it is shown.
"""

from __future__ import annotations

import difflib
import inspect
import os
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

_PACKAGES = ("daq", "haptics", "protocols", "sim_rig", "sysid")  # of this program

USER_CODE_ERRORS = (Exception, SystemExit)
"""What code of a user's own may raise without meaning to end the program."""


@dataclass(frozen=True)
class Mistake:
    """Something wrong that a user can mend.

    problem: what is wrong. cure: what to do about it. file, line, column: where, counted from 1.
    key: dotted name of a setting, or the option as it was typed.

    >>> Mistake("it must be above 0", "write 0.5", Path("rig.yaml"), 3, 5, "limits.speed").text
    'rig.yaml:3:5: limits.speed: it must be above 0; write 0.5'
    """

    problem: str
    cure: str = ""
    file: Path | str | None = None
    line: int | None = None
    column: int | None = None
    key: str = ""

    @property
    def place(self) -> str:
        """``FILE:LINE:COLUMN`` with the parts that are there."""
        parts = (self.file, self.line, self.column)
        return ":".join(str(part) for part in parts if part is not None)

    @property
    def text(self) -> str:
        """``FILE:LINE:COLUMN: KEY: PROBLEM; CURE`` with the parts that are there."""
        sentence = "; ".join(filter(None, (self.problem, self.cure)))
        return ": ".join(filter(None, (self.place, self.key, sentence)))

    def behind(self, place: Mistake) -> Mistake:
        """The mistake at another place, which names what its own place is part of.

        >>> unknown = Mistake("unknown protocol 'prbz'", "did you mean 'prbs'?")
        >>> unknown.behind(Mistake("", file="run.yaml", line=1, key="protocol")).text
        "run.yaml:1: protocol: unknown protocol 'prbz'; did you mean 'prbs'?"
        """
        return replace(place, problem=replace(self, cure="").text, cure=self.cure)


class RigError(Exception):
    """Base of all expected errors: one mistake or several, each with its cure.

    >>> error = ConfigError("unknown key", cure="did you mean 'rate'?", key="rata")
    >>> str(error), error.cure
    ("rata: unknown key; did you mean 'rate'?", "did you mean 'rate'?")
    """

    exit_status = 1

    def __init__(
        self,
        problem: str,
        *,
        cure: str = "",
        file: Path | str | None = None,
        line: int | None = None,
        column: int | None = None,
        key: str = "",
    ) -> None:
        super().__init__(problem)
        self.mistakes: tuple[Mistake, ...] = (Mistake(problem, cure, file, line, column, key),)

    @classmethod
    def of(cls, mistakes: Iterable[Mistake]) -> Self:
        """An error of one mistake or more."""
        several = tuple(mistakes)
        error = cls(several[0].problem)
        error.mistakes = several
        return error

    def __str__(self) -> str:
        return "\n".join(mistake.text for mistake in self.mistakes)

    @property
    def cure(self) -> str:
        """What to do about the first mistake; empty without one."""
        return self.mistakes[0].cure

    @property
    def file(self) -> Path | str | None:
        """Where the first mistake stands."""
        return self.mistakes[0].file

    @property
    def line(self) -> int | None:
        """Line of the first mistake, counted from 1."""
        return self.mistakes[0].line

    @property
    def key(self) -> str:
        """Setting that the first mistake is about; empty without one."""
        return self.mistakes[0].key


class ConfigError(RigError):
    """Wrong usage, configuration or input file: nothing was energised (exit status 2).

    >>> str(ConfigError("it must be above 0", cure="write 0.5", file="rig.yaml", line=3))
    'rig.yaml:3: it must be above 0; write 0.5'
    """

    exit_status = 2


class DeviceError(RigError):
    """The device failed or cannot do what was asked."""


class UnreachedError(DeviceError):
    """Nobody was reached: nothing was asked of any device, so that a run has not begun."""


class RunError(RigError):
    """A run ended before its time; the log holds what was measured until then."""


class InterlockError(RunError):
    """A measured quantity passed its limit; the device was told to zero its outputs."""


class IncompleteError(RunError):
    """More samples of a run are missing than may be."""


class Terminated(BaseException):
    """The process was asked to end by the named signal; raised so that the rig is made safe first.

    ``str`` of it is the signal's name, for example SIGTERM.
    """


def together(*steps: Callable[[], Any]) -> list[Any]:
    """What each step returns; one ConfigError with the mistakes of all of them."""
    results: list[Any] = []
    mistakes: dict[str, Mistake] = {}  # by text: each once
    for step in steps:
        try:
            results.append(step())
        except ConfigError as error:
            mistakes |= {mistake.text: mistake for mistake in error.mistakes}
    if mistakes:
        raise ConfigError.of(mistakes.values())
    return results


def suggestion(name: str, candidates: Sequence[str]) -> str:
    """The cure for a misspelt name: the nearest candidate, or all of them.

    >>> suggestion("chrip", ["chirp", "prbs"]), suggestion("x", ["chirp", "prbs"])
    ("did you mean 'chirp'?", 'known are chirp, prbs')
    """
    near = difflib.get_close_matches(name, candidates, n=1, cutoff=0.6)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"known are {', '.join(sorted(candidates))}" if candidates else "none are known"


def line_in(error: BaseException, file: Path) -> int | None:
    """The last line of a file that an error passed through; None where it did not."""
    steps = traceback.walk_tb(error.__traceback__)
    lines = [line for frame, line in steps if same_file(frame.f_code.co_filename, file)]
    return lines[-1] if lines else None


def same_file(name: str | None, path: Path) -> bool:
    """Whether the name of a file in an error means a path."""
    return name is not None and Path(name).resolve() == path.resolve()


def raised_in(kind: type, error: BaseException) -> str:
    """`` (FILE:LINE)``, the last line of a class's own file that an error passed through.

    Empty where it passed through none, or where the class comes with this program.
    """
    if kind.__module__.partition(".")[0] in _PACKAGES:
        return ""
    try:
        file = Path(inspect.getfile(kind)).resolve()
    except (OSError, TypeError):
        return ""
    # Of an editable install the clone, users' files beside.
    installed = Path(__file__).resolve().parents[1]
    if any(file.is_relative_to(installed / package) for package in _PACKAGES):
        return ""
    line = line_in(error, file)
    return f" ({nearby(file)}:{line})" if line is not None else ""


def nearby(path: str | Path) -> str:
    """A path, or ``FILE.py:CLASS``, as it is typed in the working folder; whole outside of it."""
    return str(path).removeprefix(f"{Path.cwd()}{os.sep}")
