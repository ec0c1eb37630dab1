"""Who gets the processor's cores: simulations all of them, linear algebra one."""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

R = TypeVar("R")


@contextmanager
def one_thread() -> Iterator[None]:
    """Within it, or a function it decorates, linear algebra keeps to one thread.

    Matrices this narrow gain nothing from several, and lose much on a busy machine, where those
    that share one wait for each other.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


def available_cores() -> int:
    """Cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Workers:
    """So many threads, the calling one included, that wait for tasks from call to call."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def each(self, function: Callable[[Any], None], tasks: Sequence[Any]) -> None:
        """Run a function on every task, each thread taking the next one when it is free."""
        queue = iter(tasks)  # hands each task out once, to whichever thread

        def work() -> None:
            for task in queue:
                function(task)

        # This thread is one of them: waking another takes as long as a short simulation.
        others = min(self.count, len(tasks)) - 1
        try:
            workers = [self._ready().submit(work) for _ in range(others)]
        except BaseException:
            # Ctrl-C: a thread that was just begun may not be known to the pool, which would then
            # never be told to end, and the program would wait for it.
            if self._pool is not None:
                self._pool.shutdown(wait=False)
                self._pool = None
            raise
        try:
            work()
            for worker in workers:
                # One that has not woken yet has nothing left to do.
                if not worker.cancel():
                    worker.result()
        finally:
            deque(queue, maxlen=0)  # after an interrupt nothing more is begun

    def results(self, function: Callable[[Any], R], tasks: Sequence[Any]) -> list[R]:
        """What a function returns of every task, in their order."""
        results: dict[int, R] = {}

        def run(place: int) -> None:
            results[place] = function(tasks[place])

        self.each(run, range(len(tasks)))
        return [results[place] for place in range(len(tasks))]

    def _ready(self) -> ThreadPoolExecutor:
        # A forked process inherits the pool without its threads.
        if self._pool is None or self._process != os.getpid():
            self._pool = ThreadPoolExecutor(max(self.count - 1, 1))
            self._process = os.getpid()
        return self._pool
