"""Another process for what can be done beside this one.

What a report takes is mostly Python's work, of which a process does one thing at a time.
"""

from __future__ import annotations

import contextlib
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import IO, Any, Generic, Self, TypeVar, cast

from sysid.threads import available_cores

# It imports from where this one does, whatever folder it is in.
_START = "import sys; sys.path[:] = sys.argv[1:]; from daq.second_process import serve; serve()"

Result = TypeVar("Result")


@dataclass(frozen=True)
class Job(Generic[Result]):
    """A call of a function that may have been taken on by the other process."""

    function: Callable[..., Result]
    arguments: tuple[Any, ...]
    answer: Future[Result] | None = None

    @property
    def pending(self) -> bool:
        """Whether the other process has not answered yet."""
        return self.answer is not None and not self.answer.done()

    @property
    def is_answered(self) -> bool:
        """Whether the other process has taken it on, and is done with it."""
        return self.answer is not None and self.answer.done()

    def result(self) -> Result:
        """What the function returns: of the other process, or if that has ended of this one."""
        if self.answer is not None:
            with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError, CancelledError):
                return self.answer.result()
        return self.function(*self.arguments)


class SecondProcess:
    """A process that starts at once and ends with its context, and does one job after another.

    Without a second core, or where no process can be started, jobs are left to this one.

    >>> with SecondProcess() as second:
    ...     second.call(divmod, 7, 2).result()
    (3, 1)
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._correspondent = ThreadPoolExecutor(1)
        if available_cores() > 1 and sys.executable:
            with contextlib.suppress(OSError):
                self._process = subprocess.Popen(
                    [sys.executable, "-c", _START, *sys.path], stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
        self._correspondent.shutdown(cancel_futures=True)  # it hears that the process is gone
        if self._process is not None:
            self._process.communicate()

    def call(self, function: Callable[..., Result], *arguments: Any) -> Job[Result]:
        """Have it call a module's function, if what it is given can be sent."""
        answer = None
        if self._process is not None:
            # What a model's own figure holds need not be.
            with contextlib.suppress(pickle.PicklingError, AttributeError, TypeError):
                request = pickle.dumps((function, arguments))
                answer = self._correspondent.submit(_exchanged, self._process, request)
        return Job(function, arguments, answer)


def done(result: Result) -> Job[Result]:
    """A job of which there is the result already."""
    answer: Future[Result] = Future()
    answer.set_result(result)
    return Job(lambda: result, (), answer)


def serve() -> None:
    """Do the jobs that come on standard input, until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that sends them
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    with contextlib.suppress(EOFError):
        while True:
            function, arguments = pickle.load(requests)
            pickle.dump(function(*arguments), answers)
            answers.flush()


def _exchanged(process: subprocess.Popen[bytes], request: bytes) -> Any:
    requests, answers = cast(IO[bytes], process.stdin), cast(IO[bytes], process.stdout)
    requests.write(request)
    requests.flush()
    return pickle.load(answers)
