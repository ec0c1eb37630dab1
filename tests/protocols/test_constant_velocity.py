"""Torque against velocity: the staircase, what of it counts, and c0 and c1 against the plant's."""

import dataclasses
import math

import numpy as np
import pytest

from daq.config.rig import RigConfig
from daq.errors import ConfigError, RunError
from daq.experiment import Sample
from daq.hal import Samples
from daq.run.plan import plan
from protocols.analysis.plateau_findings import _slope, ripple
from protocols.analysis.torque_curve import Level, Motor, fit, levels_of
from protocols.constant_velocity import ConstantVelocity
from protocols.control.loop import Pid, SpeedTracker, VelocityGains, VelocityServo
from protocols.control.staircase import Plateau, SettlingTest, Staircase, longest
from tests.protocols.closed_loop import logged, numbers, run, shipped

C0, C1, K_M, B_M = 1.2e-4, 6e-4, 0.353 / 2.5, 8e-5  # sim_rig/physics/values.py
K_DB, R_B = 13000.0, 24.0 / 0.19
RESIDUAL, PER_AMPERE = 0.014, (0.6779 - 0.014) / 0.19
QUICK = {
    "velocities": [20, 120, -20, -120], "brake_commands": [0, 0.06, 0.12],
    "calibration": {"samples": 800},
}  # fmt: skip


def experiment(**changes):
    return shipped("constant_velocity.yaml", ConstantVelocity, **changes)


def within(number, truth, part):
    assert number.value == pytest.approx(truth, rel=part)
    assert number.low < truth < number.high
    assert (number.high - number.low) / 2.0 < part * truth, "an interval worth having"


@pytest.fixture(scope="module")
def between(tmp_path_factory):
    settings = experiment(**QUICK, measure=1)
    samples, extra = run(
        settings, tmp_path_factory.mktemp("between"), {"load": "free", "sensor": "between"}
    )
    return settings, samples, extra, settings.findings(samples, extra)


@pytest.mark.soak
def test_with_the_sensor_between_c0_and_c1_are_the_plants(between):
    found = numbers(between[3])
    within(found["c0"], C0, 0.05)
    within(found["c1"], C1, 0.05)
    within(found["K_m"], K_M, 0.01)
    assert found["B_m"].value == pytest.approx(B_M, rel=0.06)


@pytest.mark.soak
def test_the_torque_of_every_plateau_is_the_plants(between):
    (table,) = (table for table in between[3].tables if table.name == "torque_velocity")
    own = table.columns
    assert own["settled"].all()
    np.testing.assert_allclose(own["omega"], own["omega_ref"], rtol=1e-3)
    current = K_DB / (K_DB + R_B) * 0.5 * own["brake_command"]
    np.testing.assert_allclose(own["brake_current"], current, atol=1e-3)
    kappa = RESIDUAL + PER_AMPERE * current
    truth = np.sign(own["omega"]) * kappa + (C0 + C1 * current) * own["omega"]
    # Noise of 7 mN*m on means of a second, and on the sensor's zero.
    np.testing.assert_allclose(own["torque"], truth, atol=1e-3)
    np.testing.assert_allclose(own["torque_spread"], 0.00706, rtol=0.1)


def test_noise_is_not_called_a_ripple(between):
    cyclic = numbers(between[3])["cyclic"]
    assert cyclic.low == cyclic.value == 0.0 and "none seen above" in cyclic.meaning
    assert 0.0 < cyclic.high < 2.5e-3, "what there could be all the same"


def test_ranges_hold_the_truth_and_name_what_the_model_has(between):
    ranges = between[3].ranges
    for name, truth in (("c0", C0), ("c1", C1), ("K_m", K_M), ("B_m", B_M)):
        low, high = ranges[name]
        assert 0.0 < low < truth < high


def test_only_what_has_settled_is_measured(between):
    settings, samples, extra, _ = between
    for level in levels_of(samples, extra, settings.plateaus):
        step = settings.plateaus[level.index]
        band = settings.settling.band(step.velocity)
        rows = np.isin(samples.theta, level.theta) & (extra["plateau"] == level.index)
        first = int(np.flatnonzero(rows & (extra["settled"] == 1.0))[0])
        before = slice(first - round(0.5 * settings.sample_rate) + 1, first)
        assert (np.abs(extra["omega_tracked"][before] - step.velocity) <= band).all()
        assert (extra["omega_ref"][before] == step.velocity).all()


def test_commands_stay_within_the_limit_and_the_shaft_is_left_at_rest(between):
    settings, samples, extra, _ = between
    assert np.abs(samples.cmd_voltage_motor).max() <= settings.motor_limit
    assert abs(extra["omega_tracked"][-1]) < 1.0
    assert (extra["plateau"][-400:] == -1).all()
    assert not samples.flags.any()


@pytest.mark.soak
def test_with_the_sensor_at_the_load_c0_has_the_motors_damping(tmp_path):
    settings = experiment(**QUICK, measure=1, torque_sensor="load")
    samples, extra = run(settings, tmp_path, {"load": "free"})
    found = settings.findings(samples, extra)
    within(numbers(found)["c0"], C0 + B_M, 0.02)
    within(numbers(found)["c1"], C1, 0.05)
    assert not found.remarks
    knows = settings.model_copy(
        update={"ratings": settings.ratings.model_copy(update={"motor_damping": B_M})}
    )
    within(numbers(knows.findings(samples, extra))["c0"], C0, 0.05)


@pytest.mark.soak
@pytest.mark.parametrize("place", ["between", "load"])
def test_the_friction_of_worn_brushes_is_seen_along_a_turn(tmp_path, place):
    plant = {"load": "free", "sensor": place, "friction": "cyclic"}
    settings = experiment(
        velocities=[3, 30], brake_commands=[0], measure=2, torque_sensor=place,
        calibration={"samples": 400},
    )  # fmt: skip
    found = settings.findings(*run(settings, tmp_path, plant))
    cyclic = numbers(found)["cyclic"]
    assert cyclic.value == pytest.approx(math.hypot(0.006, 0.004), rel=0.1)
    assert cyclic.high - cyclic.value < 0.1 * cyclic.value
    assert any("2 times a turn" in remark for remark in found.remarks)
    assert "torque_angle" in {figure.name for figure in found.figures}


def test_what_does_not_settle_is_named_and_left_out(tmp_path):
    settings = experiment(
        velocities=[20, -20], brake_commands=[0, 0.3], measure=0.5, settling={"timeout": 1},
        ratings={"brake_constant": None}, calibration={"samples": 400},
    )  # fmt: skip
    samples, extra = run(settings, tmp_path, {"load": "free", "sensor": "between"})
    found = settings.findings(samples, extra)
    (remark,) = (remark for remark in found.remarks if "Not settled" in remark)
    assert remark.count("at 0.3 V") == 2 and "at 0 V" not in remark
    (table,) = (table for table in found.tables if table.name == "torque_velocity")
    assert table.columns["settled"].tolist() == [1.0, 1.0, 0.0, 0.0]
    assert np.isnan(table.columns["torque"][2:]).all()
    assert np.abs(samples.cmd_voltage_motor).max() == settings.motor_limit


def test_a_run_cut_short_concludes_from_what_it_has(between):
    settings, samples, extra, whole = between
    end = int(np.argmax(extra["plateau"] == 6.0)) + 900  # half-way through the seventh
    cut = Samples(**{name: getattr(samples, name)[:end] for name in samples.__dataclass_fields__})
    found = settings.findings(cut, {name: values[:end] for name, values in extra.items()})
    assert found.remarks == ("The run ended before the last 6 of 12 plateaus were measured.",)
    np.testing.assert_array_equal(
        found.tables[1].columns["torque"][:6], whole.tables[1].columns["torque"][:6]
    )


def test_a_torque_that_falls_with_the_speed_has_a_slope_below_zero():
    """As of friction that is largest at rest."""
    assert _slope(np.array([5.0, 10.0]), np.array([2.0, 1.0])) == pytest.approx(-0.2)
    assert _slope(np.array([-10.0, 10.0]), np.array([-3.0, 1.0])) == pytest.approx(0.2)


def test_a_brake_command_with_a_single_plateau_has_no_slope_across(between):
    settings, samples, extra, whole = between
    plateaus = whole.tables[1].columns
    first = int(np.flatnonzero(plateaus["brake_command"] == plateaus["brake_command"][-1])[0])
    end = int(np.flatnonzero(extra["plateau"] == first)[-1]) + 200
    cut = Samples(**{name: getattr(samples, name)[:end] for name in samples.__dataclass_fields__})
    found = settings.findings(cut, {name: values[:end] for name, values in extra.items()})
    across = found.tables[0].columns["slope_across"]
    assert np.isfinite(across[:-1]).all() and np.isnan(across[-1])


def test_a_loop_that_runs_away_is_ended(tmp_path):
    settings = experiment(**QUICK)
    with pytest.raises(RunError, match=r"encoder\.sign"):
        plant = {"load": "free", "sensor": "between"}
        run(settings, tmp_path, plant, {"sensors": {"encoder": {"sign": -1}}})
    (folder,) = (tmp_path).iterdir()
    samples, extra = logged(settings, folder)
    assert len(samples) < 800
    with pytest.raises(ValueError, match="no plateau has settled"):
        settings.findings(samples, extra)


@pytest.mark.soak
def test_a_sensor_said_to_be_elsewhere_is_noticed(tmp_path):
    settings = experiment(
        velocities=[20, 60], brake_commands=[0, 0.04], measure=0.5, calibration={"samples": 400}
    )
    found = settings.findings(*run(settings, tmp_path, {"load": "free", "sensor": "load"}))
    assert any("torque_sensor: load" in remark for remark in found.remarks)
    assert "c0" not in numbers(found)


# The staircase by itself, fed with angles of known motions.

RATE = 1000.0
GAINS = VelocityGains(proportional=0.1, integral=1.0)
SLOPE, LIMIT = 1e4, 4.5
SETTLING = SettlingTest(tolerance=5.0, least=0.5, time=0.1, timeout=1.0)


def visit(speeds, plateaus, brake_current=0.0):
    """The controller's answers to a shaft that turns with given speeds, whatever it commands."""
    servo = VelocityServo(Pid(GAINS, -LIMIT, LIMIT), SpeedTracker(200.0), 100.0, "")
    controller = Staircase(plateaus, SETTLING, servo, LIMIT, SLOPE)
    theta = np.concatenate([[0.0], np.cumsum(speeds)]) / RATE
    answers = []
    for k in range(len(speeds)):
        sample = Sample(k, k / RATE, 0.0, brake_current, 0.0, theta[k], 0.0, 0)
        answer = controller.answer(sample)
        if answer is None:
            break
        answers.append(answer)
    return answers


def column(answers, place):
    return np.array([answer.logged[place] for answer in answers])


def test_transients_stay_out_and_a_departure_starts_anew():
    speeds = np.full(3000, 20.0)
    speeds[:300] = 20.0 * (1.0 - np.exp(-np.arange(300) / 40.0))  # in the band after 120 ms
    speeds[700:720] = 25.0  # a jolt while it is measured
    answers = visit(speeds, (Plateau(20.0, 0.0, 0.5), Plateau(30.0, 0.0, 0.5)))
    settled = np.flatnonzero(column(answers, 3))
    # In the band from about sample 120, measured 100 samples later, up to the jolt.
    assert 215 < settled[0] < 235
    again = settled[settled > 705][0]
    assert 815 < again < 840
    assert set(range(settled[0], 700)) | set(range(again, again + 500)) <= set(settled.tolist())
    assert not set(range(702, again)) & set(settled.tolist())
    assert column(answers, 2)[again + 502] == 1.0, "measured whole, the next plateau follows"
    assert settled[-1] <= again + 501, "20 rad/s never counts as 30"


def test_a_plateau_that_never_settles_is_given_up_at_its_timeout():
    plateaus = (Plateau(20.0, 0.0, 0.5), Plateau(-20.0, 0.0, 0.5))
    answers = visit(np.zeros(4500), plateaus)
    plateau, reference = column(answers, 2), column(answers, 0)
    assert not column(answers, 3).any()
    arrived = int(np.argmax(reference == 20.0))
    assert int(np.argmax(plateau == 1.0)) - arrived == pytest.approx(1500, abs=3)
    assert plateau[-1] == -1.0 and len(answers) < 4000
    assert (
        len(answers)
        <= longest((Plateau(20.0, 0.1, 0.5), Plateau(-20.0, 0.1, 0.5)), SETTLING, SLOPE) * RATE + 20
    )


def test_the_brake_is_let_go_slowly_and_holds_to_the_end():
    answers = visit(np.zeros(6000), (Plateau(5.0, 0.2, 0.1), Plateau(5.0, 0.0, 0.1),
                                     Plateau(5.0, 0.1, 0.1)))  # fmt: skip
    brake = np.array([answer.brake for answer in answers])
    assert np.abs(np.diff(brake)).max() <= 0.5 / RATE + 1e-12
    assert brake.max() == 0.2 and brake[-1] == 0.1


def trace(settled, theta, torque, plateau=0):
    n = len(theta)
    zeros = np.zeros(n)
    samples = Samples(
        np.arange(n), np.arange(n) / RATE, *(zeros,) * 4, zeros, zeros + 0.02, torque, theta,
        zeros, np.zeros(n, dtype=np.int64),
    )  # fmt: skip
    return samples, {
        "settled": settled.astype(float), "plateau": np.full(n, float(plateau)),
        "omega_tracked": zeros, "omega_ref": zeros,
    }  # fmt: skip


def test_means_are_of_the_last_whole_stretch_and_of_whole_turns():
    theta = 8.0 * np.pi * np.arange(1400) / RATE  # two turns in 500 samples
    settled = np.zeros(1400, dtype=bool)
    settled[100:300] = True  # left the band before it was whole
    settled[600:1301] = True  # 2.8 turns
    torque = np.where(settled, 1.0 + np.sin(theta), 100.0)
    torque[100:300] = 50.0
    (level,) = levels_of(*trace(settled, theta, torque), [Plateau(8.0 * np.pi, 0.0, 0.7)])
    assert level.samples == 500
    assert level.torque.mean() == pytest.approx(1.0)
    assert level.omega == pytest.approx(8.0 * np.pi)


def test_a_stretch_cut_short_is_no_plateau():
    theta = 8.0 * np.pi * np.arange(1400) / RATE
    settled = np.arange(1400) > 750
    assert not levels_of(*trace(settled, theta, theta), [Plateau(8.0 * np.pi, 0.0, 0.7)])


def synthetic(rng, noise, sensor_offset=0.0, dry=0.0):
    """Plateaus of a brake as the equations have it, and noise."""
    plateaus = [Plateau(v, b, 1.0) for b in (0.0, 0.05, 0.1) for v in (20.0, 60.0, -20.0, -60.0)]
    levels = []
    for index, step in enumerate(plateaus):
        current, s, n = 0.5 * step.brake, np.sign(step.velocity), 800
        brake = (RESIDUAL + PER_AMPERE * current) * s + (C0 + C1 * current) * step.velocity
        motor = (brake + B_M * step.velocity + dry * s) / K_M
        torque = brake + sensor_offset + 0.007 * noise * rng.standard_normal(n)
        amperes = motor + 0.005 * noise * rng.standard_normal(n)
        error = noise / math.sqrt(n)
        levels.append(
            Level(index, step.brake, 0.0, step.velocity, 0.0, current, np.zeros(n), torque, amperes,
                  0.007 * error, 0.005 * error)
        )  # fmt: skip
    return levels


@pytest.mark.parametrize("motor", [None, Motor(K_M, B_M)])
def test_without_noise_the_line_is_exact(motor):
    levels = synthetic(np.random.default_rng(0), 0.0, sensor_offset=0.003)
    line = fit(levels, motor)
    assert line.c0.value == pytest.approx(C0, rel=1e-6)
    assert line.c1.value == pytest.approx(C1, rel=1e-6)
    np.testing.assert_allclose(line.kappa, RESIDUAL + PER_AMPERE * line.currents, rtol=1e-6)
    if motor is None:
        assert line.constant.value == pytest.approx(K_M, rel=1e-6)
        assert line.damping.value == pytest.approx(B_M, rel=1e-6)


def test_the_motors_dry_friction_is_not_taken_for_the_brakes():
    levels = synthetic(np.random.default_rng(0), 0.0, dry=0.004)
    line = fit(levels, None)
    assert line.c0.value == pytest.approx(C0, rel=1e-6)
    np.testing.assert_allclose(line.kappa, RESIDUAL + PER_AMPERE * line.currents, rtol=1e-6)


@pytest.mark.parametrize("offset", [-3e-4, 3e-4])
def test_what_the_brake_sensors_zero_is_off_stays_out_of_c1(offset):
    levels = synthetic(np.random.default_rng(0), 0.0)
    shifted = [dataclasses.replace(x, brake_current=x.brake_current + offset) for x in levels]
    assert fit(shifted, Motor(K_M, B_M)).c1.value == pytest.approx(C1, rel=1e-6)


def test_with_one_brake_command_nothing_is_said_of_the_motor():
    levels = synthetic(np.random.default_rng(3), 1.0)
    line = fit([level for level in levels if level.brake_current == 0.0], None)
    assert line.constant is None and line.damping is None and line.c1 is None
    assert line.c0.low < C0 < line.c0.high


@pytest.mark.parametrize("motor", [None, Motor(K_M, B_M)])
def test_intervals_hold_the_truth_at_least_as_often_as_they_say(motor):
    rng = np.random.default_rng(5)
    held = np.zeros(2)
    for _ in range(150):
        levels = synthetic(rng, 1.0)
        line = fit(levels, motor)
        held += [line.c0.low < C0 < line.c0.high, line.c1.low < C1 < line.c1.high]
    assert (held >= 135).all(), "95 % of 150 are 142, give or take three"


def test_one_velocity_makes_no_slope():
    levels = synthetic(np.random.default_rng(0), 1.0)
    with pytest.raises(ValueError, match="two settled velocities"):
        fit([level for level in levels if abs(level.omega) < 30.0], None)


def test_a_ripple_is_told_from_noise():
    rng = np.random.default_rng(2)
    theta = np.linspace(0.0, 6.0 * np.pi, 2400)
    noise = 0.007 * rng.standard_normal(2400)
    found = ripple(theta, 0.02 + 0.004 * np.cos(3.0 * theta + 1.0) + noise)
    assert found.periods == 3
    assert found.amplitude == pytest.approx(0.004, abs=3.0 * found.error)
    assert found.error == pytest.approx(0.007 * math.sqrt(2.0 / 2400), rel=0.05)
    none = ripple(theta, 0.02 + noise)  # twelve harmonics, of which the strongest is taken
    assert none.amplitude < 4.0 * none.error


# What a file may say.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"velocities": [5, 0]}, r"velocities: 0 rad/s is no velocity"),
        ({"homing": {"turns": 5}}, r"homing\.turns: .* take the load off"),
        ({"torque_sensor": "load", "ratings": {"torque_constant": None}}, r"^ratings\.torque_con"),
        ({"brake_commands": [0.2]}, r"brake_commands: at 0\.2 V the brake takes about 5\.1 V"),
        ({"brake_commands": [-0.1]}, r"brake: the plan asks"),
        ({"motor_limit": 6}, r"motor: the plan asks up to 6 V"),
        ({"measure": 3600, "sample_rate": 20000}, "^measure: .* samples"),
        ({"velocities": [160]}, r"omega_ref: the plan asks for 160 rad/s"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_moves(changes, message):
    with pytest.raises(ConfigError, match=message):
        plan(experiment(**changes), RigConfig.model_validate({"limits": {"speed": 150}}))


def test_a_settling_that_has_no_time_is_refused():
    with pytest.raises(ValueError, match=r"timeout of 0\.1 s is shorter than time, 0.5 s"):
        experiment(settling={"timeout": 0.1})


def test_the_plan_draws_the_staircase_where_every_velocity_settles_at_once():
    settings = experiment(velocities=[10, -5], brake_commands=[0, 0.1], slope=50, measure=2)
    planned = plan(settings, RigConfig())
    velocity, brake = planned.references["omega_ref"], planned.references["cmd_voltage_brake"]
    # Ramps of 0.2, 0.3, 0.3, 0.3 and 0.1 s; four plateaus of 0.5 + 2 s, and 0.5 s at rest.
    assert len(velocity) == len(brake) == pytest.approx(800 * (1.2 + 4 * 2.5 + 0.5), abs=5)
    assert len(velocity) < planned.n_samples
    assert np.abs(np.diff(velocity, prepend=0.0)).max() <= 50 / 800 * (1.0 + 1e-9)
    held = [np.count_nonzero((velocity == v) & (brake == b)) for b in (0, 0.1) for v in (10, -5)]
    assert min(held) >= 2.5 * 800 - 2
    assert velocity[-1] == 0.0 and brake[-1] == pytest.approx(0.1)
    assert planned.remarks[0].startswith(f"It takes {len(velocity) / 800:.4g} s if")


def test_the_plan_says_how_far_the_shaft_turns_and_what_the_brake_takes():
    planned = plan(experiment(), RigConfig())
    _, travel, needed = planned.remarks
    assert "turns in all" in travel and "take the load off" in travel
    assert "2.53 V" in needed
    unknown = plan(experiment(ratings={"brake_constant": None}), RigConfig())
    assert "not known" in unknown.remarks[2]
