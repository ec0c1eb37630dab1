"""Who gets the processor's cores: simulations all of them, linear algebra one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]


@contextmanager
def one_thread() -> Iterator[None]:
    """Within it, or a function it decorates, linear algebra keeps to one thread.

    Matrices this narrow gain nothing from several, and lose much on a busy machine, where those
    that share one wait for each other.
    """
    with threadpool_limits(1, user_api="blas"):
        yield
