"""Ranges of drivers and windings from the currents' responses to the amplifiers' commands.

A response is a regression on past commands; the motor's current also feels the speed at its
sample and before, by the back-EMF. The delays are grouped, eight groups of one sample, then eight
twice as wide, and so on for some octaves.

In steady state, and over the whole of a step, the gain a [A/V], the current per speed b [A*s/rad]
and the mean delay d [s] of a current's response are, with f = 1 + K/R for a closed-loop driver
(3.10) and f = 1 for an open-loop one (3.7),

    a = K_v2i K/R / f  (closed)    a = G/R  (open)
    b = n_c K_m / (R f)            d = (L + R/omega_d) / (R f)

so that resistance, driver gain and motor constant follow up to a common factor, and of
inductance and driver cutoff how large and how small they may be. What is assumed of one narrows
the others. R is the winding's resistance and the driver's output resistance in series; of a driver
of higher order omega_d is the first cutoff, by which alone its mean delay is.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_rig.guesses.ranges import Interval, Ranges
from sim_rig.physics.options import DriverKind
from sysid.arrays import FloatArray, IntArray
from sysid.problem.guesses import Measured, regression

SIGMAS = 3.0  # standard errors either side of an estimate

_ROUNDS = 3  # after which ranges that narrow each other have settled
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
    per_speeds = list(filter(None, [response.per_speed for response in responses]))
    gain = _overlap([response.gain for response in responses])
    delay = _overlap([response.delay for response in responses])
    source = responses[0].source if len(responses) == 1 else f"{len(responses)} logs"
    return CurrentResponse(gain, delay, _overlap(per_speeds) if per_speeds else None, source)


def narrow(
    ranges: Ranges,
    records: Sequence[Measured],
    channel: str,
    driver: DriverKind,
    output_resistance: bool,
) -> float:
    """Narrow what the response of a channel, motor or brake, ties together; its longest delay."""
    response = current_response(records, channel)
    if response is None:
        return 0.0
    index, where = channel[0], f"in {response.source}"
    resistance = f"R_{index}"
    if output_resistance:
        resistance = ranges.add(f"R_{index}", f"R_o{index}")
    gain = response.gain
    source = f"current_{channel} over its command, {_text(gain)} A/V {where}"
    ratio, factor = gain, (1.0, 1.0)
    if driver == "closed":
        # a = K_v2i r / (1 + r) with r = K/R; a noisy a may reach the K_v2i of an ideal amplifier
        lowest_v2i, highest_v2i = ranges.intervals["K_v2i"]
        ratio = _loop_gain(gain[0], highest_v2i), _loop_gain(gain[1], lowest_v2i)
        factor = 1.0 + ratio[0], 1.0 + ratio[1]
        source += f", K_v2i {lowest_v2i:g}"
    for _ in range(_ROUNDS):
        driver_gain = f"{'K' if driver == 'closed' else 'G'}_d{index}"
        ranges.narrow_product(driver_gain, ratio, resistance, source)
        if response.per_speed is not None:
            low, high = response.per_speed
            size = sorted(abs(n) for n in ranges.intervals["n_c"])
            scale = low * factor[0] / size[1], high * factor[1] / size[0]
            felt = f"current_motor per speed, {_text(response.per_speed)} A*s/rad {where}"
            ranges.narrow_product("K_m", scale, resistance, felt)
    delay = response.delay[1]
    longest = delay * factor[1]
    source = f"mean delay of current_{channel}, {1e3 * delay:.3g} ms at most {where}"
    highest = longest * ranges.intervals[resistance][1]
    ranges.narrow(f"L_{index}", 0.0, highest, f"{source}, {ranges.text(resistance)}")
    if longest > 0.0:
        ranges.narrow(f"omega_d{index}", 1.0 / longest, math.inf, source)
    if output_resistance:
        ranges.resolve(f"R_{index}", f"R_o{index}")
    return delay


def _loop_gain(gain: float, K_v2i: float) -> float:
    """r of a = K_v2i r / (1 + r)."""
    return gain / (K_v2i - gain) if K_v2i > gain else math.inf


def _text(interval: Interval) -> str:
    return f"{interval[0]:.4g} .. {interval[1]:.4g}"


def speed_of(record: Measured) -> FloatArray | None:
    """Speed [rad/s] as measured, or the difference of the angle, (n_samples,)."""
    if "omega" in record:
        return record["omega"]
    if "theta" in record:
        return np.gradient(record["theta"], record.dt)
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
    delays = max(delay - 1.5 * dt - late, 0.0), max(delay, 0.0) + 0.5 * dt + late
    return CurrentResponse((gain - spread, gain + spread), delays, per_speed, record.name)


def _memory(current: FloatArray, signals: list[FloatArray]) -> int:
    """Octaves of the past in the current, one more than Schwarz's criterion takes; 0 for none."""
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
