"""Outputs as a sensor shows them that averages over a while before it is read."""

import math

import numpy as np
from numba import njit

from sysid.arrays import FloatArray


@njit(cache=True, nogil=True)
def average(outputs: FloatArray, windows: FloatArray) -> FloatArray:
    """An output with each sample its mean over a window, (n_samples, n_lanes).

    outputs: (n_samples, n_lanes), straight between samples. windows: (n_samples, 2), begin and end
    in samples from the sample on; a window of no length is an instant. What would be outside of
    the record is cut off.
    """
    n, lanes = outputs.shape
    area = np.empty((n, lanes))  # under the output until each sample
    area[0] = 0.0
    for k in range(1, n):
        for lane in range(lanes):
            area[k, lane] = area[k - 1, lane] + 0.5 * (outputs[k - 1, lane] + outputs[k, lane])
    seen = np.empty((n, lanes))
    for k in range(n):
        begin, end = (min(max(k + windows[k, i], 0.0), n - 1.0) for i in range(2))
        i, j = min(math.floor(begin), n - 2), min(math.floor(end), n - 2)
        a, b = begin - i, end - j
        for lane in range(lanes):
            if end - begin < 1e-6:
                seen[k, lane] = outputs[j, lane] + b * (outputs[j + 1, lane] - outputs[j, lane])
            else:
                before = a * (outputs[i, lane] + 0.5 * a * (outputs[i + 1, lane] - outputs[i, lane]))
                until = b * (outputs[j, lane] + 0.5 * b * (outputs[j + 1, lane] - outputs[j, lane]))
                seen[k, lane] = (area[j, lane] + until - area[i, lane] - before) / (end - begin)
    return seen
