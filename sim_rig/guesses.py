"""What a log tells of the actuator's parameters before any search.

Electrical: the current's response to its command, by regression on past commands (and on the
speed, whose back-EMF the motor feels), gives its gain a [A/V], its mean delay d [s] (the area
between the step response and its end), and b, the current per speed [A*s/rad]. In steady state
and over the whole of a step these are, with f = 1 + K/R for a closed-loop driver (3.10) and f = 1
for an open-loop one (3.7),

    a = K_v2i K/R / f  (closed)    a = G/R  (open)
    b = n_c K_m / (R f)            d = (L + R/omega_d) / (R f)

so that resistance, driver gain and motor constant are known up to a common factor, and of
inductance and driver cutoff how large and how small they may be. What is assumed of one narrows
the others.

Mechanical: the slope (4.5) of the torque that resists the shaft over its speed, at moments at
which the speed is steady and the brake slides under an unchanged command. It is an upper limit:
Coulomb's jump at zero speed adds to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from sim_rig.options import DriverKind, FrictionKind, LoadKind
from sysid import Guess
from sysid.arrays import FloatArray, IntArray
from sysid.problem.guesses import Guesses, Known, Measured, regression

_SIGMAS = 3.0
_PER_OCTAVE = 8  # steps of an impulse response before they become twice as long
_OCTAVES = 6  # 504 samples
_MOST_ROWS = 20_000  # of a record in a regression
_MARGIN = 0.1  # of the current per speed: the speed is measured, and its error pulls it to zero
_HALF = 4  # samples either side that a torque is averaged over
_SLIDING = 0.3  # rad in one direction after which the brake slides whatever its stiffness
_FEWEST = 8  # moments of steady speed that make a slope
_SETTLED = 6.0  # mean delays after a change of the brake's command


@dataclass(frozen=True)
class _Channel:
    """Names of one amplifier and its winding."""

    name: str
    gain: str
    cutoff: str
    resistance: str
    inductance: str
    closed: bool

    @classmethod
    def of(cls, name: str, driver: DriverKind) -> _Channel:
        s, kind = name[0], "K" if driver == "closed" else "G"
        return cls(
            name, f"{kind}_d{s}", f"omega_d{s}", f"R_{s}", f"L_{s}", closed=driver == "closed"
        )


@dataclass(frozen=True)
class _Response:
    """Gain a, current per speed b, mean delay d: each (low, high); b may be unknown."""

    a: tuple[float, float]
    b: tuple[float, float] | None
    d: tuple[float, float]


@dataclass
class _Box:
    """Ranges as they get narrower, and what narrowed them last."""

    known: dict[str, tuple[float, float]]
    guesses: dict[str, Guess] = field(default_factory=dict)

    def narrow(self, name: str, low: float, high: float, source: str) -> None:
        """Keep what lies in [low, high]; all of it where the range assumed lies outside."""
        old = self.known[name]
        if old[0] == old[1]:
            return
        new = (max(old[0], low), min(old[1], high))
        if new[0] >= new[1]:
            new = (low or 0.1 * high, high if math.isfinite(high) else 10.0 * low)
        if not 0.0 < new[0] < new[1] < math.inf:
            return
        # A change of less than a hundredth is not worth a word.
        if new[0] > 1.01 * old[0] or new[1] < 0.99 * old[1] or new[0] > old[1]:
            self.known[name] = new
            self.guesses[name] = Guess(*new, source)

    def text(self, name: str) -> str:
        """A range as part of a source."""
        low, high = self.known[name]
        return f"{name} {low:.3g}" if low == high else f"{name} in {low:.3g} .. {high:.3g}"


def guesses(
    driver_motor: DriverKind, driver_brake: DriverKind, load: LoadKind, friction: FrictionKind
) -> Guesses:
    """The function that guesses ranges for an actuator of these parts.

    Brush friction or a load that is neither measured nor absent leave the damping unguessed.
    """
    channels = (_Channel.of("motor", driver_motor), _Channel.of("brake", driver_brake))

    def guess(records: Sequence[Measured], known: Known) -> dict[str, Guess]:
        box = _Box(dict(known))
        delay = 0.0
        for channel in channels:
            found = _responses(records, channel)
            if found is not None:
                response, names = found
                _electrical(box, channel, response, names)
                delay = response.d[1] if channel.name == "brake" else delay
        if friction == "none" and load in ("measured", "free"):
            _damping(box, records, _SETTLED * delay)
        return box.guesses

    return guess


# --- electrical -----------------------------------------------------------------------------


def _electrical(box: _Box, channel: _Channel, found: _Response, names: str) -> None:
    """Narrow what a channel's response ties together, until nothing moves."""
    R, gain = channel.resistance, channel.gain
    told = f"current_{channel.name} over its command, {_shown(found.a)} A/V in {names}"
    if channel.closed:
        # a = K_v2i r / (1 + r) with r = K/R; a noisy a may reach the K_v2i of an ideal amplifier
        v2i = box.known["K_v2i"]
        ratio = tuple(
            a / (k - a) if k > a else math.inf for a, k in zip(found.a, reversed(v2i), strict=True)
        )
        factor = (1.0 + ratio[0], 1.0 + ratio[1])
        told += f", K_v2i {v2i[0]:g}"
    else:
        ratio, factor = found.a, (1.0, 1.0)
    for _ in range(3):
        _product(box, gain, (ratio[0], ratio[1]), R, told)
        if found.b is not None:
            per = f"current_motor per speed, {_shown(found.b)} A*s/rad in {names}"
            size = sorted(abs(n) for n in box.known["n_c"])
            scale = (found.b[0] * factor[0] / size[1], found.b[1] * factor[1] / size[0])
            _product(box, "K_m", scale, R, per)
    resistance = box.known[R][1]
    wide = found.d[1] * factor[1]
    text = f"mean delay of current_{channel.name}, {1e3 * found.d[1]:.3g} ms at most in {names}"
    box.narrow(channel.inductance, 0.0, wide * resistance, f"{text}, {box.text(R)}")
    if wide > 0.0:
        box.narrow(channel.cutoff, 1.0 / wide, math.inf, text)


def _product(box: _Box, x: str, scale: tuple[float, float], y: str, told: str) -> None:
    """x = scale * y with the scale in a range: each narrows the other."""
    low, high = box.known[y]
    box.narrow(x, scale[0] * low, scale[1] * high, f"{told}, {box.text(y)}")
    low, high = box.known[x]
    if scale[0] > 0.0:
        below = low / scale[1] if math.isfinite(scale[1]) else 0.0
        box.narrow(y, below, high / scale[0], f"{told}, {box.text(x)}")


def _responses(records: Sequence[Measured], channel: _Channel) -> tuple[_Response, str] | None:
    """What all records together say, and their names."""
    found = [(r, _response(r, channel)) for r in records]
    told = [(r.name, response) for r, response in found if response is not None]
    if not told:
        return None
    a = _overlap([response.a for _, response in told])
    b = _overlap([response.b for _, response in told if response.b is not None])
    d = _overlap([response.d for _, response in told])
    assert a is not None and d is not None
    return _Response(a, b, d), _names([name for name, _ in told])


def _response(record: Measured, channel: _Channel) -> _Response | None:
    command, current = f"applied_voltage_{channel.name}", f"current_{channel.name}"
    if current not in record:
        return None
    signals = [record[command]]
    if channel.name == "motor":
        speed = _speed(record)
        if speed is None:
            return None
        if np.any(np.nan_to_num(speed) != 0.0):
            signals.append(speed)
    rows = slice(_MOST_ROWS)
    return _told(record[current][rows], [signal[rows] for signal in signals], record.dt)


def _told(current: FloatArray, signals: list[FloatArray], dt: float) -> _Response | None:
    """Gain and mean delay of the current behind the first signal, gain behind the second."""
    octaves = _memory(current, signals)
    fitted = _fit(current, signals, octaves, _first_row(octaves)) if octaves else None
    if fitted is None:
        return None
    h, covariance = fitted
    bins = _bins(octaves)
    width = np.array([len(each) for each in bins], dtype=np.float64)
    when = dt * np.array([each.mean() for each in bins]) * width
    sums = np.zeros(len(h))
    times = np.zeros(len(h))
    sums[: len(bins)], times[: len(bins)] = width, when
    gain, spread = float(sums @ h), _SIGMAS * _deviation(sums, covariance)
    if gain <= spread:
        return None
    # The mean of the times at which the response arrives; its samples come a whole one late.
    delay = float(times @ h) / gain
    off = _SIGMAS * _deviation(times - delay * sums, covariance) / gain
    per_speed = None
    if len(signals) > 1:
        felt = np.zeros(len(h))
        felt[len(bins) : -1] = [1.0, *width]
        size = abs(float(felt @ h))
        allowed = _SIGMAS * _deviation(felt, covariance) + _MARGIN * size
        per_speed = (max(size - allowed, 0.0), size + allowed)
    return _Response(
        (gain - spread, gain + spread),
        per_speed,
        (max(delay - 1.5 * dt - off, 0.0), max(delay, 0.0) + 0.5 * dt + off),
    )


def _memory(current: FloatArray, signals: list[FloatArray]) -> int:
    """Octaves of the past that the current depends on: one more than Schwarz's criterion asks.

    0 where no regression is possible.
    """
    best, least = 0, math.inf
    start = min(_first_row(_OCTAVES), len(current) // 2)
    for octaves in range(1, _OCTAVES + 1):
        if _first_row(octaves) > start:
            break
        fitted = _fit(current, signals, octaves, start)
        if fitted is None:
            break
        target, columns = _table(current, signals, octaves, start)
        residual = target - np.column_stack(columns) @ fitted[0]
        rows = np.isfinite(residual)
        n = int(rows.sum())
        power: float = max(float(np.mean(residual[rows] ** 2)), 1e-300)
        score = n * math.log(power) + len(columns) * math.log(n)
        if score < least:
            best, least = octaves, score
    return min(best + 1, _OCTAVES) if best > 0 else 0


def _bins(octaves: int) -> list[IntArray]:
    """Delays in samples from 1 on, grouped; eight groups, then eight twice as wide, and so on."""
    bins, begin = [], 1
    for octave in range(octaves):
        for _ in range(_PER_OCTAVE):
            bins.append(np.arange(begin, begin + 2**octave))
            begin += 2**octave
    return bins


def _first_row(octaves: int) -> int:
    """The first row that has all the past behind it."""
    return _PER_OCTAVE * ((1 << octaves) - 1)


def _fit(
    current: FloatArray, signals: list[FloatArray], octaves: int, start: int
) -> tuple[FloatArray, FloatArray] | None:
    return regression(*_table(current, signals, octaves, start))


def _table(
    current: FloatArray, signals: list[FloatArray], octaves: int, start: int
) -> tuple[FloatArray, list[FloatArray]]:
    """The current from a row on, over sums of what was before it, of the speed at it, and 1.

    A command counts from the row after the one it stands in.
    """
    n = len(current)
    columns = []
    for place, signal in enumerate(signals):
        if place > 0:
            columns.append(signal[start:])
        total = _running(np.nan_to_num(signal))
        lost = _running(np.isnan(signal).astype(np.float64))
        for each in _bins(octaves):
            # Rows start - oldest .. start - newest of the signal, summed, for each row from start.
            newest, oldest = int(each[0]), int(each[-1])
            behind = slice(start - newest + 1, n - newest + 1), slice(start - oldest, n - oldest)
            column = total[behind[0]] - total[behind[1]]
            columns.append(np.where(lost[behind[0]] > lost[behind[1]], np.nan, column))
    columns.append(np.ones(n - start))
    return current[start:], columns


def _running(values: FloatArray) -> FloatArray:
    """Sums of all values before each row, and of all."""
    return np.concatenate([[0.0], np.cumsum(values)])


def _deviation(direction: FloatArray, covariance: FloatArray) -> float:
    return math.sqrt(max(float(direction @ covariance @ direction), 0.0))


# --- mechanical -----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Slope:
    """The most that torque over speed can be [N*m*s/rad], at so many moments of a record.

    current: the least that the brake carried [A].
    """

    limit: float
    current: float
    moments: int
    name: str


def _damping(box: _Box, records: Sequence[Measured], settling: float) -> None:
    """Limits (4.5) of the viscous dampings from all records."""
    n_c = box.known["n_c"]
    if n_c[0] != n_c[1] or n_c[0] == 0.0:
        return
    slopes = [slope for record in records for slope in _slopes(record, box, n_c[0], settling)]
    if not slopes:
        return
    least = min(slopes, key=lambda slope: slope.limit)
    text = _slope_text(least, "") + f", {box.text('K_m')}"
    box.narrow("B_m", 0.0, least.limit / n_c[0] ** 2, text)
    box.narrow("c0", 0.0, least.limit, text)
    carrying = [slope for slope in slopes if slope.current > 0.0]
    if carrying:
        least = min(carrying, key=lambda slope: slope.limit / slope.current)
        text = _slope_text(least, f" under {least.current:.3g} A") + f", {box.text('K_m')}"
        box.narrow("c1", 0.0, least.limit / least.current, text)


def _slope_text(slope: _Slope, under: str) -> str:
    return (
        f"slope of torque over omega, {slope.limit:.3g} N*m*s/rad at most{under}, at "
        f"{slope.moments} moments of steady speed in {slope.name}"
    )


def _slopes(record: Measured, box: _Box, n_c: float, settling: float) -> list[_Slope]:
    """One for each brake command under which there are enough moments."""
    speed = _speed(record)
    if speed is None or "current_motor" not in record:
        return []
    load = record["torque"] if "torque" in record else np.zeros(len(speed))
    command = record["applied_voltage_brake"]
    omega = _smooth(speed)
    moments = _steady(omega, command, record.dt, settling)
    levels = command[_HALF : len(command) - _HALF]
    carried = _smooth(record["current_brake"]) if "current_brake" in record else None
    found = []
    for level in np.unique(levels[moments]):
        rows = moments & (levels == level)
        if rows.sum() < _FEWEST:
            continue
        limits = []
        for K_m in box.known["K_m"]:
            resisting = _smooth(load - n_c * K_m * record["current_motor"])
            fitted = regression(resisting[rows], [omega[rows], np.ones(int(rows.sum()))])
            if fitted is not None:
                limits.append(fitted[0][0] + _SIGMAS * math.sqrt(fitted[1][0, 0]))
        if len(limits) == 2 and max(limits) > 0.0:
            current = 0.0 if carried is None else _at_least(np.abs(carried[rows]))
            found.append(_Slope(max(limits), current, int(rows.sum()), record.name))
    return found


def _steady(
    omega: FloatArray, command: FloatArray, dt: float, settling: float
) -> npt.NDArray[np.bool_]:
    """Rows of the averaged speed at which it stands at a peak, the brake sliding undisturbed."""
    n = len(omega)
    change = np.diff(omega)
    peaks = np.zeros(n, dtype=bool)
    peaks[1:-1] = change[1:] * change[:-1] <= 0.0
    # Distance since the motion last turned round.
    angle = dt * np.cumsum(np.nan_to_num(omega))
    turned = np.concatenate([[True], np.sign(omega[1:]) != np.sign(omega[:-1])])
    since = np.maximum.accumulate(np.where(turned, np.arange(n), 0))
    sliding = np.abs(angle - angle[since]) >= _SLIDING
    # Rows since the command last changed, to the end of the average.
    rows = np.arange(len(command))
    changed = np.concatenate([[False], np.diff(command) != 0.0])
    last = np.maximum.accumulate(np.where(changed, rows, -len(command)))
    quiet = (rows - last)[2 * _HALF :] >= 2 * _HALF + settling / dt
    steady: npt.NDArray[np.bool_] = peaks & sliding & quiet & np.isfinite(omega)
    return steady


def _at_least(values: FloatArray) -> float:
    """A mean less what it may be off."""
    return max(0.0, float(values.mean() - _SIGMAS * values.std() / math.sqrt(len(values))))


# --- signals and texts ----------------------------------------------------------------------


def _speed(record: Measured) -> FloatArray | None:
    """Measured, or the difference of the angle."""
    if "omega" in record:
        return record["omega"]
    if "theta" in record:
        speed: FloatArray = np.gradient(record["theta"], record.dt)
        return speed
    return None


def _smooth(values: FloatArray) -> FloatArray:
    """Means over 2 _HALF + 1 samples; row k is that around sample k + _HALF."""
    return np.convolve(values, np.full(2 * _HALF + 1, 1.0 / (2 * _HALF + 1)), "valid")


def _overlap(ranges: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """What all ranges have in common; all that they cover where that is nothing."""
    if not ranges:
        return None
    low, high = max(r[0] for r in ranges), min(r[1] for r in ranges)
    if low < high:
        return low, high
    return min(r[0] for r in ranges), max(r[1] for r in ranges)


def _shown(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.4g} .. {ends[1]:.4g}"


def _names(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} logs"
