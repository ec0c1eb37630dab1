"""Measured inputs without the noise above the frequencies that they have.

White noise has all frequencies; what drives a plant often has few. An input is averaged over as
many samples as change it by no more than its noise does: each wider average is compared with the
one before, on the whole and at every sample, so that one step in a slow record keeps it as it is,
and none is taken whose change would be hidden by chance.
What is left of the noise is less, and coloured, n_(k+1) = a n_k + what is new. The weights are such
that white noise becomes just that, so that a filter may count on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from sysid.arrays import FloatArray
from sysid.problem.data import Dataset

# Colours that are tried: from each to the next the noise's variance falls by the root of two.
_COLOURS = tuple((2.0 ** (k / 2) - 1.0) / (2.0 ** (k / 2) + 1.0) for k in range(1, 41))
_NEGLIGIBLE = 1e-3  # part of the largest weight
# Mean square change, in parts of what noise does, and the largest in its deviations, by which a
# wider average is taken to change more than noise.
_MEAN_SQUARE, _LARGEST = 1.25, 5.5
# Most that may be lost of a signal, in parts of what is taken away, the deviations of chance that
# may hide it, and the most that they may hide of what one step takes away.
_MOST_LOST, _SURELY, _HIDDEN = 0.1, 2.0, 0.15
_TWICE = 4.0  # of the noise's deviation, in variances


@dataclass(frozen=True)
class Denoised:
    """A record with averaged inputs.

    colour: (n_inputs,), how much of their noise goes on from sample to sample. lost: (n_inputs,),
    part of what the averages took away that may, at most, have been no noise.
    """

    record: Dataset
    colour: FloatArray
    lost: FloatArray


def denoised(record: Dataset) -> Denoised:
    """A record with its noisy inputs averaged.

    >>> slow = 50.0 * np.sin(np.linspace(0.0, 9.0, 4096))
    >>> noisy = slow + np.random.default_rng(0).standard_normal(4096)
    >>> quiet = denoised(Dataset(noisy, noisy, 0.01, input_noise=np.ones(1)))
    >>> error = np.std(quiet.record.inputs[:, 0] - slow)
    >>> quiet.record.input_noise.round(2), error.round(2), quiet.colour.round(2)
    (array([0.21]), np.float64(0.21), array([0.92]))
    """
    inputs, noise = record.inputs.copy(), record.input_noise.astype(np.float64)
    colour, lost = np.zeros(len(noise)), np.zeros(len(noise))
    for j in np.flatnonzero(noise):
        inputs[:, j], colour[j], lost[j] = _averaged(record.inputs[:, j], float(noise[j]))
    noise *= np.sqrt((1.0 - colour) / (1.0 + colour))
    return Denoised(replace(record, inputs=inputs, input_noise=noise), colour, lost)


def coloured(noise: FloatArray, colour: FloatArray) -> FloatArray:
    """White noise, (n_samples, n_inputs), made as coloured as that of ``denoised`` inputs."""
    onward = noise.copy()
    fresh = np.sqrt(1.0 - colour**2)
    for k in range(1, len(noise)):
        onward[k] = colour * onward[k - 1] + fresh * noise[k]
    return onward


def just_missed(noise: FloatArray, colour: FloatArray) -> FloatArray:
    """What averages take of white noise, (n_samples, n_inputs), that others would let through.

    colour: theirs, (n_inputs,). The others leave twice the noise, or all of it if that is less.

    >>> white = np.random.default_rng(0).standard_normal((4096, 1))
    >>> just_missed(white, np.array([0.92])).std().round(2)
    np.float64(0.24)
    """
    missed = np.zeros_like(noise)
    for j in np.flatnonzero(colour):
        left = min(_TWICE * (1.0 - colour[j]) / (1.0 + colour[j]), 1.0)
        narrow, wide = _weights((1.0 - left) / (1.0 + left)), _weights(float(colour[j]))
        missed[:, j] = _convolved(noise[:, j], narrow) - _convolved(noise[:, j], wide)
    return missed


def _averaged(signal: FloatArray, noise: float) -> tuple[FloatArray, float, float]:
    """A signal averaged as widely as its noise allows, with ``Denoised.colour`` and ``lost``."""
    weights, average, colour, share = np.ones(1), signal, 0.0, 0.0
    taken = lost = 0.0
    for wider_colour in _COLOURS:
        wider = _weights(wider_colour)
        if len(wider) > len(signal):
            break
        next_average, difference = _convolved(signal, wider), wider.copy()
        middle, reach = len(wider) // 2, len(weights) // 2
        difference[middle - reach : middle + reach + 1] -= weights
        expected = noise * float(np.linalg.norm(difference))
        change = (next_average - average) / expected
        excess = float(np.mean(change**2)) - 1.0
        chance = _SURELY * _chance(difference, len(signal))
        taken, lost = taken + expected**2, lost + expected**2 * (max(excess, 0.0) + chance)
        if excess > _MEAN_SQUARE - 1.0 or np.abs(change).max() > _LARGEST:
            break
        if chance > _HIDDEN or lost > _MOST_LOST * taken:
            break
        weights, average, colour, share = wider, next_average, wider_colour, lost / taken
    return average, colour, share


def _chance(weights: FloatArray, count: int) -> float:
    """Deviation of the mean square of so much white noise, weighted so, in parts of itself."""
    size = next_fast_len(2 * len(weights), real=True)
    correlation = irfft(np.abs(rfft(weights, size)) ** 2, size)
    return float(np.sqrt(2.0 / count) * np.linalg.norm(correlation) / correlation[0])


def _weights(colour: float) -> FloatArray:
    """Weights, as many before as behind, that give white noise a first-order colour.

    Half of it comes from those before, half from those behind: (1 - a / z)^(-1/2) each.
    """
    count = int(np.ceil(np.log(_NEGLIGIBLE) / np.log(colour))) if colour else 0
    steps = np.arange(1, count + 1)
    half = np.cumprod(np.append(1.0, colour * (1.0 - 0.5 / steps)))
    weights = np.correlate(half, half, mode="full")
    normalised: FloatArray = weights / weights.sum()
    return normalised


def _convolved(signal: FloatArray, weights: FloatArray) -> FloatArray:
    """Beyond its ends a signal goes on as its mirror image: no end point counts for more."""
    beyond = np.pad(signal, len(weights) // 2, mode="symmetric")
    size = next_fast_len(len(beyond), real=True)
    convolved: FloatArray = irfft(rfft(beyond, size) * rfft(weights, size), size)
    return convolved[len(weights) - 1 : len(beyond)]
