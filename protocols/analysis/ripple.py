"""The part of a torque that recurs with every turn of the shaft."""

import math
from dataclasses import dataclass

import numpy as np

from daq.findings import Number
from daq.hal import FloatArray
from protocols.analysis.results import Estimate

_HARMONICS = 12  # in a turn
_PARTS = 72  # of a turn
_TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Ripple:
    """The strongest harmonic of a torque along a turn.

    amplitude and its standard error [N*m], periods in a turn; angle, torque, errors: means over
    parts of a turn and their standard errors, (n,).
    """

    amplitude: float
    error: float
    periods: int
    angle: FloatArray
    torque: FloatArray
    errors: FloatArray

    def exceeds(self, n_errors: float) -> bool:
        """Whether it is above the noise; the strongest of a dozen harmonics is never zero."""
        return self.amplitude > n_errors * self.error

    def number(self, n_errors: float) -> Number:
        """The amplitude as a result; one within the noise only bounds what there may be."""
        amplitude = Estimate(self.amplitude, self.error, 1.96)
        if self.exceeds(n_errors):
            meaning = f"torque that recurs {self.periods} times a turn, amplitude"
            return amplitude.number("cyclic", "N*m", meaning)
        meaning = "torque that recurs with every turn, amplitude: none seen above the noise"
        return Number("cyclic", 0.0, "N*m", 0.0, amplitude.high, meaning)


def ripple(theta: FloatArray, torque: FloatArray) -> Ripple:
    """How a torque (n,) [N*m] goes with the angle (n,) [rad] over whole turns."""
    waves = np.exp(-1j * np.outer(theta, np.arange(1, _HARMONICS + 1)))
    matrix = np.column_stack([np.ones(len(theta)), waves.real, waves.imag])
    weights, *_ = np.linalg.lstsq(matrix, torque, rcond=None)
    amplitudes = np.hypot(weights[1 : _HARMONICS + 1], weights[_HARMONICS + 1 :])
    noise = (torque - matrix @ weights).std()
    strongest = int(np.argmax(amplitudes))
    part = np.floor(theta % _TURN / _TURN * _PARTS).astype(int) % _PARTS
    counts = np.bincount(part, minlength=_PARTS)
    sums = np.bincount(part, torque, minlength=_PARTS)
    seen = counts > 0
    return Ripple(
        amplitude=float(amplitudes[strongest]),
        error=float(noise * math.sqrt(2.0 / len(theta))),
        periods=strongest + 1,
        angle=(np.flatnonzero(seen) + 0.5) * 2.0 * math.pi / _PARTS,
        torque=sums[seen] / counts[seen],
        errors=noise / np.sqrt(counts[seen]),
    )
