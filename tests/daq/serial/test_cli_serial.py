"""``rig ports``, ``rig doctor``, and what the command line says about ports."""

import json
import os
import sys

import pytest

from tests.daq.serial.support import emulator, write_serial_rig
from tests.daq.support import forked_rig, rig, write_experiment

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="forks")


@pytest.fixture(scope="module")
def run():
    with forked_rig() as start:
        yield start


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    with emulator(tmp_path_factory.mktemp("cli")) as there:
        yield there


def test_ports_says_who_answers_and_who_does_not(tmp_path, run, running):
    document = json.loads(run(["ports", running.port, "./none", "--json"], tmp_path).stdout)
    there, gone = document["ports"]
    assert there["answers"]["device"] and there["problem"] is None
    assert [c["name"] for c in there["answers"]["channels"]][-1] == "encoder"
    assert gone["answers"] is None and "no such port" in gone["problem"]
    shown = run(["ports", running.port], tmp_path).stdout
    assert "emulator 1" in shown and f"--port {running.port}" in shown


def test_ports_sends_nothing_when_told_only_to_list(tmp_path, run, running):
    before = len(running.journal)
    result = run(["ports", running.port, "--list"], tmp_path)
    assert "not asked" in result.stdout and len(running.journal) == before


def test_doctor_has_a_verdict_on_everything_and_leaves_nothing_behind(tmp_path, run, running):
    result = run(["doctor", running.port, "--json", "--wakes", "200"], tmp_path)
    document = json.loads(result.stdout)
    assert (result.returncode == 0) == document["good"]
    checks = {check["what"]: check for check in document["checks"]}
    assert {"real-time scheduling", "wake-ups", "memory lock", "disk of runs"} < set(checks)
    for check in checks.values():
        assert (check["verdict"] == "good") == (check["cure"] == "")
    assert list(tmp_path.iterdir()) == []


def test_doctor_asks_the_device_at_a_port(tmp_path, run, running):
    before = len(running.journal)
    # Also beside a rig's file, whose port it goes before.
    write_serial_rig(tmp_path / "rig.yaml", "/dev/not-this-one")
    words = ["doctor", "--port", running.port, "--rig", "rig.yaml", "--json", "--wakes", "20"]
    checks = {c["what"]: c for c in json.loads(run(words, tmp_path).stdout)["checks"]}
    assert "emulat" in checks["rig"]["found"] and checks["rig"]["verdict"] == "good"
    assert f"access to {running.port}" in checks
    # It samples at zero, in both modes; a busy computer's late commands are not the device's.
    assert checks["open loop at 800 Hz"]["found"] == "2000 of 2000 samples came"
    assert checks["open loop at 800 Hz"]["verdict"] == "good"
    assert "2000 of 2000 samples came, " in checks["closed loop at 800 Hz"]["found"]
    assert all(entry["outputs"] == [0, 0] for entry in running.journal[before:])
    result = run(["doctor", "--rig", "simulated.yaml", "--port", running.port], tmp_path)
    assert result.returncode == 2 and "has no port" in result.stderr


@pytest.mark.parametrize(
    ("fault", "found"),
    [
        ("overflow=100@open+1", "1900 of 2000 samples came"),
        ("stall=2@open+1", "has come from the device for 1 s"),
    ],
)
def test_a_device_that_does_not_sample_in_time_is_bad(tmp_path, run, fault, found):
    with emulator(tmp_path / "board", "--fault", fault) as there:
        result = run(["doctor", "--port", there.port, "--json", "--wakes", "20"], tmp_path)
    checks = {check["what"]: check for check in json.loads(result.stdout)["checks"]}
    check = checks["open loop at 800 Hz"]
    assert result.returncode == 1 and check["verdict"] == "bad", check
    assert found in check["found"] and check["cure"]
    assert "closed loop at 800 Hz" not in checks, "nothing is asked further"


def test_a_rate_that_a_device_has_not_is_named(tmp_path, run, running):
    result = run(["doctor", "--port", running.port, "--rate", "1e6", "--wakes", "20"], tmp_path)
    assert result.returncode == 1 and "too fast for it" in result.stdout
    result = run(["doctor", "--rate", "100", "--wakes", "20"], tmp_path)
    assert result.returncode == 2 and "add --port PORT" in result.stderr


def test_a_port_at_which_nobody_answers_is_not_good(tmp_path, run):
    ours, theirs = os.openpty()
    try:
        result = run(["doctor", "--port", os.ttyname(theirs), "--wakes", "20"], tmp_path)
    finally:
        os.close(ours)
        os.close(theirs)
    assert result.returncode == 1 and "no answer in 2 s" in result.stderr


def test_doctor_looks_at_a_port_and_at_a_rig(tmp_path, run):
    words = ["doctor", "/dev/no-such-port", "--rig", "simulated.yaml", "--wakes", "20"]
    result = run(words, tmp_path)
    assert result.returncode == 1 and "access to /dev/no-such-port" in result.stderr
    assert "rig  " in result.stdout


def test_doctor_ends_with_1_and_a_cure_when_something_is_bad(tmp_path, run):
    result = run(["doctor", "/dev/no-such-port", "--wakes", "200"], tmp_path)
    assert result.returncode == 1
    assert "access to /dev/no-such-port: 'rig ports' lists" in result.stdout
    assert "access to /dev/no-such-port" in result.stderr


def test_a_port_on_the_command_line_goes_before_the_files(tmp_path, run, running):
    write_experiment(tmp_path / "e.yaml", duration=0.1)
    write_serial_rig(tmp_path / "rig.yaml", "/dev/not-this-one", watchdog=0.5)
    words = ["run", "e.yaml", "--rig", "rig.yaml"]
    absent = run([*words, "--json"], tmp_path)
    assert "/dev/not-this-one: there is no such port; 'rig ports' lists" in absent.stderr
    assert (
        json.loads(absent.stdout)["errors"][0]["cure"] == "'rig ports' lists those that there are"
    )
    assert not list((tmp_path / "runs").iterdir()), "where nobody was reached there was no run"
    assert run([*words, "--port", running.port], tmp_path).returncode == 0
    result = run(["check", "e.yaml", "--rig", "serial.yaml", "--port", "COM3"], tmp_path)
    assert result.returncode == 0 and "--port COM3" in result.stdout, "a check opens nothing"


def test_a_rig_without_a_port_says_which_has_one(tmp_path, run):
    write_experiment(tmp_path / "e.yaml")
    result = run(["run", "e.yaml", "--port", "COM3"], tmp_path)
    assert result.returncode == 2 and "--rig serial.yaml" in result.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--fault", "drp"], "did you mean 'drop'"),
        (["--rig", "serial.yaml"], "only the simulated one"),
        (["--link", "taken.txt"], "there is a file of that name"),
        (["--tcp", "0", "--link", "x"], "leave it out"),
        (["--tcp", "99999"], "cannot listen there"),
        (["--journal", "no/such/folder"], "--journal no/such/folder"),
    ],
)
def test_an_emulator_that_cannot_be_is_refused_before_it_starts(tmp_path, run, words, said):
    (tmp_path / "taken.txt").write_text("mine")
    result = run(["emulate", *words], tmp_path)
    assert result.returncode == 2 and said in result.stderr, result.stderr
    assert (tmp_path / "taken.txt").read_text("utf-8") == "mine"


def test_the_faults_are_listed(tmp_path):
    result = rig("emulate", "--fault", "help", "--json", cwd=tmp_path)
    assert "disconnect" in json.loads(result.stdout)
