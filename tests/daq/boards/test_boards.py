"""Rigs on cards of other makers: faults, lateness, watchdogs, the phase, and the command."""

import json
import os
import signal

import numpy as np
import pytest

from daq.boards import loopback
from daq.errors import ConfigError, DeviceError
from daq.hal import Flag, Mode
from tests.daq.boards.support import environment, fakes, nidaqmx, quanser
from tests.daq.hal_contract import RATE, guard_of, levels
from tests.daq.support import (
    journal_of,
    only_capture,
    record_of,
    rig,
    run_in_progress,
    write_experiment,
    write_rig,
    write_yaml,
)

CARDS = {"quanser": quanser, "nidaqmx": nidaqmx}
OPEN, CLOSED = Mode.OPEN_LOOP, Mode.CLOSED_LOOP
both_cards = pytest.mark.parametrize("make", list(CARDS.values()), ids=list(CARDS))


def life(device, mode=OPEN, blocks=6):
    """Everything that a run does with a device."""
    device.open()
    for _ in range(2):
        device.start(RATE, mode, guard_of())
        device.send(0, levels(200, motor=0.3, brake=0.1))
        for _ in range(blocks):
            device.receive()
        device.safe()
        device.receive()
        device.stop()
    device.close()


def calls_of_a_life(make, **options):
    with fakes() as bench_world:
        life(make(**options))
        (world,) = bench_world._worlds.values()
        return dict(world.calls)


@pytest.mark.parametrize(
    ("make", "playback"),
    [
        (quanser, "host"),
        pytest.param(quanser, "board", marks=pytest.mark.soak),
        pytest.param(nidaqmx, "host", marks=pytest.mark.soak),
        pytest.param(nidaqmx, "board", marks=pytest.mark.soak),
    ],
)
def test_a_card_that_is_gone_at_any_call_is_an_error_in_words_and_never_another(make, playback):
    calls = calls_of_a_life(make, playback=playback)
    assert sum(calls.values()) > 60
    tried = 0
    for method, count in calls.items():
        if method == "close":
            continue
        for at in sorted({1, count}):
            with fakes(fault=(method, at)):
                device = make(playback=playback)
                try:
                    life(device)
                except DeviceError as error:
                    assert "failed" in str(error) and error.cure, method
                    assert "Traceback" not in str(error)
                # What it was in the middle of, it says nothing of zeros that it did not see.
                device.safe()
                if device._facts is not None:
                    assert "could not be zeroed" in device.report()["warnings"][0]
                with pytest.raises(DeviceError):
                    device.close()
                    device.receive()
                device.close()
                device.safe()
            tried += 1
    assert tried > 20


@pytest.mark.parametrize(
    ("make", "method"), [(quanser, "write_analog"), (nidaqmx, "write_one_sample")]
)
def test_a_stop_of_which_a_step_fails_takes_all_others(make, method):
    with fakes(once=True) as bench_world:
        device = make()
        device.open()
        device.start(RATE, CLOSED, guard_of())
        device.send(0, levels(20))
        device.receive()
        (world,) = bench_world._worlds.values()
        # Behind the zeros of safe: those of the stop itself.
        world.settings.fault = (method, world.calls[method] + 2)
        with pytest.raises(DeviceError, match="failed"):
            device.stop()
        assert not world.readers and not world.armed
        device.start(RATE, CLOSED, guard_of())
        device.send(0, levels(20, motor=0.1))
        assert device.receive().applied[0, 0] == 0.1


@both_cards
@pytest.mark.parametrize("mode", [OPEN, CLOSED])
def test_outputs_move_only_while_a_watchdog_would_zero_them(make, mode, tmp_path):
    journal = tmp_path / "journal"
    with fakes(journal=str(journal)):
        life(make(), mode)
    armed, moved = None, 0
    for entry in journal_of(journal):
        if entry["what"] == "armed":
            assert entry["states"] == [0.0, 0.0] and entry["watchdog"] == 0.1
            armed = entry["watchdog"]
        elif entry["what"] == "disarmed":
            armed = None
        elif any(entry["volts"]):
            assert armed is not None
            moved += 1
    assert moved >= 2


@both_cards
@pytest.mark.parametrize("playback", ["board", "host"])
def test_a_waveform_that_ends_leaves_zeros_and_not_its_last_volts(make, playback):
    with fakes() as bench_world:
        device = make(playback=playback)
        device.open()
        device.start(RATE, OPEN, guard_of())
        device.send(0, levels(100, motor=0.5))
        ticks = 0
        while ticks < 400:
            ticks += len(device.receive().tick)
        (world,) = bench_world._worlds.values()
    on = [time for time, volts in world.history if volts[0] == 0.5]
    off = next(time for time, volts in world.history if time > on[0] and not any(volts))
    assert off - on[0] == pytest.approx(100 / RATE)
    assert not world.outputs.any()


@both_cards
def test_a_host_that_falls_silent_is_stopped_by_the_watchdog(make):
    with fakes() as bench_world:
        device = make()
        device.open()
        device.start(RATE, OPEN, guard_of())
        device.send(0, levels(4000, motor=0.3))
        device.receive()
        (world,) = bench_world._worlds.values()
        assert world.outputs.tolist() == [0.3, 0.0]
        world.pass_time(0.3)
        world.sync()
        assert world.outputs.tolist() == [0.0, 0.0]
        with pytest.raises(DeviceError, match=r"0\.1 s.*options\.watchdog.*rig doctor"):
            device.receive()
        # And a new start works again.
        device.start(RATE, OPEN, guard_of())
        device.send(0, levels(200, motor=0.2))
        assert device.receive().applied[0, 0] == 0.2
        assert world.outputs.tolist() == [0.2, 0.0]


@both_cards
def test_a_card_without_a_watchdog_is_refused_until_that_is_accepted(make):
    with fakes(watchdog=False):
        with pytest.raises(DeviceError, match=r"not supported.*watchdog: null.*switch"):
            make().open()
        device = make(watchdog=None)
        device.open()
        device.start(RATE, CLOSED, guard_of())
        device.send(0, levels(5))
        device.receive()
        texts = [caveat.text for caveat in device.caveats()]
        assert any("may stay at their last volts" in text for text in texts)
        assert texts == device.report()["cannot_promise"]


@both_cards
@pytest.mark.parametrize("phase", [-2, -1, 0, 1, 3])
def test_outputs_that_come_behind_inputs_are_shifted_into_their_ticks(make, phase):
    commands = np.repeat(np.random.default_rng(4).uniform(-0.5, 0.5, (40, 1)), 5, axis=0)
    commands = np.hstack([commands, np.zeros_like(commands)])
    with fakes(phase=phase, loopback="wire"):
        device = make(phase=phase)
        device.open()
        device.start(RATE, OPEN, guard_of())
        device.send(0, commands)
        blocks = [device.receive() for _ in range(30)]
    shown = np.concatenate([block.analog for block in blocks])[:200, 0]
    ticks = np.concatenate([block.tick for block in blocks])
    assert np.array_equal(ticks, np.arange(len(ticks)))
    # Row k + 1 shows the command of row k.
    assert np.array_equal(shown[1:], commands[:199, 0])


@pytest.mark.parametrize(
    "phase",
    [0.2, *(pytest.param(value, marks=pytest.mark.soak) for value in (-1.0, 2.1))],
)
def test_the_phase_is_measured_by_a_loop_back(phase):
    with fakes(phase=phase, loopback="rc"):
        device = quanser(phase=None)
        device.open()
        delays = device.measure_phase()
        device.close()
    assert len(delays) == loopback.STARTS
    np.testing.assert_allclose(delays, phase, atol=0.02)
    assert loopback.phase(delays) == int(np.floor(phase))


def test_outputs_of_a_card_of_national_instruments_come_behind_all_conversions():
    with fakes(loopback="rc"):
        device = nidaqmx(phase=None, delay=2e-4)
        device.open()
        # 0.2 ms, of a sample at 1 kHz.
        np.testing.assert_allclose(device.measure_phase(), 0.2, atol=0.02)


@pytest.mark.soak
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"phase": [0, 1, 0, 2], "loopback": "rc"}, "another delay at each start"),
        ({"phase": 0.5, "loopback": "rc"}, r"change 0\.50 of a sample behind"),
        ({"loopback": "wire"}, "is no RC"),
    ],
)
def test_a_phase_that_cannot_be_relied_on_is_refused(settings, words):
    with fakes(**settings), pytest.raises(DeviceError, match=words) as raised:
        device = quanser(phase=None)
        device.open()
        loopback.phase(device.measure_phase())
    assert "playback: host" in raised.value.cure or "100 nF" in raised.value.cure


@both_cards
def test_without_a_phase_only_the_host_plays(make):
    with fakes():
        device = make(phase=None)
        device.open()
        with pytest.raises(ConfigError, match=r"options\.phase.*--loopback.*playback: host"):
            device.start(RATE, OPEN, guard_of())
        device.start(RATE, CLOSED, guard_of())
        device = make(phase=None, playback="host")


def test_samples_that_a_card_lost_are_a_gap():
    with fakes() as bench_world:
        device = quanser(buffer=256, watchdog=None)
        device.open()
        device.start(RATE, CLOSED, guard_of())
        device.send(0, levels(50))
        ticks = [int(device.receive().tick[0]) for _ in range(10)]
        bench_world.world("qpid").pass_time(400 / RATE)
        ticks += [int(device.receive().tick[0]) for _ in range(300)]
    assert ticks[:10] == list(range(10))
    assert ticks[10] == 10 + 400 - 256
    assert (np.diff(ticks[10:]) == 1).all()


def test_a_card_that_does_not_overwrite_ends_the_run_where_samples_are_lost():
    with fakes(overwrites=False) as bench_world:
        device = quanser(buffer=256, watchdog=None)
        device.open()
        device.start(RATE, CLOSED, guard_of())
        device.receive()
        bench_world.world("qpid").pass_time(400 / RATE)
        with pytest.raises(DeviceError, match="reading samples failed: The buffer has overflowed"):
            device.receive()


@both_cards
def test_a_command_that_comes_too_late_is_held_and_never_played(make):
    with fakes() as bench_world:
        device = make(watchdog=None)
        device.open()
        device.start(RATE, CLOSED, guard_of())
        device.send(0, np.arange(60)[:, np.newaxis] * [0.01, 0.0])
        rows = [device.receive() for _ in range(20)]
        (world,) = bench_world._worlds.values()
        world.pass_time(10.5 / RATE)
        rows += [device.receive() for _ in range(30)]
    applied = np.concatenate([row.applied for row in rows])[:, 0]
    held = np.array([bool(row.flags[0] & int(Flag.HELD)) for row in rows])
    # Tick 29 was half over by then: its command is late, but still its own.
    assert held.tolist() == [20 <= k < 29 for k in range(50)]
    expected = [0.19 if 20 <= k < 29 else 0.01 * k for k in range(50)]
    np.testing.assert_allclose(applied, expected, atol=1e-12)
    volts = [round(volts[0], 9) for _, volts in world.history]
    assert not {round(0.01 * k, 9) for k in range(20, 29)} & set(volts)


@both_cards
def test_how_late_commands_come_is_recorded(make):
    with fakes() as bench_world:
        device = make(watchdog=None)
        device.open()
        device.start(RATE, CLOSED, guard_of())
        device.send(0, levels(300))
        (world,) = bench_world._worlds.values()
        for k in range(200):
            if k == 100:
                world.pass_time(1.2 / RATE)
            device.receive()
        device.stop()
    delays = device.report()["command_delay_seconds"]
    assert delays["median"] == pytest.approx(0.0, abs=1e-6)
    assert delays["largest"] == pytest.approx(0.2 / RATE, rel=5e-3)


def test_a_waveform_that_the_host_plays_too_late_ends_in_zeros():
    with fakes() as bench_world:
        device = quanser(playback="host", watchdog=None)
        device.open()
        device.start(RATE, OPEN, guard_of())
        device.send(0, levels(100, motor=0.3))
        device.receive()
        (world,) = bench_world._worlds.values()
        world.pass_time(5 / RATE)
        row = device.receive()
        assert row.flags[0] & int(Flag.UNDERFLOW) and not row.applied.any()
        assert not world.outputs.any()
        assert not any(device.receive().applied.any() for _ in range(20))


def test_a_count_that_runs_over_goes_on():
    with fakes() as bench_world:
        device = nidaqmx()
        device.open()
        device.start(RATE, CLOSED, guard_of())
        device.send(0, levels(2000, motor=-2.0))
        counts = np.concatenate([device.receive().counts for _ in range(200)])
        # Below zero the card's counter of 32 bits shows 4294967295.
        (world,) = bench_world._worlds.values()
        assert counts[-1] < -100 and np.abs(np.diff(counts)).max() < 1000
        assert counts[-1] == pytest.approx(np.floor(world.count), abs=100)


def test_a_rate_that_the_clock_of_a_card_cannot_have_is_refused():
    with fakes():
        device = nidaqmx()
        device.open()
        device.start(97_000.0, CLOSED, guard_of())
        with pytest.raises(DeviceError, match=r"cannot be divided.*96993\.2105 Hz.*sample_rate"):
            device.receive()


# --- the command -----------------------------------------------------------------------------

REAL = {"time": "real"}


def rig_file(path, backend="quanser", **changes):
    options = {"phase": 0, "watchdog": 1.0, **changes}
    return write_rig(path / "rig.yaml", backend=backend, name=f"{backend} rig", options=options)


def without_seed(path):
    text = path.read_text("utf-8")
    path.write_text("\n".join(line for line in text.splitlines() if "seed:" not in line))
    return path


@pytest.mark.parametrize(
    ("backend", "words"),
    [
        ("quanser", ["Quanser SDK", "docs/boards.md"]),
        ("nidaqmx", ["nidaqmx", "install"]),
    ],
)
def test_a_missing_library_is_said_with_status_2_and_only_a_run_needs_it(tmp_path, backend, words):
    write_experiment(tmp_path / "e.yaml")
    without_seed(rig_file(tmp_path, backend))
    checked = rig("check", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert checked.returncode == 0, checked.stderr
    assert "Caveat: this backend has been tested on a simulated card" in checked.stdout
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 2
    assert all(word in result.stderr for word in words) and "Traceback" not in result.stderr


@pytest.mark.parametrize("backend", list(CARDS))
def test_a_run_on_a_fake_card_is_recorded_with_what_cannot_be_promised(tmp_path, backend):
    write_experiment(tmp_path / "e.yaml")
    without_seed(rig_file(tmp_path, backend))
    env = environment(**REAL)
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path, env=env)
    assert result.returncode == 0, result.stderr
    record = record_of(only_capture(tmp_path))
    assert record["status"] == "completed" and record["outputs"]["confirmed"]
    assert not record["timing"].get("flags")
    connection = record["connection"]
    assert any("never on hardware" in text for text in connection["cannot_promise"])


def test_an_open_loop_without_a_measured_phase_is_refused_before_anything(tmp_path):
    write_experiment(tmp_path / "e.yaml")
    without_seed(rig_file(tmp_path, phase=None))
    for command in ("check", "run"):
        result = rig(command, "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
        assert result.returncode == 2
        assert "rig.yaml: options.phase: it is not measured" in result.stderr
        assert "rig doctor --rig FILE --loopback" in result.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "ending", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.soak)]
)
def test_a_signal_zeroes_the_outputs_of_a_card(tmp_path, ending):
    write_experiment(tmp_path / "e.yaml", duration=60)
    without_seed(rig_file(tmp_path))
    env = environment(**REAL, journal=str(tmp_path / "journal"))
    process, _ = run_in_progress(tmp_path, rows=100, env=_whole(env))
    process.send_signal(ending)
    _, said = process.communicate(timeout=60)
    assert process.returncode not in (0, 2)
    assert "both outputs are zero: read back from the device" in said
    outputs = [entry for entry in journal_of(tmp_path / "journal") if entry["what"] == "outputs"]
    assert any(outputs[-2]["volts"]) and not any(outputs[-1]["volts"])


@pytest.mark.parametrize("backend", ["quanser", pytest.param("nidaqmx", marks=pytest.mark.soak)])
def test_a_killed_host_leaves_an_armed_watchdog_behind(tmp_path, backend):
    write_experiment(tmp_path / "e.yaml", duration=60)
    without_seed(rig_file(tmp_path, backend))
    env = environment(**REAL, journal=str(tmp_path / "journal"))
    process, _ = run_in_progress(tmp_path, rows=100, env=_whole(env))
    process.kill()
    process.communicate(timeout=60)
    entries = journal_of(tmp_path / "journal")
    # The card's own timer does the rest: it was armed, with zeros, and nobody has disarmed it.
    assert any(entries[-1].get("volts", [1.0]))
    timers = [entry for entry in entries if entry["what"] in ("armed", "disarmed")]
    assert timers[-1]["what"] == "armed" and timers[-1]["states"] == [0.0, 0.0]


def test_a_card_that_is_unplugged_ends_a_run_that_says_what_is_not_known(tmp_path):
    write_experiment(tmp_path / "e.yaml")
    without_seed(rig_file(tmp_path))
    env = environment(**REAL, fault=("task_read", 40))
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path, env=env)
    assert result.returncode == 1
    assert "reading samples failed" in result.stderr and "Traceback" not in result.stderr
    assert "switch off the amplifier: zero outputs are not confirmed" in result.stderr


@pytest.mark.soak
def test_doctor_measures_the_phase_and_says_what_to_write(tmp_path):
    without_seed(rig_file(tmp_path, phase=None, watchdog=None))
    env = environment(phase=1, loopback="rc")
    command = ("doctor", "--rig", "rig.yaml", "--loopback", "--json", "--wakes", 200)
    result = rig(*command, cwd=tmp_path, env=env)
    assert result.returncode in (0, 1), result.stderr  # by what the computer is like
    checks = {check["what"]: check for check in json.loads(result.stdout)["checks"]}
    assert checks["outputs"]["verdict"] == "good"
    assert "phase: 1" in checks["outputs"]["cure"]
    promises = [c["found"] for c in json.loads(result.stdout)["checks"] if c["what"] == "promise"]
    assert any("last volts" in text for text in promises)


def test_doctor_asks_no_loop_back_of_other_rigs(tmp_path):
    result = rig("doctor", "--rig", "simulated.yaml", "--loopback", cwd=tmp_path)
    assert result.returncode == 2 and "no card of another maker" in result.stderr
    result = rig("doctor", "--loopback", cwd=tmp_path)
    assert result.returncode == 2 and "add --rig" in result.stderr


@pytest.mark.parametrize("backend", list(CARDS))
def test_a_first_evening_begins_with_the_doctor(tmp_path, backend):
    result = rig("init", "lab", "--rig", backend, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "1. rig doctor --rig rig.yaml" in result.stdout and "rig ports" not in result.stdout
    text = (tmp_path / "lab/rig.yaml").read_text("utf-8")
    assert "  # phase: 0" in text and "motor: [-0.5, 0.5]" in text


@pytest.mark.skipif(
    not os.environ.get("RIG_REAL_TIME_TESTS"),
    reason="it keeps the clock's pace on a machine with nothing else to do; RIG_REAL_TIME_TESTS=1",
)
@pytest.mark.parametrize("backend", list(CARDS))
def test_the_shipped_experiment_is_identified_on_a_fake_card(tmp_path, backend):
    env = environment(**REAL, hand=[2, 5], let_down=[4])
    text = (tmp_path / "lab").mkdir() or rig("init", "lab", "--rig", backend, cwd=tmp_path)
    assert text.returncode == 0, text.stderr
    from daq.lookup.shipped import shipped_files

    shipped = shipped_files("backend")[f"{backend}.yaml"].read_text("utf-8")
    measured = shipped.replace("  # phase: 0", "  phase: 0").replace("watchdog: 0.1", "watchdog: 1")
    (tmp_path / "rig.yaml").write_text(measured)
    write_yaml(tmp_path / "id.yaml", {"model": "actuator", "seed": 1})
    args = ("run", "prbs.yaml", "--rig", "rig.yaml", "--identify", "--json")
    result = rig(*args, cwd=tmp_path, env=env, timeout=300)
    assert result.returncode == 0, result.stderr
    from sim_rig.actuator import actuator

    truth = actuator(parameters="rig")
    true = dict(zip(truth.parameter_names, truth.nominal, strict=True))
    document = json.loads(result.stdout)["identification"]
    for name in ("R_m", "K_m", "gamma"):
        row = document["parameters"][name]
        low, high = row["interval"]
        assert low <= true[name] <= high, (name, row, true[name])


def _whole(env):
    return {**os.environ, **env, "PYTHONWARNINGS": "error", "NO_COLOR": "1"}
