"""Whether the currents of a run are what its commands and the amplifiers' gains make of them."""

from pathlib import Path

import numpy as np

from daq.config.rig import RigConfig
from daq.hal import CHANNELS, FloatArray

_ROWS = 20_000  # of a log, from its beginning: enough to tell a gain
_BLOCK = 5e-3  # s that are averaged
_TAPS = 5  # blocks, the present among them, in which a current comes to follow its command
_FEWEST = 50  # blocks
_CERTAIN = 5.0  # standard errors
_ALIKE = 0.95  # cosine of two commands of which nobody can say which a current follows
_OFF = 1.4  # ratio of gains, either way, that no data sheet's tolerance explains


def notes(log: Path, rig: RigConfig) -> list[str]:
    """Mistakes in sensors' signs, scales or wiring by a completed run's log, each with its cure.

    Empty for amplifiers without a gain in the rig's file, and for channels without a command.
    """
    stated = [getattr(rig.amplifiers, name) for name in CHANNELS]
    estimate = _gains(log) if any(gain is not None for gain in stated) else None
    if estimate is None:
        return []
    signs = [rig.sensors.current_motor.sign, rig.sensors.current_brake.sign]
    judged = [
        _judge(row, gain, signs[row], *estimate)
        for row, gain in enumerate(stated)
        if gain is not None
    ]
    return [note for note in judged if note is not None]


def _judge(row: int, stated: float, sign: int, gains: FloatArray, errors: FloatArray) -> str | None:
    """A note on the gain of a channel, [A/V], by the data sheet and by the log; sign: in use."""
    name, rival = CHANNELS[row], CHANNELS[1 - row]
    gain, error = float(gains[row, row]), float(errors[row, row])
    if not error <= stated / _CERTAIN:
        return None  # too small a command, or none
    contrast = (
        f"current_{name} follows its command with {gain:.3g} A/V, where amplifiers.{name} says "
        f"{stated:g}"
    )
    crossed = max(abs(gains[1 - row, row]), abs(gains[row, 1 - row]))
    if crossed > max(0.5 * stated, 2.0 * abs(gain)):
        return (
            f"{contrast}, and what it should do the {rival}'s does; look whether the inputs "
            "or the outputs of the two channels are swapped"
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


def _gains(log: Path) -> tuple[FloatArray, FloatArray] | None:
    """Gains of both currents by both commands, (2, 2) [A/V], and standard errors; None: unknown.

    By least squares of each current on the applied commands of the last 25 ms, in the slower half
    of the run: at speed the back EMF may leave an amplifier short of voltage. There is no constant:
    the calibration has made the current at zero command zero. The error is infinite for a channel
    without a command.
    """
    blocks = _averaged(log)
    if len(blocks) < _FEWEST:
        return None
    speed = np.abs(blocks[_TAPS:, 4])
    slow = np.flatnonzero(speed <= np.median(speed)) + _TAPS
    current, command = blocks[slow, :2], blocks[:, 2:4]
    norm = np.linalg.norm(command, axis=0)
    commanded = np.flatnonzero(norm > 0.0)
    if not len(commanded) or abs(command[:, 0] @ command[:, 1]) > _ALIKE * norm[0] * norm[1] > 0.0:
        return None
    design = np.hstack([command[np.ix_(slow - lag, commanded)] for lag in range(_TAPS)])
    inverse = np.linalg.pinv(design.T @ design)
    solution = inverse @ design.T @ current
    variance = ((current - design @ solution) ** 2).mean(axis=0)
    gains, errors = np.zeros((2, 2)), np.full((2, 2), np.inf)
    for place, channel in enumerate(commanded):
        taps = slice(place, None, len(commanded))
        gains[:, channel] = solution[taps].sum(axis=0)
        errors[:, channel] = np.sqrt(variance * inverse[taps, taps].sum())
    return gains, errors


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
