"""``rig emulate``: the simulated rig behind the serial protocol."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from daq.cli import terminal as console
from daq.errors import ConfigError
from daq.hal import ANALOG_INPUTS, CHANNELS, Device, Guard, IntArray, Mode, Phase
from daq.lookup.rigs import load_rig
from daq.run.realtime import RealTime
from daq.serial import messages
from daq.serial.emulation import faults
from daq.serial.emulation.emulator import Emulator, PtyPort, TcpPort
from daq.serial.messages import Channel, Codes, Records, Start, Welcome
from sim_rig import converters
from sim_rig.backend import SimulatedDevice

CLOCK = 48_000_000  # Hz, of a microcontroller with USB
QUEUE = 16_384  # commands; 64 KiB of its memory
_LARGEST_BLOCK = 256  # ticks that the simulated rig computes at once
_IDEAL_BITS = 24


class SimulatedBoard:
    """The simulated rig as a board. Its time is the machine's: it computes a tick when asked to."""

    def __init__(self, device: Device, channels: tuple[Channel, ...]) -> None:
        self._device = device
        inputs = channels[: len(ANALOG_INPUTS)]
        outputs = channels[len(ANALOG_INPUTS) : len(ANALOG_INPUTS) + len(CHANNELS)]
        self._in_scale = np.array([channel.scale for channel in inputs])
        self._out_scale = np.array([channel.scale for channel in outputs])
        self._tick = 0

    def connect(self) -> None:
        """The rig as it stands when somebody switches it on, its load let down."""
        self._device.open()

    def announce(self, phase: int, turns: float) -> None:
        """The simulated user winds the handle when asked to."""
        phases = list(Phase)
        if phase < len(phases):
            self._device.announce(phases[phase], turns)

    def start(self, rate: float, limits: Start) -> None:
        """Sampling from tick 0 on."""
        guard = Guard(
            np.array(limits.command_low) * self._out_scale,
            np.array(limits.command_high) * self._out_scale,
            np.array(limits.analog_low) * self._in_scale,
            np.array(limits.analog_high) * self._in_scale,
            limits.counts_low,
            limits.counts_high,
            limits.count_rate,
            limits.count_step,
        )
        # Each tick comes with its command: missing ones are the machine's matter.
        self._device.start(rate, Mode.CLOSED_LOOP, guard)
        self._tick = 0

    def play(self, commands: Codes) -> Records:
        """Simulate n ticks."""
        records = np.zeros(len(commands), dtype=messages.SAMPLE_DTYPE)
        for at in range(0, len(commands), _LARGEST_BLOCK):
            part = slice(at, min(at + _LARGEST_BLOCK, len(commands)))
            self._device.send(self._tick, commands[part] * self._out_scale)
            raw = self._device.receive()
            records["analog"][part] = np.rint(raw.analog / self._in_scale)
            records["counts"][part] = _wrapped(np.rint(raw.counts).astype(np.int64))
            records["count_rate"][part] = raw.count_rate
            records["applied"][part] = np.rint(raw.applied / self._out_scale)
            records["flags"][part] = raw.flags
            self._tick += len(raw.tick)
        return records

    def zero(self) -> None:
        """Outputs to zero until the next start."""
        self._device.safe()


def emulate_command(
    rig: str,
    link: Path | None,
    tcp: int | None,
    fault: list[str],
    drift: float,
    seed: int,
    journal: Path | None,
    as_json: bool,
) -> None:
    """Serve a simulated rig on a port until Ctrl-C."""
    if "help" in fault:
        _list_faults(as_json)
        return
    chosen = [faults.parse(text) for text in fault]
    config, device = load_rig(rig, notify=console.report)
    if not isinstance(device, SimulatedDevice):
        raise ConfigError(
            f"{rig}: its backend is {config.backend!r}; only the simulated one can be emulated. "
            "Name a rig file with 'backend: simulated'"
        )
    # Time is the machine's, and so is what goes wrong on the line.
    own = {"time": "virtual", "faults": type(device.options.faults)()}
    options = device.options.model_copy(update=own)
    identity = _identity(config.name, options.ideal, options.imperfections.bits)
    device = SimulatedDevice(options)
    _warm_up(device)
    board = SimulatedBoard(SimulatedDevice(options), identity.channels)
    port = _port(link, tcp)
    stop = _StopRequest()
    port.connect()
    RealTime().begin("prefer")
    note = _Journal(journal)
    emulator = Emulator(board, identity, port, chosen, 1e-6 * drift, seed, note)
    if as_json:
        console.print_json({"port": port.name, "pid": os.getpid()})
    else:
        console.print_line(port.name)
        console.report_note(
            f"{config.name} answers there; run it with:  "
            f"rig run prbs.yaml --rig serial.yaml --port {port.name}"
        )
    sys.stdout.flush()
    emulator.run(stop)


def _list_faults(as_json: bool) -> None:
    if as_json:
        console.print_json(
            {name: {"default": value, "does": text} for name, (value, text) in faults.KINDS.items()}
        )
        return
    console.print_table(
        "Faults for --fault NAME[=VALUE][@PHASE[+SECONDS]]",
        ["name", "default", "what it does"],
        [
            [name, "-" if value is None else f"{value:g}", text]
            for name, (value, text) in faults.KINDS.items()
        ],
        text=["what it does"],
    )
    console.print_line(
        "Phases: open, calibration, homing, run, safe. Without one a fault is there from the start."
    )


class _Journal:
    """Lines of JSON in a file, each on disk before the device goes on."""

    def __init__(self, path: Path | None) -> None:
        self._file = None
        if path is not None:
            try:
                self._file = path.open("w", encoding="utf-8")
            except OSError as error:
                raise ConfigError(f"--journal {path}: {error.strerror}") from None

    def __call__(self, entry: dict[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(entry) + "\n")
            self._file.flush()


class _StopRequest:
    """Whether Ctrl-C or SIGTERM has come; asked by calling it."""

    def __init__(self) -> None:
        self._come = False
        for name in ("SIGINT", "SIGTERM"):
            signal.signal(getattr(signal, name), self._note)

    def __call__(self) -> bool:
        return self._come

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._come = True


def _port(link: Path | None, tcp: int | None) -> PtyPort | TcpPort:
    if tcp is not None or sys.platform == "win32":
        if link is not None:
            raise ConfigError("--link names a pty; leave it out where a TCP port is served")
        return TcpPort(tcp or 0)
    if link is not None and link.exists() and not link.is_symlink():
        raise ConfigError(f"--link {link}: there is a file of that name; choose another")
    return PtyPort(link)


def _identity(name: str, ideal: bool, bits: int) -> Welcome:
    """What a microcontroller with such converters would say of itself."""
    span = 2.0 * converters.RANGE
    step_in = span / 2 ** (_IDEAL_BITS if ideal else bits)
    step_out = span / 2**16
    both = (-converters.RANGE, converters.RANGE)
    analog = [Channel(item, "V", step_in, 0.0, *both) for item in ANALOG_INPUTS]
    outputs = [Channel(item, "V", step_out, 0.0, *both) for item in CHANNELS]
    limits = (float(np.iinfo(np.int32).min), float(np.iinfo(np.int32).max))
    counter = Channel("encoder", "count", 1.0, 0.0, *limits)
    return Welcome(
        device=name,
        firmware="emulator 1",
        serial="simulated",
        clock=CLOCK,
        max_rate=20_000.0,
        queue=QUEUE,
        max_payload=1024,
        watchdog_default=100,
        watchdog_longest=10_000,
        channels=(*analog, *outputs, counter),
    )


def _warm_up(device: Device) -> None:
    """Compile what the rig computes with, before a host waits for it."""
    wide = np.full(3, 1e9)
    device.open()
    device.start(1000.0, Mode.CLOSED_LOOP, Guard(np.full(2, -1.0), np.full(2, 1.0), -wide, wide))
    for n in (1, 20):
        device.send(0 if n == 1 else 1, np.zeros((n, len(CHANNELS))))
        device.receive()
    device.close()


def _wrapped(counts: IntArray) -> IntArray:
    """Counts as a counter of 32 bits shows them."""
    return (counts + 2**31) % 2**32 - 2**31
