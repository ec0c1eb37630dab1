"""A device of the serial protocol by its document alone: no code of ours, bytes by its tables.

It keeps the rules but for those that a test has it break.
"""

import select
import socket
import struct
import threading
import time
import zlib
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np
from cobs import cobs

HELLO, START, GO, STOP, SAFE, CLEAR, ANNOUNCE = range(1, 8)
COMMANDS, PING = 0x10, 0x11
WELCOME, REPLY, SAMPLES, PONG, STATUS = 0x81, 0x82, 0x90, 0x91, 0x92
NAMES = ["current_motor", "current_brake", "torque", "motor", "brake", "encoder"]
IDLE, ARMED, RUNNING = range(3)
HELD, UNDERFLOW = 2, 16
CLOCK = 48_000_000  # Hz
QUEUE = 8192
I32 = (-(2**31), 2**31 - 1)


def frame(kind, session, number, payload):
    head = struct.pack("<BBHHH", kind, 0, session, number & 0xFFFF, len(payload)) + payload
    return b"\0" + cobs.encode(head + struct.pack("<I", zlib.crc32(head))) + b"\0"


def channel(name, scale=1e-3, offset=0.0, low=-10.0, high=10.0, unit=b"V"):
    return struct.pack("<16s8sdddd", name.encode(), unit, scale, offset, low, high)


def welcome(*, channels=None, **changes):
    facts = {
        "clock": CLOCK, "max_rate": 4000.0, "queue": 512, "max_payload": 256,
        "watchdog": 100, "longest": 1000,
    }  # fmt: skip
    rows = {name: channel(name) for name in NAMES}
    rows |= {"encoder": channel("encoder", 1.0, unit=b"count")} | (channels or {})
    numbers = tuple((facts | changes).values())
    head = struct.pack("<4sHBBIfIHHHH", b"HRIG", 1, len(rows), 0, *numbers, 0)
    texts = struct.pack("<32s32s32s", b"paper", b"1", b"7")
    return head + texts + b"".join(rows.values())


@dataclass
class Lies:
    """What the device does against the document.

    clock: its ticks in a second, as a share of what it says. timer: its samples in a second, by
    its own clock, as a share of START's. times: whether SAMPLES tell of that timer. pongs: how many
    it answers. loses: the sample numbers that it does not send, a function. counts: of the encoder
    by sample number, a function. bits: of the counter, sign-extended. counter: (low, high) of its
    row of WELCOME. sticks: ``"output"`` for outputs that stay where SAFE, STOP or START find
    them, ``"amplifier"`` for a current that does. deaf: requests without an answer.
    output: what is applied for a command, a function of sample number and codes. flags: by sample
    number, a function. saturates: in which samples the torque stands at its end, a function.
    """

    clock: float = 1.0
    timer: float = 1.0
    times: bool = True
    pongs: float = np.inf
    loses: object = None
    counts: object = None
    bits: int = 32
    counter: tuple = I32
    sticks: str = ""
    deaf: tuple = ()
    output: object = None
    flags: object = None
    saturates: object = None


class Paper:
    """The device on a connection, in a thread of its own."""

    def __init__(self, line, lies):
        self.line, self.lies = line, lies
        self.session, self.state, self.latch = 0, IDLE, 0
        self.answered = (None, b"")
        self.sequence = self.run = self.tick = self.until = self.mode = 0
        self.out, self.commands = (0, 0), {}
        self.current = (0, 0)
        self.noise = np.random.default_rng(0)

    def serve(self):
        heard = b""
        while True:
            if select.select([self.line], [], [], 0.002)[0]:
                data = self.line.recv(65536)
                if not data:
                    return
                *frames, heard = (heard + data).split(b"\0")
                for coded in filter(None, frames):
                    self.receive(cobs.decode(coded))
            if self.state == RUNNING:
                self.sample()

    def now(self):
        return int(time.perf_counter() * CLOCK * self.lies.clock)

    def receive(self, body):
        kind, _, session, number, _ = struct.unpack_from("<BBHHH", body)
        payload = body[8:-4]
        if kind == HELLO:
            if session != self.session:
                self.session, self.state, self.answered = session, IDLE, (None, b"")
                self.zero()
            low, high = self.lies.counter
            encoder = channel("encoder", 1.0, 0.0, low, high, b"count")
            facts = {"queue": QUEUE, "max_payload": 1024, "channels": {"encoder": encoder}}
            self.send(WELCOME, number, welcome(**facts))
        elif kind == COMMANDS:
            self.take(payload)
        elif kind == PING:
            self.lies.pongs -= 1
            if self.lies.pongs >= 0:
                times = struct.pack("<QQ", self.now(), self.now())
                self.send(PONG, number, payload + times + self.status())
        elif kind not in self.lies.deaf:
            if number != self.answered[0]:
                result = self.carry_out(kind, payload)
                self.answered = number, struct.pack("<BBH", kind, result, 0)
            self.send(REPLY, number, self.answered[1] + self.status())

    def carry_out(self, kind, payload):
        if kind == START:
            self.run, self.mode, _, self.period = struct.unpack_from("<HBBI", payload)
            self.tick = self.until = self.latch = 0
            self.state = ARMED
            self.zero()
        elif kind == GO:
            self.state, self.origin = RUNNING, self.now()
        elif kind in (STOP, SAFE, CLEAR):
            self.zero()
            self.state = self.state if kind == SAFE else IDLE
            self.latch = 1 if kind == SAFE else self.latch
        return 0

    def take(self, payload):
        run, n, first = struct.unpack_from("<HHI", payload)
        codes = struct.iter_unpack("<hh", payload[8:])
        if run == self.run:
            if self.latch == 0:
                self.commands |= dict(zip(range(first, first + n), codes, strict=True))
            self.until = max(self.until, first + n)
        if self.state == ARMED:
            self.sequence += 1
            self.send(STATUS, self.sequence, self.status())

    def zero(self):
        self.commands = {}
        if self.lies.sticks != "output":
            self.out = (0, 0)
        if not self.lies.sticks:
            self.current = (0, 0)

    def play(self, tick):
        """Latch, then apply: a record of this tick."""
        analog = [code + self.noise.integers(-3, 4) for code in (*self.current, 0)]
        if self.lies.saturates is not None and self.lies.saturates(tick):
            analog[2] = 10_000
        count = 0 if self.lies.counts is None else self.lies.counts(tick)
        half = 2 ** (self.lies.bits - 1)
        count = (count + half) % (2 * half) - half
        flags = 0 if self.lies.flags is None else self.lies.flags(tick)
        held = self.commands.pop(tick, None) if not self.latch else (0, 0)
        if held is None and self.mode == 0:
            held, self.latch, flags = (0, 0), 2, flags | UNDERFLOW
        elif held is None:
            held, flags = self.out, flags | HELD
        stuck = self.lies.sticks == "output" and any(self.out) and not any(held)
        self.out = self.out if stuck else held
        shown = self.out if self.lies.output is None else self.lies.output(tick, self.out)
        if self.lies.sticks != "amplifier" or any(self.out):
            self.current = self.out
        return struct.pack("<3iif2hI", *analog, count, 0.0, *shown, flags)

    def sample(self):
        apart = self.period / self.lies.timer  # ticks of the clock
        due = int((self.now() - self.origin) / apart) + 1
        fresh = range(self.tick, min(due, self.tick + 30))
        records = [self.play(tick) for tick in fresh]
        self.tick = fresh.stop
        kept = [k for k in fresh if self.lies.loses is None or not self.lies.loses(k)]
        if kept != list(fresh) and kept:  # one at a time, so that no gap lies in a block
            blocks = [(k, [records[k - fresh.start]]) for k in kept]
        else:
            blocks = [(fresh.start, records)] if kept else []
        for first, rows in blocks:
            when = self.origin + int(first * (apart if self.lies.times else self.period))
            head = struct.pack("<IHHQ", first, len(rows), 0, when)
            self.sequence += 1
            self.send(SAMPLES, self.sequence, self.status() + head + b"".join(rows))

    def status(self):
        queue = self.tick, self.until, self.tick + QUEUE, 0, 0
        return struct.pack("<HBBIIIII", self.run, self.state, self.latch, *queue)

    def send(self, kind, number, payload):
        self.line.sendall(frame(kind, self.session, number, payload))


@contextmanager
def paper_device(**lies):
    """The port of such a device, which serves one connection after the other."""
    rules = Lies(**lies)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            while True:
                try:
                    line, _ = server.accept()
                except OSError:
                    return
                with line:
                    try:
                        Paper(line, rules).serve()
                    except OSError:
                        continue

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"
        with suppress(OSError):  # Windows, where closing it ends an accept as well
            server.shutdown(socket.SHUT_RDWR)
    thread.join(timeout=5.0)
    assert not thread.is_alive()
