"""Lanes: how many chromosomes one block of the batch simulator holds, and where they live."""

import numpy as np

from sysid.arrays import FloatArray

LANES = 16


def work_area(size: int) -> FloatArray:
    """Floats starting on a cache line: vector loads that straddle lines take twice as long."""
    raw = np.empty(size + 8)
    start = (-raw.ctypes.data % 64) // 8
    return raw[start : start + size]
