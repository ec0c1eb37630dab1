"""A rig on a serial port, as a ``daq.hal.Device``."""

import contextlib
import math
import re
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds, Unit
from daq.counter import Counter
from daq.errors import DeviceError
from daq.hal import (
    ANALOG_INPUTS,
    CHANNELS,
    DeviceInfo,
    FloatArray,
    Guard,
    LawScales,
    Mode,
    Phase,
    RawSamples,
)
from daq.serial import messages
from daq.serial.connection import Connection
from daq.serial.host import HostMachine
from daq.serial.messages import Block, Channel, CodedGuard, Codes, Latch, Law, Start, Type, Welcome

_SAFE_PATIENCE = 0.25  # s to hear that the outputs are zero
_RATE_TOLERANCE = 5e-5  # as good as a quartz
_MOST_DRIFT = 200.0  # ppm between two clocks with a quartz each, and to spare
_SIGMAS = 3.0  # of the drift's error that are not held against the device
_N_IN, _N_OUT = len(ANALOG_INPUTS), len(CHANNELS)
_SHORT, _NEAR = 2**16, 2**12  # counts of a short counter, and in a tick at its end
_ROUNDING = 1e-9  # codes, by which a quotient may miss a whole number
_LAW = re.compile(r", law ([0-9a-f]{8})$")  # in what a firmware says of itself
_LARGEST_RATE = float(np.finfo(np.float32).max)  # 1/s


class SerialOptions(Section):
    """Options of the serial backend."""

    port: str = Field(
        "", description="device name (/dev/serial/by-id/..., COM3), or a URL such as socket://"
    )
    baud: Annotated[int, Unit("bit/s")] = Field(
        2_000_000, ge=1200, le=20_000_000, description="speed of a UART; USB does not care"
    )
    watchdog: Seconds = Field(
        0.1,
        ge=0.01,
        le=10.0,
        description="the device zeroes its outputs when it hears nothing for so long",
    )


class SerialDevice:
    """A device on a port (see ``daq.hal.Device`` for the methods)."""

    Options = SerialOptions

    def __init__(self, options: SerialOptions) -> None:
        self.options = options
        self._connection: Connection | None = None
        self._facts: dict[str, Any] = {}  # of the device, for the record of a run
        self._warnings: list[str] = []
        self._unsafe = ""  # why the device has not confirmed zero outputs
        self._record: dict[str, Any] = {}  # of the line
        self._run = 0
        self._armed = self._going = False

    def open(self) -> DeviceInfo:
        """Connect, agree on the protocol, and clear what an earlier run left behind."""
        self.close()
        if not self.options.port:
            raise DeviceError(
                "no port is named; write options.port in the rig file or give --port. 'rig ports' "
                "lists the ports that there are"
            )
        options = self.options
        connection = Connection(options.port, options.baud, options.watchdog)
        welcome, self._warnings = connection.welcome, connection.warnings
        self._facts = {
            "port": options.port,
            "device": welcome.device,
            "firmware": welcome.firmware,
            "serial_number": welcome.serial,
            "protocol_version": welcome.version,
            "watchdog_tripped_before": welcome.latch is Latch.WATCHDOG,
        }
        try:
            connection.check_delay()
            connection.ask(Type.CLEAR)
        except BaseException:
            connection.close()
            raise
        self._connection, self._scaling = connection, Scaling(welcome.channels)
        volts_in = self._scaling.input_range
        return DeviceInfo(
            _name(welcome),
            welcome.max_rate,
            welcome.queue,
            volts_in,
            step_out=self._scaling.step_out,
            law=_law_of(welcome),
        )

    def announce(self, phase: Phase, turns: float = 0.0) -> None:
        """Tell the device which phase begins; an emulator's user winds the handle then."""
        payload = messages.ANNOUNCE.pack(list(Phase).index(phase), turns)
        self._opened().ask(Type.ANNOUNCE, payload)

    def start(self, sample_rate: float, mode: Mode, guard: Guard) -> None:
        """Arm the device. Its clock starts with the first ``receive``, what was sent preloaded."""
        connection = self._opened()
        self._run = (self._run + 1) & 0xFFFF
        self._going = False
        period, watchdog = self._timing(sample_rate, connection.welcome)
        start = Start(self._run, mode, period, watchdog, self._scaling.coded(guard))
        connection.schedule_as_caller()
        self._armed = True
        connection.request(lambda machine, now: machine.start(start, now))

    def send(self, tick: int, commands: FloatArray) -> None:
        """Queue commands (n, 2) [V]; what the device has no room for yet waits here."""
        connection = self._sampling()
        codes = self._scaling.commands(np.asarray(commands, dtype=np.float64))
        connection.act(lambda machine, now: machine.send(tick, codes, now))

    def room(self) -> int:
        """Commands that may be sent now."""
        return self._sampling().act(lambda machine, now: machine.commands.room)

    def receive(self) -> RawSamples:
        """Samples received so far; waits for the first."""
        connection = self._sampling()
        if not self._going:
            connection.go()
            self._going = True
        return self._scaling.samples(connection.samples())

    def answer(self, first: int, blend: int, scales: LawScales | None) -> None:
        """Let the device's own torque controller answer from a tick on, or commands again."""
        law = self._scaling.law(self._run, first, blend, scales)
        self._sampling().ask(Type.LAW, law.pack())

    def stop(self) -> None:
        """End sampling; outputs are zero."""
        connection = self._opened()
        self._armed = False
        self._record = connection.describe()
        connection.request(HostMachine.stop)

    def safe(self) -> None:
        """Zero both outputs now. Where the device cannot be reached, its watchdog does it."""
        if self._connection is not None:
            try:
                # Said even to a device that seems lost: it may still hear.
                self._connection.ask(Type.SAFE, give_up=_SAFE_PATIENCE)
            except DeviceError as error:
                self._unsafe = self._unsafe or f"SAFE was not acknowledged: {error}"

    def close(self) -> None:
        """Zero the outputs and disconnect."""
        self.safe()
        if self._connection is None:
            return
        if self._armed:
            with contextlib.suppress(DeviceError):
                self.stop()
        self._connection.close()
        self._connection = None

    def report(self) -> dict[str, Any]:
        """Device, connection and line, for the record of a run."""
        if not self._facts:
            return {}
        if self._connection is not None and self._armed:
            self._record = self._connection.describe()
        line = self._record.get("line", {})
        warnings = [*self._warnings, *filter(None, [self._unsafe])]
        if line.get("lost_samples"):
            warnings.append(
                f"{line['lost_samples']} samples were lost ({line['device_overflow_samples']} of "
                "them by the device, for which the line was too slow) and "
                f"{line['rejected_frames']} damaged frames refused; the log shows the gaps"
            )
        if warning := _drift_warning(self._record.get("clock")):
            warnings.append(warning)
        return {**self._facts, "warnings": warnings, **self._record}

    def _opened(self) -> Connection:
        if self._connection is None:
            raise DeviceError("the serial rig is not open; open it before starting")
        return self._connection

    def _sampling(self) -> Connection:
        connection = self._opened()
        if not self._armed:
            raise DeviceError("the serial rig is not sampling; start it first")
        return connection

    def _timing(self, sample_rate: float, welcome: Welcome) -> tuple[int, int]:
        """Ticks of the device's clock per sample, and the watchdog [ms]."""
        if sample_rate > welcome.max_rate:
            raise DeviceError(
                f"{_name(welcome)} samples at up to {welcome.max_rate:g} Hz; "
                f"sample_rate {sample_rate:g} Hz is too fast for it"
            )
        period = max(1, round(welcome.clock / sample_rate))
        if abs(welcome.clock / period / sample_rate - 1.0) > _RATE_TOLERANCE:
            near = [welcome.clock / p for p in (period + 1, period, period - 1) if p > 0]
            raise DeviceError(
                f"the device's clock of {welcome.clock:g} Hz cannot be divided down to "
                f"{sample_rate:g} Hz; near it are {', '.join(f'{rate:.9g}' for rate in near)} Hz"
            )
        watchdog = round(1e3 * self.options.watchdog)
        if watchdog > welcome.watchdog_longest:
            raise DeviceError(
                f"options.watchdog: {_name(welcome)} waits {welcome.watchdog_longest} ms at most, "
                f"not {watchdog} ms"
            )
        return period, watchdog


def _drift_warning(clock: dict[str, Any] | None) -> str | None:
    """What is wrong with a clock that drifts by more than two quartzes, and the cure."""
    if clock is None or clock["drift_ppm"] is None:
        return None
    drift, error = clock["drift_ppm"], clock["drift_error_ppm"]
    if abs(drift) <= _MOST_DRIFT + _SIGMAS * error:
        return None
    return (
        f"the device's clock drifts by {drift:.0f} ppm (standard error {error:.0f}) from this "
        "computer's, and with it every time, speed and identified parameter of the log. Give the "
        "device a quartz, or let WELCOME say the frequency that its clock has"
    )


def _name(welcome: Welcome) -> str:
    return f"{welcome.device} (firmware {welcome.firmware})"


def _law_of(welcome: Welcome) -> str:
    """Fingerprint of the controller in a firmware, as its name ends in; empty for none."""
    end = _LAW.search(welcome.firmware)
    return end[1] if end is not None else ""


class Scaling:
    """Scales of a device's codes.

    input_range: volts that every analog input can measure. step_out [V]: of the coarser output.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        inputs, outputs = channels[:_N_IN], channels[_N_IN : _N_IN + _N_OUT]
        self.input_range = max(c.low for c in inputs), min(c.high for c in inputs)
        self._in_scale, self._in_offset = _columns(inputs)
        self._out_scale, self._out_offset = _columns(outputs)
        counter = channels[-1]
        # It has 32 bits, or 16 where its row of the channel table ends there.
        is_short = counter.high - counter.low == _SHORT - 1
        self._counter = Counter(_SHORT if is_short else 2**32)
        self.step_out = float(np.abs(self._out_scale).max())
        self._guard: Guard  # of the run
        self._count: int | None = None  # the latest of the run

    def coded(self, guard: Guard) -> CodedGuard:
        """A run's guard in codes; commands within its clamps stay within them from now on."""
        # An inverting stage has a negative scale, and its lowest volts the highest code.
        low, high = np.sort([self._out(guard.command_low), self._out(guard.command_high)], axis=0)
        self._low, self._high = _within(low, high, np.int16)
        self._guard, self._count = guard, None
        low, high = np.sort([self._in(guard.analog_low), self._in(guard.analog_high)], axis=0)
        analog = _within(low, high, np.int32)
        counts = _within(guard.counts_low, guard.counts_high, np.int32)
        rate = guard.count_rate if guard.count_rate < _LARGEST_RATE else math.inf
        _, step = _within(0.0, guard.count_step, np.uint32)
        return CodedGuard(self._low, self._high, *analog, *counts, rate, step)

    def commands(self, volts: FloatArray) -> Codes:
        """Converter codes (n, 2) of commands (n, 2) [V], the nearest to each.

        A command within the clamps is not rounded to beyond them, where the device would flag it.
        """
        codes = np.rint(self._out(volts))
        within = (self._guard.command_low <= volts) & (volts <= self._guard.command_high)
        codes = np.where(within, np.clip(codes, self._low, self._high), codes)
        info = np.iinfo(np.int16)
        return np.clip(codes, info.min, info.max).astype(messages.COMMAND_DTYPE)

    def law(self, run: int, first: int, blend: int, scales: LawScales | None) -> Law:
        """LAW of a run, in codes; the counter's zero is the device's."""
        if scales is None:
            return Law(run, False, first, blend, 0, 0.0, (0.0, 0.0), (0.0, 0.0), 0.0)
        analog = scales.current_motor, scales.torque
        places = [ANALOG_INPUTS.index(name) for name in ("current_motor", "torque")]
        current, torque = (
            (float(slope * self._in_scale[at]), float(slope * self._in_offset[at] + zero))
            for (slope, zero), at in zip(analog, places, strict=True)
        )
        reference = scales.reference * float(self._out_scale[0])
        return Law(run, True, first, blend, 0, scales.angle, current, torque, reference)

    def samples(self, blocks: Sequence[Block]) -> RawSamples:
        """Blocks of records in volts and counts; DeviceError for a counter that runs over early."""
        records = messages.joined(blocks)
        ticks = [np.arange(b.first, b.first + len(b.records), dtype=np.int64) for b in blocks]
        counts = self._counter.unwrapped(records["counts"].astype(np.int64))
        before = counts[0] if self._count is None else self._count
        steps = np.abs(np.diff(counts, prepend=before))
        self._count = int(counts[-1])
        if np.any((steps > self._guard.count_step) & (np.abs(steps - _SHORT) < _NEAR)):
            raise DeviceError(
                f"the encoder's count jumped by {steps.max()} from one sample to the next, as a "
                "counter of 16 bits does that runs over",
                cure="extend it to 32 bits in the firmware, or let its row of WELCOME say that "
                "it counts from -32768 to 32767",
            )
        return RawSamples(
            tick=np.concatenate(ticks),
            analog=records["analog"] * self._in_scale + self._in_offset,
            counts=counts.astype(np.float64),
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


def _within(low: npt.ArrayLike, high: npt.ArrayLike, kind: type[np.integer]) -> tuple[Any, Any]:
    """The outermost whole numbers of an integer type within limits; infinite ones are its ends."""
    bounds = np.iinfo(kind)
    ends = np.ceil(np.asarray(low) - _ROUNDING), np.floor(np.asarray(high) + _ROUNDING)
    lowest, highest = (np.clip(end, bounds.min, bounds.max).astype(np.int64) for end in ends)
    return lowest.tolist(), highest.tolist()
