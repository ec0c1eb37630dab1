"""A rig on a serial port, as a ``daq.hal.Device``."""

import contextlib
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds, Unit
from daq.errors import DeviceError
from daq.hal import DeviceInfo, FloatArray, Guard, Mode, Phase, RawSamples
from daq.serial import messages
from daq.serial.connection import Connection
from daq.serial.host import HostMachine
from daq.serial.messages import Latch, Start, Type, Welcome
from daq.serial.scaling import Scaling

_SAFE_PATIENCE = 0.25  # s to hear that the outputs are zero
_RATE_TOLERANCE = 5e-5  # as good as a quartz


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
        return DeviceInfo(_name(welcome), welcome.max_rate, welcome.queue, volts_in)

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

    def stop(self) -> None:
        """End sampling; outputs are zero."""
        connection = self._opened()
        self._armed = False
        self._record = connection.describe()
        connection.request(HostMachine.stop)

    def safe(self) -> None:
        """Zero both outputs now. Where the device cannot be reached, its watchdog does it."""
        if self._connection is not None:
            # Said even to a device that seems lost: it may still hear.
            with contextlib.suppress(DeviceError):
                self._connection.ask(Type.SAFE, give_up=_SAFE_PATIENCE)

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
        warnings = [*self._warnings, *_losses(self._record.get("line", {}))]
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


def _name(welcome: Welcome) -> str:
    return f"{welcome.device} (firmware {welcome.firmware})"


def _losses(line: dict[str, Any]) -> list[str]:
    """A warning of what the line lost of a run."""
    lost, dropped = line.get("lost_samples", 0), line.get("device_overflow_samples", 0)
    if not lost:
        return []
    return [
        f"{lost} samples were lost ({dropped} of them by the device, for which the line was too "
        f"slow) and {line['rejected_frames']} damaged frames refused; the log shows the gaps"
    ]
