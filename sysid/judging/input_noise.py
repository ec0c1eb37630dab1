"""What of measured inputs is likely to be their noise."""

from dataclasses import replace

import numpy as np

from sysid.arrays import ComplexArray, FloatArray
from sysid.problem.data import Dataset

_CLEAR = 3.0  # times the noise's power at a frequency, as chance makes in one of twenty
_TELLING = 4  # frequencies on either side for each reference that a signal may follow
_ALIKE = 1e-10  # part of the references' power, below which they are taken for one another
_TINY = 1e-300


def quieted(record: Dataset) -> Dataset:
    """A record without what is likely to be white noise of its inputs."""
    inputs = record.inputs.copy()
    for i in np.flatnonzero(record.input_noise):
        inputs[:, i] -= likely_noise(inputs[:, i], float(record.input_noise[i]))
    return replace(record, inputs=inputs)


def likely_noise(signal: FloatArray, deviation: float, colour: float = 0.0) -> FloatArray:
    """What of a signal (n,) is likely to be its noise of this deviation: Wiener's filter.

    colour: part of the noise that goes on from sample to sample; none of white noise.

    >>> rng = np.random.default_rng(0)
    >>> noise = 0.1 * rng.standard_normal(1000)
    >>> likely = likely_noise(np.sin(0.01 * np.arange(1000)) + noise, 0.1)
    >>> bool(np.corrcoef(likely, noise)[0, 1] > 0.9)
    True
    """
    n = len(signal)
    spectrum = np.fft.rfft(signal - signal.mean())
    power = np.abs(spectrum) ** 2 / n
    width = _width(len(power))
    padded = np.pad(power, width, mode="reflect") if len(power) > width else power
    kernel = np.ones(2 * width + 1) / (2 * width + 1)
    smooth = np.convolve(padded, kernel, "valid") if len(padded) > len(power) else power
    share = np.minimum(_noise_power(n, deviation, colour) / np.maximum(smooth, _TINY), 1.0)
    likely: FloatArray = np.fft.irfft(spectrum * share, n)
    return likely


def standing_out(signal: FloatArray, deviation: float, colour: float = 0.0) -> FloatArray:
    """What of a signal (n,) is not likely to be its noise at frequencies where it stands out of it.

    What a Wiener filter keeps between the lines of a signal's spectrum is noise, which drives a
    free run as well: shifted, it goes with the errors that it makes there. Arguments as of
    ``likely_noise``.

    >>> rng = np.random.default_rng(0)
    >>> noise, wave = 0.5 * rng.standard_normal(1000), np.sin(0.02 * np.pi * np.arange(1000))
    >>> bool(standing_out(noise, 0.5).std() < 0.1)
    True
    >>> bool((standing_out(wave + noise, 0.5) - wave).std() < 0.1)
    True
    """
    n, mean = len(signal), signal.mean()
    power = np.abs(np.fft.rfft(signal - mean)) ** 2 / n
    clear = power > _CLEAR * _noise_power(n, deviation, colour)
    kept = np.fft.rfft(signal - likely_noise(signal, deviation, colour) - mean)
    standing: FloatArray = mean + np.fft.irfft(np.where(clear, kept, 0.0), n)
    return standing


def not_following(signal: FloatArray, references: FloatArray) -> FloatArray:
    """What of a signal (n,) follows none of the references (n, k), by any smooth response.

    Smooth in frequency: as long as a few per cent of the record.

    >>> rng = np.random.default_rng(0)
    >>> noise, reference = 0.1 * rng.standard_normal(1000), rng.standard_normal((1000, 1))
    >>> left = not_following(noise + np.roll(reference[:, 0], 2), reference)
    >>> bool((left - noise).std() < 0.3 * noise.std())
    True
    """
    n = len(signal)
    whole = np.fft.rfft(signal - signal.mean())
    spectra = np.fft.rfft(references - references.mean(axis=0), axis=0)
    sizes = np.sqrt(np.mean(np.abs(spectra) ** 2, axis=0))
    spectra = spectra[:, sizes > 0.0] / sizes[sizes > 0.0]
    width = min(max(_width(len(whole)), _TELLING * spectra.shape[1]), len(whole) - 1)
    conjugates = spectra.conj()
    alike = _sums(conjugates[:, :, None] * spectra[:, None, :], width)
    shared = _sums(conjugates * whole[:, None], width)
    inverse = np.linalg.pinv(alike, rcond=_ALIKE, hermitian=True)
    following = np.einsum("ki,kij,kj->k", spectra, inverse, shared)
    left: FloatArray = np.fft.irfft(whole - following, n)
    return left


def _sums(values: ComplexArray, width: int) -> ComplexArray:
    """Sums over so many frequencies on either side, mirrored at the ends of the spectrum."""
    before, after = values[width:0:-1].conj(), values[-2 : -width - 2 : -1].conj()
    sums = np.cumsum(np.concatenate([0.0 * values[:1], before, values, after]), axis=0)
    within: ComplexArray = sums[2 * width + 1 :] - sums[: -2 * width - 1]
    return within


def _width(count: int) -> int:
    """Frequencies on either side over which a spectrum of so many is smoothed."""
    return max(int(np.sqrt(count)) // 2, 1)


def _noise_power(n: int, deviation: float, colour: float) -> FloatArray:
    """Of noise in n samples, at each frequency of their spectrum."""
    turn = np.exp(-2j * np.pi * np.arange(n // 2 + 1) / n)
    power: FloatArray = deviation**2 * (1.0 - colour**2) / np.abs(1.0 - colour * turn) ** 2
    return power
