"""Limits: where each trips, that none does falsely, and that blocks of any size agree."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from daq.cli.terminal import report_event
from daq.config.rig import RigConfig
from daq.errors import ConfigError
from daq.hal import Flag, Mode, Phase, Samples
from daq.limits import Limits
from daq.limits.load import i2t_levels
from daq.lookup.rigs import load_rig
from daq.rig import Rig
from sim_rig.backend import SimulatedDevice, Simulation
from tests.daq.support import write_rig
from tests.sim_rig.support import PLANTS
from tests.soak import mostly_soak

RATE = 800.0
TURN = 2.0 * math.pi
EVERYTHING = {
    "i2t": {
        "motor": {"continuous": 1.8, "budget": 5.0},
        "brake": {"continuous": 0.15, "budget": 0.5},
    },
    "speed": 170.0,
    "torque": 3.5,
    "travel": [-40.0, 40.0],
    "winding": 0.25,
    "encoder": {"stall": {"motor": 1.0}},
}


def samples(n=400, tick=None, **columns):
    """Samples of a rig at work, with noise; some columns as given, in full or as one value."""
    rng = np.random.default_rng(4)
    time = np.arange(n) / RATE
    usual = {
        "current_motor": 0.3 + 0.005 * rng.standard_normal(n),
        "current_brake": 0.1 + 0.005 * rng.standard_normal(n),
        "torque": 0.02 * rng.standard_normal(n),
        "theta": 10.0 * time,
        "omega": 10.0 + 0.0 * time,
        "flags": np.zeros(n, dtype=np.int64),
    }
    zero = np.zeros(n)
    given = {name: np.broadcast_to(values, n).copy() for name, values in columns.items()}
    ticks = np.arange(n) if tick is None else tick
    if "theta" in given and "omega" not in given:
        given["omega"] = np.gradient(given["theta"], ticks / RATE)
    return Samples(
        **{
            "tick": ticks,
            "time": time,
            "cmd_voltage_motor": zero,
            "cmd_voltage_brake": zero,
            "applied_voltage_motor": zero,
            "applied_voltage_brake": zero,
            **usual,
            **given,
        }
    )


def part(whole, rows):
    names = [field.name for field in dataclasses.fields(whole)]
    return Samples(**{name: getattr(whole, name)[rows] for name in names})


def joined(blocks):
    names = [field.name for field in dataclasses.fields(Samples)]
    return Samples(**{n: np.concatenate([getattr(b, n) for b in blocks]) for n in names})


def first_trip(limits, whole, cuts=()):
    """The first tick beyond a limit, and the reason, of samples that arrive cut into blocks."""
    ends = sorted({*cuts, len(whole)} - {0})
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        trip = limits.check(part(whole, slice(start, end)))
        if trip is not None:
            return start + trip[0], trip[1]
    return None


def limits_of(phase=Phase.RUN, calibrated=True, amplifiers=None, sensors=None, **changes):
    limits = Limits(RigConfig(limits=changes, amplifiers=amplifiers or {}, sensors=sensors or {}))
    limits.begin(Phase.CALIBRATION, RATE)
    if calibrated:
        limits.check(samples(800, theta=0.0, omega=0.0))
    limits.begin(phase, RATE)
    return limits


def step(at, before, after, n=400):
    return np.where(np.arange(n) < at, before, after)


RAMP = 1e-6 * np.arange(400)  # never twice the same
SWING = np.sin(62.8 * np.arange(400) / RATE)
STILL = {"theta": 3.0, "omega": 0.0}
MOTOR, BRAKE = ({"amplifiers": {channel: 0.5}} for channel in ("motor", "brake"))
CASES = {
    "motor current": ({}, {"current_motor": step(100, math.nan, -2.5)}, 100, "-2.5 A, beyond its"),
    "brake current": ({}, {"current_brake": step(50, 0.1, 0.22)}, 50, "limit of 0.21 A"),
    "a current that is no number": (
        {}, {"current_motor": step(9, 0.3, math.nan)}, 9, "current_motor is nan, which is no"),
    "an infinite torque": ({}, {"torque": step(9, 0.0, math.inf)}, 9, "torque is inf, which is"),
    "torque": ({"torque": 0.5}, {"torque": step(7, 0.0, -0.6)}, 7, "limit of 0.5 N*m"),
    "speed": ({"speed": 20.0}, {"omega": step(30, 10.0, -21.0)}, 30, "omega is -21 rad/s"),
    "the device's own": (
        {}, {"flags": step(12, 0, int(Flag.INTERLOCK))}, 12, "the device found an input"),
    "travel": (
        {"travel": [-1, 1]}, {"theta": 5.0 + np.arange(400) * 0.1}, 63, "1.003 turns from where"),
    "a jump": ({}, {"theta": 0.01 * np.arange(400) + step(77, 0, 2.0)}, 77, "jumped by 2.01 rad"),
    # A quarter of a turn at 10 rad/s takes 126 ticks of 1/800 s.
    "a dead encoder": (
        {}, {"theta": step(40, 10.0 * np.arange(400) / RATE, 39 * 10.0 / RATE), "omega": 10.0},
        39 + 126, "differ by 0.251 turns"),
    "a dead estimate of the speed": (
        {}, {"theta": 10.0 * np.arange(400) / RATE, "omega": step(40, 10.0, 0.0)},
        40 + 126, "now 0 rad/s"),
    # Swings of a radian either way at 10 Hz; the dead band is left out twice.
    "a dead estimate of a shaft that swings": (
        {}, {"theta": SWING, "omega": step(0, 0.0, 0.0)}, 36, "to and fro, differ by"),
    "a dead count of a shaft that swings": (
        {}, {"theta": 3.0, "omega": 62.8 * np.cos(62.8 * np.arange(400) / RATE)},
        36, "to and fro, differ by"),
    # 2 A and 1 A of friction give 7.5 rad/s a sample.
    "half the counts at speed": (
        {"encoder": {"stall": {"motor": 1.0, "brake": 0.025}, "acceleration": 2000.0}},
        {"theta": np.cumsum(step(99, 100.0, 50.0)) / RATE, "omega": step(99, 100.0, 50.0),
         "current_motor": 2.0 + RAMP, "current_brake": RAMP},
        99 + 2, "the speed came to 50 rad/s, where currents and inertia allow"),
    "half the counts": (
        {}, {"theta": 5.0 * np.arange(400) / RATE, "omega": 10.0}, 252, "differ by 0.251 turns"),
    "speed by the count": (
        {"speed": 150.0}, {"theta": step(40, 0.0, 0.25) , "omega": 0.0}, 40,
        "the encoder's count moves at 198.8 rad/s, beyond the limit of 150 rad/s"),
    # A drive of 1.2 must turn the shaft within 1 / 1.2 of the time, from the second sample on.
    "a blocked shaft": (
        {"encoder": {"stall": {"motor": 1.0, "time": 0.25}}},
        {**STILL, "current_motor": step(20, 0.3, 1.2) + RAMP, "current_brake": RAMP},
        20 + 167, "times the current that must turn"),
    "a dead encoder at speed": (
        {"encoder": {"stall": {"motor": 0.5, "time": 0.05}}},
        {"theta": step(99, 0.1 * np.arange(400), 9.9), "omega": step(99, 80.0, 0.0),
         "current_motor": 2.0 + RAMP, "current_brake": RAMP},
        99 + 11, "the encoder stands still at 3.99"),
    # 50 ms after the last command that would explain it is out of the window.
    "an output that sticks": (
        MOTOR, {"current_motor": step(60, 0.0, 0.5) + RAMP, "applied_voltage_motor": 0.0},
        60 + 39, "current_motor is 0.5 A, and by amplifiers.motor"),
    "a turned current": (
        MOTOR, {"current_motor": -0.4 - RAMP, "applied_voltage_motor": 0.8}, 39,
        "turn 'sign' of sensors.current_motor in the rig's file"),
    "a dead brake": (
        BRAKE, {"current_brake": step(200, 0.1, 0.0) + RAMP, "applied_voltage_brake": 0.2},
        200 + 39, "Check whether the amplifier is on"),
    "a frozen torque": ({}, {"torque": step(60, math.nan, 0.01)}, 60 + 80, "its noise never let"),
    "a frozen motor current": (
        {}, {"current_motor": step(60, math.nan, 0.3)}, 60 + 80, "current_motor has read 0.3 to"),
    "a motor current that does not follow": (
        {"calibrated": False},
        {"current_motor": 0.0, "applied_voltage_motor": step(100, 0.0, 0.5)},
        179, "under a changed command"),
}  # fmt: skip


def with_noise(columns):
    """Not-a-numbers at the beginning of a frozen signal stand for the usual noise."""
    usual = samples()
    return {
        name: np.where(np.isnan(values), getattr(usual, name), values)
        if np.ndim(values) and np.isnan(values[0]) else values
        for name, values in columns.items()
    }  # fmt: skip


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("size", [1, 37, 400])
def test_a_limit_trips_at_its_sample_with_the_reason(name, size):
    changes, columns, tick, reason = CASES[name]
    whole = samples(**with_noise(columns))
    trip = first_trip(limits_of(**changes), whole, range(size, 400, size))
    assert trip is not None and trip[0] == tick
    assert reason in trip[1]


def test_a_shaft_that_runs_against_its_motor_is_doubted_and_not_stopped():
    limits = limits_of(speed=150.0, encoder={"stall": {"motor": 0.3}})
    omega = -0.5 * np.arange(400)
    whole = samples(
        theta=np.cumsum(omega) / RATE, omega=omega, current_motor=1.0 + RAMP, current_brake=RAMP
    )
    assert first_trip(limits, part(whole, slice(0, 290)), range(7, 290, 7)) is None
    (doubt,) = limits.doubts
    assert doubt.phase == "run" and "against the motor's current" in doubt.reason
    # A tenth of the limit is 15 rad/s, of which a sample brings 0.5.
    assert doubt.tick == 31
    assert np.flatnonzero(whole.flags)[0] == 31


def test_a_shaft_that_turns_round_gains_nothing_against_its_motor():
    limits = limits_of(speed=150.0, encoder={"stall": {"motor": 0.3}})
    time = np.arange(400) / RATE
    omega = 60.0 * np.sin(30.0 * time)
    columns = {"omega": omega, "theta": 2.0 * (1.0 - np.cos(30.0 * time))}
    whole = samples(**columns, current_motor=np.cos(30.0 * time) + RAMP, current_brake=RAMP)
    assert first_trip(limits, whole) is None
    assert limits.doubts == []


ACCELERATION = {"encoder": {"stall": {"motor": 0.3, "brake": 0.01}, "acceleration": 2000.0}}


@pytest.mark.parametrize("phase", [Phase.RUN, Phase.HOMING])
def test_two_wrong_speeds_or_a_hand_in_homing_contradict_no_current(phase):
    omega = np.full(400, 20.0)
    if phase is Phase.RUN:
        omega[100:102] = omega[300:302] = -20.0
    else:
        omega[100:] = -20.0
    columns = {"theta": np.cumsum(omega) / RATE, "current_motor": RAMP, "current_brake": RAMP}
    assert first_trip(limits_of(phase, **ACCELERATION), samples(omega=omega, **columns)) is None


def test_a_brake_whose_torque_lags_its_current_contradicts_nothing():
    # 0.2 A, gone within a sample, have stopped the shaft as 6.3 A of the motor would.
    omega = np.maximum(0.0, 60.0 - np.maximum(0, np.arange(400) - 100) * 6.0)
    columns = {"theta": np.cumsum(omega) / RATE, "current_motor": RAMP}
    columns["current_brake"] = step(99, 0.0, 0.2) * step(102, 1.0, 0.0) + RAMP
    assert first_trip(limits_of(**ACCELERATION), samples(omega=omega, **columns)) is None
    columns["current_brake"] = RAMP
    assert first_trip(limits_of(**ACCELERATION), samples(omega=omega, **columns)) is not None


def test_an_acceleration_without_the_friction_is_refused():
    with pytest.raises(ValueError, match=r"it needs encoder\.stall"):
        RigConfig(limits={"encoder": {"acceleration": 2000.0}})


@pytest.mark.parametrize("turns_to", [0.0, 1.0, -1.0])
def test_what_shakes_a_shaft_to_and_fro_need_not_turn_it(turns_to):
    """Ten milliseconds either way; a motor that asks more of one direction must turn it."""
    way = np.where(np.arange(400) // 8 % 2 == 0, 1.0, -1.0)
    current = np.where(way == turns_to, 1.5, 1.0) * way
    stall = {"encoder": {"stall": {"motor": 0.5, "time": 0.05}}}
    columns = {"theta": 3.0, "omega": 0.0, "current_motor": current + RAMP, "current_brake": RAMP}
    trip = first_trip(limits_of(**stall), samples(**columns))
    assert (trip is None) == (turns_to == 0.0)


TORQUES = {
    "right": (0.14, None), "a fifth more": (0.17, None), "dead": (0.0, 159), "turned": (-0.14, 159),
    "times three": (0.42, 159),
}  # fmt: skip


@pytest.mark.parametrize("name", TORQUES)
def test_a_torque_that_is_not_the_motors_is_doubted_at_steady_speed(name):
    per_ampere, tick = TORQUES[name]
    rng = np.random.default_rng(3)
    columns = {"current_motor": 1.0 + RAMP, "current_brake": RAMP, "theta": 0.1 * np.arange(400)}
    torque = per_ampere + 0.01 * rng.standard_normal(400)
    limits = limits_of(sensors={"torque": {"scale": 0.7, "motor_constant": 0.14}})
    whole = samples(**columns, torque=torque)
    assert first_trip(limits, whole, range(37, 400, 37)) is None
    assert [doubt.tick for doubt in limits.doubts] == ([] if tick is None else [tick])
    for doubt in limits.doubts:
        assert "the motor's 1 A give 0.14 N*m (sensors.torque.motor_constant)" in doubt.reason


def test_a_torque_is_not_judged_while_the_shaft_gathers_speed():
    columns = {"current_motor": 1.0 + RAMP, "current_brake": RAMP, "omega": 0.2 * np.arange(400)}
    limits = limits_of(sensors={"torque": {"scale": 0.7, "motor_constant": 0.14}}, speed=100.0)
    columns["theta"] = np.cumsum(columns["omega"]) / RATE
    first_trip(limits, samples(**columns, torque=0.01 + RAMP))
    assert limits.doubts == []


def test_an_amplifier_without_voltage_at_speed_is_none_that_is_dead():
    columns = {"theta": 0.1 * np.arange(400), "current_motor": 0.1 + RAMP}
    columns["applied_voltage_motor"] = 2.0
    assert first_trip(limits_of(speed=150.0, **MOTOR), samples(**columns)) is None
    slow = columns | {"theta": 0.001 * np.arange(400)}
    assert first_trip(limits_of(speed=150.0, **MOTOR), samples(**slow)) is not None
    strong = {"amplifiers": {"motor": 0.5, "speed": 95.0}}
    assert first_trip(limits_of(speed=150.0, **strong), samples(**columns)) is not None


@given(st.lists(st.integers(1, 399), max_size=12), st.sampled_from(sorted(CASES)))
@settings(max_examples=60, deadline=None)
def test_where_the_samples_are_cut_into_blocks_changes_nothing(cuts, name):
    changes, columns, tick, _ = CASES[name]
    trip = first_trip(limits_of(**changes), samples(**with_noise(columns)), cuts)
    assert trip is not None and trip[0] == tick


@given(
    st.lists(st.floats(0.0, 3.0), min_size=1, max_size=60),
    st.floats(0.1, 2.0), st.floats(0.0, 1.0),
)  # fmt: skip
def test_i2t_is_a_sum_that_never_falls_below_zero(currents, continuous, start):
    seconds = np.full(len(currents), 0.25)
    level, expected = start, []
    for current in currents:
        level = max(0.0, level + (current**2 - continuous**2) * 0.25)
        expected.append(level)
    found = i2t_levels(start, np.array(currents), seconds, continuous)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("size", [1, 64])
def test_i2t_allows_a_constant_current_for_as_long_as_its_budget_says(size):
    load = {"i2t": {"motor": {"continuous": 1.5, "budget": 0.7}}}
    whole = samples(400, current_motor=2.0 + 1e-6 * np.arange(400))
    trip = first_trip(limits_of(**load), whole, range(size, 400, size))
    assert trip is not None
    assert (trip[0] + 1) / RATE == pytest.approx(0.7 / (2.0**2 - 1.5**2), abs=1.5 / RATE)


def test_lost_samples_count_for_the_time_they_lack():
    tick = np.arange(400) * 5
    load = {"i2t": {"motor": {"continuous": 1.5, "budget": 0.7}}}
    whole = samples(400, tick=tick, theta=50.0 / RATE * np.arange(400), current_motor=2.0)
    whole.current_motor[::2] += 1e-6
    assert tick[first_trip(limits_of(**load), whole)[0]] / RATE == pytest.approx(0.4, abs=0.01)
    # A shaft that a gap lets go far has not jumped.
    fast = samples(400, tick=tick, theta=4.0 * np.arange(400))
    assert first_trip(limits_of(), fast) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_cable_nearly_unwound_stops_the_run_and_not_the_homing(sign):
    limits = limits_of(Phase.HOMING, winding=0.5)
    wound = sign * np.linspace(7.0, 7.0 + 3.0 * TURN, 400)
    assert first_trip(limits, samples(theta=wound)) is None
    limits.begin(Phase.RUN, RATE)
    # The device may count from zero again.
    unwound = sign * np.linspace(0.0, -3.0 * TURN, 400)
    row, reason = first_trip(limits, samples(theta=unwound))
    assert unwound[row] * sign < -2.5 * TURN <= unwound[row - 1] * sign
    assert "nearly unwound" in reason and "of 3 turns are left" in reason


def test_without_a_homing_nothing_counts_as_unwound():
    limits = limits_of(winding=0.5)
    assert first_trip(limits, samples(theta=np.linspace(0.0, -30.0, 400))) is None


# Plants that the simulated device's tests compile too.
QUIET = [
    *(({}, plant) for plant in ({}, *PLANTS.values())),
    ({"ideal": True}, {}),
    ({"imperfections": {"bits": 8}}, {}),
]


@pytest.mark.parametrize(("options", "plant"), mostly_soak(QUIET), ids=str)
def test_nothing_trips_on_a_simulated_rig_that_rests_works_and_rests(options, plant):
    config = RigConfig(limits=EVERYTHING | {"current": {"motor": 10.0, "brake": 10.0}})
    if plant.get("load") == "locked":  # which a limit of stalling is there to find
        config = RigConfig(limits=config.limits.model_dump() | {"encoder": {"stall": None}})
    rig = Rig(SimulatedDevice(Simulation(**options, plant=plant)), config)
    limits = Limits(config)
    rest = np.zeros((400, 2))
    work = np.repeat(np.random.default_rng(1).uniform([-0.5, 0], [0.7, 0.2], (40, 2)), 20, axis=0)
    with rig:
        for phase, commands in (
            (Phase.CALIBRATION, rest),
            (Phase.RUN, np.concatenate([rest, work, rest, work])),
        ):
            rig.start(RATE, Mode.OPEN_LOOP)
            limits.begin(phase, RATE)
            rig.send(0, commands)
            seen = 0
            while seen < len(commands):
                block = rig.receive()
                seen += len(block)
                assert limits.check(block) is None
            rig.stop()


def test_commands_follow_no_faster_than_the_slew():
    config = RigConfig(limits={"slew": {"motor": 80.0}})
    commands = np.zeros((60, 2))
    commands[5:30, 0], commands[30:, 0] = 0.55, -0.2
    commands[7:, 1] = 0.2
    rows = []
    with Rig(SimulatedDevice(Simulation(ideal=True)), config) as rig:
        rig.start(RATE, Mode.CLOSED_LOOP)
        for tick, command in enumerate(commands):
            rig.send(tick, command[None])
            rows.append(rig.receive())
    played = joined(rows)
    expected, now = [], 0.0
    for wanted in commands[:, 0]:
        now = min(max(wanted, now - 0.1), now + 0.1)
        expected.append(now)
    np.testing.assert_allclose(played.applied_voltage_motor, expected, atol=1e-12)
    np.testing.assert_allclose(played.applied_voltage_brake, commands[:, 1], atol=1e-12)
    np.testing.assert_allclose(played.cmd_voltage_motor, commands[:, 0])
    clamped = (played.flags & int(Flag.CLAMPED)) != 0
    np.testing.assert_array_equal(clamped, ~np.isclose(expected, commands[:, 0]))


def test_a_cables_limit_is_left_out_where_the_plant_has_no_cable(capsys):
    config, _ = load_rig("simulated.yaml", {"plant": {"load": "free"}}, report_event)
    assert config.limits.winding is None
    assert "limits.winding of 0.25 turns is left out" in capsys.readouterr().err
    config, _ = load_rig("simulated.yaml", watch=report_event)
    assert config.limits.winding == 0.25 and not capsys.readouterr().err


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"torque": 7.0, "speed": 190.0, "current": {"motor": 5.0}}, []),
        ({"torque": 7.1}, ["limits.torque: 7.1 N*m is never measured", "is 7.06 N*m by"]),
        ({"current": {"motor": 5.1}}, ["limits.current.motor: 5.1 A", "is 5 A by"]),
        ({"speed": 191.0}, ["limits.speed: 191 rad/s is beyond 190 rad/s, twice amplifiers.speed"]),
        ({"speed": 151.0, "encoder": {"fastest": 150.0}}, ["beyond 150 rad/s, limits.encoder."]),
    ],
)
def test_a_limit_that_nothing_can_pass_is_told(tmp_path, capsys, limits, words):
    amplifiers = {"motor": 0.5, "speed": 95.0}
    path = write_rig(tmp_path / "rig.yaml", amplifiers=amplifiers, limits=limits)
    load_rig(str(path), watch=report_event)
    said = capsys.readouterr().err
    assert all(word in said for word in words) and bool(said) == bool(words), said


@pytest.mark.parametrize("limits", [{"speed": 1e7}, {"torque": 1e9}, {"travel": [-1.0, 1e7]}])
def test_an_absurd_limit_is_refused(limits):
    with pytest.raises(ValidationError, match="less than or equal"):
        RigConfig(limits=limits)


def test_a_limit_of_ones_own_that_cannot_be_made_is_told_before_the_run(tmp_path):
    (tmp_path / "own.py").write_text(
        "from daq.limits import Limit\n\n\nclass Own(Limit):\n"
        "    def __init__(self):\n        self.a = {}['a']\n\n"
        "    def check(self, samples):\n        return None\n"
    )
    path = tmp_path / "rig.yaml"
    path.write_text("backend: simulated\nlimits: {own: [{use: own.py:Own}]}\n")
    config, _ = load_rig(str(path))
    with pytest.raises(ConfigError, match=r"own\.py:Own cannot be made: KeyError: 'a'"):
        Limits(config)


@pytest.mark.parametrize("seed", range(6))
def test_a_shaft_that_now_and_then_stands_still_stalls_at_the_same_sample_in_any_blocks(seed):
    rng = np.random.default_rng(seed)
    count = TURN / 8192
    stands = np.repeat(rng.choice([0.0, 10.0, 20.0], 50), 8) * count
    current = np.repeat(rng.choice([0.0, 0.9, 1.2], 50), 8)
    whole = samples(theta=stands, current_motor=current + RAMP, current_brake=RAMP)
    stall = {"encoder": {"stall": {"motor": 0.5, "time": 0.03}}}
    one_by_one = first_trip(limits_of(**stall), whole, range(1, 400))
    assert one_by_one is not None
    for size in (400, 37, 29, 23, 19):
        assert first_trip(limits_of(**stall), whole, range(size, 400, size)) == one_by_one
