"""Figures made into files by two processes: another one beside this.

Drawing is Python's work, of which a process does one thing at a time.
"""

from __future__ import annotations

import contextlib
import pickle
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import IO, TYPE_CHECKING, Any, Self, cast

from sysid.threads import available_cores

if TYPE_CHECKING:
    from daq.report.page import Picture

Files = dict[str, bytes]  # contents by format

_AHEAD = 2  # figures that the other process has before it, so that it never waits for one
# The other one imports from where this one does, whatever folder it is in.
_START = "import sys; sys.path[:] = sys.argv[1:]; from daq.report.renderer import serve; serve()"


class Renderer:
    """Renders figures in this process and in another, which starts at once and ends with it.

    Without a second core, or where no process can be started, all is done here; alone: anyway.
    """

    def __init__(self, *, alone: bool = False) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._correspondent = ThreadPoolExecutor(1)
        if not alone and available_cores() > 1 and sys.executable:
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

    def rendered(
        self, pictures: Iterable[Picture], formats: Sequence[str]
    ) -> Iterator[tuple[Picture, Files]]:
        """Pictures with their files, in order, each soon after it is drawn."""
        waiting: deque[tuple[Picture, Future[Files]]] = deque()
        for picture in pictures:
            waiting.append((picture, self._begun(picture, formats, waiting)))
            while waiting and waiting[0][1].done():
                yield _awaited(*waiting.popleft(), formats)
        while waiting:
            yield _awaited(*waiting.popleft(), formats)

    def _begun(
        self,
        picture: Picture,
        formats: Sequence[str],
        waiting: Iterable[tuple[Picture, Future[Files]]],
    ) -> Future[Files]:
        """The files of a picture, by whichever process is free."""
        if self._process is not None and sum(not job.done() for _, job in waiting) < _AHEAD:
            # What a model's own figure holds need not be what can be sent.
            with contextlib.suppress(pickle.PicklingError, AttributeError, TypeError):
                request = pickle.dumps((picture.figure, list(formats)))
                return self._correspondent.submit(_exchanged, self._process, request)
        here: Future[Files] = Future()
        here.set_result(_render(picture.figure, formats))
        return here


def serve() -> None:
    """Render the figures that come on standard input, until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that sends them
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    while True:
        try:
            figure, formats = pickle.load(requests)
        except EOFError:
            return
        pickle.dump(_render(figure, formats), answers)
        answers.flush()


def _render(figure: Any, formats: Sequence[str]) -> Files:
    from daq.figures import style  # imports matplotlib, for which a Renderer's start does not wait

    return {kind: style.render(figure, kind) for kind in formats}


def _exchanged(process: subprocess.Popen[bytes], request: bytes) -> Files:
    requests, answers = cast(IO[bytes], process.stdin), cast(IO[bytes], process.stdout)
    requests.write(request)
    requests.flush()
    return cast(Files, pickle.load(answers))


def _awaited(picture: Picture, job: Future[Files], formats: Sequence[str]) -> tuple[Picture, Files]:
    """A picture and its files, rendered here if the other process has ended."""
    try:
        return picture, job.result()
    except (OSError, EOFError, pickle.UnpicklingError):
        return picture, _render(picture.figure, formats)
