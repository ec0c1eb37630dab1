"""The firmware's own ELF in QEMU, its inputs and outputs in lockstep with a plant outside.

QEMU knows no converters. In their place the firmware exchanges a few bytes with this process at
every tick, by ARM semihosting and two named pipes: the outputs as they have been, the inputs as
they are now (``firmware/boards/qemu/plant.c``). In real time the line is a pty or a TCP port of
QEMU's; in virtual time, in which nothing waits for a clock, the plant carries the line's bytes too.
"""

import contextlib
import os
import re
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from daq.errors import ConfigError, DeviceError

_PROGRAM = "qemu-system-arm"
# In real time, where it may. Real-time scheduling would give a core to a firmware that loops.
_AHEAD_OF_OTHERS = ("nice", "-n", "-10")
_MACHINE = ("-M", "netduinoplus2", "-display", "none", "-monitor", "none")
_SEMIHOSTING = ("-semihosting-config", "enable=on,target=native")
_VIRTUAL_TIME = ("-icount", "shift=3,sleep=off")
_OUT = struct.Struct("<I2hBBBBfIHBxHHH2x")
_IN = struct.Struct("<3iifBBH")
_INSTRUCTIONS = 1e9 / 168e6 / 8.0  # in a step of SysTick, at 8 ns each
_PATIENCE = 20.0  # s for QEMU to begin, and between two exchanges
_FAULT = 3  # status of the firmware's fault handler (boards/qemu/startup.c)
_BUILD = "make -C firmware BOARD=qemu"
_LOOK = 0.01  # s


class Exchange(NamedTuple):
    """What the firmware tells its plant.

    ticks: of its clock since the exchange before, during which the outputs (codes of motor and
    brake) have been as they are here. announced, runs: how many phases and runs there were, modulo
    256; ``phase`` with ``turns`` is the last phase, ``period`` [ticks] that of the last run. late:
    by how much this comes after its time [s], 0.065 at most. cost: of the tick's interrupt, in
    instructions, and line: bytes to the host, both in virtual time.
    """

    ticks: int
    outputs: tuple[int, int]
    state: int
    latch: int
    phase: int
    announced: int
    turns: float
    period: int
    session: int
    runs: int
    late: float
    cost: float
    line: bytes


class InputCodes(NamedTuple):
    """At the inputs: codes (3,), counts, their rate [1/s], whether one is at its end."""

    analog: Sequence[int]
    counts: int
    rate: float
    at_end: bool = False


class EmulatedFirmware:
    """QEMU with the firmware, from ``with`` to its end; ``exchange`` and ``answer`` in turn.

    elf: built by ``make BOARD=qemu``. virtual: in virtual time, the line carried here. tcp: number
    of the line's port in place of a pty. port: where the host finds it in real time. Raises
    ConfigError where QEMU or the file is not there, DeviceError where QEMU ends.
    """

    def __init__(self, elf: Path, virtual: bool = False, tcp: int | None = None) -> None:
        if not hasattr(os, "mkfifo"):
            raise ConfigError(
                f"--firmware {elf}: there are no named pipes for QEMU", cure="use Linux, or WSL"
            )
        if not elf.is_file():
            raise ConfigError(
                f"--firmware {elf}: there is no such file",
                cure=f"build it with '{_BUILD}'",
            )
        if shutil.which(_PROGRAM) is None:
            raise ConfigError(
                f"--firmware {elf}: {_PROGRAM} is not installed", cure="apt install qemu-system-arm"
            )
        self.port = "" if tcp is None else f"socket://127.0.0.1:{tcp}"
        self._virtual, self._tcp, self._elf = virtual, tcp, elf.resolve()

    def __enter__(self) -> Self:
        self._files = contextlib.ExitStack()
        try:
            self._start()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._files.close()

    def exchange(self) -> Exchange:
        """Wait for what the firmware tells next; it waits for the answer."""
        ticks, motor, brake, state, latch, phase, announced, turns, *rest = _OUT.unpack(
            self._read(_OUT.size)
        )
        period, session, runs, n, late, steps = rest
        return Exchange(
            ticks, (motor, brake), state, latch, phase, announced, turns, period, session, runs,
            1e-6 * late, steps * _INSTRUCTIONS, self._read(n),
        )  # fmt: skip

    def answer(self, reading: InputCodes, line: bytes = b"") -> None:
        """The inputs as they are now. line: bytes from the host, in virtual time; 512 at most."""
        analog, counts, rate, at_end = reading
        head = _IN.pack(*analog, counts, rate, at_end, self._virtual, len(line))
        try:
            os.write(self._to, head + line)
        except BrokenPipeError:
            raise self._failure() from None

    def kill(self) -> None:
        """End QEMU at once; ``exchange`` and ``answer`` then raise DeviceError."""
        self._process.kill()

    def _start(self) -> None:
        folder = Path(self._files.enter_context(tempfile.TemporaryDirectory(prefix="rig-qemu-")))
        pipes = folder / "plant.out", folder / "plant.in"
        for pipe in pipes:
            _make(pipe)
        output = self._files.enter_context((folder / "qemu.txt").open("wb"))
        command = [_PROGRAM, *_MACHINE, *_SEMIHOSTING, *self._line(), "-kernel", str(self._elf)]
        command = command if self._virtual else [*_AHEAD_OF_OTHERS, *command]
        self._log = folder / "qemu.txt"
        # In a group of its own: a terminal's Ctrl-C is for this process.
        self._process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
            process_group=0,
        )  # fmt: skip
        self._files.callback(self._end)
        # Both ends of a pipe wait for each other; in the order in which the firmware opens them.
        self._from = self._opened(pipes[0], os.O_RDONLY)
        self._to = self._opened(pipes[1], os.O_WRONLY)
        if not self._virtual and self._tcp is None:
            match = re.search(r"redirected to (\S+)", self._log.read_text())
            if match is None:
                raise self._failure()
            self.port = match[1]

    def _line(self) -> list[str]:
        if self._virtual:
            return [*_VIRTUAL_TIME, "-serial", "null"]
        if self._tcp is None:
            return ["-chardev", "pty,id=line", "-serial", "chardev:line"]
        where = f"socket,id=line,host=127.0.0.1,port={self._tcp},server=on,wait=off,nodelay=on"
        return ["-chardev", where, "-serial", "chardev:line"]

    def _opened(self, pipe: Path, mode: int) -> int:
        """Open an end of a pipe, as soon as QEMU has the other."""
        deadline = time.perf_counter() + _PATIENCE
        while True:
            # A writer finds no reader at first; a reader would not know whether a writer is there.
            try:
                descriptor = _end_of(pipe, mode)
                break
            except OSError:
                if self._process.poll() is not None or time.perf_counter() > deadline:
                    raise self._failure() from None
                time.sleep(_LOOK)
        self._files.callback(os.close, descriptor)
        _let_wait(descriptor)
        return descriptor

    def _read(self, n: int) -> bytes:
        data = b""
        while len(data) < n:
            ready, _, _ = select.select([self._from], [], [], _PATIENCE)
            piece = os.read(self._from, n - len(data)) if ready else b""
            if not piece:
                raise self._failure()
            data += piece
        return data

    def _failure(self) -> DeviceError:
        """What became of QEMU, in words."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=1.0)
        status = self._process.poll()
        if status is None:
            return DeviceError(
                f"QEMU with the firmware has told nothing for {_PATIENCE:g} s",
                cure=f"is it the firmware of '{_BUILD}', and QEMU not held up?",
                file=str(self._elf),
            )
        lines = self._log.read_text(errors="replace").strip().splitlines()
        remarks = [line for line in lines if "redirected to" not in line]
        words = remarks[-1] if remarks else f"status {status}"
        if status < 0:
            words = f"by signal {-status}"
        elif status == _FAULT:
            words = "the firmware came to a fault"
        return DeviceError(f"QEMU with the firmware ended: {words}", file=str(self._elf))

    def _end(self) -> None:
        self.kill()
        self._process.wait()


def _make(pipe: Path) -> None:
    if sys.platform == "win32":
        raise NotImplementedError
    os.mkfifo(pipe)


def _end_of(pipe: Path, mode: int) -> int:
    """An end of a pipe; OSError where a writer finds no reader."""
    if sys.platform == "win32":
        raise NotImplementedError
    return os.open(pipe, mode | os.O_NONBLOCK)


def _let_wait(descriptor: int) -> None:
    if sys.platform == "win32":
        raise NotImplementedError
    os.set_blocking(descriptor, True)
