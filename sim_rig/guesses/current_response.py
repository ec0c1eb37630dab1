"""The response of a current to its amplifier's command, by regression on past commands.

The motor's current also feels the speed at its sample and before, by the back-EMF. The delays
are grouped, eight groups of one sample, then eight twice as wide, and so on for some octaves.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_rig.guesses.ranges import Interval
from sysid.arrays import FloatArray, IntArray
from sysid.problem.guesses import Measured, regression

SIGMAS = 3.0  # standard errors either side of an estimate

_PER_OCTAVE = 8  # groups of delays before they become twice as wide
_OCTAVES = 6  # 504 samples
_MOST_ROWS = 20_000  # of a record in a regression
_MARGIN = 0.1  # of the current per speed: the speed is measured, and its error pulls it to zero


@dataclass(frozen=True)
class CurrentResponse:
    """Gain [A/V], mean delay [s] and size of the current per speed [A*s/rad], as intervals.

    The delay is the area between the step response and its end, in parts of that end. per_speed:
    None of the brake, and where nothing turned. source: the logs it was read from.
    """

    gain: Interval
    delay: Interval
    per_speed: Interval | None
    source: str


def current_response(records: Sequence[Measured], channel: str) -> CurrentResponse | None:
    """The response of motor or brake that all records have in common, None where none shows it."""
    responses = list(filter(None, [_of_record(record, channel) for record in records]))
    if not responses:
        return None
    per_speeds = [response.per_speed for response in responses if response.per_speed is not None]
    return CurrentResponse(
        _overlap([response.gain for response in responses]),
        _overlap([response.delay for response in responses]),
        _overlap(per_speeds) if per_speeds else None,
        responses[0].source if len(responses) == 1 else f"{len(responses)} logs",
    )


def speed_of(record: Measured) -> FloatArray | None:
    """Speed [rad/s] as measured, or the difference of the angle, (n_samples,)."""
    if "omega" in record:
        return record["omega"]
    if "theta" in record:
        speed: FloatArray = np.gradient(record["theta"], record.dt)
        return speed
    return None


def _of_record(record: Measured, channel: str) -> CurrentResponse | None:
    if f"current_{channel}" not in record:
        return None
    signals = [record[f"applied_voltage_{channel}"]]
    if channel == "motor":
        speed = speed_of(record)
        if speed is None:
            return None
        if np.any(np.nan_to_num(speed) != 0.0):
            signals.append(speed)
    rows = slice(_MOST_ROWS)
    current, signals = record[f"current_{channel}"][rows], [signal[rows] for signal in signals]
    octaves = _memory(current, signals)
    start = _oldest(octaves)
    solved = regression(current[start:], _regressors(signals, octaves, start)) if octaves else None
    return None if solved is None else _response(*solved, octaves, record)


def _response(
    weights: FloatArray, covariance: FloatArray, octaves: int, record: Measured
) -> CurrentResponse | None:
    """The response by the weights of the regressors and their covariance."""
    dt, (newest, oldest) = record.dt, _delays(octaves)
    width = oldest - newest + 1.0
    behind = len(weights) - len(width)
    steps = np.pad(width, (0, behind))
    times = np.pad(dt * (0.5 * (newest + oldest)) * width, (0, behind))
    gain, spread = float(steps @ weights), SIGMAS * _deviation(steps, covariance)
    if gain <= spread:
        return None
    # The mean of the times at which the response arrives; its samples come a whole one late.
    delay = float(times @ weights) / gain
    late = SIGMAS * _deviation(times - delay * steps, covariance) / gain
    per_speed = None
    if behind > 1:
        felt = np.concatenate([np.zeros(len(width)), [1.0], width, [0.0]])
        size = abs(float(felt @ weights))
        reach = SIGMAS * _deviation(felt, covariance) + _MARGIN * size
        per_speed = (max(size - reach, 0.0), size + reach)
    return CurrentResponse(
        (gain - spread, gain + spread),
        (max(delay - 1.5 * dt - late, 0.0), max(delay, 0.0) + 0.5 * dt + late),
        per_speed,
        record.name,
    )


def _memory(current: FloatArray, signals: list[FloatArray]) -> int:
    """Octaves of the past that the current depends on: one more than Schwarz's criterion takes.

    0 where no regression is possible.
    """
    best, lowest = 0, math.inf
    start = min(_oldest(_OCTAVES), len(current) // 2)
    target = current[start:]
    for octaves in range(1, _OCTAVES + 1):
        if _oldest(octaves) > start:
            break
        columns = _regressors(signals, octaves, start)
        solved = regression(target, columns)
        if solved is None:
            break
        residual = target - np.column_stack(columns) @ solved[0]
        rows = np.isfinite(residual)
        n = int(rows.sum())
        power: float = max(float(np.mean(residual[rows] ** 2)), 1e-300)
        score = n * math.log(power) + len(columns) * math.log(n)
        if score < lowest:
            best, lowest = octaves, score
    return min(best + 1, _OCTAVES) if best > 0 else 0


def _oldest(octaves: int) -> int:
    """The longest delay [samples], before which no row has all the past behind it."""
    return _PER_OCTAVE * ((1 << octaves) - 1)


def _delays(octaves: int) -> tuple[IntArray, IntArray]:
    """Newest and oldest delay of each group, from 1 on [samples]."""
    width = np.repeat(2 ** np.arange(octaves), _PER_OCTAVE)
    oldest = np.cumsum(width)
    return oldest - width + 1, oldest


def _regressors(signals: list[FloatArray], octaves: int, start: int) -> list[FloatArray]:
    """For the rows from ``start`` on: sums of each signal over the groups of delays, and 1.

    In front of those of the speed, the second signal, stands the speed itself: a command counts
    from the row after the one it stands in.
    """
    n = len(signals[0])
    columns = []
    for place, signal in enumerate(signals):
        if place > 0:
            columns.append(signal[start:])
        # Sums of all values before each row, and of all.
        total, lost = (
            np.concatenate([[0.0], np.cumsum(values)])
            for values in (np.nan_to_num(signal), np.isnan(signal))
        )
        for newest, oldest in zip(*_delays(octaves), strict=True):
            ends = slice(start - newest + 1, n - newest + 1)
            begins = slice(start - oldest, n - oldest)
            sums = total[ends] - total[begins]
            columns.append(np.where(lost[ends] > lost[begins], np.nan, sums))
    return [*columns, np.ones(n - start)]


def _deviation(direction: FloatArray, covariance: FloatArray) -> float:
    return math.sqrt(max(float(direction @ covariance @ direction), 0.0))


def _overlap(intervals: Sequence[Interval]) -> Interval:
    """What all intervals have in common; all that they cover where that is nothing."""
    lows, highs = zip(*intervals, strict=True)
    if max(lows) < min(highs):
        return max(lows), min(highs)
    return min(lows), max(highs)
