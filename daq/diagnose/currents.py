"""Whether the currents of a run are what its commands and the amplifiers' gains make of them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from daq.config.rig import RigConfig
from daq.hal import CHANNELS, FloatArray

_ROWS = 20_000  # of a log, from its beginning: enough to tell a gain
_BLOCK = 5e-3  # s that are averaged
_TAPS = 5  # blocks, its own among them, in which a current comes to follow its command
_FEWEST = 50  # blocks
_CERTAIN = 5.0  # standard errors
_ALIKE = 0.95  # cosine of two commands of which nobody can say which a current follows
_OFF = 1.4  # ratio of gains, either way, that no data sheet's tolerance explains


def notes(log: Path, rig: RigConfig) -> list[str]:
    """What is wrong with sensors' signs, scales or wiring by a completed run, with the cure.

    Says nothing of amplifiers without a gain in the rig's file, and of channels without a command.
    """
    stated = [getattr(rig.amplifiers, name) for name in CHANNELS]
    if all(gain is None for gain in stated):
        return []
    measured = _gains(log)
    if measured is None:
        return []
    gains, errors = measured
    found = []
    for row, name in enumerate(CHANNELS):
        gain = stated[row]
        if gain is not None and math.isfinite(errors[row, row]):
            said = _judge(name, row, gain, gains, errors)
            found += [said] if said else []
    return found


def _judge(name: str, row: int, stated: float, gains: FloatArray, errors: FloatArray) -> str | None:
    own, error = float(gains[row, row]), float(errors[row, row])
    if error > stated / _CERTAIN:
        return None  # too small a command, or none
    says = f"current_{name} follows its command with {own:.3g} A/V, where amplifiers.{name} says"
    other = CHANNELS[1 - row]
    crossed = max(abs(gains[1 - row, row]), abs(gains[row, 1 - row]))
    if crossed > max(0.5 * stated, 2.0 * abs(own)):
        return (
            f"{says} {stated:g}, and what it should do the {other}'s does; look whether the inputs "
            "or the outputs of the two channels are swapped"
        )
    if abs(own) < 0.1 * stated:
        return f"{says} {stated:g}; look whether the amplifier is on, and its sensor connected"
    if own < 0.0:
        return f"{says} {stated:g}; set 'sign: -1' of sensors.current_{name} in the rig's file"
    if not 1.0 / _OFF < own / stated < _OFF:
        return (
            f"{says} {stated:g}; measure the current with a clamp meter, and correct "
            f"sensors.current_{name}.scale or amplifiers.{name} in the rig's file"
        )
    return None


def _gains(log: Path) -> tuple[FloatArray, FloatArray] | None:
    """A per V of both currents by both commands, (2, 2), and standard errors; infinite: unknown.

    By least squares of each current on the applied commands of the last 25 ms, in the slower half
    of the run: at speed the back EMF may leave an amplifier short of voltage. There is no constant:
    the calibration has made the current at zero command zero.
    """
    with log.open(encoding="ascii") as file:
        names = file.readline().strip().split(",")
        wanted = [f"current_{name}" for name in CHANNELS]
        wanted += [*(f"applied_voltage_{name}" for name in CHANNELS), "omega", "t"]
        columns = [names.index(name) for name in wanted]
        rows = np.loadtxt(file, delimiter=",", usecols=columns, max_rows=_ROWS, ndmin=2)
    if len(rows) < _FEWEST:
        return None
    size = max(1, round(_BLOCK * (len(rows) - 1) / (rows[-1, 5] - rows[0, 5])))
    blocks = rows[: len(rows) // size * size].reshape(-1, size, rows.shape[1]).mean(axis=1)
    if len(blocks) < _FEWEST:
        return None
    speed = np.abs(blocks[_TAPS:, 4])
    slow = np.flatnonzero(speed <= np.median(speed)) + _TAPS
    current, command = blocks[slow, :2], blocks[:, 2:4]
    norm = np.linalg.norm(command, axis=0)
    there = np.flatnonzero(norm > 0.0)
    if not len(there) or abs(command[:, 0] @ command[:, 1]) > _ALIKE * norm[0] * norm[1] > 0.0:
        return None
    lags = [command[np.ix_(slow - k, there)] for k in range(_TAPS)]
    design = np.concatenate(lags, axis=1)
    inverse = np.linalg.pinv(design.T @ design)
    solution = inverse @ design.T @ current
    variance = ((current - design @ solution) ** 2).mean(axis=0)
    gains, errors = np.zeros((2, 2)), np.full((2, 2), np.inf)
    for place, channel in enumerate(there):
        taps = slice(place, None, len(there))
        gains[:, channel] = solution[taps].sum(axis=0)
        errors[:, channel] = np.sqrt(variance * inverse[taps, taps].sum())
    return gains, errors
