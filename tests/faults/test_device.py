"""The independent device itself: it keeps the contract, and without a fault it runs everything."""

import contextlib
import functools
import itertools
import json
import re
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from daq.config.rig import RigConfig
from daq.diagnose import currents
from daq.errors import DeviceError
from daq.hal import Mode, Phase, RawSamples
from daq.lookup.shipped import find_file
from daq.recording.session import open_session
from daq.rig import Rig
from daq.run.runner import run_experiment
from daq.run.sampling import at_rest
from daq.serial.backend import SerialDevice, SerialOptions
from tests.daq.hal_contract import Bench, HalContract, guard_of
from tests.daq.support import only_capture, record_of, rig, write_yaml
from tests.faults import line, serial_device
from tests.faults.board import Setting
from tests.faults.device import Options, VirtualDevice
from tests.faults.faults import FAULTS, VIRTUAL
from tests.faults.plant import COUNTS, Plant, draw
from tests.faults.serial_device import serving
from tests.soak import mostly_soak

DEVICE = Path(__file__).parent / "device.py"
PAGE = Path(__file__).parents[2] / "docs" / "serial-protocol.md"

QUICK = {"calibration": {"samples": 80}, "homing": {"turns": 0.5}}
EXCITATIONS = {
    "prbs.yaml": {"duration": 0.5},
    "multisine.yaml": {"periods": 1, "draws": 2},
    "steps.yaml": {"brake": {"levels": [0.05]}},
    "chirp.yaml": {"duration": 0.5},
    "sine.yaml": {"duration": 0.5},
}  # fmt: skip
LOOPS = {
    "constant_velocity.yaml": {
        "velocities": [20, -60], "brake_commands": [0.04], "measure": 0.2, "turns": 0.1,
    },
    "hysteresis_loop.yaml": {"brake_commands": [0.06], "cycles": 3, "period": 0.5},
}  # fmt: skip
# Loops that a busy machine closes in time.
SLOW_LOOP = {
    "sample_rate": 100,
    "speed_filter": 30,
    "loop": {"proportional": 0.02, "integral": 0.3},
}
LEISURE = {"constant_velocity.yaml": SLOW_LOOP | {"velocities": [20], "slope": 20}}


def changed(kind, name, folder, **changes):
    """A shipped file with other values of some keys; its path."""
    content = yaml.safe_load(find_file(kind, name).read_text(encoding="utf-8"))
    return write_yaml(folder / name, content, **changes)


def quick(name, folder, **others):
    """A shipped experiment that takes seconds."""
    changes = {**EXCITATIONS, **LOOPS}[name] | others
    if name == "constant_velocity.yaml":
        return changed("protocol", name, folder, calibration=QUICK["calibration"], **changes)
    return changed("protocol", name, folder, **QUICK, **changes)


def rig_file(folder, **options):
    """A rig file with shipped limits and the device of this folder."""
    name = "free_shaft.yaml" if options.get("load", "free") == "free" else "simulated.yaml"
    content = yaml.safe_load(find_file("backend", name).read_text(encoding="utf-8"))
    content |= {"backend": f"{DEVICE}:VirtualDevice", "options": options}
    return write_yaml(folder / "rig.yaml", content)


class TestVirtualDevice(HalContract):
    @pytest.fixture
    def bench(self):
        return Bench(
            name="the independent device",
            make=lambda: VirtualDevice(Options(noise=0.0, offset=0.0)),
            config=RigConfig(),
            resolution=2e-4,
            noise=1e-3,
            step=0.3,
        )


@pytest.fixture(scope="module")
def port():
    with serving(Setting(noise=0.0, offset=0.0)) as server:
        yield server.port


@pytest.mark.soak
class TestSerialDevice(HalContract):
    @pytest.fixture
    def bench(self, port):
        return Bench(
            name="the independent device on a line",
            make=lambda: SerialDevice(SerialOptions(port=port, watchdog=1.0)),
            config=RigConfig(),
            resolution=2e-4,
            noise=1e-3,
            step=0.3,
        )


@pytest.mark.parametrize("seed", mostly_soak([0, 1]))
@pytest.mark.parametrize("name", [*EXCITATIONS, *LOOPS])
def test_without_a_fault_every_protocol_is_completed(tmp_path, name, seed):
    load, sensor = ("free", "between") if name == "constant_velocity.yaml" else ("pulley", "load")
    options = {"seed": seed, "load": load, "sensor": sensor, "truth": str(tmp_path / "truth.json")}
    path = rig_file(tmp_path, **options)
    session = open_session(str(quick(name, tmp_path)), str(path))
    experiment, device = session.loaded.experiment, session.device
    result = run_experiment(experiment, "e", session.rig, device, tmp_path / "runs")
    assert not currents.notes(result.folder / "log.csv", session.rig)
    assert record_of(result.folder)["status"] == "completed"
    truth = json.loads((tmp_path / "truth.json").read_text("utf-8"))
    assert truth["onset"] is None and truth["output"] == [0.0, 0.0]
    assert 0.0 < truth["omega"] < 150.0 and 0.0 < truth["current_motor"] < 2.4


STAIRCASES = [
    ([30, 120], [0, 0.06], None),  # fast but for its ends, and the brake comes on with the motor
    ([120, -120], [0, 0.08], 1),
    ([30, 60, 120], [0, 0.04, 0.12], None),
    ([-30, -120], [0.15, 0], 1),
    ([5], [0.02], None),
]


@pytest.mark.parametrize(("velocities", "brake", "seed"), mostly_soak(STAIRCASES, always=0))
def test_a_healthy_motor_at_speed_is_not_called_wrong(tmp_path, velocities, brake, seed):
    """On the simulated rig, without a seed, as on drawn plants of this folder's."""
    name = "constant_velocity.yaml"
    changes = {"velocities": velocities, "brake_commands": brake, "measure": 0.2, "turns": 0.1}
    path = changed("protocol", name, tmp_path, calibration=QUICK["calibration"], **changes)
    rig_of = "free_shaft.yaml" if seed is None else str(rig_file(tmp_path, seed=seed))
    session = open_session(str(path), rig_of)
    result = run_experiment(
        session.loaded.experiment, "e", session.rig, session.device, tmp_path / "runs"
    )
    assert currents.notes(result.folder / "log.csv", session.rig) == []


SLOW = pytest.param("constant_velocity.yaml", marks=pytest.mark.soak)


@pytest.mark.soak
@pytest.mark.parametrize("name", ["prbs.yaml", SLOW])
def test_on_a_line_it_completes_them_at_the_pace_of_the_clock(tmp_path, name):
    load = "free" if name == "constant_velocity.yaml" else "pulley"
    experiment = quick(name, tmp_path, **LEISURE.get(name, {}))
    result, truth = run_on_a_line(tmp_path, experiment, Setting(load=load))
    assert result.returncode == 0, result.stderr
    assert record_of(only_capture(tmp_path))["device"].startswith("faulty board")
    assert truth.output == [0.0, 0.0]


def test_no_more_zeros_are_sent_ahead_than_the_queue_holds(monkeypatch):
    monkeypatch.setattr(serial_device, "QUEUE", 16)
    with serving(Setting()) as server:
        device = SerialDevice(SerialOptions(port=server.port, watchdog=1.0))
        with Rig(device, RigConfig()) as opened:
            opened.start(800.0, Mode.CLOSED_LOOP)
            ticks = [samples.tick[-1] for samples in itertools.islice(at_rest(opened, 800.0), 40)]
            opened.stop()
    assert ticks[-1] >= 39


BROKEN = {"device hangs": 1, "host paused 0.5 s": 1}


@pytest.mark.soak
@pytest.mark.parametrize("fault", ["device hangs", "host paused 0.5 s", "frames damaged"])
def test_a_line_or_a_device_that_fails_ends_in_words(tmp_path, fault):
    setting = Setting(load="pulley", fault=fault, at=0.2)
    result, truth = run_on_a_line(tmp_path, quick("prbs.yaml", tmp_path), setting, watchdog=0.3)
    assert result.returncode == BROKEN.get(fault, result.returncode) < 2, result.stderr
    assert "Traceback" not in result.stderr and result.stderr.startswith("rig: ")
    assert truth.onset is not None
    assert truth.output == [0.0, 0.0] or fault == "device hangs"


def run_on_a_line(folder, experiment, setting, watchdog=1.0):
    """``rig run`` on the device behind a socket: its result and the truth."""
    content = yaml.safe_load(find_file("backend", "serial.yaml").read_text(encoding="utf-8"))
    cable = setting.load == "pulley"
    content["limits"] |= {"travel": None, "winding": 0.25 if cable else None}
    path = write_yaml(folder / "rig.yaml", content, options={"watchdog": watchdog})
    setting = replace(setting, sensor="load" if cable else "between")
    with serving(setting) as server:
        result = rig("run", experiment, "--rig", path, "--port", server.port, cwd=folder)
    return result, server.board.truth


# --- the faults --------------------------------------------------------------------------


@pytest.mark.soak
@pytest.mark.parametrize("name", VIRTUAL)
def test_a_fault_changes_nothing_before_its_instant_and_something_after(name):
    load = FAULTS[name].loads[0] if len(FAULTS[name].loads) == 1 else "free"
    healthy, faulty = (played(load, fault) for fault in ("", name))
    assert faulty.onset == pytest.approx(ONSET / 800.0)
    for column, values in healthy.rows.items():
        before = healthy.rows["tick"] < ONSET
        np.testing.assert_array_equal(values[before], faulty.rows[column][: before.sum()])
    same = all(np.array_equal(v, faulty.rows[c], equal_nan=True) for c, v in healthy.rows.items())
    assert not same or faulty.output != healthy.output == [0.0, 0.0]


ONSET, TICKS, SAFE_AT = 100, 300, 260


@dataclass(frozen=True)
class Sent:
    """What a device sent, by field of RawSamples, its outputs at the end, the fault's instant."""

    rows: dict
    output: list
    onset: float | None


@functools.cache
def played(load, fault):
    """Commands that move everything, made safe at the end; what came of it until it failed."""
    device = VirtualDevice(Options(seed=3, load=load, fault=fault, at=ONSET / 800.0))
    device.open()
    device.announce(Phase.RUN)
    device.start(800.0, Mode.CLOSED_LOOP, guard_of())
    ticks = np.arange(TICKS)
    motor, brake = 1.5 + 0.5 * np.sin(0.2 * ticks), 0.03 + 0.02 * np.sin(0.1 * ticks)
    commands = np.stack([motor, brake], axis=1)
    blocks = []
    with contextlib.suppress(DeviceError):
        for tick in ticks:
            if tick == SAFE_AT:
                device.safe()
            device.send(tick, commands[tick : tick + 1])
            blocks.append(device.receive())
    device.close()
    names = [item.name for item in fields(RawSamples)]
    rows = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in names}
    return Sent(rows, device.board.truth.output, device.board.truth.onset)


# --- the plant and the line ---------------------------------------------------------------


def test_the_plant_turns_as_its_equations_say():
    p = draw(4)._replace(residual_brake=0.0)
    plant = Plant(p)
    for _ in range(8000):
        plant.advance(1.0, 0.0, 1.0 / 800.0)
    # At rest of every rate: K i = (B_m + c) omega, as far as the supply goes.
    steady = p.constant_motor * p.gain_motor / (p.damping_motor + p.damping_brake)
    voltage = p.resistance_motor * p.gain_motor + p.constant_motor * steady
    if voltage > p.supply:
        load = (p.damping_motor + p.damping_brake) / p.constant_motor
        steady = p.supply / (p.resistance_motor * load + p.constant_motor)
    assert plant.state[2] == pytest.approx(steady, rel=0.02)
    rate = plant.count_rate * 2.0 * np.pi / COUNTS
    assert rate == pytest.approx(plant.state[2], rel=1e-3)


def test_energy_is_what_the_supply_gave():
    p = draw(6)
    plant = Plant(p)
    given = sum(plant.advance(1.0, 0.0, 1.0 / 800.0).energy for _ in range(40))
    inertia = p.inertia_motor + p.inertia_brake + p.inertia_load
    kept = 0.5 * inertia * plant.state[2] ** 2
    kept += 0.5 * p.inductance_motor * plant.state[0] ** 2
    assert kept < given < 1.7 * kept + 0.05


def test_frames_are_those_of_the_page():
    text = PAGE.read_text(encoding="utf-8").split("## Examples")[1]
    blocks = [bytes.fromhex(block) for block in re.findall(r"```\n([0-9A-F \n]+)```", text)]
    frames = [block for block in blocks if block[0] == 0 and block[-1] == 0]
    assert len(frames) > 8
    for wire in frames:
        frame = line.decoded(wire[1:-1])
        assert frame is not None and line.encoded(frame) == wire
    assert all(line.decoded(wire[1:-2]) is None for wire in frames)
