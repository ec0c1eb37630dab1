"""Counts without an end, of a counter that runs over."""

import numpy as np

from daq.hal import IntArray


class Counter:
    """A counter that begins anew after ``span`` counts.

    >>> Counter(2**16).unwrapped(np.array([1, 0, 2**16 - 1])).tolist()
    [1, 0, -1]
    """

    def __init__(self, span: int) -> None:
        self._span = span
        self._last: int | None = None

    def unwrapped(self, counts: IntArray) -> IntArray:
        """The counts (n,) that follow those before: the nearer way round is taken for the true."""
        before = counts[0] if self._last is None else self._last
        half = self._span // 2
        steps = (np.diff(counts, prepend=before) + half) % self._span - half
        result: IntArray = before + np.cumsum(steps)
        self._last = int(result[-1])
        return result
