"""Limits: what stops a run, each a small class that looks at every sample.

A limit of one's own derives from ``Limit``; docs/safety.md shows one. Blocks are judged with
arrays; a block of one sample, as in closed loop, by plain numbers, which takes a fraction of the
time.
"""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter

from daq.config.rig import RigConfig, UserLimit
from daq.errors import USER_CODE_ERRORS, ConfigError, RigError, RunError, raised_in
from daq.hal import CHANNELS, Flag, Phase, Samples
from daq.limits.agreement import CurrentAgreement, TorqueAgreement
from daq.limits.base import Limit, Trip
from daq.limits.encoder import Acceleration, Contrary, Disagreement, Drive, Stalled
from daq.limits.load import DeviceFound, I2t, Magnitude
from daq.limits.sensors import Frozen, Jump
from daq.limits.shaft import CountedSpeed, Travel, Winding

__all__ = ["Doubt", "Limit", "Limits", "Trip"]

_LEAST = 0.1  # of the current's limit, that may be friction where no stall tells


@dataclass(frozen=True)
class Doubt:
    """What a limit that does not stop a run has said first, and of which sample."""

    phase: str
    tick: int
    reason: str

    @property
    def sentence(self) -> str:
        """For people."""
        return f"sample {self.tick} of the {self.phase}: {self.reason}"


class Limits:
    """All limits of a rig, asked together.

    faults: those too that tell hardware which fails. only: those of one class.
    """

    def __init__(
        self, config: RigConfig, *, faults: bool = True, only: type[Limit] = Limit
    ) -> None:
        users = [_UserCode(settings) for settings in config.limits.own]
        limits = [*_built_in(config), *users]
        self._limits = [
            limit
            for limit in limits
            if isinstance(limit, only) and (faults or not limit.tells_faults)
        ]
        self._phase = Phase.OPEN
        self._doubts: dict[Limit, Doubt] = {}

    @property
    def doubts(self) -> list[Doubt]:
        """What those have said that do not stop a run, once each."""
        return list(self._doubts.values())

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Tell every limit that a phase begins."""
        self._phase = phase
        for limit in self._limits:
            limit.begin(phase, sample_rate)

    def window(self) -> tuple[float, float]:
        """Angles [rad] from the first of the phase that no limit wants the shaft to leave."""
        lows, highs = zip(*(limit.window() for limit in self._limits), strict=True)
        return max(lows), min(highs)

    def check(self, samples: Samples) -> Trip | None:
        """The first row beyond any limit, and why; the earlier limit of two in one row.

        A row that a limit only doubts is flagged.
        """
        trips = []
        for limit in self._limits:
            trip = limit.check(samples)
            if trip is None:
                continue
            if limit.stops:
                trips.append(trip)
            else:
                self._note(limit, samples, *trip)
        return min(trips, key=itemgetter(0), default=None)

    def _note(self, limit: Limit, samples: Samples, row: int, reason: str) -> None:
        samples.flags[row] |= int(Flag.DOUBTFUL)
        self._doubts.setdefault(limit, Doubt(self._phase.value, samples.tick.item(row), reason))


def _built_in(config: RigConfig) -> list[Limit]:
    """The limits that a rig's file asks for; a value that is not finite passes none of them."""
    settings, encoder = config.limits, config.limits.encoder
    count = abs(config.sensors.encoder.count)  # rad
    gains = config.amplifiers.motor, config.amplifiers.brake
    limits: list[Limit] = [
        Magnitude("current_motor", settings.current.motor, "A"),
        Magnitude("current_brake", settings.current.brake, "A"),
        Magnitude("torque", settings.torque, "N*m"),
        Magnitude("omega", settings.speed, "rad/s"),
        Magnitude("theta", None, "rad"),
        Jump(encoder.fastest),
        Disagreement(encoder.silent),
    ]
    if settings.speed is not None:
        limits.append(CountedSpeed(settings.speed, count))
    for channel in CHANNELS:
        overload = getattr(settings.i2t, channel)
        if overload is not None:
            limits.append(I2t(f"current_{channel}", overload))
    if settings.travel is not None:
        limits.append(Travel(*settings.travel))
    if settings.winding is not None:
        limits.append(Winding(settings.winding))
    if encoder.stall is not None:
        drive = Drive(encoder.stall, gains)
        limits.append(Stalled(encoder.stall, drive, count))
        if settings.speed is not None:
            limits.append(Contrary(drive, settings.speed))
        if encoder.acceleration is not None:
            limits.append(Acceleration(drive, encoder.acceleration, count))
    limits += [*_of_currents(config), *_of_torque(config)]
    if settings.frozen is not None:
        limits += [Frozen(f"current_{name}", settings.frozen, name) for name in CHANNELS]
        limits.append(Frozen("torque", settings.frozen, None))
    limits.append(DeviceFound())  # last, for the others know more of what it found
    return limits


def _of_currents(config: RigConfig) -> list[Limit]:
    """Limits that currents of amplifiers with a known gain allow."""
    limits: list[Limit] = []
    for channel in CHANNELS:
        gain = getattr(config.amplifiers, channel)
        if gain is not None:
            # The brake has no back EMF.
            slow = math.inf if channel == "brake" else config.amplifiers.speed or config.slow
            most = getattr(config.limits.current, channel)
            limits.append(CurrentAgreement(channel, gain, most, slow))
    return limits


def _of_torque(config: RigConfig) -> list[Limit]:
    """The limit that a torque sensor between motor and brake allows."""
    constant, stall = config.sensors.torque.motor_constant, config.limits.encoder.stall
    if constant is None:
        return []
    current = stall.motor if stall is not None else _LEAST * config.limits.current.motor
    return [TorqueAgreement(constant, constant * current, config.slow)]


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
        self.stops = bool(self._limit.stops)
        self.tells_faults = bool(self._limit.tells_faults)

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
                cure="check must return None or (row, reason)",
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
            raise RunError(problem) from error
