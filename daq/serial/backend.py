"""A rig on a serial port, as a ``daq.hal.Device``."""

from __future__ import annotations

import contextlib
import getpass
import os
import platform
import sys
import threading
import time
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds, Unit
from daq.errors import DeviceError
from daq.hal import (
    DeviceInfo,
    FloatArray,
    Guard,
    Mode,
    Phase,
    RawSamples,
)
from daq.serial import messages
from daq.serial.host import HostMachine, refusal
from daq.serial.link import Link, open_link
from daq.serial.messages import LoopMode, Reply, Result, Start, Type, Welcome
from daq.serial.scaling import Scaling

HANDSHAKE = 2.0
"""Longest time that a device may take to say who it is [s]: a board resets in less."""

_FEED = 0.01  # s between two looks at what is to be sent, or sent again
_PINGS = 6  # round trips measured before a run
_PING_PATIENCE = 0.5  # s for all of them
_SAFE_PATIENCE = 0.25  # s to hear that the outputs are zero
_PATIENCE = 1.0  # s without a call from the run until the watchdog is no longer fed
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
    """A device on a port (see ``daq.hal.Device`` for the methods).

    One thread reads the port. Another feeds the device's watchdog, because the kernel may keep a
    reader waiting for its own workers on a busy computer; it does so only while the program calls:
    one that hangs is no better than one that is dead.
    """

    Options = SerialOptions

    def __init__(self, options: SerialOptions) -> None:
        self.options = options
        self._link: Link | None = None
        self._machine: HostMachine | None = None
        self._welcome: Welcome | None = None
        self._threads: list[threading.Thread] = []
        self._leaving = threading.Event()
        self._changed = threading.Condition()
        self._run = 0
        self._mode = Mode.CLOSED_LOOP
        self._started = self._gone = False
        self._called = 0.0
        self._tripped_before = False
        self._warnings: list[str] = []
        self._record: dict[str, Any] = {}

    # --- daq.hal.Device -----------------------------------------------------------------------

    def open(self) -> DeviceInfo:
        """Connect, agree on the protocol, and clear what an earlier run left behind."""
        if self._link is not None:
            self.close()
        if not self.options.port:
            raise DeviceError(
                "no port is named; write options.port in the rig file or give --port. 'rig ports' "
                "lists the ports that there are"
            )
        welcome = self._connect()
        try:
            self._measure_delay()
            self._tripped_before = welcome.latch is messages.Latch.WATCHDOG
            self._ask(Type.CLEAR)
        except BaseException:
            self._disconnect()
            raise
        self._scaling = Scaling(welcome.channels)
        volts_in = self._scaling.input_range
        return DeviceInfo(self._name(), welcome.max_rate, welcome.queue, volts_in)

    def announce(self, phase: Phase, turns: float = 0.0) -> None:
        """Tell the device which phase begins; an emulator's user winds the handle then."""
        self._ask(Type.ANNOUNCE, messages.pack_announce(list(Phase).index(phase), turns))

    def start(self, sample_rate: float, mode: Mode, guard: Guard) -> None:
        """Arm the device. Its clock starts with the first ``receive``, what was sent preloaded."""
        machine, welcome = self._opened()
        self._run = (self._run + 1) & 0xFFFF
        self._mode, self._gone = mode, False
        start = self._start_message(sample_rate, mode, guard, welcome)
        self._schedule_as_caller()
        with self._changed:
            self._called = time.monotonic()
            machine.start(start, self._called)
            self._started = True
            self._write(machine)
        self._await_reply(machine)

    def send(self, tick: int, commands: FloatArray) -> None:
        """Queue commands (n, 2) [V]; what the device has no room for yet waits here."""
        machine = self._sampling()
        codes = self._scaling.commands(np.asarray(commands, dtype=np.float64))
        with self._changed:
            self._called = time.monotonic()
            machine.send(tick, codes, self._called)
            self._write(machine)

    def room(self) -> int:
        """Commands that may be sent now."""
        machine = self._sampling()
        with self._changed:
            self._called = time.monotonic()
            return machine.room

    def receive(self) -> RawSamples:
        """Wait for samples; all that have come."""
        machine = self._sampling()
        if not self._gone:
            self._go(machine)
        with self._changed:
            while not machine.blocks:
                if machine.failure is not None:
                    raise machine.failure
                self._called = time.monotonic()
                self._changed.wait(0.1)
            self._called = time.monotonic()
            blocks = list(machine.blocks)
            machine.blocks.clear()
        return self._scaling.samples(blocks)

    def stop(self) -> None:
        """End sampling; outputs are zero."""
        machine, _ = self._opened()
        with self._changed:
            self._started = False
            self._record = machine.describe()
            machine.stop(time.monotonic())
            self._write(machine)
        self._await_reply(machine)

    def safe(self) -> None:
        """Zero both outputs now. Where the device cannot be reached, its watchdog does it."""
        machine = self._machine
        if machine is None or self._link is None:
            return
        with contextlib.suppress(DeviceError):
            with self._changed:
                # Said even to a device that seems lost: it may still hear.
                machine.ask(Type.SAFE, b"", time.monotonic(), _SAFE_PATIENCE)
                self._write(machine)
            self._await_reply(machine)

    def close(self) -> None:
        """Zero the outputs and disconnect."""
        if self._machine is None or self._link is None:
            return
        self.safe()
        if self._started:
            with contextlib.suppress(DeviceError):
                self.stop()
        self._disconnect()

    def report(self) -> dict[str, Any]:
        """What a run's record should say of device and connection."""
        if self._welcome is None:
            return {}
        if self._machine is not None and self._started:
            with self._changed:
                self._record = self._machine.describe()
        return {
            "port": self.options.port,
            "device": self._welcome.device,
            "firmware": self._welcome.firmware,
            "serial_number": self._welcome.serial,
            "protocol_version": self._welcome.version,
            "watchdog_tripped_before": self._tripped_before,
            "warnings": [*self._warnings, *_losses(self._record.get("line", {}))],
            **self._record,
        }

    def who(self) -> Welcome:
        """Ask who answers on the port, and leave the device as it is. Raises DeviceError."""
        welcome = self._connect()
        self._disconnect()
        return welcome

    # --- opening ------------------------------------------------------------------------------

    def _connect(self) -> Welcome:
        self._link = open_link(self.options.port, self.options.baud)
        session = int.from_bytes(os.urandom(2), "little") or 1
        self._machine = HostMachine(session, f"{_user()}@{platform.node()}")
        self._started = False
        self._leaving = threading.Event()
        self._threads = [
            threading.Thread(target=work, name=f"serial rig, {name}", daemon=True)
            for name, work in (("reading", self._read), ("watchdog", self._feed))
        ]
        for thread in self._threads:
            thread.start()
        try:
            self._welcome = self._shake_hands()
        except BaseException:
            self._disconnect()
            raise
        return self._welcome

    def _shake_hands(self) -> Welcome:
        machine, port = self._connected(), self.options.port
        with self._changed:
            machine.hello(time.monotonic(), HANDSHAKE)
            self._write(machine)
            while machine.waiting and machine.failure is None:
                self._changed.wait(0.1)
        if machine.failure is not None:
            raise machine.failure
        if machine.other_version is not None:
            raise DeviceError(_version_mismatch(port, machine.other_version))
        if machine.welcome is None:
            raise DeviceError(_no_answer(port, machine))
        names = tuple(channel.name for channel in machine.welcome.channels)
        if names != messages.CHANNEL_NAMES:
            raise DeviceError(
                f"{port}: {machine.welcome.device} has the channels {', '.join(names) or 'none'}, "
                f"not {', '.join(messages.CHANNEL_NAMES)}; its firmware is for another rig"
            )
        self._warnings = list(self._link.warnings) if self._link else []
        return machine.welcome

    def _measure_delay(self) -> None:
        """Round trips before anything moves; a line too slow for the watchdog is refused."""
        machine = self._connected()
        deadline = time.monotonic() + _PING_PATIENCE
        limit = 0.5 * self.options.watchdog
        for _ in range(_PINGS):
            with self._changed:
                before, now = machine.clock.round_trips, time.monotonic()
                # One that is lost must not use up the time of the others.
                next_at = min(deadline, now + _PING_PATIENCE / _PINGS)
                machine.ping(now)
                self._write(machine)
                while machine.clock.round_trips == before and time.monotonic() < next_at:
                    self._changed.wait(0.02)
        if machine.clock.quickest > limit:
            if not machine.clock.round_trips and machine.decoder.rejected:
                raise DeviceError(
                    f"{self.options.port}: {machine.decoder.rejected} damaged frames came, and not "
                    f"one answer in {1e3 * _PING_PATIENCE:.0f} ms; check cable, connectors and "
                    "baud rate"
                )
            took = (
                f"took {1e3 * machine.clock.quickest:.0f} ms to answer"
                if machine.clock.round_trips
                else f"does not answer within {1e3 * _PING_PATIENCE:.0f} ms"
            )
            raise DeviceError(
                f"{self.options.port}: the device {took}, too slow for its watchdog of "
                f"{1e3 * self.options.watchdog:.0f} ms. Look at the adapter's latency timer ('rig "
                "doctor'), at a hub in between, or raise options.watchdog in the rig file"
            )

    def _start_message(
        self, sample_rate: float, mode: Mode, guard: Guard, welcome: Welcome
    ) -> Start:
        if sample_rate > welcome.max_rate:
            raise DeviceError(
                f"{self._name()} samples at up to {welcome.max_rate:g} Hz; "
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
                f"options.watchdog: {self._name()} waits {welcome.watchdog_longest} ms at most, "
                f"not {watchdog} ms"
            )
        return Start(
            self._run,
            LoopMode.OPEN if mode is Mode.OPEN_LOOP else LoopMode.CLOSED,
            period,
            watchdog,
            *self._scaling.guarded(guard),
        )

    # --- requests -----------------------------------------------------------------------------

    def _go(self, machine: HostMachine) -> None:
        """Start the clock once the device has what was sent ahead."""
        deadline = time.monotonic() + 2.0
        with self._changed:
            while not machine.preloaded and machine.failure is None:
                self._called = time.monotonic()
                if self._called > deadline:
                    raise DeviceError(
                        "the device does not take the commands sent ahead; the line loses more "
                        "than it carries. Look at cable and baud rate"
                    )
                self._changed.wait(0.05)
            self._called = time.monotonic()
            machine.go(self._called)
            self._write(machine)
        self._await_reply(machine)
        self._gone = True

    def _ask(self, type_: Type, payload: bytes = b"") -> None:
        machine, _ = self._opened()
        with self._changed:
            self._called = time.monotonic()
            machine.ask(type_, payload, self._called)
            self._write(machine)
        self._await_reply(machine)

    def _await_reply(self, machine: HostMachine) -> None:
        reply: Reply | None = None
        with self._changed:
            while machine.waiting and machine.failure is None:
                self._called = time.monotonic()
                self._changed.wait(0.05)
            reply = machine.reply
            # Samples that came before a failure are still to be had from receive().
            if reply is None and machine.failure is not None:
                raise machine.failure
        if reply is not None and reply.result is not Result.OK:
            raise DeviceError(refusal(reply))

    def _connected(self) -> HostMachine:
        assert self._machine is not None
        return self._machine

    def _opened(self) -> tuple[HostMachine, Welcome]:
        if self._machine is None or self._welcome is None or self._link is None:
            raise DeviceError("the serial rig is not open; open it before starting")
        return self._machine, self._welcome

    def _sampling(self) -> HostMachine:
        machine, _ = self._opened()
        if not self._started:
            raise DeviceError("the serial rig is not sampling; start it first")
        return machine

    def _name(self) -> str:
        assert self._welcome is not None
        return f"{self._welcome.device} (firmware {self._welcome.firmware})"

    def _schedule_as_caller(self) -> None:
        """The threads go just before the run, where that is scheduled in real time by now."""
        if not sys.platform.startswith("linux"):
            return
        policy, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
        for thread in self._threads:
            # The limit may be the run's own priority.
            for urgency in (priority + 1, priority) if priority else (0,):
                with contextlib.suppress(OSError):
                    os.sched_setscheduler(thread.native_id or 0, policy, os.sched_param(urgency))
                    break

    # --- the threads --------------------------------------------------------------------------

    def _read(self) -> None:
        machine, link = self._connected(), self._link
        assert link is not None
        while not self._leaving.is_set() and machine.failure is None:
            try:
                data = link.read()
                if data:
                    with self._changed:
                        machine.feed(data, time.monotonic())
                        self._write(machine)
                        self._changed.notify_all()
            except DeviceError as error:
                self._fail(machine, error)
        with self._changed:
            self._changed.notify_all()

    def _feed(self) -> None:
        machine = self._connected()
        pause = min(_FEED, 0.2 * self.options.watchdog)
        while not self._leaving.wait(pause) and machine.failure is None:
            try:
                with self._changed:
                    now = time.monotonic()
                    waited = machine.waiting
                    machine.poll(now, keep_alive=now - self._called < _PATIENCE)
                    self._write(machine)
                    if machine.failure is not None or machine.waiting != waited:
                        self._changed.notify_all()
            except DeviceError as error:
                self._fail(machine, error)

    def _fail(self, machine: HostMachine, error: DeviceError) -> None:
        with self._changed:
            machine.failure = machine.failure or error
            self._changed.notify_all()

    def _write(self, machine: HostMachine) -> None:
        """Write what the machine has to say; the lock is held, so frames stay whole."""
        data = machine.take()
        if data and self._link is not None:
            self._link.write(data)

    def _disconnect(self) -> None:
        if self._machine is not None and self._started:
            self._record = self._machine.describe()
        self._started = False
        self._leaving.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        if self._link is not None:
            self._link.close()
        self._link = self._machine = None


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "unknown"


def _losses(line: dict[str, Any]) -> list[str]:
    """What was lost of a run, for who looks at its summary."""
    lost, dropped = line.get("lost_samples", 0), line.get("device_overflow_samples", 0)
    if not lost:
        return []
    return [
        f"{lost} samples were lost ({dropped} of them by the device, for which the line was too "
        f"slow) and {line['rejected_frames']} damaged frames refused; the log shows the gaps"
    ]


def _version_mismatch(port: str, version: int) -> str:
    own = messages.VERSION
    said = f"{port}: the device speaks version {version} of the protocol, this program {own}"
    if version > own:
        return f"{said}. This program is the old one: update hybrid-rig"
    return f"{said}. The device's firmware is the old one: update that"


def _no_answer(port: str, machine: HostMachine) -> str:
    decoder = machine.decoder
    if decoder.accepted:
        return (
            f"{port}: what answers speaks the protocol but does not say who it is; its firmware is "
            "incomplete"
        )
    if decoder.received:
        return (
            f"{port}: {decoder.received} bytes came in {HANDSHAKE:g} s but no frame of the "
            "protocol; the baud rate is wrong, or it is another device ('rig ports' shows who "
            "answers)"
        )
    return (
        f"{port}: no answer in {HANDSHAKE:g} s; check that the device has power and runs the "
        "firmware of the protocol, and that this is its port ('rig ports' shows who answers)"
    )
