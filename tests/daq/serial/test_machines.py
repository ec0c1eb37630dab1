"""Both ends' state machines over a bad line, in a time of the test's own."""

import numpy as np
import pytest

from daq.hal import ANALOG_INPUTS, CHANNELS, Flag, Mode
from daq.serial import codec, messages
from daq.serial.clock import RateBounds
from daq.serial.emulation.faults import Line
from daq.serial.emulation.machine import DeviceMachine
from daq.serial.host import HostMachine
from daq.serial.messages import (
    Channel,
    CodedGuard,
    Latch,
    Result,
    Start,
    State,
    Type,
    Welcome,
)

CLOCK = 1_000_000
RATE = 1000
PERIOD = CLOCK // RATE
STEP = 0.0005  # s between two looks at the line
WATCHDOG = 0.1


class CountingBoard:
    """Each sample says which tick it is, and what the outputs were when it was latched."""

    def __init__(self):
        self.tick = 0
        self.output = np.zeros(2, dtype=np.int64)
        self.trip_at = None
        self.history = []  # (tick, applied) for all that was ever applied

    def connect(self):
        self.zero()

    def announce(self, phase, turns):
        self.announced = (phase, turns)

    def start(self, rate, guard):
        self.tick, self.guarded = 0, False
        self.zero()

    def play(self, commands):
        records = np.zeros(len(commands), messages.SAMPLE_DTYPE)
        for record, command in zip(records, commands, strict=True):
            record["analog"] = [self.tick, *self.output]
            record["counts"] = -self.tick
            if self.tick == self.trip_at:
                self.guarded = True
                record["flags"] = int(Flag.INTERLOCK)
            self.output = np.zeros(2, dtype=np.int64) if self.guarded else command.astype(int)
            record["applied"] = self.output
            self.history.append((self.tick, *self.output.tolist()))
            self.tick += 1
        return records

    def zero(self):
        self.output = np.zeros(2, dtype=np.int64)


def identity(**changes):
    names = messages.CHANNEL_NAMES
    rows = tuple(Channel(name, "V", 1e-3, 0.0, -10.0, 10.0) for name in names[:-1])
    facts = {
        "device": "counter", "firmware": "1", "serial": "7", "clock": CLOCK, "max_rate": 20_000.0,
        "queue": 512, "max_payload": 256, "watchdog_default": 100, "watchdog_longest": 1000,
        "channels": (*rows, Channel("encoder", "count", 1.0, 0.0, -1e9, 1e9)),
    }  # fmt: skip
    return Welcome(**{**facts, **changes})


def start_message(mode, run=1, period=PERIOD, watchdog=100, **changes):
    wide = 2**31 - 1
    facts = {
        "command_low": (-5000, 0), "command_high": (5000, 380), "analog_low": (-wide,) * 3,
        "analog_high": (wide,) * 3, "counts_low": -wide, "counts_high": wide,
        "count_rate": np.inf, "count_step": 2 * wide,
    }  # fmt: skip
    return Start(run, mode, period, watchdog, CodedGuard(**{**facts, **changes}))


class Bench:
    """Host, line and device, moved on by hand."""

    def __init__(self, faults=None, seed=0, **device):
        self.faults = faults or {}
        self.now = 100.0
        self.board = CountingBoard()
        self.device = DeviceMachine(self.board, identity(**device))
        self.host = HostMachine(4711)
        self.to_device, self.to_host = Line(seed), Line(seed + 1)
        self.alive = True

    def step(self):
        self.now += STEP
        if self.alive:
            self.host.poll(self.now)
            self.to_device.put(self.host.take(), self.now, self.faults)
        ticks = round(self.now * CLOCK)
        self.device.receive(self.to_device.ready(self.now), ticks)
        self.device.poll(ticks)
        while (frame := self.device.take()) is not None:
            self.to_host.put(frame, self.now, self.faults)
        arrived = self.to_host.ready(self.now)
        if arrived and self.alive:
            self.host.feed(arrived, self.now)

    def until(self, condition, seconds=3.0):
        end = self.now + seconds
        while not condition():
            assert self.host.failure is None, self.host.failure
            assert self.now < end, "too late"
            self.step()

    def wait(self, seconds):
        end = self.now + seconds
        while self.now < end:
            self.step()

    def connect(self):
        self.host.ask(Type.HELLO, messages.pack_hello("test"), self.now, 2.0)
        self.until(lambda: self.host.welcome)

    def ask(self, type_, payload=b""):
        self.host.ask(type_, payload, self.now)
        self.until(lambda: self.host.pending is None)
        return self.host.reply.result

    def start(self, mode, **changes):
        self.host.start(start_message(mode, **changes), self.now)
        self.until(lambda: self.host.pending is None)
        assert self.host.reply.result is Result.OK

    def go(self):
        self.until(lambda: self.host.commands.preloaded)
        self.host.go(self.now)
        self.until(lambda: self.host.pending is None)

    def take(self):
        blocks = list(self.host.blocks)
        self.host.blocks.clear()
        return blocks


def wave(n):
    ticks = np.arange(n)
    return np.stack([ticks % 1999 + 1, ticks % 379 + 1], axis=1).astype("<i2")


class Log:
    """Samples as they came, with their ticks."""

    def __init__(self):
        self.ticks, self.records, self.blocks = [], [], []

    def add(self, blocks):
        for block in blocks:
            self.blocks.append(block)
            self.ticks += range(block.first, block.first + len(block.records))
            self.records += list(block.records)

    @property
    def tick(self):
        return np.array(self.ticks)

    def column(self, name):
        return np.array([record[name] for record in self.records], dtype=np.int64)


def play_open(bench, n):
    commands = wave(n)
    bench.start(Mode.OPEN_LOOP)
    log, sent = Log(), 0
    while not log.ticks or log.ticks[-1] < n - 1:
        assert bench.host.failure is None, bench.host.failure
        room = min(bench.host.commands.room, n - sent)
        if room > 0:
            bench.host.send(sent, commands[sent : sent + room], bench.now)
            sent += room
        if bench.board.tick == 0 and bench.device.state is not State.RUNNING:
            bench.go()
        bench.step()
        log.add(bench.take())
    return log, commands


def play_closed(bench, n, ahead=1):
    bench.start(Mode.CLOSED_LOOP)
    commands = wave(3 * n)
    bench.host.send(0, commands[:ahead], bench.now)
    bench.go()
    log, asked = Log(), ahead
    while not log.ticks or log.ticks[-1] < n - 1:
        bench.step()
        assert bench.host.failure is None, bench.host.failure
        log.add(bench.take())
        upto = log.ticks[-1] + 1 + ahead if log.ticks else 0
        if upto > asked:
            bench.host.send(asked, commands[asked:upto], bench.now)
            asked = upto
    return log, commands


def assert_nothing_is_misplaced(bench, log):
    """Every sample stands at the tick that it was latched in, and the missing are counted."""
    tick = log.tick
    assert (np.diff(tick) > 0).all()
    assert np.array_equal(log.column("analog")[:, 0], tick)
    assert np.array_equal(log.column("counts"), -tick)
    assert bench.host.counters.lost_samples == tick[-1] + 1 - len(tick)
    history = {t: rest for t, *rest in bench.board.history}
    assert [history[t] for t in tick] == log.column("applied").tolist()


LINES = {
    "clean": {},
    "bit errors": {"bit-errors": 3e-4},
    "drop": {"drop": 0.05},
    "duplicate": {"duplicate": 0.2},
    "split": {"split": 7},
    "merge": {"merge": 0.016},
    "delay": {"delay": 0.012},
    "jitter": {"jitter": 0.02},
    "all": {"bit-errors": 1e-4, "drop": 0.02, "duplicate": 0.05, "split": 11, "jitter": 0.01},
}


@pytest.mark.parametrize("faults", LINES.values(), ids=LINES)
def test_open_loop_plays_the_waveform_whatever_the_line_does(faults):
    bench = Bench(faults, seed=3)
    bench.connect()
    log, commands = play_open(bench, 1500)
    assert_nothing_is_misplaced(bench, log)
    keep = log.tick < 1500
    assert np.array_equal(log.column("applied")[keep], commands[log.tick[keep]])
    assert not log.column("flags")[keep].any()
    played = np.array(bench.board.history[:1500])
    assert np.array_equal(played[:, 1:], commands), "on the device too, at every tick"
    if "drop" not in faults and "bit-errors" not in faults:
        assert len(log.tick) == log.tick[-1] + 1, "nothing is lost that came through"


@pytest.mark.parametrize("faults", LINES.values(), ids=LINES)
def test_closed_loop_holds_and_flags_and_never_misplaces_a_command(faults):
    bench = Bench(faults, seed=5)
    bench.connect()
    log, commands = play_closed(bench, 800)
    assert_nothing_is_misplaced(bench, log)
    tick, applied = log.tick, log.column("applied")
    held = (log.column("flags") & int(Flag.HELD)) != 0
    assert np.array_equal(applied[~held], commands[tick[~held]])
    history = np.array([row[1:] for row in bench.board.history])
    for k in tick[held]:
        assert np.array_equal(history[k], history[k - 1]), f"tick {k} holds the one before"
    if not faults:
        assert not held.any()
    if "delay" in faults:
        assert held.any(), "a line slower than the loop must show"
        assert log.blocks[-1].status.late > 0, "and the device counts what came too late"


def test_requests_are_carried_out_once_however_often_they_come():
    bench = Bench()
    bench.connect()
    bench.start(Mode.CLOSED_LOOP)
    start = codec.encode(Type.START, 4711, 2, start_message(Mode.CLOSED_LOOP).pack())
    bench.go()
    bench.wait(0.05)
    before = bench.device.state, bench.board.tick
    for _ in range(3):
        bench.device.receive(start, round(bench.now * CLOCK))
    assert before == (State.RUNNING, bench.board.tick), "an old START does not start anew"
    hello = codec.encode(Type.HELLO, 4711, 1, messages.pack_hello("test"))
    bench.device.receive(hello, round(bench.now * CLOCK))
    assert bench.device.state is State.RUNNING, "nor does a repeated HELLO end the run"


@pytest.mark.parametrize("mode", list(Mode))
def test_a_dead_host_means_zero_within_the_watchdogs_time_until_it_is_cleared(mode):
    bench = Bench()
    bench.connect()
    bench.start(mode)
    bench.host.send(0, wave(500), bench.now)
    bench.go()
    bench.wait(0.05)
    assert bench.board.output.any()
    bench.alive = False
    died = bench.now
    while bench.board.output.any():
        bench.step()
    assert bench.now - died <= WATCHDOG + 2 * STEP
    bench.wait(0.3)
    assert bench.device.latch is Latch.WATCHDOG and not bench.board.output.any()
    bench.alive = True
    # The same host comes back to life: its commands are not taken any more.
    bench.host.send(500, wave(100), bench.now)
    bench.step()
    bench.wait(0.1)
    assert not bench.board.output.any()
    assert "watchdog" in str(bench.host.failure)
    bench.host = HostMachine(99)
    bench.connect()
    assert bench.host.welcome.latch is Latch.WATCHDOG
    assert bench.ask(Type.START, start_message(mode).pack()) is Result.LATCHED
    assert bench.ask(Type.CLEAR) is Result.OK
    bench.start(mode, run=2)


def test_a_device_that_is_left_alone_stops_sampling_too():
    bench = Bench()
    bench.connect()
    bench.start(Mode.OPEN_LOOP)
    bench.host.send(0, wave(500), bench.now)
    bench.go()
    bench.alive = False
    bench.wait(2.2)
    assert bench.device.state is State.IDLE and bench.device.latch is Latch.WATCHDOG


def test_a_waveform_that_runs_dry_is_flagged_and_zero_for_good():
    bench = Bench()
    bench.connect()
    bench.start(Mode.OPEN_LOOP)
    bench.host.send(0, wave(100), bench.now)
    bench.go()
    bench.wait(0.2)
    bench.host.send(100, wave(300), bench.now)
    bench.wait(0.2)
    log = Log()
    log.add(bench.take())
    flags = log.column("flags")
    assert not flags[:100].any() and (flags[100:] == int(Flag.UNDERFLOW)).all()
    assert not log.column("applied")[100:].any()
    assert bench.device.latch is Latch.UNDERFLOW


def test_an_input_beyond_the_guard_is_zero_from_its_own_row_on():
    bench = Bench()
    bench.board.trip_at = 60
    bench.connect()
    bench.start(Mode.OPEN_LOOP)
    bench.host.send(0, wave(400), bench.now)
    bench.go()
    bench.wait(0.2)
    log = Log()
    log.add(bench.take())
    assert np.flatnonzero(log.column("flags")).tolist() == [60]
    assert log.column("flags")[60] == int(Flag.INTERLOCK)
    assert log.column("applied")[59].any() and not log.column("applied")[60:].any()
    assert bench.device.latch is Latch.INTERLOCK


def test_a_device_clamps_to_the_narrower_of_its_own_and_the_hosts_limits():
    own = list(identity().channels)
    own[3] = Channel("motor", "V", 1e-3, 0.0, -2.0, 2.0)
    bench = Bench(channels=tuple(own))
    bench.connect()
    bench.start(Mode.OPEN_LOOP, command_high=(32767, 32767), command_low=(-32768, -32768))
    asked = np.array([[5000, 500], [-5000, -500], [1999, 10], [2000, 10]], dtype="<i2")
    bench.host.send(0, asked, bench.now)
    bench.go()
    bench.wait(0.1)
    log = Log()
    log.add(bench.take())
    assert log.column("applied")[:4, 0].tolist() == [2000, -2000, 1999, 2000]
    clamped = (log.column("flags")[:4] & int(Flag.CLAMPED)) != 0
    assert clamped.tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    "changes",
    [{"period": 0}, {"period": 1}, {"watchdog": 5000}, {"command_low": (1, 0)},
     {"command_high": (5000, -1)}],
)  # fmt: skip
def test_a_start_that_the_device_cannot_do_is_refused(changes):
    bench = Bench()
    bench.connect()
    bench.host.start(start_message(Mode.OPEN_LOOP, **changes), bench.now)
    bench.until(lambda: bench.host.pending is None)
    assert bench.host.reply.result is Result.BAD_VALUE
    assert bench.device.state is State.IDLE


def test_a_device_that_restarts_is_noticed():
    bench = Bench()
    bench.connect()
    bench.start(Mode.CLOSED_LOOP)
    bench.go()
    bench.wait(0.05)
    bench.device = DeviceMachine(bench.board, identity())
    bench.wait(0.1)
    assert "has restarted" in str(bench.host.failure)
    assert not bench.board.output.any()


def test_a_full_line_costs_samples_that_are_counted_and_no_others():
    bench = Bench()
    bench.connect()
    bench.start(Mode.CLOSED_LOOP)
    bench.host.send(0, wave(10), bench.now)
    bench.go()
    bench.wait(0.05)
    bench.device.to_lose += 17
    bench.wait(0.2)
    log = Log()
    log.add(bench.take())
    assert_nothing_is_misplaced(bench, log)
    assert bench.host.counters.lost_samples == 17
    assert log.blocks[-1].status.overflow == 17


def test_another_version_is_named_and_changes_nothing_in_the_device():
    bench = Bench(version=2)
    bench.host.ask(Type.HELLO, messages.pack_hello("test"), bench.now, 1.0)
    bench.until(lambda: bench.host.other_version is not None)
    assert bench.host.other_version == 2 and bench.host.welcome is None
    assert bench.device.state is State.IDLE


def test_random_bytes_never_move_a_device():
    rng = np.random.default_rng(2)
    bench = Bench()
    bench.connect()
    bench.start(Mode.OPEN_LOOP)
    accepted = bench.device.decoder.accepted
    for _ in range(200):
        bench.device.receive(rng.bytes(300), round(bench.now * CLOCK))
        bench.host.feed(rng.bytes(300), bench.now)
    assert bench.device.state is State.ARMED and bench.host.failure is None
    assert bench.device.decoder.accepted == accepted


@pytest.mark.parametrize("type_", [Type.SAFE, Type.CLEAR])
def test_what_takes_no_payload_is_refused_with_one(type_):
    bench = Bench()
    bench.connect()
    bench.start(Mode.CLOSED_LOOP)
    assert bench.ask(type_, b"\0") is Result.BAD_VALUE
    assert bench.device.state is State.ARMED and bench.device.latch is Latch.NONE
    assert bench.ask(type_) is Result.OK


def test_what_a_stopped_run_still_had_on_the_line_is_not_missing():
    bench = Bench({"delay": 0.03})
    bench.connect()
    for run in (1, 2, 3):
        bench.start(Mode.CLOSED_LOOP, run=run)
        bench.host.send(0, wave(10), bench.now)
        bench.go()
        bench.wait(0.1)
        bench.host.stop(bench.now)
        bench.until(lambda: bench.host.pending is None)
    assert bench.host.counters.missing_frames == 0 and bench.host.counters.lost_samples == 0


@pytest.mark.parametrize("rate", [0.9, 0.995, 1.0, 1.1])
def test_no_delay_makes_the_bounds_of_a_clocks_rate_wrong(rate):
    rng, bounds = np.random.default_rng(4), RateBounds()
    for sent in np.arange(0.0, 10.0, 0.025):
        there, back = rng.exponential([0.002, 0.05])  # s; the way back is held up
        bounds.add(sent, 7.0 + rate * (sent + there), sent + there + back)
        assert bounds.lowest <= rate <= bounds.highest
    assert (bounds.deviation() is None) == (abs(rate - 1.0) < 0.01)


def test_the_machines_speak_of_the_same_channels():
    assert len(messages.CHANNEL_NAMES) == len(ANALOG_INPUTS) + len(CHANNELS) + 1
