"""Outputs as a sensor shows them that averages over a while before it is read.

Between samples an output is the parabola through both with the mean that it has between them, of
which the simulation tells the integral: straight lines would cut its corners.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.problem.model import Output, ProcessModel, State, picker

# Of windows' ends within samples the sample, its part that has passed, the mean's row, the weight
# there of the area up to it, and whether the window is an instant, of the value itself.
Ends = tuple[IntArray, FloatArray, IntArray, FloatArray, BoolArray]

_INSTANT = 1e-6  # samples that no window is shorter than, unless it is an instant


def with_integrals(model: ProcessModel, places: Sequence[int]) -> ProcessModel:
    """The model with the integrals of the outputs at these places as further states and outputs.

    >>> from sysid.examples import lag
    >>> with_integrals(lag(), [0]).derivative((1.0, 0.0), (0.0,), (2.0, 0.5))
    (-2.0, 1.0)
    """
    return _with_integrals(model, tuple(places))


@functools.lru_cache(maxsize=8)  # one model for the same question: its kernels are kept by it
def _with_integrals(model: ProcessModel, places: tuple[int, ...]) -> ProcessModel:
    n, derivative, output = len(model.states), model.derivative, model.output
    chosen = [model.outputs[j] for j in places]
    names = [(f"integral of {signal.name}", f"{signal.unit}*s") for signal in chosen]
    if output is None:
        pick = picker([model.state_names.index(signal.name) for signal in chosen])
    else:
        pick = picker(places)

    def rates(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        plain = x[:n]
        values = plain if output is None else output(plain, u, p)
        return (*derivative(plain, u, p), *pick(values))

    def outputs(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        return (*output(x[:n], u, p), *x[n:])  # type: ignore[misc]

    return replace(
        model,
        states=model.states + tuple(State(*name, first_sample=False) for name in names),
        outputs=model.outputs + tuple(Output(*name) for name in names),
        derivative=rates,
        output=None if output is None else outputs,
    )


def _parabola(s: Any) -> tuple[Any, Any, Any]:
    """Weights in the parabola's value of both samples and of the area between them."""
    return 1.0 - 4.0 * s + 3.0 * s * s, -2.0 * s + 3.0 * s * s, 6.0 * s - 6.0 * s * s


def _area(s: Any) -> tuple[Any, Any, Any]:
    """The same in the area under it up to a part of the way."""
    s2, s3 = s * s, s * s * s
    return s - 2.0 * s2 + s3, -s2 + s3, 3.0 * s2 - 2.0 * s3


# Of one number in kernels; of arrays plain, for which a compiler would take a second.
_parabola_at: Any = njit(_parabola)
_area_at: Any = njit(_area)


@njit(cache=True, nogil=True)
def average(outputs: FloatArray, integrals: FloatArray, windows: FloatArray) -> FloatArray:
    """An output with each sample its mean over a window, (n_samples, n_lanes).

    outputs, integrals: (n_samples, n_lanes), these over the sample time. windows: (n_samples, 2),
    begin and end in samples from the sample on; a window of no length is an instant. What would
    be outside of the record is cut off.
    """
    n, lanes = outputs.shape
    means = np.empty((n, lanes))
    for k in range(n):
        begin = min(max(k + windows[k, 0], 0.0), n - 1.0)
        end = min(max(k + windows[k, 1], 0.0), n - 1.0)
        i, j = min(math.floor(begin), n - 2), min(math.floor(end), n - 2)
        a, b = begin - i, end - j
        if end - begin < _INSTANT:
            v0, v1, area = _parabola_at(b)
            for lane in range(lanes):
                change = integrals[j + 1, lane] - integrals[j, lane]
                means[k, lane] = v0 * outputs[j, lane] + v1 * outputs[j + 1, lane] + area * change
            continue
        a0, a1, area_a = _area_at(a)
        b0, b1, area_b = _area_at(b)
        part = 1.0 / (end - begin)
        for lane in range(lanes):
            change = integrals[i + 1, lane] - integrals[i, lane]
            before = a0 * outputs[i, lane] + a1 * outputs[i + 1, lane] + area_a * change
            change = integrals[j + 1, lane] - integrals[j, lane]
            until = b0 * outputs[j, lane] + b1 * outputs[j + 1, lane] + area_b * change
            between = integrals[j, lane] - integrals[i, lane]
            means[k, lane] = part * (between + until - before)
    return means


def weights_of_mean(windows: FloatArray) -> FloatArray:
    """Weights (n_samples, 3) of what has been since the sample before in each sample's mean.

    Of the output at that sample, of the output at this one and of the area between, over the
    sample time. windows: (n_samples, 2), as of ``average``; of each the part that lies there, or
    the end that is nearest to it.
    """
    begin, end = np.clip(windows + 1.0, 0.0, 1.0).T
    length = end - begin
    instant = length < _INSTANT
    parts = (np.array(_area(end)) - np.array(_area(begin))) / np.where(instant, 1.0, length)
    return np.where(instant, np.array(_parabola(end)), parts).T


def weights_of_sums(windows: FloatArray, seen: BoolArray) -> FloatArray | None:
    """Weights (n_samples, 2, 4) by which a mean is summed up from sample to sample.

    Of the output at the sample before, of that at this one, of the area between, over the sample
    time, and of the sum so far: first in each sample's mean, then in the sum that is kept for
    the next. windows: (n_samples, 2), as of ``average``; seen: (n_samples,), those that matter.
    None unless each ends since the sample before, and begins no earlier than the one before ends.
    """
    weights = np.zeros((len(windows), 2, 4))
    weights[:, 0, :3] = weights_of_mean(windows)
    rows = np.flatnonzero(seen)
    if np.any(windows[rows, 1] > _INSTANT) or np.any(windows[rows, 1] <= -1.0):
        return None
    rows = rows[windows[rows, 0] < -1.0 - _INSTANT]
    begins, length = rows + windows[rows, 0], np.diff(windows[rows], axis=1)
    first = np.ceil(begins - _INSTANT).astype(np.int64)
    if np.any(first < np.append(0, rows[:-1])):
        return None
    weights[rows, 0, :3] = np.array(_area(windows[rows, 1] + 1.0)).T / length
    weights[rows, 0, 3] = 1.0 / length[:, 0]
    before = np.array(_area(begins - (first - 1.0))).T
    for i, k, part in zip(first, rows, before, strict=True):
        weights[i, 1, :3] = [0.0, 0.0, 1.0] - part
        weights[i + 1 : k, 1, 2:] = 1.0
    return weights


def ends_of(windows: FloatArray) -> Ends:
    """Where windows (n_samples, 2), as of ``average``, begin and end within samples."""
    n = len(windows)
    times = np.clip(np.arange(n)[:, None] + windows, 0.0, n - 1.0)
    length = np.diff(times, axis=1)
    instant = length < _INSTANT
    samples = np.minimum(np.floor(times), n - 2.0)
    places = times - samples
    weights = np.where(instant, [0.0, 1.0], [-1.0, 1.0] / np.where(instant, 1.0, length))
    within = (weights != 0.0) & (places > 0.0) & (places < 1.0)
    rows, _ = np.nonzero(within)
    order = np.argsort(samples[within], kind="stable")
    rows, chosen = rows[order], samples[within][order].astype(np.int64)
    return chosen, places[within][order], rows, weights[within][order], instant[rows, 0]


@njit(cache=True, nogil=True)
def add_beyond(
    means: FloatArray,
    ends: Ends,
    first: int,
    parts: int,
    outputs: FloatArray,
    integrals: FloatArray,
) -> None:
    """Add to means (n_samples, n_lanes) what they are more than if of parabolas between samples.

    Of those ends that lie in the samples from the first on that are given in parts: outputs and
    their integrals over the time of a part, (parts n + 1, n_lanes).
    """
    samples, places, rows, weights, instants = ends
    count = (len(outputs) - 1) // parts
    for e in range(np.searchsorted(samples, first), np.searchsorted(samples, first + count)):
        begin, row, weight = (samples[e] - first) * parts, rows[e], weights[e]
        end, part = begin + parts, min(int(places[e] * parts), parts - 1)
        i, s = begin + part, places[e] * parts - part
        if instants[e]:
            (f0, f1, area), (c0, c1, whole) = _parabola_at(s), _parabola_at(places[e])
            all_of = 0.0
        else:
            (f0, f1, area), (c0, c1, whole) = _area_at(s), _area_at(places[e])
            f0, f1, area, all_of = f0 / parts, f1 / parts, area / parts, 1.0 / parts
        for lane in range(outputs.shape[1]):
            fine = f0 * outputs[i, lane] + f1 * outputs[i + 1, lane]
            fine += area * (integrals[i + 1, lane] - integrals[i, lane])
            fine += all_of * (integrals[i, lane] - integrals[begin, lane])
            coarse = c0 * outputs[begin, lane] + c1 * outputs[end, lane]
            coarse += whole / parts * (integrals[end, lane] - integrals[begin, lane])
            means[row, lane] += weight * (fine - coarse)


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
