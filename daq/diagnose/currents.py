"""Whether the currents of a run are what its commands and the amplifiers' gains make of them."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from daq.config.rig import RigConfig
from daq.hal import CHANNELS, FloatArray, IntArray

_ROWS = 20_000  # of a log, from its beginning: enough to tell a gain
_BLOCK = 5e-3  # s that are averaged
_TAPS = 5  # blocks, the present among them, in which a current comes to follow its command
_FEWEST = 50  # blocks
_CERTAIN = 5.0  # standard errors
_CLEARLY = 0.1  # of what others leave unexplained of a current's power, for one to be right
_OFF = 1.4  # ratio of gains, either way, that no data sheet's tolerance explains


class _Response(NamedTuple):
    """A current by one command alone: gain, its standard error [A/V], part of its power explained.

    The error is infinite without a command.
    """

    gain: float
    error: float
    explained: float


def notes(log: Path, rig: RigConfig) -> list[str]:
    """Mistakes in sensors' signs, scales or wiring by a completed run's log, each with its cure.

    Empty for amplifiers without a gain in the rig's file, for channels without a command, and for
    the motor of a run that was never slow: at speed the back EMF takes of what its amplifier gives.
    """
    gains = [getattr(rig.amplifiers, name) for name in CHANNELS]
    blocks = _averaged(log) if any(gain is not None for gain in gains) else np.empty((0, 6))
    slow = np.abs(blocks[:, 4]) <= rig.slow
    responses = [
        _responses(blocks, CHANNELS.index("motor"), slow),
        _responses(blocks, CHANNELS.index("brake"), np.full(len(blocks), True)),
    ]
    swapped = _swapped(responses)
    judged = [
        _judge(name, gain, getattr(rig.sensors, f"current_{name}").sign, responses, swapped)
        for name, gain in zip(CHANNELS, gains, strict=True)
        if gain is not None
    ]
    return [note for note in judged if note is not None]


def _judge(
    name: str, stated: float, sign: int, responses: list[list[_Response]], swapped: bool
) -> str | None:
    """A note on the gain of a channel, [A/V], by the data sheet and by the log; sign: in use."""
    channel = CHANNELS.index(name)
    if not responses[channel] or not responses[channel][channel].error <= stated / _CERTAIN:
        return None  # too few samples, too small a command, or none
    gain = responses[channel][channel].gain
    contrast = (
        f"current_{name} follows its command with {gain:.3g} A/V, where amplifiers.{name} says "
        f"{stated:g}"
    )
    if swapped:
        return (
            f"{contrast}, and what it should do the {CHANNELS[1 - channel]}'s does; look whether "
            "the inputs or the outputs of the two channels are swapped"
        )
    if abs(gain) < 0.1 * stated:
        return f"{contrast}; look whether the amplifier is on, and its sensor connected"
    if gain < 0.0:
        return f"{contrast}; set 'sign: {-sign}' of sensors.current_{name} in the rig's file"
    if not 1.0 / _OFF < gain / stated < _OFF:
        return (
            f"{contrast}; measure the current with a clamp meter, and correct "
            f"sensors.current_{name}.scale or amplifiers.{name} in the rig's file"
        )
    return None


def _swapped(responses: list[list[_Response]]) -> bool:
    """Whether a command shows in the other channel's current, and in neither current its own does.

    Commands so alike that nobody can say which a current follows explain both currents equally.
    """
    if not all(responses):
        return False
    (motor, brake_in_motor), (motor_in_brake, brake) = responses
    crossed = max(brake_in_motor.explained, motor_in_brake.explained)
    return 1.0 - crossed < _CLEARLY * (1.0 - max(motor.explained, brake.explained))


def _responses(blocks: FloatArray, channel: int, usable: npt.NDArray[np.bool_]) -> list[_Response]:
    """A channel's current by each command in turn, in the usable blocks; none for too few."""
    rows = np.flatnonzero(usable[_TAPS:]) + _TAPS
    if len(rows) < _FEWEST:
        return []
    current, commands = blocks[rows, channel], blocks[:, len(CHANNELS) : 2 * len(CHANNELS)]
    return [_response(current, command, rows) for command in commands.T]


def _response(current: FloatArray, command: FloatArray, rows: IntArray) -> _Response:
    """By least squares of a current, (n,), on a command in the 25 ms before each of its ``rows``.

    There is no constant: the calibration has made the current at zero command zero.
    """
    design = np.column_stack([command[rows - lag] for lag in range(_TAPS)])
    if not design.any():
        return _Response(0.0, np.inf, 0.0)
    inverse = np.linalg.pinv(design.T @ design)
    taps = inverse @ design.T @ current
    residual, power = np.square(current - design @ taps).mean(), np.square(current).mean()
    explained = 1.0 - residual / power if power > 0.0 else 0.0
    return _Response(taps.sum(), np.sqrt(residual * inverse.sum()), explained)


def _averaged(log: Path) -> FloatArray:
    """Means over blocks of 5 ms, (n, 6), of currents, applied commands, speed and time."""
    names = [f"current_{name}" for name in CHANNELS]
    names += [*(f"applied_voltage_{name}" for name in CHANNELS), "omega", "t"]
    with log.open(encoding="ascii") as file:
        header = file.readline().strip().split(",")
        columns = [header.index(name) for name in names]
        rows = np.loadtxt(file, delimiter=",", usecols=columns, max_rows=_ROWS, ndmin=2)
    if len(rows) < _FEWEST:
        return np.empty((0, len(names)))
    size = max(1, round(_BLOCK * (len(rows) - 1) / (rows[-1, 5] - rows[0, 5])))
    blocks: FloatArray = rows[: len(rows) // size * size].reshape(-1, size, len(names)).mean(axis=1)
    return blocks
