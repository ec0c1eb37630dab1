"""Limits: what stops a run, each a small class that looks at every sample.

A limit of one's own derives from ``Limit``; docs/safety.md shows one. Blocks are judged with
arrays; a block of one sample, as in closed loop, by plain numbers, which takes a fraction of the
time.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator

from daq.config.rig import OwnLimit, RigConfig
from daq.errors import USER_CODE_ERRORS, ConfigError, RigError, RunError, raised_in
from daq.hal import Flag, Phase, Samples
from daq.limits.base import Limit, Trip
from daq.limits.load import DeviceFound, I2t, Magnitude
from daq.limits.sensors import Frozen, Jump, Silence, Stalled
from daq.limits.shaft import Travel, Winding

__all__ = ["Limit", "Limits", "Trip", "mark_interlock"]


class Limits:
    """All limits of a rig, asked together."""

    def __init__(self, config: RigConfig) -> None:
        own = [_Named(_made(item)) for item in config.limits.own]
        self._limits: list[Limit] = [*_built_in(config), *own]

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
        first: Trip | None = None
        for limit in self._limits:
            trip = limit.check(samples)
            if trip is not None and (first is None or trip[0] < first[0]):
                first = trip
        return first


def _made(item: OwnLimit) -> Limit:
    """A user's own limit. Raises ConfigError for a mistake in its constructor."""
    try:
        made: Limit = item.make()
    except RigError:
        raise
    except USER_CODE_ERRORS as error:
        problem = f"{item.use} cannot be made: {type(error).__name__}: {error}"
        raise ConfigError(problem, key="limits.own") from error
    return made


def _built_in(config: RigConfig) -> list[Limit]:
    """The limits that a rig's file asks for; a value that is not finite passes none of them."""
    limits, encoder = config.limits, config.limits.encoder
    found: list[Limit] = [
        Magnitude("current_motor", limits.current.motor, "A"),
        Magnitude("current_brake", limits.current.brake, "A"),
        Magnitude("torque", limits.torque, "N*m"),
        Magnitude("omega", limits.speed, "rad/s"),
        Magnitude("theta", None, "rad"),
        Jump(encoder.fastest),
        Silence(encoder.silent),
    ]
    overloads = {"current_motor": limits.i2t.motor, "current_brake": limits.i2t.brake}
    found += [I2t(name, load) for name, load in overloads.items() if load is not None]
    if limits.travel is not None:
        found.append(Travel(*limits.travel))
    if limits.winding is not None:
        found.append(Winding(limits.winding))
    if encoder.stall is not None:
        found.append(Stalled(encoder.stall))
    if limits.frozen is not None:
        follows = {"motor": "current_motor", "brake": "current_brake"}
        found += [Frozen(name, limits.frozen, channel) for channel, name in follows.items()]
        found.append(Frozen("torque", limits.frozen, None))
    found.append(DeviceFound())  # last, for the others know more of what it found
    return found


def mark_interlock(samples: Samples, row: int) -> Samples:
    """The samples with the tripping row flagged."""
    flags = samples.flags.copy()
    flags[row] |= int(Flag.INTERLOCK)
    return dataclasses.replace(samples, flags=flags)


class _Named(Limit):
    """A limit of a user's own: what is wrong with it names its class."""

    def __init__(self, own: Limit) -> None:
        self._own = own

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Pass it on."""
        with self._blamed():
            self._own.begin(phase, sample_rate)

    def window(self) -> tuple[float, float]:
        """Pass it on."""
        with self._blamed():
            low, high = self._own.window()
            if not low <= high:
                raise ValueError(f"its window ({low!r}, {high!r}) is none")
            return float(low), float(high)

    def check(self, samples: Samples) -> Trip | None:
        """Pass it on, and see that the answer is one."""
        with self._blamed():
            trip = self._own.check(samples)
        if trip is None:
            return None
        try:
            row, reason = trip
            if not 0 <= int(row) < len(samples):
                raise ValueError
        except (TypeError, ValueError):
            raise RunError(
                f"the limit {type(self._own).__name__} answered {trip!r} to {len(samples)} samples",
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
            raise RunError(
                f"the limit {type(self._own).__name__} failed: {type(error).__name__}: {error}"
                f"{raised_in(type(self._own), error)}; outputs were set to zero"
            ) from error
