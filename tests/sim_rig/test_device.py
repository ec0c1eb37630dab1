from __future__ import annotations

import math

import numpy as np
import pytest

from daq import hal
from daq.errors import DeviceError
from daq.hal import Flag, Guard, Mode, Phase, RawSamples
from daq.serial.backend import SerialDevice, SerialOptions
from sim_rig.backend import Imperfections, SimulatedDevice, Simulation
from sim_rig.plant import Plant
from sysid import Dataset, ModelError
from tests.sim_rig.support import PLANTS
from tests.soak import mostly_soak
from tests.sysid.reference import simulate as reference

OPEN_GUARD = Guard(
    np.array([-10.0, -10.0]), np.array([10.0, 10.0]), np.full(3, -99.0), np.full(3, 99.0)
)
RATE = 800.0
RESOLUTION = 20.0 / 2**16


def device(**options):
    found = SimulatedDevice(Simulation(**options))
    found.open()
    return found


def waveform(n=600, seed=1):
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [np.repeat(rng.uniform(-2, 2, n // 10), 10), np.repeat(rng.uniform(0, 0.3, n // 10), 10)]
    )


def collect(found, n):
    parts = []
    while sum(len(part.tick) for part in parts) < n:
        parts.append(found.receive())
    return RawSamples(
        *(
            np.concatenate([getattr(part, name) for part in parts])[:n]
            for name in ("tick", "analog", "counts", "count_rate", "applied", "flags")
        )
    )


def play(found, commands, chunk=None, guard=OPEN_GUARD, mode=Mode.OPEN_LOOP):
    """Samples of a waveform sent in chunks, each played out before the next is sent."""
    found.start(RATE, mode, guard)
    chunk = chunk or len(commands)
    parts = []
    for start in range(0, len(commands), chunk):
        piece = commands[start : start + chunk]
        found.send(start, piece)
        parts.append(collect(found, len(piece)))
    return RawSamples(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("tick", "analog", "counts", "count_rate", "applied", "flags")
        )
    )


def assert_same(a, b):
    for name in ("tick", "analog", "counts", "count_rate", "applied", "flags"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


# --- determinism ----------------------------------------------------------------------------


@pytest.mark.parametrize("ideal", [False, True])
@pytest.mark.parametrize("chunk", [1, 7, 100, 256, 599])
def test_the_same_seed_gives_the_same_bits_however_commands_are_chunked(chunk, ideal):
    whole = play(device(seed=5, ideal=ideal), waveform())
    assert_same(play(device(seed=5, ideal=ideal), waveform(), chunk), whole)
    assert np.ptp(whole.counts) > 100


def test_chunks_do_not_matter_while_the_user_winds_either():
    def run(chunk):
        found = device(seed=5)
        play(found, waveform(310), 31)  # so that the clock is no round number
        found.announce(Phase.HOMING, 1.0)
        return play(found, np.zeros((1600, 2)), chunk)

    whole = run(None)
    assert_same(run(13), whole)
    assert whole.counts[-1] - whole.counts[0] > 8192 * 0.9


def test_another_seed_is_another_log():
    a, b = play(device(seed=5), waveform(100)), play(device(seed=6), waveform(100))
    assert not np.array_equal(a.analog, b.analog)


def test_an_interlock_cuts_at_the_same_sample_however_commands_are_chunked():
    guard = Guard(
        OPEN_GUARD.command_low, OPEN_GUARD.command_high, np.full(3, -2.2), np.full(3, 2.2)
    )
    commands = np.column_stack([np.where(np.arange(600) < 333, 0.2, 4.0), np.zeros(600)])
    whole = play(device(seed=2), commands, None, guard)
    row = np.flatnonzero(whole.flags & Flag.INTERLOCK)
    assert len(row) == 1
    assert np.all(whole.applied[row[0] :] == 0.0)
    assert row[0] in (334, 335)  # latched a tick after the command
    assert np.all(whole.applied[: row[0], 0] > 0.0)
    assert np.all(np.abs(whole.analog[: row[0]]) <= 2.2)
    assert np.any(np.abs(whole.analog[row[0]]) > 2.2)
    pieces = play(device(seed=2), commands, 50, guard)
    assert_same(pieces, whole)


# --- one tick -------------------------------------------------------------------------------


def test_a_tick_latches_before_it_applies():
    commands = np.zeros((20, 2))
    commands[10:, 0] = 1.0
    found = play(device(ideal=True), commands)
    current = found.analog[:, 0] / 2.0
    np.testing.assert_array_equal(found.applied, commands)
    assert current[10] == pytest.approx(0.0, abs=1e-9)
    assert current[11] > 0.1
    np.testing.assert_array_equal(found.tick, np.arange(20))


def test_closed_loop_holds_the_last_command_and_says_so():
    found = device(ideal=True)
    found.start(RATE, Mode.CLOSED_LOOP, OPEN_GUARD)
    found.send(0, np.array([[1.0, 0.1]]))
    samples = collect(found, 3)
    np.testing.assert_array_equal(samples.applied, [[1.0, 0.1]] * 3)
    assert samples.flags.tolist() == [0, Flag.HELD, Flag.HELD]


def test_open_loop_that_runs_dry_is_zero_and_says_so():
    found = device(ideal=True)
    found.start(RATE, Mode.OPEN_LOOP, OPEN_GUARD)
    found.send(0, np.ones((2, 2)))
    samples = collect(found, 4)
    np.testing.assert_array_equal(samples.applied[2:], 0.0)
    assert samples.flags[2] & Flag.UNDERFLOW


def test_commands_are_clamped_to_the_guard():
    guard = Guard(np.array([-1.0, 0.0]), np.array([1.5, 0.2]), np.full(3, -99.0), np.full(3, 99.0))
    found = play(device(ideal=True), np.array([[5.0, 5.0], [-5.0, -5.0]]), guard=guard)
    np.testing.assert_array_equal(found.applied, [[1.5, 0.2], [-1.0, 0.0]])


def test_safe_zeroes_at_once():
    found = device(ideal=True)
    found.start(RATE, Mode.CLOSED_LOOP, OPEN_GUARD)
    found.send(0, np.ones((5, 2)))
    found.safe()
    np.testing.assert_array_equal(found.receive().applied, 0.0)


def test_it_must_be_opened_and_started():
    with pytest.raises(DeviceError, match="not open"):
        SimulatedDevice(Simulation()).start(RATE, Mode.OPEN_LOOP, OPEN_GUARD)
    with pytest.raises(DeviceError, match="start it first"):
        device().receive()


# --- sensing chain --------------------------------------------------------------------------


def rest(n=4000, **options):
    return play(device(**options), np.zeros((n, 2)))


def test_an_ideal_rig_at_rest_is_silent():
    found = rest(200, ideal=True)
    np.testing.assert_allclose(found.analog, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.count_rate, 0.0, atol=1e-6)
    assert np.all(found.flags == 0)


def test_an_ideal_rig_shows_the_true_angle_and_speed():
    found = play(device(ideal=True), waveform())
    per_radian = 8192 / (2 * math.pi)
    omega, theta = found.count_rate / per_radian, found.counts / per_radian
    assert np.any(found.counts != np.round(found.counts))
    # The one is the derivative of the other.
    slope = (theta[2:] - theta[:-2]) * RATE / 2.0
    assert np.sqrt(np.mean((slope - omega[1:-1]) ** 2)) < 0.05 * np.abs(omega).max()


def test_noise_and_offsets_are_of_the_stated_size():
    offsets = []
    for seed in range(8):
        analog = rest(seed=seed).analog
        # 4000 samples: the standard error of an rms of 10 mV is 0.11 mV.
        np.testing.assert_allclose(analog.std(axis=0), 0.010, atol=0.0006)
        offsets.append(analog.mean(axis=0))
        step = np.diff(analog, axis=0)
        np.testing.assert_allclose(step.std(axis=0), 0.010 * math.sqrt(2.0), atol=0.001)  # white
    assert np.all(np.abs(offsets) < 0.020 + 0.0007)
    assert np.max(np.abs(offsets)) > 0.012
    assert len(np.unique(np.round(offsets, 6))) == 24


def test_noise_of_the_inputs_is_independent():
    found = np.corrcoef(rest(seed=1).analog.T)
    assert np.all(np.abs(found - np.eye(3)) < 0.06)


@pytest.mark.parametrize("bits", [12, 16])
def test_converters_have_their_resolution(bits):
    resolution = 20.0 / 2**bits
    found = play(device(imperfections=Imperfections(bits=bits)), waveform())
    for volts in (found.analog, found.applied):
        steps = volts / resolution
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.max(np.abs(found.applied - waveform())) <= resolution / 2 * (1 + 1e-9)
    quiet = Imperfections(noise=0.0, offset=0.0, bits=bits)
    coarse = play(device(imperfections=quiet), waveform(100))
    assert len(np.unique(coarse.analog[:, 0])) > 3
    assert np.all(coarse.counts == np.round(coarse.counts))


def test_current_and_torque_sense():
    commands = np.tile([0.0, 0.3], (800, 1))
    found = play(device(ideal=True), commands)
    assert found.analog[-1, 1] == pytest.approx(2.0 * 0.15, rel=0.01)
    other = play(device(ideal=True, current_sense=1.0), commands)
    np.testing.assert_allclose(other.analog[:, 1], 0.5 * found.analog[:, 1], rtol=1e-12)


def test_an_input_beyond_the_converter_is_flagged_and_clipped():
    found = play(device(current_sense=8.0), np.tile([4.0, 0.0], (80, 1)))
    flagged = (found.flags & Flag.SATURATED) != 0
    assert not flagged[0]
    assert flagged[1:3].any()
    assert found.analog[flagged, 0].max() == 10.0 - RESOLUTION


def test_the_user_winds_when_asked_and_then_lets_go():
    found = device(ideal=True)
    play(found, np.zeros((10, 2)))
    found.announce(Phase.HOMING, 2.0)
    samples = play(found, np.zeros((3200, 2)))
    turns = samples.counts / 8192
    assert turns.max() > 1.95
    assert np.abs(turns[-1] - turns[-400]) < 0.01  # residual friction holds what was wound
    found.announce(Phase.RUN)
    assert np.ptp(play(found, np.zeros((200, 2))).counts) < 100


def test_room_shrinks_by_what_is_queued():
    found = device(ideal=True)
    found.start(RATE, Mode.OPEN_LOOP, OPEN_GUARD)
    before = found.room()
    found.send(0, np.zeros((300, 2)))
    assert found.room() == before - 300
    played = len(found.receive().tick)
    assert found.room() == before - 300 + played


# --- other plants ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", mostly_soak(list(PLANTS)))
def test_every_plant_runs_and_shows_what_scipy_computes(name):
    plant = Plant(**PLANTS[name])
    n, compared = 200, 60
    ideal, noisy = (
        play(device(seed=3, ideal=ideal, plant=plant), waveform(n)) for ideal in (True, False)
    )
    for found in (ideal, noisy):
        np.testing.assert_array_equal(found.tick, np.arange(n))
        assert np.all(found.flags == 0)
        for column in (found.analog, found.counts, found.count_rate, found.applied):
            assert np.all(np.isfinite(column))
    assert np.all(noisy.counts == np.round(noisy.counts))
    # 10 mV of noise and up to 20 mV of offset.
    assert np.abs(noisy.analog - ideal.analog).max() < 0.020 + 5 * 0.010
    model = plant.build()
    inputs = np.zeros((compared, len(model.inputs)))
    inputs[:, :2] = waveform(n)[:compared]
    if name == "hand":
        inputs[:, 2] = 1.0  # it never lets go
    record = Dataset(inputs, np.full((compared, 5), np.nan), 1.0 / RATE)
    expected = reference(model, model.nominal, record, rtol=1e-7, atol=1e-9)
    per_radian = 8192 / (2.0 * math.pi)
    shown = np.column_stack(
        [ideal.analog / [2.0, 2.0, 5.0 / 3.53], ideal.counts / per_radian,
         ideal.count_rate / per_radian]
    )[:compared]  # fmt: skip
    size = np.maximum(np.abs(expected).max(axis=0), 1e-6)
    assert np.all(size[:3] > 0.01)
    np.testing.assert_allclose(shown / size, expected / size, atol=1e-3)
    moves = np.ptp(ideal.counts) > 20
    assert moves == (name != "locked")


@pytest.mark.soak
def test_a_hand_that_is_the_load_stays_where_it_has_wound_to():
    found = device(ideal=True, plant=Plant(**PLANTS["hand"]))
    found.announce(Phase.HOMING, 1.0)
    turns = play(found, np.zeros((2000, 2))).counts / 8192
    assert turns[-1] == pytest.approx(1.1, abs=0.02)
    found.announce(Phase.RUN)
    turns = play(found, np.zeros((400, 2))).counts / 8192
    np.testing.assert_allclose(turns, 1.1, atol=0.02)


@pytest.mark.parametrize(("ideal", "bits"), [(False, 12), (True, 24)])
def test_a_board_has_the_same_plant_in_virtual_time_and_without_faults(ideal, bits):
    options = Simulation(
        seed=7, ideal=ideal, time="real", faults={"lost": 0.5}, imperfections={"bits": 12}
    )
    served = SimulatedDevice(options)
    assert isinstance(served, hal.Simulation)
    electronics = served.board()
    assert (electronics.step_in, electronics.step_out) == (20.0 / 2**bits, 20.0 / 2**16)
    info = electronics.device.open()
    assert info.virtual_time and info.volts_in == electronics.volts == (-10.0, 10.0)
    plain = device(seed=7, ideal=ideal, imperfections={"bits": 12})
    there, here = (play(item, waveform(200)) for item in (electronics.device, plain))
    assert np.array_equal(there.analog, here.analog) and np.array_equal(there.counts, here.counts)


def test_a_simulation_knows_its_plants_values_and_hardware_does_not():
    plant = Plant(parameters={"K_m": 0.123})
    model = SimulatedDevice(Simulation(plant=plant)).process_model()
    assert dict(zip(model.parameter_names, model.nominal, strict=True))["K_m"] == 0.123
    with pytest.raises(ModelError, match="put the sensor at the load"):
        SimulatedDevice(Simulation(plant=Plant(load="hand", sensor="between"))).process_model()
    assert not isinstance(SerialDevice(SerialOptions()), hal.Simulation)
