"""What every backend must do, as one suite of tests.

A backend's test module subclasses ``HalContract`` and provides the fixture ``bench``. The rig
behind it must be a hybrid actuator (real, or simulated by firmware): the tests look at its
currents to see when a command took effect.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from daq.config.rig import EncoderLimits, RigConfig
from daq.errors import DeviceError
from daq.hal import Flag, Guard, Mode, Phase
from daq.limits import Limits
from daq.rig import Rig

RATE = 800.0  # Hz
OPEN, CLOSED = Mode.OPEN_LOOP, Mode.CLOSED_LOOP


@dataclass(frozen=True)
class Bench:
    """A backend under test.

    make: a new, closed device. config: its calibration and limits. resolution: largest
    difference between a command and what is applied for it [V]. noise: largest deviation of a
    current at rest from zero [A]. step: least motor current one sample after a step of 1 V [A].
    encoder: whether a shaft turns and the device itself watches its counter. slow: whether a frame
    of commands may take longer to cross than those before it have left to play.
    """

    name: str
    make: Callable
    config: RigConfig
    resolution: float
    noise: float
    step: float = 0.2
    encoder: bool = True
    slow: bool = False

    def needs_encoder(self):
        if not self.encoder:
            pytest.skip(f"{self.name} watches no encoder")


def free_currents(config):
    """The configuration without current interlocks, for tests of something else."""
    limits = config.limits.model_copy(
        update={"current": config.limits.current.model_copy(update={"motor": 10.0, "brake": 10.0})}
    )
    return config.model_copy(update={"limits": limits})


def guard_of(low=-5.0, high=5.0):
    wide = np.full(3, 1e9)
    return Guard(np.array([low, 0.0]), np.array([high, 0.38]), -wide, wide)


def zeros(n):
    return np.zeros((n, 2))


def levels(n, motor=0.0, brake=0.0):
    return np.tile([float(motor), float(brake)], (n, 1))


class Played:
    """All samples of a run, joined: every field of ``Samples`` as an array."""

    def __init__(self, blocks):
        for name in blocks[0].__dataclass_fields__:
            setattr(self, name, np.concatenate([getattr(block, name) for block in blocks]))

    @property
    def applied(self):
        return np.stack([self.applied_voltage_motor, self.applied_voltage_brake], axis=1)

    @property
    def asked(self):
        return np.stack([self.cmd_voltage_motor, self.cmd_voltage_brake], axis=1)

    def flagged(self, flag):
        return (self.flags & int(flag)) != 0


def collect(rig, n, blocks=None):
    """Receive until ``n`` samples are there; all of them, as received."""
    blocks = [] if blocks is None else blocks
    received = sum(map(len, blocks))
    while received < n:
        blocks.append(rig.receive())
        received += len(blocks[-1])
    return blocks


def play(rig, commands, mode=OPEN, sizes=None):
    """Play commands, preloaded in chunks of ``sizes``, and return exactly their samples."""
    rig.start(RATE, mode)
    at = 0
    for size in sizes or [len(commands)]:
        rig.send(at, commands[at : at + size])
        at += size
    return first(Played(collect(rig, len(commands))), len(commands))


def fill(rig, at, commands):
    """Send commands from tick ``at`` on, as many as it has room for; the tick after the last."""
    n = min(len(commands), rig.room())
    rig.send(at, commands[:n])
    return at + n


def first(played, n):
    for name, values in vars(played).items():
        setattr(played, name, values[:n])
    return played


def plan(n, seed):
    """Commands that differ from tick to tick, within every limit."""
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-1.0, 1.0, n), rng.uniform(0.0, 0.3, n)], axis=1)


class HalContract:
    """The tests. ``bench`` is a fixture of the subclass, and ``actuator_currents`` may be."""

    @pytest.fixture
    def bench(self):
        raise NotImplementedError("a backend's test module provides the fixture 'bench'")

    @pytest.fixture
    def actuator_currents(self):
        """Function of applied commands (n, 2) [V] and speed (n,) [rad/s]: currents (n, 2) [A]."""
        pytest.skip("no simulation of the currents to compare the alignment of rows with")

    @pytest.fixture
    def device(self, bench):
        device = bench.make()
        yield device
        device.safe()
        device.close()

    @pytest.fixture
    def rig(self, bench, device):
        rig = Rig(device, free_currents(bench.config))
        rig.open()
        return rig

    # --- time ---------------------------------------------------------------------------

    @pytest.mark.parametrize("mode", [OPEN, CLOSED])
    def test_ticks_count_from_zero_without_gaps(self, rig, mode):
        n = 600 if mode is OPEN else 60
        played = play(rig, zeros(n), mode)
        assert np.array_equal(played.tick, np.arange(n))
        np.testing.assert_allclose(played.time, np.arange(n) / RATE, rtol=1e-12)
        assert not played.flags.any()

    # 255 to 257: the ends of blocks in which samples are delivered.
    @pytest.mark.parametrize("k", [1, 2, 100, 255, 256, 257])
    def test_a_command_acts_after_its_own_tick_was_latched(self, bench, rig, k):
        commands = zeros(k + 30)
        commands[k:, 0] = 1.0
        played = play(rig, commands)
        np.testing.assert_allclose(played.applied, commands, atol=bench.resolution)
        assert np.abs(played.current_motor[: k + 1]).max() < bench.noise, "row k is before u_k"
        assert played.current_motor[k + 1] > bench.step, "row k+1 must show the command of row k"

    def test_the_very_first_command_acts_after_tick_zero(self, bench, rig):
        played = play(rig, levels(10, motor=1.0))
        assert abs(played.current_motor[0]) < bench.noise
        assert played.current_motor[1] > bench.step

    def test_the_log_is_aligned_with_an_independent_simulation(self, rig, actuator_currents):
        # Both channels switch at random; a simulation shifted by one sample must fit worse.
        rng = np.random.default_rng(11)
        commands = np.stack(
            [
                np.repeat(rng.choice([-0.5, 0.5], 60), 10),
                np.repeat(rng.choice([0.0, 0.3], 60), 10),
            ],
            axis=1,
        )
        played = play(rig, commands)
        measured = np.stack([played.current_motor, played.current_brake], axis=1)
        measured = measured - np.array([np.median(measured[:1, j]) for j in (0, 1)])

        def misfit(shift):
            simulated = actuator_currents(np.roll(played.applied, shift, axis=0), played.omega)
            inner = slice(20, -20)  # away from what the shift brought round the ends
            error = measured[inner] - simulated[inner]
            return np.sqrt((error**2).mean(axis=0)) / np.abs(measured).max(axis=0)

        aligned = misfit(0)
        assert (aligned < 0.15).all(), aligned
        for shift in (-1, 1):
            assert (misfit(shift) > 2.0 * aligned).all(), (shift, misfit(shift), aligned)

    # --- what is applied ------------------------------------------------------------------

    def test_commands_beyond_the_limits_are_clamped_and_flagged(self, bench, rig):
        commands = zeros(40)
        commands[5] = [7.0, 0.1]
        commands[6] = [-7.0, 0.1]
        commands[8] = [0.3, -0.2]
        commands[9] = [0.3, 0.5]
        commands[12] = [5.0, 0.38]  # on the limit is within it
        commands[13] = [-5.0, 0.0]
        played = play(rig, commands)
        expected = np.clip(commands, [-5.0, 0.0], [5.0, 0.38])
        np.testing.assert_allclose(played.applied, expected, atol=bench.resolution)
        assert np.array_equal(played.asked, commands), "the log keeps what was asked"
        assert np.flatnonzero(played.flagged(Flag.CLAMPED)).tolist() == [5, 6, 8, 9]

    def test_the_device_itself_clamps_to_its_guard(self, device):
        device.open()
        device.start(RATE, OPEN, guard_of(low=-0.5, high=0.5))
        device.send(0, np.array([[3.0, 2.0], [-3.0, -2.0], [0.0, 0.0], [0.0, 0.0]]))
        applied = np.concatenate([device.receive().applied for _ in range(1)])
        assert applied[:, 0].max() <= 0.5 and applied[:, 0].min() >= -0.5
        assert applied[:, 1].max() <= 0.38 and applied[:, 1].min() >= 0.0
        assert applied[0, 0] > 0.4

    @pytest.mark.parametrize("seed", [1, 2, 3])
    def test_chunks_play_at_their_ticks_however_they_are_cut(self, bench, rig, seed):
        commands = plan(700, seed)
        cuts = np.sort(np.random.default_rng(seed).choice(np.arange(1, 700), 12, replace=False))
        sizes = np.diff(np.concatenate([[0], cuts, [700]])).tolist()
        print("seed", seed, "chunks", sizes)
        played = play(rig, commands, sizes=sizes)
        np.testing.assert_allclose(played.applied, commands, atol=bench.resolution)
        assert np.array_equal(played.asked, commands)
        assert not played.flags.any()

    def test_chunks_sent_while_it_plays_continue_without_a_seam(self, bench, rig):
        commands = plan(1200, 9)
        rig.start(RATE, OPEN)
        rig.send(0, commands[:600])
        blocks = collect(rig, 1)
        for at in range(600, 1200, 50):
            rig.send(at, commands[at : at + 50])
        played = first(Played(collect(rig, 1200, blocks)), 1200)
        np.testing.assert_allclose(played.applied, commands, atol=bench.resolution)
        assert not played.flags.any()

    def test_room_shrinks_by_what_is_sent(self, rig):
        rig.start(RATE, OPEN)
        before = rig.room()
        assert 0 < before <= rig.info.queue
        rig.send(0, zeros(64))
        assert before - 64 <= rig.room() <= before

    def test_open_loop_that_runs_dry_is_flagged_and_zero_for_good(self, bench, rig):
        rig.start(RATE, OPEN)
        rig.send(0, levels(100, motor=0.5, brake=0.1))
        blocks = collect(rig, 130)
        late = int(blocks[-1].tick[-1]) + 1
        rig.send(100, levels(late + 100 - 100, motor=0.5, brake=0.1))
        played = Played(collect(rig, late + 60, blocks))
        np.testing.assert_allclose(
            played.applied[:100], levels(100, 0.5, 0.1), atol=bench.resolution
        )
        assert not played.applied[100:].any(), "commands after the underflow must not play"
        assert played.flagged(Flag.UNDERFLOW)[100]
        assert not played.flagged(Flag.UNDERFLOW)[:100].any()

    def test_closed_loop_holds_the_last_command_when_the_host_is_late(self, bench, rig):
        ramp = np.stack([np.arange(2000) * 2e-3, np.arange(2000) * 1.5e-4], axis=1)
        rig.start(RATE, CLOSED)
        rig.send(0, ramp[:3])
        blocks = collect(rig, 20)
        behind = int(blocks[-1].tick[-1]) + 1
        # From the tick after the last one sent; those for ticks already past come too late.
        end = fill(rig, 3, ramp[3:])
        while blocks[-1].flags[-1] & int(Flag.HELD) and blocks[-1].tick[-1] < end - 30:
            blocks.append(rig.receive())
        played = Played(collect(rig, sum(map(len, blocks)) + 20, blocks))
        held = played.flagged(Flag.HELD)
        assert held[3:behind].all() and not held[:3].any()
        caught_up = int(np.flatnonzero(~held[behind:])[0]) + behind
        assert bench.slow or not held[caught_up:end].any()
        played, held = first(played, end), held[:end]
        on_time = played.tick[~held]
        np.testing.assert_allclose(
            played.applied[~held], ramp[on_time], atol=bench.resolution + 1e-12
        )
        for k in np.flatnonzero(held):
            assert np.array_equal(played.applied[k], played.applied[k - 1]), f"tick {k}"

    # --- safety ---------------------------------------------------------------------------

    def test_safe_never_raises_in_any_state(self, device):
        device.safe()
        device.safe()
        device.open()
        device.safe()
        device.start(RATE, OPEN, guard_of())
        device.safe()
        device.start(RATE, CLOSED, guard_of())
        device.send(0, zeros(4))
        device.safe()
        device.receive()
        device.safe()
        device.stop()
        device.safe()
        device.close()
        device.safe()
        device.close()
        device.safe()

    @pytest.mark.parametrize("mode", [OPEN, CLOSED])
    def test_safe_zeroes_the_outputs_until_the_next_start(self, rig, mode):
        rig.start(RATE, mode)
        end = fill(rig, 0, levels(2000, motor=0.5, brake=0.1))
        blocks = collect(rig, 20)
        rig.safe()
        rig.safe()
        before = sum(map(len, blocks))
        # What was already on its way when safe came may still show the old command.
        blocks = collect(rig, before + 60, blocks)
        fill(rig, end, levels(2000, motor=0.5, brake=0.1))
        played = Played(collect(rig, before + 120, blocks))
        assert played.applied[0, 0] > 0.4
        assert not played.applied[before + 40 :].any()
        assert np.array_equal(played.tick, np.arange(len(played.tick)))
        again = play(rig, levels(20, motor=0.25), mode)
        np.testing.assert_allclose(again.applied[:, 0], 0.25, atol=0.01)

    @pytest.mark.parametrize("mode", [OPEN, CLOSED])
    def test_a_current_beyond_its_limit_zeroes_the_outputs_from_that_row_on(
        self, bench, device, mode
    ):
        most = 0.75 * bench.step
        limits = bench.config.limits.model_copy(
            update={"current": bench.config.limits.current.model_copy(update={"motor": most})}
        )
        config = bench.config.model_copy(update={"limits": limits})
        rig = Rig(device, config)
        rig.open()
        commands = levels(400, brake=0.1)
        commands[30:, 0] = 1.0
        rig.start(RATE, mode)
        rig.send(0, commands)
        played = Played(collect(rig, 300))
        limits = Limits(config)
        limits.begin(Phase.RUN, RATE)
        row, reason = limits.check(played)
        assert row == 31, "the current rises within one sample of the step in row 30"
        assert "current_motor" in reason and f"{most:g}" in reason
        np.testing.assert_allclose(played.applied[:31], commands[:31], atol=bench.resolution)
        assert not played.applied[31:].any(), "zero from the very row that tripped"
        assert np.flatnonzero(played.flagged(Flag.INTERLOCK)).tolist() == [31]
        assert not played.flagged(Flag.UNDERFLOW).any()
        # Nothing but a new start ends it.
        rig.send(400, levels(100, motor=0.1))
        late = Played(collect(rig, 60))
        assert not late.applied.any()
        again = play(rig, levels(20, motor=0.1), mode)
        np.testing.assert_allclose(again.applied[:, 0], 0.1, atol=0.01)

    def test_the_brake_current_is_guarded_too(self, bench, device):
        limits = bench.config.limits.model_copy(
            update={"current": bench.config.limits.current.model_copy(update={"brake": 0.08})}
        )
        rig = Rig(device, bench.config.model_copy(update={"limits": limits}))
        rig.open()
        played = play(rig, levels(200, brake=0.3))
        row = int(np.flatnonzero(played.flagged(Flag.INTERLOCK))[0])
        assert not played.applied[row:].any() and played.applied[row - 1, 1] > 0.2

    @pytest.mark.parametrize("mode", [OPEN, CLOSED])
    @pytest.mark.parametrize(
        ("changes", "word"),
        [
            ({"speed": 5.0}, "omega"),
            ({"travel": (-0.5, 0.05)}, "travel"),
            ({"encoder": EncoderLimits(fastest=10.0)}, "jumped"),
        ],
        ids=["speed", "travel", "jump"],
    )
    def test_a_shaft_beyond_a_limit_zeroes_the_outputs_from_that_row_on(
        self, bench, device, mode, changes, word
    ):
        bench.needs_encoder()
        config = free_currents(bench.config)
        config = config.model_copy(update={"limits": config.limits.model_copy(update=changes)})
        limits = Limits(config)
        rig = Rig(device, config)
        rig.open()
        limits.begin(Phase.RUN, RATE)
        rig.start(RATE, mode, limits.window())
        commands = zeros(400)
        commands[30:, 0] = 2.0
        rig.send(0, commands)
        played = Played(collect(rig, 300))
        row, reason = limits.check(played)
        assert word in reason
        assert row > 30 and np.flatnonzero(played.flagged(Flag.INTERLOCK)).tolist() == [row]
        assert played.applied[row - 1, 0] > 1.0
        assert not played.applied[row:].any(), "zero from the very row that tripped"

    def test_travel_is_counted_from_the_first_sample_of_each_start(self, bench, device):
        bench.needs_encoder()
        rig = Rig(device, free_currents(bench.config))
        rig.open()
        play(rig, levels(100, motor=2.0))
        turned = 2.0 * np.pi * 0.05
        rig.stop()
        rig.start(RATE, OPEN, (-np.inf, turned))
        rig.send(0, levels(400, motor=2.0))
        played = Played(collect(rig, 300))
        row = int(np.flatnonzero(played.flagged(Flag.INTERLOCK))[0])
        moved = played.theta - played.theta[0]
        assert (moved[:row] <= turned).all() and moved[row] > turned

    def test_outputs_are_zero_at_the_first_tick_of_a_start(self, rig):
        play(rig, levels(50, motor=0.5, brake=0.1))
        rig.stop()
        rig.start(RATE, CLOSED)
        rig.send(0, zeros(1))
        assert not collect(rig, 1)[0].applied_voltage_motor.any()

    def test_leaving_the_context_by_an_exception_closes_the_device(self, bench):
        device = bench.make()
        rig = Rig(device, free_currents(bench.config))
        with pytest.raises(ZeroDivisionError), rig:
            rig.start(RATE, OPEN)
            rig.send(0, levels(200, motor=0.5))
            rig.receive()
            raise ZeroDivisionError
        with pytest.raises(DeviceError):
            device.receive()

    # --- order of calls -------------------------------------------------------------------

    def test_start_after_stop_begins_at_tick_zero_again(self, bench, rig):
        one = plan(80, 1)
        for commands in (one, plan(50, 2), one):
            played = play(rig, commands)
            rig.stop()
            assert np.array_equal(played.tick, np.arange(len(commands)))
            np.testing.assert_allclose(played.applied, commands, atol=bench.resolution)

    def test_commands_left_over_at_a_stop_do_not_play_after_the_next_start(self, rig):
        rig.start(RATE, OPEN)
        fill(rig, 0, levels(3000, motor=0.5))
        collect(rig, 10)
        rig.stop()
        played = play(rig, zeros(100))
        assert not played.applied.any()

    def test_it_opens_again_after_it_was_closed(self, bench, device):
        for motor in (0.2, 0.3):
            rig = Rig(device, free_currents(bench.config))
            info = rig.open()
            assert info.name and info.max_rate >= RATE and info.queue > 0
            played = play(rig, levels(60, motor=motor))
            np.testing.assert_allclose(played.applied[:, 0], motor, atol=0.01)
            rig.close()

    def test_announcing_phases_is_allowed_whenever_it_is_open(self, rig):
        for phase in Phase:
            rig.announce(phase, 0.0)
        play(rig, zeros(10))

    def test_receive_before_start_is_a_device_error_that_says_what_to_do(self, device):
        for prepare in (lambda: None, device.open, device.close):
            prepare()
            with pytest.raises(DeviceError, match=r"start it first|open it"):
                device.receive()

    def test_receive_after_stop_is_a_device_error(self, rig):
        play(rig, zeros(10))
        rig.stop()
        with pytest.raises(DeviceError, match="start"):
            rig.receive()

    def test_start_and_send_out_of_order_are_device_errors(self, device):
        with pytest.raises(DeviceError, match="open"):
            device.start(RATE, OPEN, guard_of())
        with pytest.raises(DeviceError, match=r"start|open"):
            device.send(0, zeros(4))
        device.open()
        with pytest.raises(DeviceError, match="start"):
            device.send(0, zeros(4))

    def test_a_rate_beyond_the_device_is_refused_by_name(self, rig):
        with pytest.raises(DeviceError, match=r"sample_rate 1e\+09 Hz is too fast"):
            rig.start(1e9, OPEN)

    def test_a_gap_or_a_number_that_is_none_is_refused_before_it_is_sent(self, rig):
        rig.start(RATE, OPEN)
        rig.send(0, zeros(10))
        with pytest.raises(DeviceError, match="commands for tick 11 follow those until 10"):
            rig.send(11, zeros(1))
        for bad in (np.nan, np.inf):
            with pytest.raises(DeviceError, match="not a finite number of volts"):
                rig.send(10, levels(5, motor=bad))
        assert len(collect(rig, 5)[0]) >= 1

    def test_a_rig_that_is_not_open_says_so(self, bench, device):
        with pytest.raises(DeviceError, match="open"):
            Rig(device, bench.config).start(RATE, OPEN)
