"""Studies: one function of many things (seeds, hidden rigs, logs), over cores or machines.

Whatever joblib runs on, a study runs on: the cores of this machine by ``n_jobs``, a dask cluster by
``joblib.parallel_config(backend="dask")`` around the call. A machine that is lost costs what it was
at; a cluster does that again elsewhere.
"""

from __future__ import annotations

import functools
import os
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sysid.campaigns.parcels import pack, unpack
from sysid.problem.model import ModelError

_LOOK_EVERY = 0.5  # s between two looks of a worker at whether it is still wanted


@dataclass(frozen=True)
class StudyResult:
    """What became of one thing: the function's value, or the problem that kept it from one.

    >>> StudyResult(item=3, value=9, seconds=0.1).problem
    ''
    """

    item: Any
    value: Any
    seconds: float
    problem: str = ""


@dataclass(frozen=True)
class Study:
    """Results in the order of the things; without those that Ctrl-C left undone.

    >>> Study((StudyResult(3, 9, 0.1), StudyResult(4, None, 0.1, "ValueError: no"))).values
    [9]
    """

    results: tuple[StudyResult, ...]
    interrupted: bool = False

    @property
    def values(self) -> list[Any]:
        """What the function gave of those that had no problem."""
        return [result.value for result in self.results if not result.problem]

    @property
    def failed(self) -> tuple[StudyResult, ...]:
        """The results that have a problem in place of a value."""
        return tuple(result for result in self.results if result.problem)


def study(
    function: Callable[[Any], Any],
    items: Iterable[Any],
    *,
    n_jobs: int | None = None,
    on_result: Callable[[StudyResult], None] | None = None,
) -> Study:
    """Call a function of every item, several at a time, in other processes.

    n_jobs: processes, -1 for all cores; default what ``joblib.parallel_config`` says, else this
    one. What the function refers to and no package holds travels with it. An item that fails is
    kept with its problem. on_result: called with each result as it comes. Raises ModelError when
    there is nothing to do, or the function cannot be sent to another process.

    >>> study(lambda seed: seed**2, range(4)).values
    [0, 1, 4, 9]
    """
    import joblib

    todo = list(items)
    if not todo:
        raise ModelError("a study needs at least one item")
    parcel = pack("the study's function", function)
    jobs = [
        joblib.delayed(_call)(place, parcel, pack("an item", item), os.getpid())
        for place, item in enumerate(todo)
    ]
    results: dict[int, StudyResult] = {}

    def take(answer: bytes) -> None:
        place, value, seconds, problem = unpack(answer)
        results[place] = StudyResult(todo[place], value, seconds, problem)
        if on_result is not None:
            on_result(results[place])

    interrupted, problem = work_through(jobs, n_jobs, take)
    if not interrupted:
        for place in set(range(len(todo))) - set(results):
            results[place] = StudyResult(todo[place], None, 0.0, problem)
    return Study(tuple(results[place] for place in sorted(results)), interrupted)


def work_through(
    jobs: Sequence[Any], n_jobs: int | None, take: Callable[[Any], None]
) -> tuple[bool, str]:
    """Hand the result of each of joblib's jobs to ``take`` as it comes, until Ctrl-C.

    Whether that ended it, and the problem that did otherwise.
    """
    results = _parallel(n_jobs)(jobs)
    try:
        for result in results:
            take(result)
    except KeyboardInterrupt:
        return True, ""
    except Exception as error:
        # A worker that died, or one that lacks something, takes the others with it.
        return False, described(error)
    finally:
        if isinstance(results, Generator):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that some were not finished, which is known
                results.close()
    return False, ""


@functools.cache
def end_with(caller: int) -> None:
    """If this is a process of the caller's, end it when that is gone, even by ``kill -9``."""

    def watch() -> None:
        while os.getppid() == caller:
            time.sleep(_LOOK_EVERY)
        os._exit(1)

    if os.getppid() == caller:
        threading.Thread(target=watch, daemon=True).start()


def described(error: Exception) -> str:
    """An error in one line."""
    return str(error) if isinstance(error, ModelError) else f"{type(error).__name__}: {error}"


# The same object for all jobs of a worker, so that kernels of what it holds are made once.
unpack_once = functools.lru_cache(maxsize=8)(unpack)


def _call(place: int, function: bytes, item: bytes, caller: int) -> bytes:
    """A worker's part."""
    end_with(caller)
    started, value, problem = time.perf_counter(), None, ""
    try:
        value = unpack_once(function)(unpack(item))
    except Exception as error:
        problem = described(error)
    return pack("a result", (place, value, time.perf_counter() - started, problem))


def _parallel(n_jobs: int | None) -> Any:
    """joblib's Parallel that hands out results as they come, where its backend can."""
    import joblib

    # Each run by itself: a batch of several would only be finished as a whole.
    try:
        return joblib.Parallel(n_jobs, batch_size=1, return_as="generator_unordered")
    except ValueError:
        return joblib.Parallel(n_jobs, batch_size=1)
