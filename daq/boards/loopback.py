"""When a card's outputs change between its samples, by an output wired to an input over an RC.

A plain wire does not tell an output that changes right behind a sample from one that changes right
before the next: both show in the next sample, and only the first is the tick that logs are made of.
An RC of about a sample time does, for its charge says for how long it has been charged.
"""

import math
from collections.abc import Sequence

import numpy as np

from daq.errors import DeviceError
from daq.hal import CHANNELS, FloatArray

RATE = 1000.0  # Hz
STARTS = 8
_SAMPLES, _HOLD, _LEVEL = 960, 4, 0.5  # of a start; samples and volts of a level
_DELAYS = range(-9, 10)  # samples
_WIRE, _LOOSE = 0.05, 0.1  # pole of what is no RC; share of the signal that is not the output's
_SPREAD = 0.1  # samples, from start to start
_EARLY, _LATE = 0.02, 0.25  # of a sample, from a sample's latch to the change of the outputs
_WIRING = (
    "with the amplifiers unplugged, wire the motor's output over 10 kilohm to the motor's current "
    "input, and 100 nF from there to ground"
)


def sequence(seed: int) -> FloatArray:
    """Volts (n, 2) to play: levels at random on the motor's output, zero on the brake's."""
    levels = np.random.default_rng(seed).choice([-_LEVEL, _LEVEL], _SAMPLES // _HOLD)
    volts = np.zeros((_SAMPLES, len(CHANNELS)))
    volts[:, 0] = np.repeat(levels, _HOLD)
    return volts


def delay(played: FloatArray, shown: FloatArray) -> float:
    """Samples from a row of the input to the change of the output that was played for it.

    played: (n,) [V]; shown: (n,) [V] at the other end of the RC. With the delay p + f, p whole, the
    row behind k is y = a y_k + b1 u_(k-p-1) + b0 u_(k-p), where u_(k-p) has charged it for 1 - f of
    a sample. Raises DeviceError where that is not what is shown.
    """
    inner = np.arange(-_DELAYS[0], len(shown) - _DELAYS[-1] - 1)
    y, following, ones = shown[inner], shown[inner + 1], np.ones(len(inner))
    fits = []
    for p in _DELAYS:
        rows = np.stack([y, played[inner - p], played[inner - p - 1], ones], axis=1)
        coefficients = np.linalg.lstsq(rows, following, rcond=None)[0]
        fits.append((float(((following - rows @ coefficients) ** 2).mean()), p, coefficients))
    error, p, (a, b0, b1, _) = min(fits, key=lambda fit: fit[0])
    gain = (b0 + b1) / (1.0 - a)
    if error > _LOOSE**2 * following.var() or not 0.1 < gain < 10.0:
        raise DeviceError(
            "the motor's current input does not show the motor's output", cure=_WIRING
        )
    if not _WIRE < a < 1.0 - _WIRE:
        raise DeviceError(
            f"the loop-back is no RC of about {1e3 / RATE:g} ms: of a step, "
            f"{100.0 * (1.0 - a):.0f} % are there a sample later",
            cure=_WIRING,
        )
    charged = min(max(b0 / gain, 0.0), 1.0 - a)
    return p + 1.0 - math.log(1.0 - charged) / math.log(a)


def phase(delays: Sequence[float]) -> int:
    """The whole samples of delays, one a start. DeviceError where outputs cannot be trusted."""
    shown = ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in delays)
    cure = "write 'playback: host' under options, and leave 'phase' out"
    if max(delays) - min(delays) > _SPREAD:
        problem = f"outputs come {shown} samples behind inputs, another delay at each start"
        raise DeviceError(problem, cure=cure)
    mean = sum(delays) / len(delays)
    whole = math.floor(mean + _EARLY)
    if mean - whole > _LATE:
        problem = f"outputs change {mean - whole:.2f} of a sample behind the inputs ({shown})"
        raise DeviceError(problem, cure=cure)
    return whole
