"""The way that ``rig init --rig serial`` names, from the port to the first commands."""

import json
import re
import sys

import numpy as np
import pandas as pd
import pytest
import yaml

from daq.lookup.shipped import shipped_files
from tests.daq.serial.support import emulator
from tests.daq.support import forked_rig, record_of
from tests.soak import mostly_soak

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="forks")


@pytest.fixture(scope="module")
def run():
    with forked_rig() as start:
        yield start


def evening(lab, run, **changes):
    """Runs the commands that ``rig init`` numbers, one after the other, on an emulator.

    changes: of a line in an experiment. Gives the emulator's journal after each run.
    """
    lab.mkdir()
    with emulator(lab.parent / "board") as board:
        result = run(["init", "--rig", "serial"], lab)
        assert result.returncode == 0, result.stderr
        numbered = re.findall(r"^(\d)\. (?:rig )?(.+?)  +", result.stdout, re.MULTILINE)
        assert [int(place) for place, _ in numbered] == [1, 2, 3, 4, 5, 6]
        ports, doctor, check, *runs, more = [words.split() for _, words in numbered]
        assert more == ["more"] and board.port in run([*ports, board.port], lab).stdout
        replace_in(lab / "rig.yaml", "# port: /dev/serial/by-id/usb-...", f"port: {board.port}")
        # The computer of a test has other work.
        replace_in(lab / "rig.yaml", "watchdog: 0.1", "watchdog: 2")
        # Good or bad is the computer of a test, not the emulator.
        checked = run([*doctor, "--wakes", "20"], lab).stdout
        assert "2000 of 2000 samples came" in checked
        for name, change in changes.items():
            replace_in(lab / f"{name}.yaml", *change)
        journals = []
        for words in (check, *runs):
            result = run(words, lab)
            assert result.returncode == 0 and "warning" not in result.stderr, result.stderr
            journals.append(board.journal)
    return journals[1:]


def replace_in(file, old, new):
    text = file.read_text("utf-8")
    assert old in text
    file.write_text(text.replace(old, new))


def assert_gentle(lab, journals):
    """Nothing was commanded in the still run, and a tenth of prbs.yaml in the other."""
    (still,), (tenth,) = ((lab / "runs").glob(f"*-{name}") for name in ("still", "tenth"))
    # What the device says of its outputs, beside what the logs say of them.
    assert not any(any(entry["outputs"]) for entry in journals[0])
    assert any(any(entry["outputs"]) for entry in journals[1])
    assert [record_of(folder)["status"] for folder in (still, tenth)] == ["completed"] * 2
    assert not applied(still).any() and len(applied(still)) > 0
    step = 1e-3  # V, of the outputs
    assert (abs(applied(tenth)).max(axis=0) <= [0.085 + step, 0.014 + step]).all()


def applied(folder):
    log = pd.read_csv(folder / "log.csv")
    assert not log["flags"].any()
    return log[["applied_voltage_motor", "applied_voltage_brake"]].to_numpy()


@pytest.mark.soak
def test_the_numbered_commands_work_as_they_stand_on_the_emulator(tmp_path, run):
    shorter = {"still": ("hold: 10 ", "hold: 0.5 "), "tenth": ("samples: 3200", "samples: 400")}
    lab = tmp_path / "lab"
    assert_gentle(lab, evening(lab, run, **shorter))


def test_what_the_init_wrote_passes_the_check_on_any_port(tmp_path, run):
    run(["init", "--rig", "serial"], tmp_path)
    for name in ("still", "tenth"):
        words = ["check", f"{name}.yaml", "--rig", "rig.yaml", "--port", "COM3"]
        result = run(words, tmp_path)
        assert result.returncode == 0 and "--port COM3" in result.stdout, result.stderr
        assert ("excites nothing" in result.stdout) == (name == "still")
    refused = run(["check", "prbs.yaml", "--rig", "rig.yaml"], tmp_path)
    assert refused.returncode == 2 and "limits.command.motor" in refused.stderr
    assert "options.port" not in refused.stderr, "a plan is judged without a port"


def test_a_shipped_experiment_lies_beside_the_first_ones_where_it_is_named(tmp_path, run):
    result = run(["init", "lab", "--rig", "serial", "--protocol", "steps"], tmp_path)
    assert "Next: cd lab\n1. rig ports" in result.stdout and "up to steps.yaml" in result.stdout
    experiments = {path.name for path in (tmp_path / "lab").glob("*.yaml")}
    assert experiments == {
        "still.yaml", "tenth.yaml", "steps.yaml", "rig.yaml", "identification.yaml"
    }  # fmt: skip
    assert "1. rig ports" not in run(["init", "q", "--rig", "serial", "-q"], tmp_path).stdout


def test_zero_commands_are_not_offered_for_an_identification(tmp_path, run):
    at_rest = run(["run", "still.yaml", "--rig", "simulated.yaml"], tmp_path).stdout
    assert "rig identify" not in at_rest
    assert at_rest.endswith("Next: rig run tenth.yaml --rig simulated.yaml\n")
    record = json.loads(next(tmp_path.glob("runs/*-still/run.json")).read_text("utf-8"))
    offset = 1e3 * record["offsets"]["current_motor"]
    shown = re.search(r"current_motor +(\S+) mA", at_rest)[1]
    assert float(shown) == pytest.approx(offset, rel=5e-3)
    assert "rig identify" in run(["run", "tenth.yaml"], tmp_path).stdout


def limits_of(name):
    return yaml.safe_load(shipped_files("backend")[name].read_text("utf-8"))["limits"]


def test_the_first_limits_are_a_tenth_of_the_full_ones():
    full, first = limits_of("serial.yaml"), limits_of("serial_tenth.yaml")
    for of_channel in ("motor", "brake"):
        assert first["command"][of_channel] == pytest.approx(
            np.multiply(full["command"][of_channel], 0.1)
        )
    assert first["current"]["motor"] == pytest.approx(0.1 * full["current"]["motor"])
    assert first["speed"] == pytest.approx(0.1 * full["speed"])
    heat, full_heat = first["i2t"]["motor"], full["i2t"]["motor"]
    assert heat["continuous"] == pytest.approx(0.1 * full_heat["continuous"])
    assert heat["budget"] == pytest.approx(0.01 * full_heat["budget"])  # of amperes squared


@pytest.mark.parametrize("seed", mostly_soak(range(4), always=2))
def test_no_first_limit_trips_by_an_honest_sensors_noise(tmp_path, run, seed):
    """50 mV of offset and 10 mV rms of noise on every input, load and cable on or off."""
    content = {
        "backend": "simulated",
        "limits": limits_of("serial_tenth.yaml"),
        "options": {
            "seed": seed,
            "plant": {"load": ("free", "pulley")[seed % 2]},
            "imperfections": {"offset": 0.05, "noise": 0.01},
        },
    }
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(content))
    for name in ("still.yaml", "tenth.yaml"):
        result = run(["run", name, "--rig", "rig.yaml"], tmp_path)
        assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    ("channel", "message"),
    [
        # The limit on the motor's current stops the run: the other sign, and where to look.
        (
            "motor",
            r"current_motor is 0\.\d+ A, and by amplifiers.motor .* asks for -0\.\d+ to -0\.\d+ A"
            r"\. It has the other sign: turn 'sign' of sensors\.current_motor",
        ),
        # The brake's is too small for its limit, which noise would pass.
        ("brake", "set 'sign: 1' of sensors.current_brake"),
    ],
    ids=["motor", "brake"],
)
def test_a_tenth_is_enough_to_find_a_sensor_turned_round(tmp_path, run, channel, message):
    content = yaml.safe_load(shipped_files("backend")["serial_tenth.yaml"].read_text("utf-8"))
    content |= {"backend": "simulated", "options": {}}
    content["sensors"][f"current_{channel}"]["sign"] = -1
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(content))
    result = run(["run", "tenth.yaml", "--rig", "rig.yaml"], tmp_path)
    assert re.search(message, result.stderr), result.stderr
