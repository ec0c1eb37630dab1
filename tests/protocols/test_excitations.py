"""Multisine, chirp, sine and steps against Fourier transforms and closed forms."""

import json
import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.signal import chirp as scipy_chirp

from daq.config.rig import RigConfig
from daq.errors import ConfigError
from daq.lookup.experiments import load_experiment
from daq.plugins import load_plugin
from tests.daq.support import only_capture, record_of
from tests.protocols.support import loaded, planned
from tests.soak import mostly_soak

HELD = {"offset": 0.1}
MULTISINE = {
    "protocol": "multisine",
    "sample_rate": 800,
    "period": 0.5,
    "periods": 3,
    "motor": {"amplitude": 1.5, "offset": 0.2, "band": [10, 100], "seed": 3},
    "brake": HELD,
}


def multisine(folder, motor=(), **changes):
    return planned(folder, **(MULTISINE | changes | {"motor": MULTISINE["motor"] | dict(motor)}))


def lines_of(column):
    """Amplitudes of a periodic column's harmonics, (n // 2 + 1,)."""
    return np.abs(np.fft.rfft(column)) * 2.0 / len(column)


# --- multisine ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("grid", "expected"),
    [("all", set(range(5, 51))), ("odd", set(range(5, 51, 2)))],
)
def test_a_multisine_has_equal_power_at_its_lines_and_none_elsewhere(tmp_path, grid, expected):
    commands = multisine(tmp_path, {"harmonics": grid})
    assert commands.shape == (1200, 2)
    period = commands[:400, 0]
    np.testing.assert_allclose(commands[:, 0], np.tile(period, 3), rtol=0, atol=1e-15)
    lines = lines_of(period - 0.2)
    assert set(np.flatnonzero(lines > 1e-9)) == expected
    powered = lines[sorted(expected)]
    np.testing.assert_allclose(powered, powered[0], rtol=1e-9)
    assert np.max(np.abs(period - 0.2)) == pytest.approx(1.5, rel=1e-12)
    np.testing.assert_array_equal(commands[:, 1], 0.1)


def test_the_odd_random_grid_leaves_one_out_of_every_four_odd_harmonics(tmp_path):
    period = multisine(tmp_path, {"harmonics": "odd-random", "band": [2, 162]})[:400, 0]
    present = np.flatnonzero(lines_of(period - 0.2) > 1e-9)
    odd = np.arange(1, 82, 2)
    missing = [sorted(set(odd[k : k + 4]) - set(present)) for k in range(0, 40, 4)]
    assert all(len(group) == 1 for group in missing)
    assert len({odd.tolist().index(m) % 4 for (m,) in missing}) > 1, "not always the same place"
    assert 81 in present, "a group that is not full is whole"
    assert set(present) <= set(odd)


def test_more_draws_lower_the_crest_factor_and_what_was_drawn_is_recorded(tmp_path):
    one, best = (
        loaded(tmp_path, **MULTISINE, draws=draws).experiment for draws in (1, 40)
    )  # fmt: skip
    drawn, kept = (e.describe()["excitation"]["motor"] for e in (one, best))
    assert kept["crest_factor"] < drawn["crest_factor"]
    period = best.plan().commands[:400, 0] - 0.2
    rms = math.sqrt(np.mean(period**2))
    assert kept["crest_factor"] == pytest.approx(1.5 / rms, rel=1e-9)
    time = np.arange(400) / 800
    again = sum(
        np.cos(2 * np.pi * k / 0.5 * time + phase)
        for k, phase in zip(kept["harmonics"], kept["phases"], strict=True)
    )
    np.testing.assert_allclose(period, again * 1.5 / np.max(np.abs(again)), atol=1e-9)
    assert kept["seed"] == 3 and 0 < kept["draw"] < 40


def test_the_phases_of_many_seeds_are_uniform(tmp_path):
    phases = [
        loaded(tmp_path, **MULTISINE | {"motor": MULTISINE["motor"] | {"seed": seed}})
        .experiment.describe()["excitation"]["motor"]["phases"]
        for seed in range(20)
    ]  # fmt: skip
    counts, _ = np.histogram(phases, bins=8, range=(0.0, 2.0 * np.pi))
    expected = counts.sum() / 8
    assert np.sum((counts - expected) ** 2 / expected) < 24.3, "chi-squared, 7 degrees, p = 0.001"


def test_ramps_are_added_around_whole_periods(tmp_path):
    plain = multisine(tmp_path)
    ramped = multisine(tmp_path, ramp=0.1)
    assert ramped.shape == (1200 + 160, 2)
    np.testing.assert_allclose(ramped[80:-80], plain, atol=1e-15)
    np.testing.assert_allclose(ramped[:80, 1], ramped[-80:, 1][::-1])
    assert 0.0 < ramped[0, 1] < 1e-3 and (np.diff(ramped[:81, 1]) > 0.0).all()
    # Under the rise stands the period that would have come before.
    rise = ramped[:80, 1] / 0.1
    np.testing.assert_allclose(ramped[:80, 0], rise * plain[320:400, 0], atol=1e-12)


# --- chirp and sine -----------------------------------------------------------------------


def chirp(folder, **changes):
    channel = {"amplitude": 1.0, "start_frequency": 2, "end_frequency": 80}
    return planned(
        folder,
        **{"protocol": "chirp", "sample_rate": 4000, "duration": 3, "motor": channel,
           "brake": HELD} | changes,
    )  # fmt: skip


@pytest.mark.parametrize("sweep", ["linear", "logarithmic"])
@pytest.mark.parametrize(("start", "end"), [(2, 80), (80, 2), (5, 5)])
def test_a_chirp_is_scipys(tmp_path, sweep, start, end):
    channel = {"amplitude": 0.8, "offset": 0.3, "start_frequency": start, "end_frequency": end}
    commands = chirp(tmp_path, sweep=sweep, motor=channel)[:, 0]
    time = np.arange(12_000) / 4000
    expected = scipy_chirp(time, start, 3.0, end, method=sweep, phi=-90)
    np.testing.assert_allclose(commands, 0.3 + 0.8 * expected, atol=1e-9)


def test_the_instantaneous_frequency_stays_at_the_ends_in_the_ramps(tmp_path):
    ramp = 1.0
    commands = chirp(tmp_path, ramp=ramp)[:, 0]
    n = len(commands)
    time = np.arange(n) / 4000 - ramp
    window = np.ones(n)
    rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, 4001) / 4001)
    window[:4000], window[-4000:] = rise, rise[::-1]
    sine = commands / window
    rows = np.flatnonzero(np.diff(np.signbit(sine)))
    crossings = time[rows] - sine[rows] / (sine[rows + 1] - sine[rows]) / 4000
    between = 0.5 * (crossings[1:] + crossings[:-1])
    frequency = 0.5 / np.diff(crossings)
    expected = 2.0 * 40.0 ** (np.clip(between, 0.0, 3.0) / 3.0)
    np.testing.assert_allclose(frequency, expected, rtol=0.01)
    assert between[0] < -0.5 and between[-1] > 3.5


def test_a_sine_is_one_with_its_phase_in_degrees(tmp_path):
    channel = {"amplitude": 0.5, "offset": 0.1, "frequency": 4, "phase": "90 deg"}
    commands = planned(
        tmp_path, protocol="sine", sample_rate=1000, duration="250 ms", motor=channel, brake={}
    )
    expected = 0.1 + 0.5 * np.cos(2 * np.pi * 4 * np.arange(250) / 1000)
    np.testing.assert_allclose(commands[:, 0], expected, atol=1e-12)
    assert not commands[:, 1].any()


# --- steps --------------------------------------------------------------------------------


def steps(folder, **changes):
    return planned(folder, **{"protocol": "steps", "sample_rate": 1000, "brake": HELD} | changes)


def test_steps_visit_their_levels_for_their_times(tmp_path):
    motor = {"levels": ["500 mV", -1, 0], "hold": [0.1, "20 ms", 0.03]}
    commands = steps(tmp_path, motor=motor)
    expected = np.repeat([0.5, -1.0, 0.0], [100, 20, 30])
    np.testing.assert_array_equal(commands[:, 0], expected)
    np.testing.assert_array_equal(commands[:, 1], 0.1)


def test_a_staircase_goes_up_and_down(tmp_path):
    stairs = {"lowest": -1, "highest": 2, "steps": 3}
    commands = steps(tmp_path, motor={"offset": 0.5, "staircase": stairs, "hold": 0.01})
    np.testing.assert_allclose(commands[::10, 0], [-0.5, 0.5, 1.5, 2.5, 1.5, 0.5, -0.5])


def test_the_shorter_sequence_starts_again(tmp_path):
    motor, brake = {"levels": [0, 1], "hold": 0.02}, {"levels": [0, 0.1, 0.2], "hold": 0.04}
    commands = steps(tmp_path, motor=motor, brake=brake)
    np.testing.assert_array_equal(commands[:, 0], np.tile(np.repeat([0.0, 1.0], 20), 3))
    np.testing.assert_array_equal(commands[:, 1], np.repeat([0.0, 0.1, 0.2], 40))


def test_a_ramp_smooths_every_change_and_ends_at_zero(tmp_path):
    commands = steps(tmp_path, ramp=0.05, motor={"levels": [1, -1, -1], "hold": 0.2})[:, 0]
    assert len(commands) == 650
    np.testing.assert_array_equal(commands[50:200], 1.0)
    np.testing.assert_array_equal(commands[250:600], -1.0)
    for change in (commands[:51], -commands[199:251], commands[599:]):
        assert (np.diff(change) > 0.0).all()
        # No sample moves further than the raised cosine's middle: pi / 2 of the mean slope.
        span = abs(change[-1] - change[0])
        assert np.max(np.diff(change)) <= 0.5 * np.pi * span / 50
    assert -0.01 < commands[-1] < 0.0


# --- what is refused ----------------------------------------------------------------------

CHIRP = {"protocol": "chirp", "duration": 1, "brake": HELD}
SINE = {"protocol": "sine", "duration": 1, "brake": HELD}
STEPS = {"protocol": "steps", "brake": HELD}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (MULTISINE | {"period": 0.3333}, "period: 0.3333 s is 266.64 samples at 800 Hz, not a "
         "whole number; the nearest that are: 0.3325 or 0.33375 s"),
        (MULTISINE | {"motor": {"amplitude": 1}}, "motor.band: this key is missing"),
        (MULTISINE | {"motor": {"amplitude": 1, "band": [20, 10]}}, "motor.band: [20, 10] Hz"),
        (MULTISINE | {"motor": {"amplitude": 1, "band": [0, 10]}}, "motor.band: [0, 10] Hz"),
        (MULTISINE | {"motor": {"amplitude": 1, "band": [10, 400]}},
         "motor.band: 400 Hz is not below half the sample rate, 400 Hz"),
        (MULTISINE | {"motor": {"amplitude": 1, "band": [2.5, 3.5]}},
         "motor.band: no harmonic of 2 Hz lies from 2.5 to 3.5 Hz"),
        (MULTISINE | {"motor": {"amplitude": 1, "band": [3.5, 4.5], "harmonics": "odd"}},
         "motor.band: no odd harmonic of 2 Hz lies from 3.5 to 4.5 Hz"),
        (MULTISINE | {"motor": {"amplitude": 1, "band": [1, 2], "harmonics": "even"}},
         "motor.harmonics: it must be 'all', 'odd' or 'odd-random'"),
        (MULTISINE | {"periods": 100_000, "period": 3600}, "periods: 3.6e+08 s at 800 Hz makes"),
        (CHIRP | {"motor": {"amplitude": 1, "end_frequency": 3}}, "motor.start_frequency: this"),
        (CHIRP | {"motor": {"amplitude": 1, "start_frequency": 0, "end_frequency": 3}},
         "motor.start_frequency: it must be above 0"),
        (CHIRP | {"motor": {}, "sweep": "log"}, "sweep: it must be 'linear' or 'logarithmic'"),
        (SINE | {"motor": {"amplitude": 1}}, "motor.frequency: this key is missing"),
        (SINE | {"motor": {"amplitude": 1, "frequency": 900}}, "motor.frequency: 900 Hz is not"),
        (SINE | {"motor": {"amplitude": 6, "frequency": 9}}, "motor: the plan asks for"),
        (STEPS | {"motor": {"levels": [1], "staircase": {"highest": 1, "steps": 1}}},
         "motor.staircase: give levels or a staircase, not both"),
        (STEPS | {"motor": {"levels": []}}, "motor.levels: the list is empty"),
        (STEPS | {"motor": {"levels": [1]}}, "motor.hold: this key is missing"),
        (STEPS | {"motor": {"levels": [1], "hold": [1, 2]}}, "motor.hold: 2 times for 1 levels"),
        (STEPS | {"motor": {"levels": [1], "hold": 0}}, "motor.hold: 0 s; a level is held for"),
        (STEPS | {"motor": {"levels": [1], "hold": 0.0001}}, "motor.hold: 0.0001 s is 0.08"),
        (STEPS | {"motor": {"levels": [1], "hold": 1}, "ramp": 1}, "motor.hold: 1 s is not"),
        (STEPS | {"motor": {}}, "motor.levels: neither channel has levels"),
        (STEPS | {"motor": {"levels": [1, "x"], "hold": 1}}, "motor.levels.1: expected a number"),
    ],
)  # fmt: skip
def test_settings_that_make_no_run_are_refused_with_line_and_key(tmp_path, content, message):
    with pytest.raises(ConfigError) as refused:
        planned(tmp_path, **content)
    text = str(refused.value)
    assert message in text
    assert text.startswith(f"{tmp_path / 'e.yaml'}:"), text


# --- any settings -------------------------------------------------------------------------

small = st.floats(-1.0, 1.0).map(lambda x: round(x, 3))
size = st.floats(0.0, 3.0).map(lambda x: round(x, 3))
frequency = st.floats(0.1, 600.0).map(lambda x: round(x, 2))


def channel(**keys):
    return st.fixed_dictionaries({"offset": small}, optional={"amplitude": size, **keys})


@st.composite
def experiments(draw):
    kind = draw(st.sampled_from(["multisine", "chirp", "sine", "steps"]))
    seconds = st.floats(0.01, 3.0).map(lambda x: round(x, 2))
    common = {"protocol": kind, "sample_rate": draw(st.sampled_from([100, 500, 800])),
              "ramp": draw(st.floats(0.0, 0.3))}  # fmt: skip
    if kind == "multisine":
        channels = channel(
            band=st.tuples(frequency, frequency).map(list),
            harmonics=st.sampled_from(["all", "odd", "odd-random"]),
            seed=st.integers(0, 9),
        )
        rest = {"period": draw(seconds), "periods": draw(st.integers(1, 3))}
    elif kind == "steps":
        levels = st.lists(small, max_size=4)
        holds = seconds | st.lists(seconds, min_size=1, max_size=4)
        channels = st.fixed_dictionaries(
            {"offset": small}, optional={"levels": levels, "hold": holds}
        )
        rest = {}
    elif kind == "chirp":
        channels = channel(start_frequency=frequency, end_frequency=frequency)
        rest = {
            "duration": draw(seconds),
            "sweep": draw(st.sampled_from(["linear", "logarithmic"])),
        }
    else:
        channels = channel(frequency=frequency, phase=st.floats(-7.0, 7.0))
        rest = {"duration": draw(seconds)}
    return common | rest | {"motor": draw(channels), "brake": draw(channels)}


def length(settings):
    """Seconds of excitation, without ramps."""
    if settings["protocol"] == "multisine":
        return settings["period"] * settings["periods"]
    if settings["protocol"] == "steps":
        return max(
            np.sum(np.broadcast_to(c.get("hold", 0.0), len(c.get("levels", ()))))
            for c in (settings["motor"], settings["brake"])
        )
    return settings["duration"]


@settings(max_examples=150, deadline=None, derandomize=True,
          suppress_health_check=[HealthCheck.too_slow])  # fmt: skip
@given(experiments())
def test_any_settings_give_a_clear_error_or_commands_within_what_they_declare(content):
    kind = load_plugin("protocol", content["protocol"])
    experiment = kind.model_validate(content)
    try:
        plan = experiment.plan()
    except ValueError as error:
        key = str(error).split(":")[0]
        assert key.split(".")[0] in kind.model_fields, error
        return
    rate, ramp = content["sample_rate"], round(content["ramp"] * content["sample_rate"])
    ramps = 1 if content["protocol"] == "steps" else 2
    assert plan.n_samples == len(plan.commands) == round(length(content) * rate) + ramps * ramp
    for index, name in enumerate(("motor", "brake")):
        given_ = content[name]
        deviations = given_.get("levels", [given_.get("amplitude", 0.0)])
        most = abs(given_["offset"]) + np.max(np.abs(deviations))
        assert np.max(np.abs(plan.commands[:, index])) <= most * (1 + 1e-12)
    np.testing.assert_array_equal(plan.highest, plan.commands.max(axis=0))
    assert json.loads(json.dumps(experiment.describe()))["protocol"] == content["protocol"]


# --- on the simulated rig -----------------------------------------------------------------


@pytest.mark.parametrize(
    "name", mostly_soak(["multisine", "prbs", "chirp", "sine", "steps", "play"], 2)
)
def test_every_shipped_file_runs_and_is_logged_as_planned(tmp_path, command, name):
    result = command(["run", f"{name}.yaml"], tmp_path)
    assert result.returncode == 0, result.stderr
    folder = only_capture(tmp_path)
    log = pd.read_csv(folder / "log.csv")
    plan = load_experiment(f"{name}.yaml").plan(RigConfig())
    np.testing.assert_allclose(log[["cmd_voltage_motor", "cmd_voltage_brake"]], plan.commands)
    assert not log["flags"].any()
    record = record_of(folder)
    assert record["status"] == "completed"
    drawn = record["experiment"].pop("excitation", None)
    assert (drawn is not None) == (name in {"multisine", "play"})
    analysed = command(["analyse", folder], tmp_path)
    assert analysed.returncode == 2 and "concludes nothing" in analysed.stderr


def test_validation_runs_of_the_shipped_files_are_possible():
    for name in ("multisine", "chirp", "prbs"):
        shipped = load_experiment(f"{name}.yaml")
        one = shipped.plan(RigConfig()).commands
        other = shipped.validation().plan(RigConfig()).commands
        assert one.shape == other.shape and not np.array_equal(one, other)
