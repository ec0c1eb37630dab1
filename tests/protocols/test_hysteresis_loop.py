"""Hysteresis loops: the fitted loop against the brake's own equation, runs against the plant."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from daq.config.rig import RigConfig
from daq.errors import ConfigError, RunError
from daq.run.plan import plan
from protocols.analysis.hysteresis import Cycles, fit, hysteresis
from protocols.hysteresis_loop import HysteresisLoop
from sim_rig.physics.hysteresis import hysteresis as brake_model
from sim_rig.physics.options import Design
from sim_rig.physics.values import named
from tests.protocols.closed_loop import numbers, run, shipped
from tests.soak import mostly_soak

TRUTH = named("rig", Design())
GAMMA, BETA, A = (TRUTH[name] for name in ("gamma", "beta", "A"))
RATE, PART, SATURATION = BETA + GAMMA, GAMMA / (BETA + GAMMA), A / (BETA + GAMMA)


def experiment(**changes):
    short = {"brake_commands": [0, 0.1], "period": 1, "cycles": 3, "homing": {"turns": 0},
             "calibration": {"samples": 800}}  # fmt: skip
    return shipped("hysteresis_loop.yaml", HysteresisLoop, **(short | changes))


def swing(n, size):
    return size * (1.0 - np.cos(2.0 * np.pi * np.arange(n) / n))


# --- the loop's shape ---------------------------------------------------------------------


@pytest.mark.parametrize(("gamma", "beta"), [(28.0, 20.0), (40.0, 5.0), (15.0, 15.0)])
def test_the_loop_is_that_of_the_brakes_equation(gamma, beta):
    rate = brake_model("bouc-wen").rate
    n, size = 500, 0.1
    found = solve_ivp(
        lambda t, z: [rate(2.0 * np.pi * size * math.sin(2.0 * np.pi * t), z[0], (gamma, beta, A))],
        (0.0, 3.0), [0.0], t_eval=2.0 + np.arange(n) / n, rtol=1e-9, atol=1e-11, max_step=1e-3,
    )  # fmt: skip
    angles = np.stack([swing(n, size), -2.0 * swing(n, size)])
    w = hysteresis(angles, gamma + beta, gamma / (gamma + beta))
    np.testing.assert_allclose(w[0], found.y[0] * (gamma + beta) / A, atol=1e-4)
    assert np.max(np.abs(w)) <= 1.0


def cycles(command, current, kappa, noise=0.0, seed=0, n=800, count=4):
    """Cycles of a brake with viscous damping and inertia behind a sensor with an offset."""
    size, dt = 0.6, 1.0 / n
    angle = swing(n, size)
    time = np.arange(n) * dt
    speed = 2.0 * np.pi * size * np.sin(2.0 * np.pi * time)
    acceleration = 4.0 * np.pi**2 * size * np.cos(2.0 * np.pi * time)
    torque = kappa * hysteresis(angle[None], RATE, PART)[0]
    torque = torque + (1e-4 + 6e-4 * current) * speed + 1e-4 * acceleration + 0.003
    rng = np.random.default_rng(seed)
    noisy = torque + noise * rng.standard_normal((count, n))
    return Cycles(command, current, np.tile(angle, (count, 1)), noisy, dt)


def test_a_fit_of_exact_loops_finds_what_they_were_made_with():
    levels = [cycles(0.0, 0.0, 0.014), cycles(0.1, 0.05, 0.014 + 3.5 * 0.05)]
    found = fit(levels)
    assert found.rate.value == pytest.approx(RATE, rel=5e-3)
    assert found.part.value == pytest.approx(PART, rel=5e-3)
    assert found.kappa0.value == pytest.approx(0.014, rel=5e-3)
    assert found.kappa1.value == pytest.approx(3.5, rel=5e-3)
    assert found.explained > 0.9999
    np.testing.assert_allclose(found.torque[1], levels[1].torque[0], atol=2e-3)


def test_intercept_and_slope_are_where_the_loop_has_them():
    found = fit([cycles(0.1, 0.05, 0.2)])
    assert found.kappa0 is None and found.kappa1 is None
    # Way back from saturation to z = 0, by quadrature of the brake's equation.
    way, _ = quad(lambda z: 1.0 / (A + (GAMMA - BETA) * z), 0.0, SATURATION)
    assert found.intercept == pytest.approx(way, rel=5e-3)
    slope = (A + (GAMMA - BETA) * SATURATION) / SATURATION
    assert found.reversal == pytest.approx(slope, rel=5e-3)


@pytest.mark.soak
def test_errors_are_those_of_the_noise():
    """Estimates of many noisy sets scatter as each of them says."""
    sets = [
        fit([cycles(0.1, 0.05, 0.2, noise=5e-3, seed=seed, n=200, count=10)]) for seed in range(10)
    ]
    for name in ("rate", "part"):
        values = [getattr(found, name).value for found in sets]
        stated = math.sqrt(np.mean([getattr(found, name).error ** 2 for found in sets]))
        # Chi-squared of 9 degrees of freedom, p = 0.001 on either side.
        assert 0.36 < np.std(values, ddof=1) / stated < 1.76


def test_the_energy_is_the_closed_forms():
    """Half a cycle of way s takes kappa (s - D), D the way lost in turning over."""
    level = cycles(0.1, 0.05, 0.2)
    loss, _ = quad(lambda w: (1.0 + w) / (RATE * (1.0 + (2.0 * PART - 1.0) * w)), 0.0, 1.0)
    loss += 1.0 / RATE
    viscous = math.pi * (2.0 * math.pi * 0.6) * 0.6 * (1e-4 + 6e-4 * 0.05)
    expected = 2.0 * 0.2 * (1.2 - loss) + viscous
    np.testing.assert_allclose(level.energy, expected, rtol=3e-3)


# --- on the simulated rig -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("plant", "changes"),
    mostly_soak(
        [
            ({"load": "pulley"}, {"homing": {"turns": 3}}),
            (
                {"load": "free", "sensor": "between"},
                {"torque_sensor": "between", "shape": "triangle"},
            ),
        ]
    ),
)
def test_a_run_finds_the_plants_parameters(tmp_path, plant, changes):
    chosen = experiment(**changes)
    samples, extra = run(chosen, tmp_path, plant, seed=2)
    assert len(samples) == chosen.plan().n_samples
    np.testing.assert_allclose(extra["omega_ref"], chosen.plan().references["omega_ref"])
    found = chosen.findings(samples, extra)
    by_name = numbers(found)
    assert by_name["rate"].value == pytest.approx(RATE, rel=0.1)
    assert by_name["kappa0"].value == pytest.approx(TRUTH["alpha0"] * SATURATION, rel=0.3)
    assert by_name["kappa1"].value == pytest.approx(TRUTH["alpha1"] * SATURATION, rel=0.05)
    assert set(found.ranges) == {"gamma", "beta", "A", "alpha0", "alpha1"}
    for name, (low, high) in found.ranges.items():
        assert low < TRUTH[name] < high, name
    (table,) = found.tables
    # What the loop encloses is what is lost: the integral of torque over all of the way.
    rows = extra["cycle"] >= 1
    for index, energy in enumerate(table.columns["energy"]):
        at = rows & (extra["level"] == index)
        height = table.columns["hysteretic_torque"][index]
        way = np.sum(np.abs(np.diff(samples.theta[at]))) / 2
        assert 0.7 * height * way < energy < 1.1 * height * way
    assert [chart.name for chart in found.figures] == ["torque_angle", "torque_velocity"]
    assert "explains 9" in found.remarks[0]


def test_an_encoder_that_counts_the_other_way_ends_the_run(tmp_path):
    rig = {"sensors": {"encoder": {"sign": -1}}}
    with pytest.raises(RunError, match="encoder counts the other way round"):
        run(experiment(), tmp_path, {"load": "free", "sensor": "between"}, rig)


@pytest.mark.soak
def test_a_run_that_ended_early_concludes_from_what_there_is(tmp_path):
    chosen, plant = experiment(torque_sensor="between"), {"load": "free", "sensor": "between"}
    samples, extra = run(chosen, tmp_path, plant, ideal=True)

    def first(n):
        fields = {name: getattr(samples, name)[:n] for name in samples.__dataclass_fields__}
        return type(samples)(**fields), {name: values[:n] for name, values in extra.items()}

    one = int(np.argmax(extra["level"] == 1)) + 1600
    found = chosen.findings(*first(one))
    assert set(found.ranges) == {"gamma", "beta", "A"}
    assert any("1 brake command" in remark for remark in found.remarks)
    with pytest.raises(ValueError, match="two cycles behind the first"):
        chosen.findings(*first(1600))


@pytest.mark.soak
def test_a_few_lost_samples_do_not_cost_their_cycles(tmp_path):
    chosen = experiment()
    samples, extra = run(chosen, tmp_path, {"load": "free"}, ideal=True)

    def without(share):
        kept = np.random.default_rng(1).random(len(samples)) >= share
        fields = {name: getattr(samples, name)[kept] for name in samples.__dataclass_fields__}
        return type(samples)(**fields), {name: values[kept] for name, values in extra.items()}

    whole, thinned = (numbers(chosen.findings(*without(share))) for share in (0.0, 0.02))
    for name in ("rate", "kappa0", "kappa1"):
        assert thinned[name].value == pytest.approx(whole[name].value, rel=0.02), name
    with pytest.raises(ValueError, match="nearly all samples"):
        chosen.findings(*without(0.1))


def test_the_plan_is_what_is_asked_of_the_shaft():
    chosen = experiment(brake_commands=[0.1, 0.0, 0.12])
    planned = chosen.plan()
    brake, speed = planned.references["cmd_voltage_brake"], planned.references["omega_ref"]
    assert np.max(np.abs(np.diff(brake))) <= 0.5 / 800 * 1.05, "the brake is ramped"
    assert brake[0] == brake[-1] == 0.0 and planned.highest.tolist() == [4.5, 0.12]
    assert abs(speed.sum() / 800) < 1e-9, "the shaft comes back to where it was"
    assert np.max(np.abs(speed)) == pytest.approx(5.0, rel=1e-3)
    assert planned.n_samples == len(speed) == len(brake)
    assert "swings by 1.59 rad" in planned.remarks[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"period": 0.3333}, "period: 0.3333 s is 266.64 samples"),
        ({"period": 600, "cycles": 1000}, "cycles: 1.2e+06 s at 800 Hz makes 960001520 samples"),
        ({"ratings": {"torque_constant": None}}, "ratings.torque_constant: with the torque sensor"),
        ({"brake_commands": [0.3]}, "brake_commands: at 0.3 V the brake takes about 7.6 V"),
    ],
)
def test_settings_that_make_no_run_are_refused(changes, message):
    with pytest.raises(ConfigError) as refused:
        plan(experiment(**changes), RigConfig())
    assert message in str(refused.value)


@settings(max_examples=40, deadline=None, derandomize=True,
          suppress_health_check=[HealthCheck.too_slow])  # fmt: skip
@given(
    st.fixed_dictionaries(
        {
            "brake_commands": st.lists(st.floats(0.0, 0.2), min_size=1, max_size=4),
            "amplitude": st.floats(0.1, 50.0),
            "shape": st.sampled_from(["sine", "triangle"]),
            "period": st.floats(0.05, 3.0).map(lambda x: round(x, 2)),
            "cycles": st.integers(3, 6),
            "sample_rate": st.sampled_from([100, 800]),
        }
    )
)
@example({"brake_commands": [0.012], "amplitude": 1.0, "sample_rate": 100})  # a ramp of 2 samples
def test_any_settings_give_a_clear_error_or_a_plan_within_what_it_declares(changes):
    chosen = experiment(**changes)
    try:
        planned = chosen.plan()
    except ValueError as error:
        assert str(error).split(":")[0] in {"brake_commands", "period"}
        return
    speed = planned.references["omega_ref"]
    brake = planned.references["cmd_voltage_brake"]
    assert planned.n_samples == len(speed) == len(brake)
    assert np.max(np.abs(speed)) <= changes["amplitude"]
    assert planned.lowest[1] <= brake.min() and brake.max() <= planned.highest[1]
    assert speed[0] == speed[-1] == brake[-1] == 0.0
    # A ramp's samples are a whole number, rounded: of 1.5 samples one.
    assert max(brake[0], np.max(np.abs(np.diff(brake)))) <= 0.5 / changes["sample_rate"] * 1.5


@pytest.mark.parametrize(
    ("said", "place", "told"),
    mostly_soak(
        [
            ("load", "between", "where ratings.brake_constant says 3.568"),
            ("between", "load", "That is too little for ranges. Is the torque sensor"),
        ]
    ),
)
def test_a_torque_sensor_that_is_elsewhere_is_suspected(tmp_path, said, place, told):
    chosen = experiment(torque_sensor=said, brake_commands=[0.05, 0.1])
    samples, extra = run(chosen, tmp_path, {"load": "free", "sensor": place})
    found = chosen.findings(samples, extra)
    assert any(told in remark for remark in found.remarks), found.remarks
    assert bool(found.ranges) == (said == "load")
