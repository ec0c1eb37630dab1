"""What the kernels of all models need, compiled once."""

import math

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.intrinsics import shared

_SQUARINGS = 4


@shared("f8(f8[:, ::1], f8[:, ::1])")
def fastest_rate(J: FloatArray, T: FloatArray) -> float:
    """||J^16||^(1/16), a bound on J's spectral radius that is tight to a few per cent.

    J: (n, n), overwritten; T: (n, n), to work in. Infinite for a J that is not finite.
    """
    n = len(J)
    exponent = 0.0
    for squaring in range(_SQUARINGS + 1):
        norm = 0.0
        for i in range(n):
            for j in range(n):
                norm += J[i, j] * J[i, j]
        norm = math.sqrt(norm)
        if norm == 0.0:
            return 0.0
        if not math.isfinite(norm):
            return math.inf
        exponent += math.log(norm) / 2.0**squaring
        if squaring == _SQUARINGS:
            break
        for i in range(n):
            for j in range(n):
                J[i, j] /= norm
        for i in range(n):
            for j in range(n):
                t = 0.0
                for q in range(n):
                    t += J[i, q] * J[q, j]
                T[i, j] = t
        J, T = T, J
    return math.exp(exponent)


@shared("f8[:, ::1](i8, i8)")
def zeros(rows: int, columns: int) -> FloatArray:
    """A table of zeros."""
    return np.zeros((rows, columns))


@shared("f8[::1](i8, f8)")
def filled(n: int, value: float) -> FloatArray:
    """A row of n times a value."""
    return np.full(n, value)


PARTS = (fastest_rate, zeros, filled)
