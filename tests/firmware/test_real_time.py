"""The firmware's ELF in QEMU in real time on a pty, by ``rig emulate --firmware``.

A busy machine keeps QEMU waiting, now and then for longer than the protocol allows. What fails is
tried again on load alone (``patience``). Among all other tests those are the load: these run where
``RIG_REAL_TIME_TESTS`` asks for them, alone.
"""

import os
import signal
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from daq.config.rig import RigConfig
from daq.device_code import device_code
from daq.experiment import Sample
from daq.lookup.controllers import load_controller
from daq.lookup.shipped import find_file
from daq.serial.backend import SerialDevice, SerialOptions
from tests.daq.hal_contract import Bench, HalContract
from tests.daq.serial.support import emulator
from tests.daq.support import few_free, record_of, rig, rows_in, start_rig, until, write_yaml
from tests.daq.test_hal import _exact_currents
from tests.firmware import lockstep, patience
from tests.firmware.build import make, needs

pytestmark = pytest.mark.skipif(
    not os.environ.get("RIG_REAL_TIME_TESTS"),
    reason="in real time, beside no other tests: RIG_REAL_TIME_TESTS=1 pytest -n 0 tests/firmware",
)

RESOLUTION, NOISE = 1.6e-4, 0.05
WATCHDOG = 2.0  # s
CONTROLLER = "simulated_controller.yaml"


@pytest.fixture(scope="module")
def elf():
    needs("make", "arm-none-eabi-gcc", "qemu-system-arm")
    return lockstep.elf()


@pytest.fixture(scope="module")
def port(elf, tmp_path_factory):
    with emulated(elf, tmp_path_factory.mktemp("qemu"), seed=5) as running:
        patience.watch(running)
        # QEMU looks for a host once a second; to whom a pty stays open it does not lose its line.
        line = os.open(running.port, os.O_RDWR | os.O_NOCTTY)
        yield running.port
        os.close(line)


def emulated(elf, folder, **plant):
    return emulator(folder, "--firmware", elf, plant=plant)


@pytest.mark.soak
@pytest.mark.patient
class TestFirmware(HalContract):
    @pytest.fixture
    def bench(self, port):
        return Bench(
            name=f"firmware in QEMU on {port}",
            make=lambda: SerialDevice(SerialOptions(port=port, watchdog=WATCHDOG)),
            config=RigConfig(),
            resolution=RESOLUTION,
            noise=NOISE,
            slow=True,
        )

    @pytest.fixture
    def actuator_currents(self):
        return _exact_currents


# Shorter than the shipped one, so that it takes seconds; the same signals. Without homing: that
# closes a loop, by 21 kB/s at 800 Hz, and QEMU hands over 10.
SHORT = {"duration": 4, "calibration": {"samples": 200}, "homing": None}
FREE = {"seed": 5, "plant": {"load": "free", "sensor": "between"}}
NO_CABLE = {"travel": None, "winding": None}
# By each of the signals, in either direction of the wire; all that are free take a minute.
TOLD = ("R_m", "K_m", "R_b", "L_b", "J_m", "alpha0")


def changed(kind, name, path, **changes):
    content = yaml.safe_load(find_file(kind, name).read_text(encoding="utf-8"))
    for key in [key for key, value in changes.items() if value is None]:
        del content[key], changes[key]
    return write_yaml(path, content, **changes)


@pytest.mark.soak
def test_an_identification_on_it_is_that_of_the_simulated_rig(elf, tmp_path):
    """``rig run prbs.yaml --rig serial.yaml --port ...``, and without the wire, identified."""
    experiment = changed("protocol", "prbs.yaml", tmp_path / "prbs.yaml", **SHORT)
    serial = changed(
        "backend", "serial.yaml", tmp_path / "serial.yaml", options={"watchdog": 2}, limits=NO_CABLE
    )
    simulated = changed(
        "backend", "simulated.yaml", tmp_path / "simulated.yaml", options=FREE, limits=NO_CABLE
    )

    def wired():
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        with emulated(elf, folder / "qemu", **FREE) as running:
            patience.watch(running)
            recorded(experiment, "--rig", serial, "--port", running.port, folder=folder)
        return folder

    there = identified(patience.on_load(wired))
    (tmp_path / "direct").mkdir()
    recorded(experiment, "--rig", simulated, folder=tmp_path / "direct")
    here = identified(tmp_path / "direct")
    assert there.keys() == here.keys() == set(TOLD)
    apart = {
        name: (there[name], here[name]) for name in TOLD if not overlap(there[name], here[name])
    }
    assert not apart


@pytest.mark.soak
def test_its_own_torque_controller_answers_a_run(tmp_path):
    """``rig run`` with ``on_device``: what was applied is what the same law in Python answers."""
    needs("make", "arm-none-eabi-gcc", "qemu-system-arm")
    (tmp_path / "law").mkdir()
    device_code(CONTROLLER, "single").save(tmp_path / "law", "law")
    elf = make(BOARD="qemu", LAW=tmp_path / "law") / "qemu-law" / "rig.elf"
    experiment = changed(
        "protocol", "torque_tracking.yaml", tmp_path / "e.yaml",
        on_device=True, duration=3, calibration={"samples": 200},
    )  # fmt: skip
    serial = changed(
        "backend", "serial.yaml", tmp_path / "serial.yaml", options={"watchdog": 2}, limits=NO_CABLE
    )
    hand = {"seed": 5, "plant": {"load": "hand"}, "hand": [[0.5, 1.0], [1.5, -1.0]]}

    def wired():
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        with emulated(elf, folder / "qemu", **hand) as running:
            patience.watch(running)
            recorded(experiment, "--rig", serial, "--port", running.port, folder=folder)
        return next(folder.glob("runs/*/log.csv"))

    log = pd.read_csv(patience.on_load(wired))
    tuned = load_controller(CONTROLLER, tmp_path)
    law, fields = tuned.law(), [name for name in Sample._fields if name in log]
    rows = log[fields].to_dict("records")
    samples = (Sample(time=t, **row) for t, row in zip(log.t, rows, strict=True))
    answers = np.array([law.volts(*each) for each in zip(samples, log.torque_ref, strict=True)])
    applied = log[["applied_voltage_motor", "applied_voltage_brake"]].to_numpy()
    blend = 40  # samples at either end
    error = np.abs(applied[blend + 1 : -blend] - answers[blend : -blend - 1])
    assert (error.max(axis=0) < 1e-3 * np.array(tuned.most_volts)).all()
    assert np.abs(answers[:, 0]).max() > 0.5
    assert (log["flags"] == 128).all()
    steps = np.abs(np.diff(applied[-blend:, 0], append=0.0))
    assert steps.max() < 1.5 * np.abs(applied[-blend, 0]) / blend + 1e-3, "it went without a jump"


@pytest.mark.soak
def test_the_shipped_experiment_runs_on_it_homing_and_all(elf, tmp_path):
    rate = 200  # Hz, at which QEMU keeps up with a closed loop
    changes = {"sample_rate": rate, "calibration": {"samples": rate}}
    experiment = changed("protocol", "prbs.yaml", tmp_path / "prbs.yaml", **changes)
    serial = changed("backend", "serial.yaml", tmp_path / "serial.yaml", options={"watchdog": 1})

    def wired():
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        with emulated(elf, folder / "qemu", seed=5) as running:
            patience.watch(running)
            recorded(experiment, "--rig", serial, "--port", running.port, folder=folder)
        return folder, running.journal

    folder, journal = patience.on_load(wired)
    (run,) = folder.glob("runs/*/")
    record = record_of(run)
    assert record["status"] == "completed" and record["outputs"]["confirmed"]
    assert record["timing"]["late"]["commands"] == 0 and rows_in(run) == 1.25 * rate
    phases = [entry["phase"] for entry in journal]
    assert phases.index("homing") < phases.index("run")
    assert journal[-1]["outputs"] == [0, 0]


def recorded(*words, folder):
    """``rig run`` with its runs in a folder."""
    done = rig("run", *words, "--out", folder / "runs", cwd=folder)
    assert done.returncode == 0, done.stderr


def identified(folder):
    """Intervals with two ends, by name, of a folder's one log."""
    (log,) = folder.glob("runs/*/log.csv")
    model = "actuator:" + ",".join(f"{name}={value}" for name, value in FREE["plant"].items())
    settings = write_yaml(folder / "id.yaml", few_free(*TOLD, **FREE["plant"]) | {"model": model})
    words = ("identify", log, "--config", settings, "--out", folder)
    done = rig(*words, cwd=folder, timeout=600)
    assert done.returncode == 0, done.stderr
    (file,) = folder.glob("**/parameters.yaml")
    rows = yaml.safe_load(file.read_text("utf-8"))["parameters"]
    intervals = {name: row.get("interval") for name, row in rows.items()}
    return {name: ends for name, ends in intervals.items() if ends and None not in ends}


def overlap(a, b):
    return a[0] <= b[1] and b[0] <= a[1]


@pytest.mark.soak
@pytest.mark.patient
def test_a_host_that_is_killed_leaves_zero_outputs(elf, tmp_path):
    with emulated(elf, tmp_path / "qemu", **FREE) as running:
        patience.watch(running)
        serial = changed(
            "backend",
            "serial.yaml",
            tmp_path / "serial.yaml",
            options={"port": running.port, "watchdog": 0.3},
            limits=NO_CABLE,
        )
        experiment = changed("protocol", "prbs.yaml", tmp_path / "prbs.yaml", **SHORT)
        process = start_rig("run", experiment, "--rig", serial, cwd=tmp_path)
        try:
            until(lambda: moving(running.journal), "outputs that are not zero")
        finally:
            process.kill()
            process.communicate()
        until(lambda: not moving(running.journal), "zero outputs")
        last = running.journal[-1]
        assert last["latch"] == "WATCHDOG" and last["outputs"] == [0, 0]


def moving(journal):
    return bool(journal) and any(journal[-1]["outputs"])


@pytest.fixture
def rehearsal(elf, tmp_path):
    """``rig emulate --firmware`` in a group of its own, and the number of its QEMU."""
    process = start_rig("emulate", "--firmware", elf, cwd=tmp_path, start_new_session=True)
    try:
        assert process.stdout.readline().startswith("/dev/pts/"), process.communicate()[1]
        children = (
            Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text("utf-8").split()
        )
        yield process, int(children[0])
    finally:
        process.kill()
        process.communicate()


@pytest.mark.soak
def test_ctrl_c_ends_it_even_where_qemu_stands_still(rehearsal):
    process, qemu = rehearsal
    os.kill(qemu, signal.SIGSTOP)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=15)
    assert process.returncode == 0 and "QEMU" not in errors, errors
    assert not Path(f"/proc/{qemu}").exists()


@pytest.mark.soak
def test_a_qemu_that_is_killed_is_told_in_words(rehearsal):
    process, qemu = rehearsal
    os.kill(qemu, signal.SIGKILL)
    _, errors = process.communicate(timeout=15)
    assert process.returncode == 1 and "QEMU with the firmware ended: by signal 9" in errors
    assert "Traceback" not in errors


def test_what_the_emulator_has_and_the_firmware_not_is_refused(tmp_path):
    missing = tmp_path / "rig.elf"
    result = rig("emulate", "--firmware", missing, cwd=tmp_path)
    assert result.returncode == 2 and "there is no such file" in result.stderr
    assert "make -C firmware BOARD=qemu" in result.stderr
    result = rig("emulate", "--firmware", missing, "--fault", "mute", cwd=tmp_path)
    assert result.returncode == 2 and "--fault" in result.stderr
    missing.write_bytes(b"no program")
    result = rig("emulate", "--firmware", missing, cwd=tmp_path, env={"PATH": "/nowhere"})
    assert result.returncode == 2 and "apt install qemu-system-arm" in result.stderr


def test_a_file_that_is_no_firmware_ends_in_words(tmp_path):
    needs("qemu-system-arm")
    wrong = tmp_path / "rig.elf"
    wrong.write_bytes(bytes(64))
    result = rig("emulate", "--firmware", wrong, cwd=tmp_path)
    assert result.returncode == 1 and "QEMU with the firmware ended" in result.stderr
    assert "Traceback" not in result.stderr
