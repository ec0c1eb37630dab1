"""The board on a serial line, at the pace of the clock: the protocol's device in a thread.

with serving(Setting(fault="encoder dead", at=0.3)) as device:
    ... --port device.port ...
device.board.truth
"""

import contextlib
import math
import select
import socket
import struct
import threading
import time
from dataclasses import dataclass, field

from tests.faults import line
from tests.faults.board import _PHASES, STEP, Board
from tests.faults.firmware import NONE, SAFE, WATCHDOG, Limits, Ticker

IDLE, ARMED, RUNNING = range(3)
CLOCK = 1_000_000  # Hz
QUEUE = 2048  # ticks
MAX_RATE = 5000.0  # Hz
_MOST_VOLTS = ((-5.0, 0.0), (5.0, 0.38))
_DEFAULT_WATCHDOG, _LONGEST_WATCHDOG = 100, 1000  # ms
_ORPHANED = 2.0  # s without a frame
_BLOCK = 0.02  # s of samples that nobody waits for
_TICKS_AT_ONCE = 8  # that a late device does before it listens again
_MOST_SAMPLES = 140  # of a frame
_IDLE_STEP = 0.005  # s of the plant while no tick is due

_CHANNELS = (
    *((f"current_{name}", "V", STEP, -10.0, 10.0 - STEP) for name in ("motor", "brake")),
    ("torque", "V", STEP, -10.0, 10.0 - STEP),
    ("motor", "V", STEP, -5.0, 5.0),
    ("brake", "V", STEP, 0.0, 0.38),
    ("encoder", "count", 1.0, -(2.0**31), 2.0**31 - 1.0),
)


@dataclass
class Run:
    """One run, from START on; waiting: samples that have not been sent, with the first's clock."""

    number: int
    ticker: Ticker
    period: int  # ticks of the clock
    watchdog: float  # s
    closed: bool
    begun: int = 0  # clock at tick 0
    queued_until: int = 0
    late: int = 0
    waiting: list = field(default_factory=list)


class SerialBoard:
    """The device's state machine; ``handle`` takes bytes, ``work`` does what is due."""

    def __init__(self, setting, transmit):
        self.board = Board(setting)
        self._transmit = transmit
        self._state, self._latch = IDLE, NONE
        self._session = self._run = None
        self._last = None  # number of the last request, and its REPLY
        self._number = 0  # of SAMPLES and STATUS
        self._buffer = bytearray()
        self._heard = self._when = time.perf_counter()
        self._clock = 0.0  # ticks
        self._idle_until = self._when
        self._gone = False  # reset, and nothing more to say of it

    # --- time ---------------------------------------------------------------------------

    def clock(self):
        """The device's clock [ticks]."""
        now = time.perf_counter()
        self._clock += (now - self._when) * CLOCK * self.board.now.clock
        self._when = now
        return int(self._clock)

    def patience(self):
        """Seconds until something is due."""
        if self._state != RUNNING:
            return _IDLE_STEP
        due = self._run.begun + self._run.ticker.tick * self._run.period
        return min(_IDLE_STEP, max(0.0, (due - self.clock()) / CLOCK))

    def hears(self):
        """Whether what comes in is looked at now."""
        now = self.board.now
        return now.ends != "hung" and not 0.0 <= self.board.since_fault < now.pause

    def work(self):
        """Ticks that are due, samples, the watchdog."""
        now = self.board.now
        if now.ends == "reset" and not self._gone:
            self._gone, self._state, self._latch = True, IDLE, NONE
            self._session = self._run = None
        if self._state != RUNNING:
            self._idle()
            return
        run = self._run
        self._watch(run)
        for _ in range(_TICKS_AT_ONCE):
            if self.clock() < run.begun + run.ticker.tick * run.period:
                break
            self._tick(run)
        self._idle_until = time.perf_counter()

    def _idle(self):
        now = time.perf_counter()
        while now - self._idle_until >= _IDLE_STEP:
            self._idle_until += _IDLE_STEP
            kept = self._run.ticker.last if self._run and self.board.now.ignores_safe else [0.0] * 2
            self.board.drive(*kept, _IDLE_STEP)

    def _tick(self, run):
        if self.board.now.ends == "hung":
            self.board.drive(*run.ticker.last, run.period / CLOCK)
            run.ticker.tick += 1
            return
        latch = run.ticker.latch
        row = run.ticker.run()
        self._latch = run.ticker.latch
        codes = [round(value / STEP) for value in row.analog]
        applied = [round(value / STEP) for value in row.applied]
        run.waiting.append((row.tick, (codes, row.count, row.rate, applied, row.flags)))
        block = max(1, round(_BLOCK * CLOCK / run.period))
        waited_for = run.closed and not self._latch and run.ticker.waiting() < block
        if waited_for or len(run.waiting) >= block or latch != self._latch:
            self._send_samples(run)

    def _send_samples(self, run):
        rows, run.waiting = run.waiting, []
        for at in range(0, len(rows), _MOST_SAMPLES):
            part = rows[at : at + _MOST_SAMPLES]
            first = part[0][0]
            payload = line.samples(
                self._status(), first, run.begun + first * run.period, [row for _, row in part]
            )
            lost = self.board.now.lost
            if lost and self.board.rng.random() < lost:
                self._number += 1
                continue
            self._send(line.SAMPLES, payload)

    def _watch(self, run):
        silence = time.perf_counter() - self._heard
        if silence > run.watchdog and self._latch != WATCHDOG:
            run.ticker.latch = NONE  # this one outlasts every other
            run.ticker.make_safe(WATCHDOG)
            self._latch = WATCHDOG
            self._send_samples(run)
        if silence > _ORPHANED:
            self._state = IDLE

    # --- frames -------------------------------------------------------------------------

    def handle(self, data):
        """Bytes from the host."""
        self._buffer += data
        *codes, self._buffer = self._buffer.split(b"\0")
        for code in codes:
            damaged = self.board.now.damaged
            if not code or (damaged and self.board.rng.random() < damaged):
                continue
            frame = line.decoded(bytes(code))
            if frame is not None:
                self._take(frame)

    def _take(self, frame):
        if frame.kind == line.HELLO:
            self._hello(frame)
            return
        if frame.session != self._session:
            self._answer(frame, line.reply(frame.kind, line.NO_SESSION, self._status()))
            return
        self._heard = time.perf_counter()
        if frame.kind == line.COMMANDS:
            self._commands(frame.payload)
        elif frame.kind == line.PING:
            self._ping(frame)
        else:
            self._request(frame)

    def _hello(self, frame):
        if frame.payload[:4] != line.MAGIC or len(frame.payload) < 6:
            return
        (version,) = struct.unpack_from("<H", frame.payload, 4)
        if version == line.VERSION and frame.session != self._session:
            self._to_idle()
            self._latch = self._latch if self._latch == WATCHDOG else NONE
            self._session, self._run, self._last = frame.session, None, None
        if frame.session == self._session:
            self._heard = time.perf_counter()
        watchdog = (_DEFAULT_WATCHDOG, _LONGEST_WATCHDOG)
        payload = line.welcome(self._latch, CLOCK, MAX_RATE, QUEUE, watchdog, _CHANNELS)
        self._send(line.WELCOME, payload, frame)

    def _ping(self, frame):
        if len(frame.payload) != 8:
            return
        heard = self.clock()
        (host_time,) = struct.unpack("<Q", frame.payload)
        self._send(line.PONG, line.pong(host_time, heard, self.clock(), self._status()), frame)

    def _commands(self, payload):
        parsed, run = line.commands(payload), self._run
        if parsed is None or run is None or self._state == IDLE or parsed[0] != run.number:
            return
        _, tick, codes = parsed
        if not run.closed and tick > run.queued_until:
            self._send(line.STATUS, self._status().pack())
            return
        for at, pair in enumerate(codes, start=tick):
            if at >= run.ticker.tick + QUEUE:
                break
            if not run.ticker.send(at, [STEP * code for code in pair]) and run.closed:
                run.late += 1
            run.queued_until = max(run.queued_until, at + 1)
        if self._state == ARMED:
            self._send(line.STATUS, self._status().pack())

    def _request(self, frame):
        if self._last is not None:
            newer = (frame.number - self._last[0]) % 65536
            if newer == 0:
                self._answer(frame, self._last[1])
            if newer == 0 or newer >= 32768:
                return
        result = self._carry_out(frame.kind, frame.payload)
        payload = line.reply(frame.kind, result, self._status())
        self._last = (frame.number, payload)
        self._answer(frame, payload)

    def _carry_out(self, kind, payload):
        if kind not in line.LENGTHS:
            return line.UNKNOWN
        if len(payload) != line.LENGTHS[kind]:
            return line.BAD_VALUE
        does = {
            line.START: self._start,
            line.GO: self._go,
            line.STOP: self._stop,
            line.SAFE: self._safe,
            line.CLEAR: self._clear,
            line.ANNOUNCE: self._announce,
        }
        return does[kind](payload)

    def _start(self, payload):
        request = line.start(payload)
        watchdog = request.watchdog or _DEFAULT_WATCHDOG
        clamps = zip(request.lowest, request.highest, strict=True)
        if (
            request.period == 0
            or CLOCK / request.period > MAX_RATE
            or watchdog > _LONGEST_WATCHDOG
            or request.mode not in (0, 1)
            or not all(low <= 0 <= high for low, high in clamps)
        ):
            return line.BAD_VALUE
        if self._latch == WATCHDOG:
            return line.LATCHED
        ticker = Ticker(self.board, request.period / CLOCK, request.mode == 1, _limits(request))
        self._run = Run(request.run, ticker, request.period, watchdog * 1e-3, request.mode == 1)
        self._state, self._latch = ARMED, NONE
        return line.OK

    def _go(self, payload):
        if not self._is_this_run(payload) or self._state == IDLE:
            return line.WRONG_STATE
        if self._state == ARMED:
            self._state, self._run.begun = RUNNING, self.clock()
        return line.OK

    def _stop(self, payload):
        if self._is_this_run(payload):
            self._to_idle()
        return line.OK

    def _safe(self, payload):
        if self._run is not None:
            self._run.ticker.make_safe(SAFE)
        self._latch = self._latch or (NONE if self.board.now.ignores_safe else SAFE)
        return line.OK

    def _clear(self, payload):
        self._to_idle()
        self._latch = NONE
        return line.OK

    def _announce(self, payload):
        phase, turns = struct.unpack("<B3xf", payload)
        if phase < len(_PHASES):
            self.board.announce(_PHASES[phase], turns)
        return line.OK

    def _is_this_run(self, payload):
        return self._run is not None and struct.unpack("<H", payload)[0] == self._run.number

    def _to_idle(self):
        if self._run is not None:
            self._run.ticker.make_safe(SAFE)
            self._run.waiting = []
        self._state, self._idle_until = IDLE, time.perf_counter()

    def _status(self):
        run = self._run
        if run is None:
            return line.Status(0, self._state, self._latch, 0, 0, QUEUE, 0, 0)
        tick = run.ticker.tick
        return line.Status(
            run.number, self._state, self._latch, tick, run.queued_until, tick + QUEUE, run.late, 0
        )

    def _answer(self, frame, payload):
        self._send(line.REPLY, payload, frame)

    def _send(self, kind, payload, request=None):
        if request is None:
            frame = line.Frame(kind, self._session or 0, self._number, payload)
            self._number = (self._number + 1) % 65536
        else:
            frame = line.Frame(kind, request.session, request.number, payload)
        now = self.board.now
        if now.ends in ("mute", "hung"):
            return
        data = bytearray(line.encoded(frame))
        if now.damaged and self.board.rng.random() < now.damaged:
            data[len(data) // 2] ^= 0x55
        self._transmit(bytes(data))


def _limits(request):
    """The guard of START in volts and counts."""
    lowest, highest = line.NOTHING_PASSES_I32
    low, high = ([STEP * code for code in codes] for codes in (request.lowest, request.highest))
    return Limits(
        tuple(map(max, low, _MOST_VOLTS[0])),
        tuple(map(min, high, _MOST_VOLTS[1])),
        tuple(-math.inf if code == lowest else (code - 0.5) * STEP for code in request.guard_low),
        tuple(math.inf if code == highest else (code + 0.5) * STEP for code in request.guard_high),
        -math.inf if request.counts_low == lowest else request.counts_low,
        math.inf if request.counts_high == highest else request.counts_high,
        request.rate,
        math.inf if request.step == line.NOTHING_PASSES_U32 else request.step,
    )


class Server:
    """A SerialBoard behind a TCP port, in a thread. port: its URL; board: with the truth."""

    def __init__(self, setting):
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._peer = None
        self._device = SerialBoard(setting, self._transmit)
        self.board = self._device.board
        self.board.drive(0.0, 0.0, _IDLE_STEP)  # compiled before a clock runs
        self.board.latch()
        self.port = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        self._over = threading.Event()
        self._error = None
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self):
        """End the thread; raises what went wrong in it."""
        self._over.set()
        self._thread.join()
        self.board.truth.ended = self.board.plant.time
        self._listener.close()
        if self._peer is not None:
            self._peer.close()
        if self._error is not None:
            raise self._error

    def _serve(self):
        try:
            while not self._over.is_set():
                self._exchange()
                self._device.work()
        except BaseException as error:
            self._error = error

    def _exchange(self):
        listens = self._device.hears()
        sockets = [s for s in (self._listener, self._peer) if s is not None] if listens else []
        ready, _, _ = select.select(sockets, [], [], self._device.patience())
        for source in ready:
            if source is self._listener:
                if self._peer is not None:
                    self._peer.close()
                self._peer, _ = self._listener.accept()
                self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            elif source is self._peer:
                self._receive()

    def _receive(self):
        try:
            data = self._peer.recv(65536)
        except OSError:
            data = b""
        if data:
            self._device.handle(data)
        else:
            self._peer.close()
            self._peer = None

    def _transmit(self, data):
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._peer.sendall(data)


@contextlib.contextmanager
def serving(setting):
    """A Server until the end of the block."""
    server = Server(setting)
    try:
        yield server
    finally:
        server.close()
