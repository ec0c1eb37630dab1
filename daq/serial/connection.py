"""A connection to the device on a port: handshake, threads that read and feed, requests."""

import contextlib
import getpass
import math
import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from daq.errors import DeviceError
from daq.serial import messages
from daq.serial.codec import Decoder
from daq.serial.host import GIVE_UP, HostMachine, refusal
from daq.serial.messages import Block, Result, Type, Welcome
from daq.serial.ports import PortFacts, open_link

_HANDSHAKE = 2.0  # s in which a device says who it is: a board resets in less
_FEED = 0.01  # s between two looks at what is to be sent, or sent again
_PINGS = 6  # round trips measured before a run
_PING_PATIENCE = 0.5  # s for all of them
_PRELOAD_PATIENCE = 2.0  # s for the device to take what is sent ahead
_PATIENCE = 1.0  # s without a call from the run until the watchdog is no longer fed
_LOOK = 0.05  # s between two looks at the clock while waiting

T = TypeVar("T")


class Connection:
    """An open port and the device that answers on it.

    One thread reads the port. Another feeds the device's watchdog, because on a busy computer the
    kernel may keep a reader waiting. It feeds only while the program keeps calling: a program that
    hangs must trip the watchdog as a dead one does.

    welcome: what the device says of itself. warnings: what is wrong with the port's settings.
    Raises DeviceError, with the cure, where nobody answers or the wrong device does.
    """

    def __init__(self, port: str, baud: int, watchdog: float = 0.1) -> None:
        self._port = port
        self._watchdog = watchdog
        self._link = open_link(port, baud)
        self._machine = HostMachine(int.from_bytes(os.urandom(2), "little") or 1)
        self._leaving = threading.Event()
        self._changed = threading.Condition()
        self._last_call = 0.0
        self._threads = [
            threading.Thread(
                target=self._serve, args=(work,), name=f"serial rig, {name}", daemon=True
            )
            for name, work in (("reading", self._read), ("watchdog", self._feed))
        ]
        for thread in self._threads:
            thread.start()
        try:
            self.welcome = self._shake_hands()
        except BaseException:
            self.close()
            raise
        self.warnings = self._link.warnings

    def close(self) -> None:
        """Disconnect; the device's watchdog then stops a run."""
        self._leaving.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self._link.close()

    def act(self, action: Callable[[HostMachine, float], T]) -> T:
        """Let the machine act at the present time [s] and send its frames; the action's result."""
        with self._changed:
            self._last_call = time.perf_counter()
            result = action(self._machine, self._last_call)
            self._write()
        return result

    def request(self, action: Callable[[HostMachine, float], None]) -> None:
        """Let the machine act, and wait for the device's answer. DeviceError for a refusal."""
        self.act(action)
        self._wait(lambda: self._machine.pending is None)
        reply, failure = self._machine.reply, self._machine.failure
        # Samples that came before a failure are still to be had from samples().
        if reply is None and failure is not None:
            raise failure
        if reply is not None and reply.result is not Result.OK:
            raise DeviceError(refusal(reply))

    def ask(self, type_: Type, payload: bytes = b"", give_up: float = GIVE_UP) -> None:
        """Send a request and wait for its answer."""
        self.request(lambda machine, now: machine.ask(type_, payload, now, give_up))

    def samples(self) -> list[Block]:
        """Blocks received so far; waits for the first."""
        machine = self._machine
        with self._changed:
            if not self._wait(lambda: bool(machine.blocks)) and machine.failure is not None:
                raise machine.failure
            self._last_call = time.perf_counter()
            taken, machine.blocks = machine.blocks, []
        return taken

    def go(self) -> None:
        """Start the clock once the device has what was sent ahead."""
        machine = self._machine
        deadline = time.perf_counter() + _PRELOAD_PATIENCE
        preloaded = self._wait(lambda: machine.commands.preloaded, deadline)
        if not preloaded and machine.failure is None:
            raise DeviceError(
                "the device does not take the commands sent ahead; the line loses more "
                "than it carries. Look at cable and baud rate"
            )
        self.request(HostMachine.go)

    def describe(self) -> dict[str, Any]:
        """Counts of bytes, frames and errors, and the clocks' relation, for the log."""
        with self._changed:
            return self._machine.describe()

    def check_delay(self) -> None:
        """Measure round trips; raises DeviceError for a line too slow for the watchdog."""
        clock, decoder = self._machine.clock, self._machine.decoder
        deadline = time.perf_counter() + _PING_PATIENCE
        for _ in range(_PINGS):
            # A ping that is lost must not use up the time of the others.
            self._ping(min(deadline, time.perf_counter() + _PING_PATIENCE / _PINGS))
        if clock.quickest <= 0.5 * self._watchdog:
            return
        if not clock.round_trips and decoder.rejected:
            raise DeviceError(
                f"{decoder.rejected} damaged frames came, and not one answer in "
                f"{1e3 * _PING_PATIENCE:.0f} ms; check cable, connectors and baud rate",
                file=self._port,
            )
        slow = f"does not answer within {1e3 * _PING_PATIENCE:.0f} ms"
        if clock.round_trips:
            slow = f"took {1e3 * clock.quickest:.0f} ms to answer"
        raise DeviceError(
            f"the device {slow}, too slow for its watchdog of {1e3 * self._watchdog:.0f} ms. Look "
            "at the adapter's latency timer ('rig doctor'), at a hub in between, or raise "
            "options.watchdog in the rig file",
            file=self._port,
        )

    def schedule_as_caller(self) -> None:
        """If the caller runs in real time, schedule the threads just ahead of it."""
        if not sys.platform.startswith("linux"):
            return
        policy, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
        for thread in self._threads:
            # The system may allow no priority above the run's own.
            for urgency in (priority + 1, priority) if priority else (0,):
                with contextlib.suppress(OSError):
                    os.sched_setscheduler(thread.native_id or 0, policy, os.sched_param(urgency))
                    break

    def _shake_hands(self) -> Welcome:
        machine = self._machine
        host = messages.pack_hello(f"{_user()}@{platform.node()}")
        self.act(lambda machine, now: machine.ask(Type.HELLO, host, now, _HANDSHAKE))
        self._wait(lambda: machine.pending is None)
        if machine.failure is not None:
            raise machine.failure
        if machine.other_version is not None:
            raise DeviceError(_version_mismatch(machine.other_version), file=self._port)
        welcome = machine.welcome
        if welcome is None:
            raise DeviceError(_no_answer(machine.decoder), file=self._port)
        if complaint := welcome.complaint():
            problem = f"{welcome.device} says of itself what cannot be: {complaint}"
            raise DeviceError(problem, cure="mend its firmware", file=self._port)
        return welcome

    def _ping(self, deadline: float) -> None:
        clock = self._machine.clock
        before = clock.round_trips
        self.act(HostMachine.ping)
        self._wait(lambda: clock.round_trips > before, deadline)

    def _wait(self, condition: Callable[[], bool], deadline: float = math.inf) -> bool:
        """Wait for a condition, a failure or a deadline; whether the condition holds."""
        with self._changed:
            while not condition():
                self._last_call = time.perf_counter()
                if self._machine.failure is not None or self._last_call >= deadline:
                    return False
                self._changed.wait(min(_LOOK, deadline - self._last_call))
        return True

    def _serve(self, work: Callable[[], None]) -> None:
        """Do a thread's work until the session ends; a failing port ends it for all."""
        failure: DeviceError | None = None
        try:
            work()
        except DeviceError as error:
            failure = error
        except Exception as error:  # a thread that ends in silence would leave the run waiting
            doing = threading.current_thread().name
            problem = f"{doing}: {type(error).__name__}: {error}"
            failure = DeviceError(problem, cure="report this to who maintains hybrid-rig")
        with self._changed:
            self._machine.failure = self._machine.failure or failure
            self._changed.notify_all()

    def _read(self) -> None:
        while not self._leaving.is_set() and self._machine.failure is None:
            data = self._link.read()
            if data:
                with self._changed:
                    self._machine.feed(data, time.perf_counter())
                    self._write()
                    self._changed.notify_all()

    def _feed(self) -> None:
        machine, pause = self._machine, min(_FEED, 0.2 * self._watchdog)
        while not self._leaving.wait(pause) and machine.failure is None:
            with self._changed:
                now, pending = time.perf_counter(), machine.pending
                machine.poll(now, keep_alive=now - self._last_call < _PATIENCE)
                self._write()
                if machine.failure is not None or machine.pending is not pending:
                    self._changed.notify_all()

    def _write(self) -> None:
        """Write the machine's frames; the caller holds the lock, so that no two frames mix."""
        data = self._machine.take()
        if data:
            self._link.write(data)


@dataclass(frozen=True)
class Inquiry:
    """The device that answers on a port, or why none does; neither if the port was not asked."""

    port: PortFacts
    welcome: Welcome | None = None
    problem: str | None = None


def inquire(ports: Sequence[PortFacts], baud: int) -> list[Inquiry]:
    """Ask all ports at once who is there; takes as long as the slowest answer."""

    def ask(port: PortFacts) -> Inquiry:
        try:
            connection = Connection(port.name, baud)
        except DeviceError as error:
            return Inquiry(port, problem=error.mistakes[0].problem)
        connection.close()
        return Inquiry(port, connection.welcome)

    with ThreadPoolExecutor(max(1, len(ports))) as pool:
        return list(pool.map(ask, ports))


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "unknown"


def _version_mismatch(version: int) -> str:
    spoken = f"the device speaks version {version} of the protocol, this program {messages.VERSION}"
    if version > messages.VERSION:
        return f"{spoken}. This program is the old one: update hybrid-rig"
    return f"{spoken}. The device's firmware is the old one: update that"


def _no_answer(decoder: Decoder) -> str:
    if decoder.accepted:
        return (
            "what answers speaks the protocol but does not say who it is; its firmware is "
            "incomplete"
        )
    if decoder.received:
        return (
            f"{decoder.received} bytes came in {_HANDSHAKE:g} s but no frame of the protocol; the "
            "baud rate is wrong, or it is another device ('rig ports' shows who answers)"
        )
    return (
        f"no answer in {_HANDSHAKE:g} s; check that the device has power and runs the firmware of "
        "the protocol, and that this is its port ('rig ports' shows who answers)"
    )
