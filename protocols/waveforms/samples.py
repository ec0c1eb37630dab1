"""Times as numbers of samples, and the rise from zero."""

import math

import numpy as np

from daq.hal import FloatArray


def smooth_rise(n: int) -> FloatArray:
    """Raised cosine from 0 to 1 in n samples, both ends left out, (n,)."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(1, n + 1) / (n + 1))


def whole_samples(key: str, seconds: float, sample_rate: float) -> int:
    """Samples in a time [s] that must be a whole number of them, one or more.

    Raises ValueError that names the key and the nearest times that are.
    """
    samples = seconds * sample_rate
    nearest = max(1, round(samples))
    if math.isclose(samples, nearest, rel_tol=1e-9):
        return nearest
    neighbours = sorted({max(1, math.floor(samples)), max(1, math.ceil(samples))})
    near = " or ".join(f"{n / sample_rate:.10g}" for n in neighbours)
    raise ValueError(
        f"{key}: {seconds:g} s is {samples:.6g} samples at {sample_rate:g} Hz, not a whole "
        f"number; the nearest that are: {near} s"
    )
