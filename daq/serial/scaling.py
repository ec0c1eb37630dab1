"""Volts of the HAL as converter codes of a device, by its channel table, and back."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from daq.hal import ANALOG_INPUTS, CHANNELS, FloatArray, Guard, RawSamples
from daq.serial import messages
from daq.serial.messages import Block, Channel, CodedGuard, Codes

_N_IN, _N_OUT = len(ANALOG_INPUTS), len(CHANNELS)
_ROUNDING = 1e-9  # codes, by which a quotient may miss a whole number
_LARGEST_RATE = float(np.finfo(np.float32).max)  # 1/s


class Scaling:
    """Scales of a device's codes. input_range: volts that every analog input can measure."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        inputs, outputs = channels[:_N_IN], channels[_N_IN : _N_IN + _N_OUT]
        self.input_range = max(c.low for c in inputs), min(c.high for c in inputs)
        self._in_scale, self._in_offset = _columns(inputs)
        self._out_scale, self._out_offset = _columns(outputs)
        self._guard: Guard | None = None

    def coded(self, guard: Guard) -> CodedGuard:
        """A run's guard in codes; commands within its clamps stay within them from now on."""
        coded = CodedGuard(
            _ceil(self._out(guard.command_low), np.int16),
            _floor(self._out(guard.command_high), np.int16),
            _ceil(self._in(guard.analog_low), np.int32),
            _floor(self._in(guard.analog_high), np.int32),
            _ceil([guard.counts_low], np.int32)[0],
            _floor([guard.counts_high], np.int32)[0],
            guard.count_rate if guard.count_rate < _LARGEST_RATE else math.inf,
            _floor([guard.count_step], np.uint32)[0],
        )
        self._guard, self._low, self._high = guard, coded.command_low, coded.command_high
        return coded

    def commands(self, volts: FloatArray) -> Codes:
        """Converter codes (n, 2) of commands (n, 2) [V], the nearest to each.

        A command within the clamps is not rounded to beyond them, where the device would flag it.
        """
        assert self._guard is not None, "a run begins with its guard"
        codes = np.rint(self._out(volts))
        codes = np.where(volts <= self._guard.command_high, np.minimum(codes, self._high), codes)
        codes = np.where(volts >= self._guard.command_low, np.maximum(codes, self._low), codes)
        info = np.iinfo(np.int16)
        return np.clip(codes, info.min, info.max).astype(messages.COMMAND_DTYPE)

    def samples(self, blocks: Sequence[Block]) -> RawSamples:
        """Blocks of records in volts and counts."""
        records = messages.joined(blocks)
        ticks = [np.arange(b.first, b.first + len(b.records), dtype=np.int64) for b in blocks]
        return RawSamples(
            tick=np.concatenate(ticks),
            analog=records["analog"] * self._in_scale + self._in_offset,
            counts=records["counts"].astype(np.float64),
            count_rate=records["count_rate"].astype(np.float64),
            applied=records["applied"] * self._out_scale + self._out_offset,
            flags=records["flags"].astype(np.int64),
        )

    def _in(self, volts: FloatArray) -> FloatArray:
        return np.asarray((volts - self._in_offset) / self._in_scale, dtype=np.float64)

    def _out(self, volts: FloatArray) -> FloatArray:
        return np.asarray((volts - self._out_offset) / self._out_scale, dtype=np.float64)


def _columns(channels: Sequence[Channel]) -> tuple[FloatArray, FloatArray]:
    return np.array([c.scale for c in channels]), np.array([c.offset for c in channels])


def _ceil(values: npt.ArrayLike, kind: type[np.integer]) -> tuple[int, ...]:
    """The lowest whole numbers of an integer type that are not below the values."""
    return _within(np.ceil(np.asarray(values) - _ROUNDING), kind)


def _floor(values: npt.ArrayLike, kind: type[np.integer]) -> tuple[int, ...]:
    """The highest whole numbers of an integer type that are not above the values."""
    return _within(np.floor(np.asarray(values) + _ROUNDING), kind)


def _within(values: FloatArray, kind: type[np.integer]) -> tuple[int, ...]:
    """Whole numbers within a type's range; limits that are infinite become its ends."""
    bounds = np.iinfo(kind)
    return tuple(int(value) for value in np.clip(values, bounds.min, bounds.max))
