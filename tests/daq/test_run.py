"""``rig run``: phases, capture folders, and every way in which a run can end."""

import hashlib
import itertools
import json
import signal
import subprocess
import sys

import numpy as np
import pytest

from daq.errors import ConfigError
from daq.hal import Flag
from daq.identification.records import from_recording
from daq.logs.capture import Capture
from daq.logs.recording import load
from sim_rig.actuator import actuator
from tests.daq.support import EXPERIMENT as SETTINGS
from tests.daq.support import (
    environment,
    install_faulty,
    journal_of,
    merged,
    only_capture,
    record_of,
    rig,
    rows_in,
    run_in_progress,
    start_rig,
    until,
    write_experiment,
    write_rig,
)
from tests.soak import mostly_soak

BY_HAND = "hand (Ctrl-C, or Stop in the scope)"
FAULTY = {"backend": "faulty", "options": {"journal": "journal.jsonl"}}


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    return install_faulty(tmp_path_factory.mktemp("plugin"))


@pytest.fixture(scope="module")
def completed(tmp_path_factory, plugin):
    """One run with every phase on the journaling backend."""
    root = tmp_path_factory.mktemp("completed")
    write_experiment(root / "all.yaml", homing={"turns": 1, "timeout": 30})
    write_rig(root / "rig.yaml", **FAULTY)
    result = rig("run", "all.yaml", "--rig", "rig.yaml", cwd=root, env=plugin)
    assert result.returncode == 0, result.stderr
    return root, result


def run_with(tmp_path, plugin, fault, at=0, experiment=None, rig_changes=None):
    write_experiment(tmp_path / "e.yaml", **(experiment or {}))
    options = {"fault": fault, "at": at}
    write_rig(tmp_path / "rig.yaml", **merged(merged(FAULTY, {"options": options}),
                                              rig_changes or {}))  # fmt: skip
    return rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path, env=plugin)


def assert_left_safe(root):
    """The last that the device applied was zero, and it was closed."""
    journal = journal_of(root / "journal.jsonl")
    outputs = [entry for entry in journal if entry["what"] == "outputs"]
    assert outputs and not np.any(outputs[-1]["applied"])
    assert journal[-1]["what"] == "close"
    after = journal[journal.index(outputs[-1]) + 1 :]
    assert not [e for e in after if e["what"] == "receive" and np.any(e["applied"])]


# --- a run that completes -----------------------------------------------------------------


def test_phases_come_in_order_and_the_device_is_made_safe_before_it_is_closed(completed):
    root, _ = completed
    journal = journal_of(root / "journal.jsonl")
    steps = [e.get("phase") or e["what"] for e in journal if e["what"] != "outputs"]
    order = [step for step, _ in itertools.groupby(steps)]
    wanted = ["calibration", "start", "homing", "start", "run", "start", "close"]
    assert [step for step in order if step in wanted] == wanted
    assert "safe" in order[order.index("run") :], "announced, or called, at the end"
    assert_left_safe(root)
    modes = [e["mode"] for e in journal if e["what"] == "start"]
    assert modes == ["closed loop", "closed loop", "open loop"]


def test_outputs_are_zero_before_the_run_phase(completed):
    root, _ = completed
    journal = journal_of(root / "journal.jsonl")
    begin = next(i for i, e in enumerate(journal) if e.get("phase") == "run")
    before = [e for e in journal[:begin] if e["what"] == "receive"]
    assert len(before) > 10 and not any(np.any(e["applied"]) for e in before)


def test_the_capture_folder_holds_the_run_as_resolved(completed):
    root, result = completed
    folder = only_capture(root)
    record = record_of(folder)
    assert sorted(p.name for p in folder.iterdir()) == ["log.csv", "run.json"]
    assert {
        "status", "reason", "started", "experiment", "rig", "software", "host", "device",
        "calibration", "offsets", "homing", "phase", "timing", "log", "realtime", "outputs",
        "saturated_samples", "doubts", "process", "rig_file", "planned",
    } == set(record)  # fmt: skip
    assert (record["status"], record["reason"], record["phase"]) == ("completed", None, "close")
    assert record["planned"] is True and from_recording(load(folder), actuator()).dataset.planned
    assert record["experiment"] == {
        **merged(SETTINGS, {"homing": {"turns": 1.0, "timeout": 30.0}}),
        "calibration": {"samples": 16, "motion": 0.01, "current_motor": 0.1, "current_brake": 0.05},
        "name": "",
        "rig": "",
        "model": "",
        "validation": {},
        "metadata": {"operator": "", "sample": "", "note": "", "tags": []},
    }
    assert record["rig_file"] == "rig.yaml"
    assert record["rig"]["sensors"]["encoder"] == {"cycles": 2048, "sign": 1, "speed": "auto"}, (
        "defaults too"
    )
    assert record["rig"]["limits"]["command"]["brake"] == [0.0, 0.38]
    assert record["rig"]["options"]["journal"] == "journal.jsonl"
    assert record["software"]["hybrid-rig"] and record["software"]["numpy"] == np.__version__
    assert record["homing"]["turns"] == pytest.approx(1.0, abs=0.15)
    assert folder.name.endswith("-all") and str(folder.name) in result.stdout


def test_the_log_is_the_one_the_record_fingerprints(completed):
    root, _ = completed
    folder = only_capture(root)
    digest = hashlib.sha256((folder / "log.csv").read_bytes()).hexdigest()
    assert record_of(folder)["log"] == {"file": "log.csv", "sha256": digest}
    recording = load(folder)
    assert recording.warning is None and recording.name == folder.name
    assert len(recording.frame) == 400 and recording.dt == pytest.approx(1 / 800, rel=1e-14)
    assert np.array_equal(recording.frame["tick"], np.arange(400))


def test_offsets_are_taken_off_the_log(tmp_path):
    # 1 V of offset would be 0.5 A; the experiment commands nothing, so all that is left is noise.
    quiet = {"amplitude": 0.0, "offset": 0.0}
    write_experiment(
        tmp_path / "e.yaml", motor=quiet, brake=quiet, duration=2,
        calibration={"samples": 2000, "current_motor": 0.6, "current_brake": 0.6},
    )  # fmt: skip
    flaws = {"options": {"imperfections": {"offset": 1.0, "noise": 0.01}}}
    write_rig(tmp_path / "rig.yaml", **merged(flaws, {"limits": {"current": {"brake": 2.0}}}))
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    frame = load(only_capture(tmp_path)).frame
    volts = record_of(only_capture(tmp_path))["offsets"]["volts"]
    assert np.abs(volts).max() > 0.3
    for name in ("current_motor", "current_brake", "torque"):
        # Mean of 2000 at sigma = 7 mA: six standard errors of both means.
        assert abs(frame[name].mean()) < 2e-3, name


def test_one_seed_gives_a_byte_identical_log_and_another_does_not(tmp_path):
    logs = []
    for index, seed in enumerate((7, 7, 8)):
        root = tmp_path / str(index)
        root.mkdir()
        write_experiment(root / "e.yaml")
        write_rig(root / "rig.yaml", options={"seed": seed})
        assert rig("run", "e.yaml", "--rig", "rig.yaml", cwd=root).returncode == 0
        logs.append((only_capture(root) / "log.csv").read_bytes())
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]


def test_two_runs_in_one_second_get_a_folder_each(tmp_path):
    made = [Capture.create(tmp_path, "same", {}).folder for _ in range(3)]
    assert len(set(made)) == 3 and all((folder / "run.json").exists() for folder in made)


# --- runs that end early ------------------------------------------------------------------


def test_homing_that_takes_too_long_ends_the_run(tmp_path, plugin):
    result = run_with(
        tmp_path, plugin, "no hand", experiment={"homing": {"turns": 5, "timeout": 1.5}}
    )
    assert result.returncode == 1
    assert "0.00 of 5 turns were wound in 1.5 s" in result.stderr
    assert "homing.timeout" in result.stderr
    record = record_of(only_capture(tmp_path))
    assert (record["status"], record["phase"]) == ("failed", "homing")
    assert "turns were wound" in record["reason"]
    assert_left_safe(tmp_path)


@pytest.mark.soak
def test_a_device_that_fails_during_the_run_leaves_zero_outputs_and_says_why(tmp_path, plugin):
    result = run_with(tmp_path, plugin, "unplugged", at=300)
    assert result.returncode == 1
    # The device cannot be closed either; the first cause is the one to report.
    assert result.stderr.splitlines()[-1] == ("rig: the device no longer answers; check its cable")
    folder = only_capture(tmp_path)
    record = record_of(folder)
    assert (record["status"], record["phase"]) == ("failed", "run")
    assert record["reason"] == "the device no longer answers; check its cable"
    assert_left_safe(tmp_path)
    recording = load(folder)
    assert 200 < len(recording.frame) <= 300
    assert "ended early: failed: the device no longer answers" in recording.warning


@pytest.mark.soak
def test_a_mistake_in_a_backend_leaves_zero_outputs_and_is_named(tmp_path, plugin):
    result = run_with(tmp_path, plugin, "bug", at=300)
    assert result.returncode == 1
    record = record_of(only_capture(tmp_path))
    assert record["status"] == "failed"
    assert "the backend failed in receive()" in record["reason"]
    assert "ZeroDivisionError: a mistake in the backend" in record["reason"]
    assert record["reason"] in result.stderr
    assert "Traceback" not in result.stderr
    assert_left_safe(tmp_path)


def test_a_current_beyond_its_limit_ends_the_run_with_its_sample_logged(tmp_path, plugin):
    # The brake's level of 0.14 V is 0.07 A.
    limits = {"limits": {"current": {"brake": 0.05}}}
    result = run_with(tmp_path, plugin, "", rig_changes=limits)
    assert result.returncode == 1
    assert "interlock in sample" in result.stderr and "limit of 0.05 A" in result.stderr
    folder = only_capture(tmp_path)
    record = record_of(folder)
    assert (record["status"], record["phase"]) == ("interlock", "run")
    frame = load(folder).frame
    flagged = np.flatnonzero(frame["flags"] & int(Flag.INTERLOCK))
    assert flagged.tolist() == [len(frame) - 1], "the tripping sample is the last"
    last = frame.iloc[-1]
    assert abs(last["current_brake"]) > 0.05
    assert last["applied_voltage_motor"] == 0.0 and last["applied_voltage_brake"] == 0.0
    assert f"interlock in sample {len(frame) - 1}:" in record["reason"]
    assert_left_safe(tmp_path)


def test_a_current_beyond_its_limit_before_the_run_is_an_interlock_too(tmp_path):
    # 0.3 V rms of noise is 0.15 A at the input.
    write_experiment(tmp_path / "e.yaml", calibration={"samples": 500})
    write_rig(tmp_path / "rig.yaml", options={"imperfections": {"noise": 0.3}})
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 1 and "interlock during calibration" in result.stderr
    record = record_of(only_capture(tmp_path))
    assert (record["status"], record["phase"]) == ("interlock", "calibration")


CROSSED = """
import dataclasses

from sim_rig.backend import SimulatedDevice


class Crossed(SimulatedDevice):
    def receive(self):
        raw = super().receive()
        return dataclasses.replace(raw, analog=raw.analog[:, [1, 0, 2]])
"""


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"sensors": {"current_motor": {"scale": 0.5, "sign": -1}}},
            "'sign: 1' of sensors.current_motor",
        ),
        (
            {"sensors": {"current_brake": {"scale": 1.0}}},
            "correct sensors.current_brake.scale",
        ),
        (
            {"backend": "crossed.py:Crossed"},
            "inputs or the outputs of the two channels are swapped",
        ),
        ({}, None),
    ],
    ids=["sign", "scale", "swapped", "right"],
)
def test_currents_that_do_not_follow_their_commands_are_named_with_the_cure(
    tmp_path, changes, message
):
    (tmp_path / "crossed.py").write_text(CROSSED)
    write_experiment(tmp_path / "e.yaml", calibration={"samples": 400})
    gains = {"motor": 0.5, "brake": 0.5}
    # So wide that what the limits on currents allow for noise hides the mistake during the run.
    limits = {"current": {"motor": 10.0, "brake": 10.0}}
    write_rig(tmp_path / "rig.yaml", amplifiers=gains, limits=limits, **changes)
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    warned = "amplifiers." in result.stderr
    assert (message in result.stderr) if message else not warned


BOASTING = """
import dataclasses

from sim_rig.backend import SimulatedDevice


class Boasting(SimulatedDevice):
    def open(self):
        return dataclasses.replace(super().open(), {change})
"""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("step_out=6.0", "limits.command.motor of the rig's file is -5 to 5 V"),
        ("step_out=0.2", "limits.command.brake of the rig's file is 0 to 0.38 V"),
        ("step_out=float('nan')", "nan for DeviceInfo.step_out"),
        ("step_out=float('inf')", "inf for DeviceInfo.step_out"),
        ("step_out=-0.01", "-0.01 for DeviceInfo.step_out"),
        ("queue=0", "0 for DeviceInfo.queue"),
    ],
)
def test_what_no_device_can_be_is_refused_before_anything_is_energised(tmp_path, change, message):
    (tmp_path / "boasting.py").write_text(BOASTING.format(change=change))
    write_experiment(tmp_path / "e.yaml")
    write_rig(tmp_path / "rig.yaml", backend="boasting.py:Boasting")
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    assert message in " ".join(result.stderr.split()), result.stderr
    assert rows_in(only_capture(tmp_path)) == 0


def test_an_interlock_that_only_the_device_saw_ends_the_run(tmp_path, plugin):
    result = run_with(tmp_path, plugin, "own interlock", at=150)
    assert result.returncode == 1
    assert "interlock in sample 150" in result.stderr
    assert record_of(only_capture(tmp_path))["status"] == "interlock"
    frame = load(only_capture(tmp_path)).frame
    assert len(frame) == 151 and frame["flags"].iloc[-1] & int(Flag.INTERLOCK)


def test_lost_samples_are_flagged_and_keep_their_place(tmp_path, plugin):
    allowed = {"limits": {"lost": 0.1}}
    result = run_with(tmp_path, plugin, "lost", at=100, rig_changes=allowed)
    assert result.returncode == 0, result.stderr
    assert "lost" in result.stdout, "the summary says that samples were lost"
    log = load(only_capture(tmp_path))
    ticks = log.frame["tick"].to_numpy()
    flagged = ticks[(log.frame["flags"] & int(Flag.LOST)) != 0]
    assert set(range(400)) - set(ticks) and len(flagged) >= 1
    np.testing.assert_allclose(log.frame["t"], ticks / 800)
    for tick in flagged:
        row = int(np.flatnonzero(ticks == tick)[0])
        assert ticks[row] > ticks[row - 1] + 1


def test_losing_the_last_samples_of_a_run_is_no_complete_run(tmp_path, plugin):
    result = run_with(tmp_path, plugin, "lost to the end", at=350)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    record = record_of(only_capture(tmp_path))
    assert record["status"] == "incomplete" and "are missing" in record["reason"]
    ticks = load(only_capture(tmp_path)).frame["tick"]
    assert ticks.max() < 400


@pytest.mark.parametrize(
    ("number", "said", "recorded"),
    mostly_soak(
        [
            (signal.SIGINT, BY_HAND, BY_HAND),
            (signal.SIGTERM, "SIGTERM", "SIGTERM"),
        ]
    ),
)
def test_a_signal_stops_a_run_in_real_time_with_its_log_whole(
    tmp_path, plugin, number, said, recorded
):
    write_experiment(tmp_path / "e.yaml", duration=30)
    write_rig(tmp_path / "rig.yaml", **merged(FAULTY, {"options": {"time": "real"}}))
    process, folder = run_in_progress(tmp_path, env=plugin)
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 1, errors
    assert f"stopped by {said}" in errors and "Traceback" not in errors
    record = record_of(folder)
    assert (record["status"], record["reason"]) == ("stopped", f"stopped by {recorded} during run")
    recording = load(folder)
    assert 50 <= len(recording.frame) < 24_000
    assert "ended early: stopped" in recording.warning
    assert_left_safe(tmp_path)


@pytest.mark.soak
def test_a_closed_terminal_stops_a_run_too(tmp_path, plugin):
    write_experiment(tmp_path / "e.yaml", duration=30)
    write_rig(tmp_path / "rig.yaml", **merged(FAULTY, {"options": {"time": "real"}}))
    process, folder = run_in_progress(tmp_path, env=plugin)
    process.send_signal(signal.SIGHUP)
    process.communicate(timeout=30)
    assert process.returncode == 1
    assert record_of(folder)["reason"] == "stopped by SIGHUP during run"
    assert_left_safe(tmp_path)


_CLOSED = """
import ctypes, sys, threading, time
from pathlib import Path
import daq.cli

def close():
    while not any(log.stat().st_size > 5000 for log in Path("runs").glob("*/log.csv")):
        time.sleep(0.01)
    ctypes.WinDLL("kernelbase").CtrlRoutine(2)  # as the console does, in a thread of the process

threading.Thread(target=close, daemon=True).start()
sys.argv = ["rig", "run", "e.yaml", "--rig", "rig.yaml"]
daq.cli.main()
"""


@pytest.mark.skipif(sys.platform != "win32", reason="windows of Windows")
def test_a_closed_window_stops_a_run_before_windows_ends_the_process(tmp_path, plugin):
    write_experiment(tmp_path / "e.yaml", duration=30)
    write_rig(tmp_path / "rig.yaml", **merged(FAULTY, {"options": {"time": "real"}}))
    words = [sys.executable, "-c", _CLOSED]
    subprocess.run(words, cwd=tmp_path, env=environment(**plugin), timeout=60, check=False)
    record = record_of(only_capture(tmp_path))
    assert (record["status"], record["reason"]) == (
        "stopped",
        "stopped by a closed window during run",
    )
    assert record["outputs"]["confirmed"]
    assert_left_safe(tmp_path)


@pytest.mark.soak
def test_a_signal_while_the_load_is_wound_is_recorded_with_its_phase(tmp_path):
    write_experiment(tmp_path / "e.yaml", homing={"turns": 20, "timeout": 60})
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    process = start_rig("run", "e.yaml", "--rig", "rig.yaml", "--json", cwd=tmp_path)
    folder = until(lambda: next(iter((tmp_path / "runs").glob("*/log.csv")), None), "a log").parent
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=30)
    assert process.returncode == 1, errors
    (mistake,) = json.loads(out)["errors"]
    assert mistake["error"] == f"stopped by {BY_HAND}"
    record = record_of(folder)
    assert record["status"] == "stopped" and record["phase"] in {"open", "calibration", "homing"}
    with pytest.raises(ConfigError, match="holds 0 samples"):
        load(folder)


def test_rows_reach_the_file_while_the_run_is_going_on(tmp_path):
    write_experiment(tmp_path / "e.yaml", duration=30)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    process, folder = run_in_progress(tmp_path, rows=20)
    try:
        for more in (100, 200, 300):
            until(lambda least=more: rows_in(folder) >= least, f"{more} rows")
            assert process.poll() is None
        assert record_of(folder)["status"] == "running"
        assert "still running" in load(folder).warning
    finally:
        process.kill()
        process.communicate()


def test_json_of_a_run_names_folder_and_timing(tmp_path):
    write_experiment(tmp_path / "e.yaml")
    result = rig("run", "e.yaml", "--json", cwd=tmp_path)
    document = json.loads(result.stdout)
    assert document["run"]["samples"] == 400 and document["validation"] is None
    assert document["run"]["folder"] == str(only_capture(tmp_path).relative_to(tmp_path))
