"""Frequency responses: estimated from records, and of linear models as a sampler sees them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sysid.arrays import BoolArray, ComplexArray, FloatArray
from sysid.problem.data import Dataset
from sysid.problem.model import Hold, ModelError
from sysid.response.linearization import LinearModel

_SHORTEST = 16  # samples of a segment
_FEWEST = 3  # segments for each input
_LONGEST = 4096
_PARTS = 3.0  # segments without overlap that a record should hold at least
# Segments grow with the root of the record: finer steps of frequency and less scatter alike.
_GROWTH = 10.0
# Independent segments that one half-overlapping Hann segment is worth (Welch 1967).
_WORTH = 0.95
_FALSE = 0.05  # share of the significant frequencies that may be noise alone
# Of an input's largest density; what a Hann window leaks from there is more than what is below.
_FLOOR = 1e-6


@dataclass(frozen=True)
class FrequencyResponse:
    """An estimate of y = H u + noise at each frequency.

    frequency: (n,), Hz, above 0. response: (n, n_outputs, n_inputs). coherence: the same shape,
    partial coherence of output and input, what the other inputs explain taken away; of a single
    input the ordinary one. deviation: the same shape, standard deviation of the response (as of a
    complex number, so of its magnitude that over root 2). significant: the same shape, where the
    input has power and the coherence is more than noise alone gives, which 5 % of these points may
    be by chance. input_density: (n, n_inputs), power spectral density, unit squared per Hz,
    one-sided. varied: (n_inputs,), inputs that change; the columns of the others are NaN.
    n_segments: how many were averaged.
    """

    frequency: FloatArray
    response: ComplexArray
    coherence: FloatArray
    deviation: FloatArray
    significant: BoolArray
    input_density: FloatArray
    varied: BoolArray
    n_segments: int


def frequency_response(records: Sequence[Dataset]) -> FrequencyResponse:
    """Least squares between the spectra of Hann-windowed, half-overlapping segments (H1).

    All inputs together: what another input does is not taken for this one's. Records must have
    one sample time. Segments with a lost sample are left out. Raises ModelError when there are
    too few segments, or none of the inputs changes. Bendat & Piersol, "Random Data", chapter 7;
    Welch, IEEE Trans. Audio Electroacoustics 15 (1967).

    >>> u = np.random.default_rng(0).normal(size=2000)
    >>> y = 3.0 * u
    >>> response = frequency_response([Dataset(u, y, dt=0.01)])
    >>> np.abs(response.response[:3, 0, 0]).round(6).tolist()
    [3.0, 3.0, 3.0]
    """
    dt = records[0].dt
    if any(abs(record.dt - dt) > 1e-6 * dt for record in records):
        raise ModelError("records of different sample times have no common frequency response")
    changes = [np.ptp(record.inputs, axis=0) > 0.0 for record in records]
    varied: BoolArray = np.array(np.any(changes, axis=0), dtype=np.bool_)
    m, length = int(varied.sum()), _segment_length(records)
    if not m:
        raise ModelError("no input changes, so there is no frequency response")
    inputs, outputs = _spectra(records, length)
    # Shorter segments where there would be too few: coarser frequencies rather than none.
    while len(inputs) < _FEWEST * m and length > _SHORTEST:
        length //= 2
        inputs, outputs = _spectra(records, length)
    if len(inputs) <= 2 * m:
        raise ModelError(
            f"{len(inputs)} segments of {length} samples do not tell {m} inputs apart; log for "
            "longer"
        )
    return _estimate(inputs, outputs, varied, length, dt)


def sampled_response(
    linear: LinearModel, frequency: FloatArray, dt: float, holds: Sequence[Hold]
) -> ComplexArray:
    """Response of a linear model from input samples to output samples, (n, n_outputs, n_inputs).

    holds: of each input; a held one acts through the exact discretisation of x' = A x + B u, an
    interpolated one as in continuous time. frequency: Hz, below half the sample rate.
    """
    from scipy.linalg import expm

    a, b, c, d = linear
    n, m = b.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = a, b
    step = expm(block * dt)
    omega = 2.0 * np.pi * np.asarray(frequency, dtype=np.float64)
    eye = np.eye(n)
    held = _solved(np.exp(1j * omega * dt)[:, None, None] * eye - step[:n, :n], step[:n, n:])
    smooth = _solved((1j * omega)[:, None, None] * eye - a, b)
    zoh = np.array([hold == "zoh" for hold in holds])
    return (c @ np.where(zoh, held, smooth) + d).astype(np.complex128)


def _solved(matrices: npt.NDArray[Any], columns: FloatArray) -> ComplexArray:
    right = np.broadcast_to(columns.astype(np.complex128), (len(matrices), *columns.shape))
    return np.linalg.solve(matrices, right).astype(np.complex128)


def _segment_length(records: Sequence[Dataset]) -> int:
    longest = max(record.n_samples for record in records)
    aim = min(_GROWTH * np.sqrt(longest), longest / _PARTS)
    return int(np.clip(2 ** round(np.log2(max(aim, 1.0))), _SHORTEST, _LONGEST))


def _spectra(records: Sequence[Dataset], length: int) -> tuple[ComplexArray, ComplexArray]:
    """Fourier transforms of all segments, (n_segments, n_frequencies, n_channels), from bin 1."""
    window = np.sqrt(2.0 / 3.0) * (1.0 - np.cos(2.0 * np.pi * np.arange(length) / length))
    segments: list[tuple[ComplexArray, ComplexArray]] = []
    for record in records:
        with np.errstate(invalid="ignore"):
            middle = np.nanmean(record.outputs, axis=0) if record.outputs.size else 0.0
        u, y = record.inputs - record.inputs.mean(axis=0), record.outputs - middle
        for begin in range(0, record.n_samples - length + 1, length // 2):
            rows = slice(begin, begin + length)
            if np.isfinite(y[rows]).all():
                segments.append((_transform(u[rows], window), _transform(y[rows], window)))
    n, m, q = length // 2 - 1, records[0].inputs.shape[1], records[0].outputs.shape[1]
    return (
        np.array([u for u, _ in segments], dtype=np.complex128).reshape(-1, n, m),
        np.array([y for _, y in segments], dtype=np.complex128).reshape(-1, n, q),
    )


def _transform(values: FloatArray, window: FloatArray) -> ComplexArray:
    # Without the mean and its leakage, and without the bin that has no phase.
    return np.fft.rfft(values * window[:, None], axis=0)[1:-1]


def _estimate(
    inputs: ComplexArray, outputs: ComplexArray, varied: BoolArray, length: int, dt: float
) -> FrequencyResponse:
    k, n, _ = inputs.shape
    u = inputs[:, :, varied]
    uu = np.einsum("kfi,kfj->fij", u, u.conj()) / k
    yu = np.einsum("kfo,kfj->foj", outputs, u.conj()) / k
    yy = np.mean(np.abs(outputs) ** 2, axis=0)
    inverse = np.linalg.pinv(uu, hermitian=True)
    response = yu @ inverse
    explained = np.einsum("foj,foj->fo", response, yu.conj()).real
    noise = np.maximum(yy - explained, 0.0)
    spread = noise[:, :, None] * np.einsum("fjj->fj", inverse).real[:, None, :]
    power = np.abs(response) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.where(power + spread > 0.0, power / (power + spread), 0.0)
    # Each fitted input takes a degree of freedom of the noise.
    left = max(_WORTH * k - u.shape[2], 1.0)
    density = 2.0 * dt / length * np.mean(np.abs(inputs) ** 2, axis=0)
    among = _among(coherence, varied).real
    return FrequencyResponse(
        frequency=np.arange(1, n + 1) / (length * dt),
        response=_among(response, varied),
        coherence=among,
        deviation=_among(np.sqrt(spread / left), varied).real,
        significant=_significant(among, left, density),
        input_density=density,
        varied=varied,
        n_segments=k,
    )


def _significant(coherence: FloatArray, left: float, density: FloatArray) -> BoolArray:
    """Where a coherence (n, n_outputs, n_inputs) is not that of noise, and the input has power.

    Without a response it exceeds c with probability (1 - c)^left, left being the independent
    segments less the inputs: Carter, Proc. IEEE 75 (1987) 236; Bendat & Piersol, "Random Data",
    9.2. Its bound, 1 - alpha^(1/left), is at the alpha by which 5 % of the points beyond it are
    noise: Benjamini & Hochberg, J. R. Stat. Soc. B 57 (1995) 289.
    """
    powered = (density > _FLOOR * density.max(axis=0))[:, None, :] & np.isfinite(coherence)
    chance = np.where(powered, (1.0 - np.clip(np.nan_to_num(coherence), 0.0, 1.0)) ** left, 1.0)
    in_order = np.sort(chance, axis=0)
    places = np.arange(1, len(chance) + 1) / len(chance)
    passing = in_order <= _FALSE * places[:, None, None]
    significant: BoolArray = chance <= np.where(passing, in_order, -1.0).max(axis=0)
    return significant


def _among(values: npt.NDArray[np.generic], varied: BoolArray) -> ComplexArray:
    """Columns of the inputs that vary among those of all, NaN for the others."""
    whole = np.full((*values.shape[:-1], len(varied)), np.nan + 0j)
    whole[:, :, varied] = values
    return whole
