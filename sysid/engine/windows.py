"""Outputs as a sensor shows them that averages over a while before it is read."""

import math

import numpy as np
from numba import njit

from sysid.arrays import FloatArray

_INSTANT = 1e-6  # samples that no window is shorter than, unless it is an instant


@njit(cache=True, nogil=True)
def average(outputs: FloatArray, windows: FloatArray) -> FloatArray:
    """An output with each sample its mean over a window, (n_samples, n_lanes).

    outputs: (n_samples, n_lanes), straight between samples. windows: (n_samples, 2), begin and end
    in samples from the sample on; a window of no length is an instant. What would be outside of
    the record is cut off.
    """
    n = len(outputs)
    area = np.zeros_like(outputs)  # under the output until each sample
    for k in range(1, n):
        area[k] = area[k - 1] + 0.5 * (outputs[k - 1] + outputs[k])
    means = np.empty_like(outputs)
    for k in range(n):
        begin = min(max(k + windows[k, 0], 0.0), n - 1.0)
        end = min(max(k + windows[k, 1], 0.0), n - 1.0)
        i, j = min(math.floor(begin), n - 2), min(math.floor(end), n - 2)
        a, b = begin - i, end - j
        if end - begin < _INSTANT:
            means[k] = (1.0 - b) * outputs[j] + b * outputs[j + 1]
            continue
        before = area[i] + a * ((1.0 - 0.5 * a) * outputs[i] + 0.5 * a * outputs[i + 1])
        until = area[j] + b * ((1.0 - 0.5 * b) * outputs[j] + 0.5 * b * outputs[j + 1])
        means[k] = (until - before) / (end - begin)
    return means
