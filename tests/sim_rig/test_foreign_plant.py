"""FMUs of other programs, and our own, as the simulated rig's plant."""

import contextlib
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

from daq.errors import ConfigError, DeviceError
from daq.fmu.export import unit_of
from daq.hal import Flag, Guard, Mode
from daq.lookup.rigs import load_rig
from sim_rig.plant import Plant

fmpy = pytest.importorskip("fmpy")
COMPILES = shutil.which("cc") is not None and fmpy.platform == "linux64"
compiled = pytest.mark.skipif(not COMPILES, reason="no compiler for the platform of this FMU")
RATE = 800.0
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="{version}" modelName="motor" guid="1">
<{kind} modelIdentifier="motor" canHandleVariableCommunicationStepSize="true"/>
<UnitDefinitions>
<Unit name="deg"><BaseUnit rad="1" factor="0.017453292519943295"/></Unit>
<Unit name="rad/s"><BaseUnit rad="1" s="-1"/></Unit>
<Unit name="V"><BaseUnit kg="1" m="2" s="-3" A="-1"/></Unit>
</UnitDefinitions>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0" unit="V"/>
</ScalarVariable>
<ScalarVariable name="k" valueReference="1" causality="parameter" variability="tunable">
<Real start="10"/></ScalarVariable>
<ScalarVariable name="motor.phi" valueReference="3" causality="output"><Real unit="deg"/>
</ScalarVariable>
<ScalarVariable name="motor.w" valueReference="4" causality="output"><Real unit="rad/s"/>
</ScalarVariable>
<ScalarVariable name="motor.n" valueReference="4" causality="output"><Real unit="shoe"/>
</ScalarVariable>
</ModelVariables>
<ModelStructure/>
</fmiModelDescription>
"""
RIG = """
backend: simulated
options:
  ideal: true
  fmu:
    file: motor.fmu
    inputs: {motor: u, brake: null}
    outputs: {theta: motor.phi, omega: motor.w, torque: null, current_motor: null,
              current_brake: null}
"""


def write_unit(path, binary=b"", platform="linux64", version="2.0", kind="CoSimulation"):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", DESCRIPTION.format(version=version, kind=kind))
        if platform:
            archive.writestr(f"binaries/{platform}/motor.so", binary)


def played(device, volts, guard=None):
    """What a device samples under commands of motor and brake (n, 2)."""
    wide = np.full(3, 1e9)
    guard = guard or Guard(np.full(2, -9.0), np.full(2, 9.0), -wide, wide)
    blocks, count = [], 0
    with contextlib.closing(device):
        device.open()
        device.start(RATE, Mode.OPEN_LOOP, guard)
        device.send(0, volts)
        while count < len(volts):
            blocks.append(device.receive())
            count += len(blocks[-1].tick)
    names = ("tick", "analog", "counts", "count_rate", "applied", "flags")
    return {name: np.concatenate([getattr(b, name) for b in blocks]) for name in names}


@compiled
def test_an_exported_plant_runs_as_the_plant_itself(tmp_path):
    plant = Plant(load="free").driven(0.0)
    unit_of(plant, plant.nominal).save(tmp_path / "free.fmu")
    rng = np.random.default_rng(1)
    levels = rng.uniform([-1.0, 0.0], [1.0, 0.2], (20, 2))
    volts = np.repeat(levels, 20, axis=0)
    wide = np.full(3, 1e9)
    guard = Guard(np.full(2, -9.0), np.full(2, 9.0), -wide, np.array([0.7, 1e9, 1e9]))
    logs = []
    for plant in ("fmu: {file: free.fmu}", "plant: {load: free}"):
        (tmp_path / "rig.yaml").write_text(f"options:\n  ideal: true\n  {plant}\n")
        _, device = load_rig(str(tmp_path / "rig.yaml"))
        logs.append([played(device, volts), played(device, volts, guard)])
    for ours, theirs in zip(*logs, strict=True):
        for name in ("applied", "flags", "tick"):
            np.testing.assert_array_equal(ours[name], theirs[name])
        scale = np.abs(theirs["analog"]).max(axis=0) + 1e-9
        assert np.all(np.abs(ours["analog"] - theirs["analog"]) < 1e-4 * scale)
        assert np.ptp(theirs["counts"]) > 10.0
        assert np.abs(ours["counts"] - theirs["counts"]).max() < 0.05
    assert 0 < np.flatnonzero(logs[0][1]["flags"] & Flag.INTERLOCK)[0] < 400


@compiled
def test_a_unit_of_another_hand_in_its_own_names_and_units(tmp_path):
    library, source = tmp_path / "motor.so", Path(__file__).with_name("foreign_motor.c")
    words = ["cc", "-std=c99", "-shared", "-fPIC", "-w", str(source), "-o", str(library), "-lm"]
    subprocess.run(words, check=True)
    write_unit(tmp_path / "motor.fmu", library.read_bytes())
    (tmp_path / "rig.yaml").write_text(RIG + "    parameters: {k: 20.0}\n")
    config, device = load_rig(str(tmp_path / "rig.yaml"))
    assert Path(config.options.fmu.file) == tmp_path / "motor.fmu"
    assert len(config.options.fmu.sha256) == 64 and not config.options.cable
    raw = played(device, np.tile([1.5, 0.1], (400, 1)))
    t = np.arange(400) / RATE
    omega = 30.0 * (1.0 - np.exp(-t / 0.05))
    theta = 30.0 * t - 0.05 * omega
    per_radian = 4 * 2048 / (2.0 * np.pi)
    np.testing.assert_allclose(raw["count_rate"], omega * per_radian, atol=1e-6)
    np.testing.assert_allclose(raw["counts"], theta * per_radian, atol=1e-6)
    assert not raw["analog"].any()
    with pytest.raises(DeviceError, match=r"motor.fmu fails at 0 s"):
        played(device, np.tile([4.5, 0.0], (4, 1)))


def test_a_unit_that_cannot_be_the_plant_is_refused_where_the_file_names_it(tmp_path):
    def refused(text=RIG):
        (tmp_path / "rig.yaml").write_text(text)
        with pytest.raises(ConfigError) as error:
            load_rig(str(tmp_path / "rig.yaml"))
        assert "rig.yaml:5:" in str(error.value) or "options" in str(error.value)
        return str(error.value)

    assert "there is no such file" in refused()
    unit = tmp_path / "motor.fmu"
    unit.write_text("no archive")
    assert "is no FMU (no ZIP file)" in refused()
    write_unit(unit, version="1.0")
    assert "is of FMI 1.0; export it as FMI 2.0 or 3.0" in refused()
    write_unit(unit, kind="ModelExchange")
    assert "without a solver; export it for co-simulation" in refused()
    write_unit(unit, platform="riscv-beos")
    text = refused()
    assert "no binary for this computer (it has riscv-beos); export it for" in text
    write_unit(unit, platform=fmpy.platform)
    text = refused(RIG.replace("motor.w", "motor.v").replace("motor: u,", "motor: k,"))
    assert "outputs.omega: there is no real variable 'motor.v'; it has motor.w" in text
    assert "inputs.motor: there is no real input 'k'; it has u" in text
    assert "'motor.phi' is in deg, which is no rad/s" in refused(
        RIG.replace("motor.w", "motor.phi")
    )
    assert "is in 'shoe', which nothing defines" in refused(RIG.replace("motor.w", "motor.n"))
    assert "there is no real 'j'" in refused(RIG + "    parameters: {j: 1.0}\n")
    assert "leave those out" in refused(RIG + "  plant: {load: free}\n")
    assert "another FMU than" in refused(RIG + f"    sha256: {'f' * 64}\n")


def test_a_binary_that_cannot_be_loaded_leaves_the_working_folder_as_it_was(tmp_path, monkeypatch):
    write_unit(tmp_path / "motor.fmu", b"no library", platform=fmpy.platform)
    (tmp_path / "rig.yaml").write_text(RIG)
    monkeypatch.chdir(tmp_path)
    _, device = load_rig("rig.yaml")
    with pytest.raises(DeviceError, match=r"motor.fmu does not start"):
        played(device, np.zeros((4, 2)))
    assert Path.cwd() == tmp_path
