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
    n, lanes = outputs.shape
    area = np.zeros((n, lanes))  # under the output until each sample
    for k in range(1, n):
        for lane in range(lanes):
            step = 0.5 * (outputs[k - 1, lane] + outputs[k, lane])
            area[k, lane] = area[k - 1, lane] + step
    means = np.empty((n, lanes))
    for k in range(n):
        begin = min(max(k + windows[k, 0], 0.0), n - 1.0)
        end = min(max(k + windows[k, 1], 0.0), n - 1.0)
        i, j = min(math.floor(begin), n - 2), min(math.floor(end), n - 2)
        a, b = begin - i, end - j
        if end - begin < _INSTANT:
            for lane in range(lanes):
                means[k, lane] = (1.0 - b) * outputs[j, lane] + b * outputs[j + 1, lane]
            continue
        # Weights of the two samples on either side of each end in the area up to it.
        a0, a1 = a * (1.0 - 0.5 * a), 0.5 * a * a
        b0, b1 = b * (1.0 - 0.5 * b), 0.5 * b * b
        part = 1.0 / (end - begin)
        for lane in range(lanes):
            before = area[i, lane] + a0 * outputs[i, lane] + a1 * outputs[i + 1, lane]
            until = area[j, lane] + b0 * outputs[j, lane] + b1 * outputs[j + 1, lane]
            means[k, lane] = part * (until - before)
    return means


@njit(cache=True, nogil=True)
def compared(outputs: FloatArray, measured: FloatArray, weights: FloatArray) -> FloatArray:
    """Sums of squares, (n_outputs, n_lanes), of residuals, which outputs become in their place.

    outputs: (n_samples, n_outputs, n_lanes). measured, weights: (n_samples, n_outputs).
    """
    n, n_outputs, lanes = outputs.shape
    sums = np.zeros((n_outputs, lanes))
    for k in range(n):
        for j in range(n_outputs):
            y, weight = measured[k, j], weights[k, j]
            for lane in range(lanes):
                residual = (outputs[k, j, lane] - y) * weight
                outputs[k, j, lane] = residual
                sums[j, lane] += residual * residual
    return sums
