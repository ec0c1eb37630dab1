"""Volts of the HAL as converter codes of a device, by its channel table, and back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from daq.hal import ANALOG_INPUTS, CHANNELS, FloatArray, Guard, IntArray, RawSamples
from daq.serial import messages
from daq.serial.messages import Block, Channel, Codes

_N_IN, _N_OUT = len(ANALOG_INPUTS), len(CHANNELS)
_ROUNDING = 1e-9  # codes, by which a quotient may miss a whole number
_LARGEST_RATE = float(np.finfo(np.float32).max)  # 1/s


class CodedGuard(NamedTuple):
    """A ``daq.hal.Guard`` as START carries it; ends of a range for what is not watched."""

    command_low: tuple[int, ...]
    command_high: tuple[int, ...]
    analog_low: tuple[int, ...]
    analog_high: tuple[int, ...]
    counts_low: int
    counts_high: int
    count_rate: float
    count_step: int


class Scaling:
    """What the codes of a device mean. input_range: volts that every analog input can measure."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        inputs, outputs = channels[:_N_IN], channels[_N_IN : _N_IN + _N_OUT]
        self.input_range = max(c.low for c in inputs), min(c.high for c in inputs)
        self._in_scale, self._in_offset = _columns(inputs)
        self._out_scale, self._out_offset = _columns(outputs)
        self._guard: Guard | None = None

    def guarded(self, guard: Guard) -> CodedGuard:
        """A run's guard in codes; commands within its clamps stay within them from now on."""
        low, high = (self._out(volts) for volts in (guard.command_low, guard.command_high))
        under, over = (self._in(volts) for volts in (guard.analog_low, guard.analog_high))
        fewest, most = _least([guard.counts_low]), _most([guard.counts_high])
        command, wide, step = np.iinfo(np.int16), np.iinfo(np.int32), np.iinfo(np.uint32)
        coded = CodedGuard(
            _whole(_least(low), command),
            _whole(_most(high), command),
            _whole(_least(under), wide),
            _whole(_most(over), wide),
            _whole(fewest, wide)[0],
            _whole(most, wide)[0],
            guard.count_rate if guard.count_rate < _LARGEST_RATE else math.inf,
            _whole(_most([guard.count_step]), step)[0],
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
        ticks: IntArray = np.concatenate(
            [np.arange(b.first, b.first + len(b.records), dtype=np.int64) for b in blocks]
        )
        return RawSamples(
            tick=ticks,
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


def _least(values: Sequence[float] | FloatArray) -> FloatArray:
    """The lowest whole numbers that are not below."""
    return np.asarray(np.ceil(np.asarray(values) - _ROUNDING), dtype=np.float64)


def _most(values: Sequence[float] | FloatArray) -> FloatArray:
    """The highest whole numbers that are not above."""
    return np.asarray(np.floor(np.asarray(values) + _ROUNDING), dtype=np.float64)


def _whole(values: FloatArray, bounds: np.iinfo[Any]) -> tuple[int, ...]:
    """Whole numbers within a type's range; limits that are infinite become its ends."""
    return tuple(int(value) for value in np.clip(values, bounds.min, bounds.max))
