"""Settings that take out what was found wrong, in the command that comes next."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm

from daq import identify
from daq.config.identification import IdentificationConfig
from daq.errors import ConfigError
from daq.identification.remedies import remedies
from daq.lookup.models import find_model
from sysid import BatchSimulator, Dataset
from sysid.judging.findings import Finding
from sysid.judging.starts import Start
from sysid.problem.faults import DataFault
from tests.daq.support import slide_log, slide_model

MOTOR = f"{Path(__file__).parents[2] / 'examples' / 'dc_motor.py'}:model"
COLUMNS = {
    "columns": {
        "time": {"column": "t"},
        "inputs": {"u": {"column": "u"}},
        "outputs": {"y": {"column": "y", "sign": -1}},
    }
}


def settings(**content):
    return IdentificationConfig.model_validate(content)


def found(kind, name, amplitude, share=0.5):
    return Finding(kind, name, "s", amplitude, 1e-12, share, ())


def fault(kind, severity="doubt", settings=()):
    return DataFault(kind, severity, "training", ("log",), "y", "", "", "", 0.1, settings=settings)


def mended(findings=(), faults=(), pushed=None, starts=(), **content):
    return remedies(
        settings(**content),
        {"u": "V", "y": "rad/s"},
        faults=faults,
        findings=findings,
        pushed=pushed,
        starts=starts,
    )


def test_a_delay_is_added_to_what_is_taken_out_already():
    assert mended([found("delay", "y", 0.00412)]) == ("delay.y=0.00412",)
    late = [found("delay", "u", -0.002)]
    assert mended(late, delay={"u": "5 ms"}) == ("delay.u=0.003",)
    assert mended([found("mean", "y", 0.002)]) == ("averaged.y=0.002",)


def test_a_filter_is_taken_out_with_what_it_is_late_beside_that():
    assert mended([found("filter", "u", 0.003)]) == ("filtered.u=0.003",)
    analog = [replace(found("filter", "y", 0.003), late=4.7e-4)]
    more = mended(analog, filtered={"y": "1 ms"}, delay={"y": "1 ms"})
    assert more == ("filtered.y=0.004", "delay.y=0.00147")


def test_a_value_fixed_wrong_is_freed():
    assert mended([found("fixed", "R", -0.1)]) == ("fixed.R=null",)
    assert not mended([found("fixed", "R", -0.1, share=0.1)])  # moves nothing


def test_starts_on_an_end_are_searched_farther():
    """As of a swinging pendulum, whose held-back part begins in motion."""
    begun = [
        Start("angle", "rad", 0.3, 0.31, -0.5, 0.5),
        Start("speed", "rad/s", 0.1, np.nan, -2.0, 2.0),
        Start("speed", "rad/s", 2.0, np.nan, -2.0, 2.0),
        Start("level", "m", 0.2, np.nan, 0.0, 0.2),
    ]
    changed = ("initial.speed=[-10, 10]", "initial.level=[0, 0.6]")
    assert mended(starts=begun) == changed
    # What the first samples say is said more closely.
    known = fault("start", settings=("initial.level=[0, 0.4]",))
    assert mended(faults=[known], starts=begun) == (changed[0], "initial.level=[0, 0.4]")


def test_a_sign_is_turned_round_where_the_file_says_it():
    wrong = [found("gain", "y", -2.1), found("gain", "u", 0.3, share=0.01)]
    assert mended(wrong, **COLUMNS) == ("columns.outputs.y.sign=1",)
    assert mended(wrong) == ()


@pytest.mark.parametrize(
    ("times", "setting"),
    [
        (30.0 / np.pi, "columns.outputs.y.unit=rpm"),
        (9.6, "columns.outputs.y.unit=rpm"),
        (180.0 / np.pi, "columns.outputs.y.unit=deg/s"),
        (1000.0, "columns.outputs.y.unit=mrad/s"),
        (8.0, "channels.y.gain=[0.5, 16]"),
    ],
)
def test_a_gain_between_two_units_is_a_unit(times, setting):
    assert mended([found("gain", "y", times - 1.0)], **COLUMNS) == (setting,)


def test_what_counts_little_or_is_of_a_single_log_is_left_alone():
    assert mended([found("delay", "y", 1e-4, share=0.01)]) == ()
    assert mended([found("delay", "y of training 2", 0.004)]) == ()


def test_faults_of_samples_come_first_and_a_lag_is_taken_out_once():
    late = fault("lag", settings=["delay.y=0.004"])
    jolts = fault("outliers", settings=["robust=true"])
    assert mended([found("delay", "u", 0.001)], [jolts, late]) == (
        "robust=true",
        "delay.y=0.004",
    )
    assert mended(faults=[fault("outliers", "note", "robust=true")]) == ()


def test_exchanged_channels_take_each_other_s_column():
    outputs = {"y": {"column": "left"}, "z": {"column": "right"}}
    columns = {"columns": {**COLUMNS["columns"], "outputs": outputs}}
    exchange = [found("exchange", "y and z", 1.0)]
    assert mended(exchange, **columns) == (
        "columns.outputs.y.column=right",
        "columns.outputs.z.column=left",
    )
    assert mended(exchange) == ()


def test_gains_offsets_and_drifts_become_parameters():
    wrong = [found("gain", "y", 0.3), found("offset", "u", -0.04), found("drift", "y", 0.01)]
    assert mended(wrong) == (
        "channels.y.gain=[0.5, 2.6]",
        "channels.u.offset=[-0.2, 0.2]",
        "channels.y.drift=[-0.05, 0.05]",
    )
    assert settings(**{"channels": {"u": {"offset": [-0.2, 0.2]}}}).channels["u"].gain is None
    assert mended(wrong, [fault("gap", settings=["use.log=0 s .. 1 s"])]) == ("use.log=0 s .. 1 s",)


@pytest.mark.parametrize(("value", "ends"), [(1e-5, "[1e-6, 0.001]"), (1e-3, "[1e-5, 0.01]")])
def test_a_range_whose_end_decides_is_widened_there_once_the_data_are_right(value, ends):
    pushed = {"J": (value, 1e-5, 1e-3)}
    assert mended(pushed=pushed) == (f"ranges.J={ends}",)
    jolts = fault("outliers", settings=["robust=true"])
    assert mended(faults=[jolts], pushed=pushed) == ("robust=true",)


def motor_log(seed):
    """The motor of examples/dc_motor.py under a square voltage, its load logged at half of it."""
    rng, n, motor = np.random.default_rng(seed), 200, find_model(MOTOR)
    t = 0.01 * np.arange(n)
    voltage = np.where(np.mod(t, 0.9 + 0.1 * seed) < 0.45, 1.0, -1.0)
    load = 0.01 * np.sin(2.0 * np.pi * 0.35 * seed * t)
    blank = Dataset(np.column_stack([voltage, load]), np.zeros((n, 2)), 0.01)
    (outputs,) = BatchSimulator(motor, accuracy=1e-8).trajectories(motor.nominal, blank)
    noisy = outputs + rng.normal(size=(n, 2)) * [0.005, 0.02]
    columns = {"voltage": voltage, "load": 0.5 * load, "current": noisy[:, 0], "omega": noisy[:, 1]}
    return pd.DataFrame({"t": t, **columns})


@pytest.mark.soak
def test_a_wrong_gain_is_fitted_by_the_command_and_stays_a_doubt():
    """A load logged at half its size: a current of twice its size explains the same."""
    logs = motor_log(1), motor_log(2)
    quick = {"population": 150, "generations": 20}
    first = identify(*logs, model=MOTOR, **quick)
    found = remedies(
        IdentificationConfig(), ("load", "current", "omega"), findings=first.suspicion.findings
    )
    ((channel, kind, ends),) = re.findall(r"channels\.(\w+)\.(\w+)=(.*)", " ".join(found))
    assert first.verdict.trust == "poor" and kind == "gain"
    errors = {channel: {kind: json.loads(ends)}}
    second = identify(*logs, model=MOTOR, channels=errors, **quick)
    values = second.parameters.value
    assert values[f"gain_of_{channel}"] == pytest.approx(2.0, rel=0.02)
    assert values["constant"] == pytest.approx(0.0238, rel=0.01)
    # The resistance is the motor's with the load corrected, and twice that with the current.
    assert values["resistance"] == pytest.approx(1.0 if channel == "load" else 2.0, rel=0.02)
    assert second.verdict.predicted.trust == "good"
    assert second.verdict.parameters.trust == "limited"
    assert any("which channel is wrong" in reason for reason in second.verdict.parameters.reasons)


def encoder_log(seed, n=600, dt=0.002, count=2.0 * np.pi / 2000.0):
    """The same motor in closed form, its speed the difference of two counts of an encoder."""
    rng, motor = np.random.default_rng(seed), find_model(MOTOR)
    p = {**dict(zip(motor.parameter_names, motor.nominal, strict=True)), "inertia": 4e-6}
    slopes = np.zeros((4, 4))  # of current, speed, angle and the voltage that is held
    slopes[0] = np.array([-p["resistance"], -p["constant"], 0.0, 1.0]) / p["inductance"]
    slopes[1, :2] = np.array([p["constant"], -p["damping"]]) / p["inertia"]
    slopes[2, 1] = 1.0
    step, voltage = expm(slopes * dt), np.repeat(rng.uniform(-1.0, 1.0, n // 10), 10)
    states = np.zeros((n, 4))
    for k in range(1, n):
        states[k] = step @ np.append(states[k - 1, :3], voltage[k - 1])
    counts = np.floor(states[:, 2] / count)
    speed = np.diff(counts, prepend=0.0) * count / dt
    current = states[:, 0] + 0.005 * rng.normal(size=n)
    columns = {"voltage": voltage, "load": np.zeros(n), "current": current, "omega": speed}
    return pd.DataFrame({"t": dt * np.arange(n), **columns}), p


@pytest.mark.soak
def test_a_speed_that_is_a_difference_of_positions_is_named_and_right_by_the_command():
    (log, truth), (check, _) = encoder_log(1), encoder_log(2)
    fixed = {"damping": truth["damping"]}
    quick = {"model": MOTOR, "population": 100, "generations": 20, "fixed": fixed}
    first = identify(log, validate=check, **quick)
    assert "omega is logged as its mean over the 2 ms" in " ".join(first.verdict.reasons)
    assert first.trust != "good"
    found = first.suspicion.findings
    setting = remedies(IdentificationConfig(), {"omega": "rad/s"}, findings=found)
    assert setting == ("averaged.omega=0.002",)
    second = identify(log, validate=check, averaged={"omega": "2 ms"}, **quick)
    assert second.trust == "good", second.verdict.reasons
    for estimate in second.uncertainty.determined():
        assert not estimate.excludes(truth), estimate


def test_a_mean_over_more_than_a_tenth_of_a_log_is_refused():
    """A unit was forgotten: 2 for 2 ms."""
    with pytest.raises(ConfigError, match=r"averaged\.omega: 2 s is more than a tenth of .*1\.2 s"):
        identify(encoder_log(1)[0], model=MOTOR, averaged={"omega": 2})


@pytest.mark.soak
def test_of_logs_of_several_rates_no_single_mean_is_named():
    fixed = {"damping": 1.33e-5}
    quick = {"model": MOTOR, "population": 100, "generations": 20, "fixed": fixed}
    logs = encoder_log(1)[0], encoder_log(2, dt=0.004)[0]
    kinds = {finding.kind for finding in identify([*logs], **quick).suspicion.findings}
    assert "mean" not in kinds and kinds & {"delay", "filter"}


@pytest.mark.soak
def test_a_speed_in_other_units_is_a_guess_and_no_term_in_the_equations(tmp_path):
    """Its size explains all that is left, so that nothing beside a line's guess of it is tried."""
    columns = {
        "time": {"column": "t"},
        "inputs": {"voltage": {"column": "voltage"}, "load": {"column": "load"}},
        "outputs": {"current": {"column": "current"}, "omega": {"column": "omega"}},
    }
    paths = [tmp_path / f"{seed}.csv" for seed in (1, 2)]
    for seed, path in enumerate(paths, 1):
        log = motor_log(seed)
        log["load"], log["omega"] = 2.0 * log["load"], 30.0 / np.pi * log["omega"]
        log.to_csv(path, index=False)
    result = identify(
        paths[0],
        validate=paths[1],
        model=MOTOR,
        columns=columns,
        population=150,
        generations=20,
    )
    (finding,) = result.suspicion.findings
    assert (finding.kind, finding.name) == ("gain", "omega")
    assert 1.0 + finding.amplitude == pytest.approx(30.0 / np.pi, rel=2e-3)
    assert result.next_step.command.endswith("--set columns.outputs.omega.unit=rpm")
    assert "is a guess by the size of a gain" in result.next_step.purpose


def test_a_position_starts_where_all_samples_say_and_commands_go_on_from_there(tmp_path):
    log, notes = slide_log(3.0), []
    quick = {"model": slide_model(tmp_path), "population": 40, "generations": 8}
    found = identify(log, **quick, watch=notes.append, initial={"v": 0.0})
    assert any("where x starts is estimated" in getattr(note, "text", "") for note in notes)
    assert found.problem.settings.initial == {"v": 0.0, "x": "estimate"}
    assert abs(found.estimator.initial_states_[0]["x"]) < 0.01
    assert abs(found.parameters.loc["friction", "value"] - 3.0) < 0.1
    again = identify(log, **quick, initial=found.problem.settings.initial)
    assert again.parameters.loc["friction", "value"] == pytest.approx(
        found.parameters.loc["friction", "value"], rel=1e-3
    )
    kept = identify(log, **quick, watch=notes.append, initial={"x": "first"})
    assert kept.estimator.initial_states_ == []


def test_where_training_is_explained_what_comes_next_is_no_longer_search(tmp_path):
    """A slide that rubs twice as much when it is validated: no search of training finds that."""
    dry, wet = slide_log(3.0), slide_log(6.0)
    moved = {
        "t": wet["t"] + 2.0 * dry["t"].iloc[-1] - dry["t"].iloc[-2],
        "x": wet["x"] + dry["x"].iloc[-1],
    }
    paths = [tmp_path / f"{name}.csv" for name in ("dry", "wet", "both")]
    for path, log in zip(paths, (dry, wet, pd.concat([dry, wet.assign(**moved)])), strict=True):
        log.to_csv(path, index=False)
    quick = {"model": slide_model(tmp_path), "population": 40, "generations": 8}
    for asked, logs in (
        ({"data": paths[0], "validate": paths[1]}, paths[:2]),
        ({"data": paths[2], "hold_back": 0.5}, paths[2:]),
    ):
        apart = identify(asked.pop("data"), **asked, **quick)
        assert apart.verdict.predicted.trust == "poor"
        assert apart.next_step.purpose.startswith("See whether any parameters explain")
        command = apart.next_step.command
        assert command.startswith(f"rig identify {' '.join(map(str, logs))} --")
        assert "--validate" not in command and "hold_back=0.5" not in command
