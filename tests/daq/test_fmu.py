"""Identified models as functional mock-up units, opened by FMPy."""

import ctypes
import datetime
import json
import shutil
import subprocess
import zipfile

import numpy as np
import pytest
import yaml

from daq.config.units import base_units
from daq.errors import ConfigError
from daq.fmu.export import export, platform_name, unit_of
from daq.lookup.models import find_model
from sysid import Input, Output, Parameter, ProcessModel, State, Stepper
from sysid.examples import lag
from tests.daq.support import rig

fmpy = pytest.importorskip("fmpy")
COMPILES = shutil.which("cc") is not None and platform_name() is not None
compiled = pytest.mark.skipif(not COMPILES, reason="no compiler for a platform of FMI's")
DT = 1e-3


def opened(unit, folder, **starts):
    """A running instance of a unit by FMPy, and its value references."""
    from fmpy.fmi3 import FMU3Slave
    from fmpy.validation import validate_fmu

    path = unit.save(folder / "model.fmu")
    assert validate_fmu(str(path)) == []
    description = fmpy.read_model_description(str(path))
    slave = FMU3Slave(
        guid=description.instantiationToken,
        unzipDirectory=fmpy.extract(str(path), str(folder / "unit")),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="one",
    )
    references = {v.name: v.valueReference for v in description.modelVariables}
    slave.instantiate()
    slave.enterInitializationMode(startTime=0.0)
    for name, value in starts.items():
        slave.setFloat64([references[name]], [value])
    slave.exitInitializationMode()
    return slave, references


def stepped(slave, references, model, inputs, begin=0):
    """Outputs at the begin of each step, under inputs that are held."""
    places = [references[signal.name] for signal in model.inputs]
    outputs = [references[signal.name] for signal in model.outputs]
    rows = []
    for k, row in enumerate(inputs, begin):
        slave.setFloat64(places, row)
        rows.append(slave.getFloat64(outputs))
        slave.doStep(k * DT, DT)
    return np.array(rows)


def levels(model, n=300, seed=0):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1.0, 1.0, (n // 30, len(model.inputs))), 30, axis=0)


def ours(model, vector, inputs, start=None):
    held = model.with_holds({signal.name: "zoh" for signal in model.inputs})
    x = model.initial_state.copy() if start is None else np.array(start)
    return Stepper(held, vector, DT, accuracy=1e-10).advance(x, np.vstack([inputs, inputs[-1:]]))[1]


@compiled
def test_a_unit_gives_the_outputs_of_the_model(tmp_path):
    model = find_model("actuator:friction=stribeck")
    slave, references = opened(unit_of(model, model.nominal), tmp_path)
    inputs = levels(model)
    wanted = ours(model, model.nominal, inputs)
    scale = np.abs(wanted).max(axis=0)
    assert np.all(np.abs(stepped(slave, references, model, inputs) - wanted) < 1e-6 * scale)
    slave.terminate()
    slave.freeInstance()


def _derivative(x, u, p):
    return (p[0] * (u[0] - x[0]),)


def _output(x, u, p):
    return (2.0 * x[0] + u[0], x[0] if x[0] > 0.1 else 0.1)


def feeding_through():
    return ProcessModel(
        name="1st & <last>",
        states=(State("x", "m"),),
        inputs=(Input("u", "m"),),
        outputs=(Output("y", "m"), Output("at least", "furlong per fortnight")),
        parameters=(Parameter("rate", "1/s", 20.0, 1.0, 100.0, "log"),),
        derivative=_derivative,
        output=_output,
    )


@pytest.mark.soak
@compiled
def test_starts_parameters_and_states_are_set_and_kept(tmp_path):
    model = feeding_through()
    slave, references = opened(unit_of(model, [20.0]), tmp_path, x_start=0.5, rate=50.0)
    inputs = levels(model)
    wanted = ours(model, np.array([50.0]), inputs, [0.5])
    first = stepped(slave, references, model, inputs[:100])
    state = slave.getFMUState()
    kept = slave.serializeFMUState(state)
    for _ in range(2):
        rest = stepped(slave, references, model, inputs[100:], 100)
        assert np.allclose(np.vstack([first, rest]), wanted, atol=1e-7)
        slave.setFMUState(slave.deserializeFMUState(kept))
    with pytest.raises(Exception, match="SetFloat64 failed"):
        slave.setFloat64([references["x_start"]], [1.0])
    slave.reset()
    assert slave.getFloat64([references["rate"], references["x"]]) == [20.0, 0.0]


@compiled
def test_what_is_no_model_of_this_name_is_not_made(tmp_path):
    slave, _ = opened(unit_of(lag(), lag().nominal), tmp_path)
    make = ctypes.CDLL(slave.dll._name).fmi3InstantiateCoSimulation
    make.restype = ctypes.c_void_p
    nothing = [None, False, False, False, False, None, 0, None, None, None]
    assert make(b"one", b"{another}", *nothing) is None
    with pytest.raises(Exception, match="DoStep failed"):
        slave.doStep(0.0, 0.0)


@compiled
def test_the_source_compiles_without_a_warning(tmp_path):
    unit = unit_of(find_model("actuator"), find_model("actuator").nominal, compiler=None)
    path = tmp_path / "model.c"
    path.write_text(unit.source)
    strict = ["cc", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-c", str(path)]
    run = subprocess.run(strict, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_the_command_writes_a_result_with_its_source_and_record(tmp_path):
    parameters = {"gain": {"value": 3.0, "unit": "m/V"}, "tau": 0.1}
    (tmp_path / "lag.py").write_text("from sysid.examples import lag\nmodel = lag()\n")
    document = {"model": "lag.py:model", "parameters": parameters}
    (tmp_path / "parameters.yaml").write_text(yaml.safe_dump(document))
    out = rig("export", "fmu", tmp_path, "--trust", "--json", cwd=tmp_path)
    written = json.loads(out.stdout)
    with zipfile.ZipFile(tmp_path / "lag.fmu") as archive:
        names = set(archive.namelist())
        assert 'name="gain"' in archive.read("modelDescription.xml").decode()
    assert {"sources/lag.c", "sources/buildDescription.xml", "resources/parameters.yaml"} <= names
    assert bool(written["binaries"]) == COMPILES == any(n.startswith("binaries/") for n in names)
    with pytest.raises(ConfigError, match="trust"):
        export(tmp_path)


def test_the_description_says_when_it_was_made_in_universal_time(tmp_path):
    noon = datetime.datetime(2026, 3, 1, 12, tzinfo=datetime.timezone(datetime.timedelta(hours=2)))
    unit = unit_of(lag(), lag().nominal, compiler=None, generated=noon)
    description = fmpy.read_model_description(str(unit.save(tmp_path / "lag.fmu")))
    assert description.generationDateAndTime == "2026-03-01T10:00:00Z"
    now = unit_of(lag(), lag().nominal, compiler=None).description
    assert f'generationDateAndTime="{datetime.datetime.now(datetime.UTC):%Y-%m-%d}' in now


def test_units_are_whole_powers_of_base_units():
    assert base_units("V*s/rad") == (1.0, {"kg": 1, "m": 2, "s": -2, "A": -1, "rad": -1})
    assert base_units("1") == (1.0, {})
    assert base_units("m^0.5") is None and base_units("shoe") is None
