"""Limits: what stops a run, each a small class that looks at every sample.

A limit of one's own derives from ``Limit``; docs/safety.md shows one. Blocks are judged with
arrays; a block of one sample, as in closed loop, by plain numbers, which takes a fraction of the
time.
"""

import contextlib
from collections.abc import Iterator
from operator import itemgetter

from daq.config.rig import RigConfig, UserLimit
from daq.errors import USER_CODE_ERRORS, ConfigError, RigError, RunError, raised_in
from daq.hal import CHANNELS, Phase, Samples
from daq.limits.base import Limit, Trip
from daq.limits.load import DeviceFound, I2t, Magnitude
from daq.limits.sensors import Frozen, Jump, Silence, Stalled
from daq.limits.shaft import Travel, Winding

__all__ = ["Limit", "Limits", "Trip"]


class Limits:
    """All limits of a rig, asked together."""

    def __init__(self, config: RigConfig) -> None:
        users = [_UserCode(settings) for settings in config.limits.own]
        self._limits: list[Limit] = [*_built_in(config), *users]

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Tell every limit that a phase begins."""
        for limit in self._limits:
            limit.begin(phase, sample_rate)

    def window(self) -> tuple[float, float]:
        """Angles [rad] from the first of the phase that no limit wants the shaft to leave."""
        lows, highs = zip(*(limit.window() for limit in self._limits), strict=True)
        return max(lows), min(highs)

    def check(self, samples: Samples) -> Trip | None:
        """The first row beyond any limit, and why; the earlier limit of two in one row."""
        trips = [limit.check(samples) for limit in self._limits]
        return min(filter(None, trips), key=itemgetter(0), default=None)


def _built_in(config: RigConfig) -> list[Limit]:
    """The limits that a rig's file asks for; a value that is not finite passes none of them."""
    settings, encoder = config.limits, config.limits.encoder
    limits: list[Limit] = [
        Magnitude("current_motor", settings.current.motor, "A"),
        Magnitude("current_brake", settings.current.brake, "A"),
        Magnitude("torque", settings.torque, "N*m"),
        Magnitude("omega", settings.speed, "rad/s"),
        Magnitude("theta", None, "rad"),
        Jump(encoder.fastest),
        Silence(encoder.silent),
    ]
    for channel in CHANNELS:
        overload = getattr(settings.i2t, channel)
        if overload is not None:
            limits.append(I2t(f"current_{channel}", overload))
    if settings.travel is not None:
        limits.append(Travel(*settings.travel))
    if settings.winding is not None:
        limits.append(Winding(settings.winding))
    if encoder.stall is not None:
        limits.append(Stalled(encoder.stall))
    if settings.frozen is not None:
        limits += [Frozen(f"current_{name}", settings.frozen, name) for name in CHANNELS]
        limits.append(Frozen("torque", settings.frozen, None))
    limits.append(DeviceFound())  # last, for the others know more of what it found
    return limits


class _UserCode(Limit):
    """A limit of a user's own: errors in its constructor or its methods name its class."""

    def __init__(self, settings: UserLimit) -> None:
        try:
            self._limit: Limit = settings.make()
        except RigError:
            raise
        except USER_CODE_ERRORS as error:
            problem = f"{settings.use} cannot be made: {type(error).__name__}: {error}"
            raise ConfigError(problem, key="limits.own") from error
        self._name = f"the limit {type(self._limit).__name__}"

    def begin(self, phase: Phase, sample_rate: float) -> None:
        with self._blamed():
            self._limit.begin(phase, sample_rate)

    def window(self) -> tuple[float, float]:
        with self._blamed():
            low, high = self._limit.window()
            if not low <= high:
                raise ValueError(f"its window ({low!r}, {high!r}) is none")
            return float(low), float(high)

    def check(self, samples: Samples) -> Trip | None:
        with self._blamed():
            trip = self._limit.check(samples)
        if trip is None:
            return None
        try:
            row, reason = trip
            if not 0 <= int(row) < len(samples):
                raise ValueError
        except (TypeError, ValueError):
            raise RunError(
                f"{self._name} answered {trip!r} to {len(samples)} samples",
                cure="check must return None or (row, reason); outputs were set to zero",
            ) from None
        return int(row), str(reason)

    @contextlib.contextmanager
    def _blamed(self) -> Iterator[None]:
        try:
            yield
        except RigError:
            raise
        except USER_CODE_ERRORS as error:
            place = raised_in(type(self._limit), error)
            problem = f"{self._name} failed: {type(error).__name__}: {error}{place}"
            raise RunError(f"{problem}; outputs were set to zero") from error
