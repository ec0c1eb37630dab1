"""Commands from a CSV: what is played, and which files are refused with file and line."""

import hashlib

import numpy as np
import pytest

from daq.errors import ConfigError
from tests.daq.support import only_capture, record_of
from tests.protocols.support import loaded, planned

RATE = 800


def write_csv(path, time, motor, brake, names="time,motor,brake", digits=9):
    rows = zip(time, motor, brake, strict=True)
    lines = [",".join(f"{value:.{digits}g}" for value in row) for row in rows]
    path.write_text("\n".join([names, *lines]) + "\n")


def play(folder, **changes):
    settings = {"protocol": "play", "sample_rate": RATE, "file": "c.csv"}
    return planned(folder, **(settings | changes))


@pytest.fixture
def commands(tmp_path):
    rng = np.random.default_rng(0)
    found = np.stack([rng.uniform(-1, 1, 50), rng.uniform(0, 0.3, 50)], axis=1)
    write_csv(tmp_path / "c.csv", 3.0 + np.arange(50) / RATE, *found.T, digits=12)
    return found


def test_rows_at_the_sample_rate_are_played_as_they_are(tmp_path, monkeypatch, commands):
    monkeypatch.chdir("/")
    np.testing.assert_allclose(play(tmp_path), commands, rtol=1e-11)


def test_times_printed_with_few_digits_are_at_the_sample_rate(tmp_path):
    time, level = np.arange(4000) / RATE, np.zeros(4000)
    write_csv(tmp_path / "c.csv", time, level, level, digits=5)
    assert len(play(tmp_path)) == 4000


def test_resampling_holds_rows_or_joins_them(tmp_path):
    write_csv(tmp_path / "c.csv", [0, 0.1, 0.125], [0, 1, -1], [0.1, 0.2, 0.3])
    held = play(tmp_path, resample="hold")
    expected = np.concatenate([np.zeros(80), np.ones(20), [-1.0]])
    np.testing.assert_array_equal(held[:, 0], expected)
    joined = play(tmp_path, resample="linear")
    time = np.arange(101) / RATE
    np.testing.assert_allclose(joined[:, 0], np.interp(time, [0, 0.1, 0.125], [0, 1, -1]))
    np.testing.assert_allclose(joined[-1], [-1, 0.3])


def test_the_log_of_a_run_is_played_again(tmp_path, command):
    first = command(["run", "sine.yaml"], tmp_path)
    assert first.returncode == 0, first.stderr
    log = only_capture(tmp_path) / "log.csv"
    again = tmp_path / "again"
    again.mkdir()
    (again / "e.yaml").write_text(
        f"protocol: play\nfile: ../{log.relative_to(tmp_path)}\ncalibration: {{samples: 16}}\n"
    )
    assert command(["run", "again/e.yaml", "--out", "again/runs"], tmp_path).returncode == 0
    replayed = only_capture(again)
    one, other = (
        np.loadtxt(path, delimiter=",", skiprows=1, usecols=(1, 2))
        for path in (log, replayed / "log.csv")
    )
    np.testing.assert_array_equal(one, other)
    played = record_of(replayed)["experiment"]["excitation"]
    assert played["sha256"] == hashlib.sha256(log.read_bytes()).hexdigest()
    assert played["rows"] == len(one)


GOOD = "time,motor,brake\n0,0,0\n0.00125,1,0\n0.0025,1,0.1\n0.00375,1,0.1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "c.csv: there is no such file; the name is looked up from the folder"),
        ("", "c.csv: the log is empty"),
        ("time,motor,brake\n", "c.csv: it holds 0 rows; at least 2 are needed"),
        ("time,motor\n0,1\n1,2\n", "c.csv: its columns are time, motor; name them time, motor, br"),
        ("0,0,0\n1,1,1\n", "c.csv:1: the first line holds numbers; it must hold the column"),
        (GOOD.replace("0.0025,1", "0.0025,nan"), "c.csv:4: motor: 'nan' is not a finite number"),
        (GOOD.replace("0.0025,1", "0.0025,"), "c.csv:4: motor: '' is not a finite number; a comma"),
        (GOOD.replace("0.0025,1", "0.0025,inf"), "c.csv:4: motor: 'inf' is not a finite number"),
        (GOOD.replace("0.0025,1", "0.001,1"), "c.csv:4: time: time does not advance"),
        (GOOD.replace("0.00375", "0.0375"), "c.csv:5: 0.035 s after the row before, but rows"),
        (GOOD.removesuffix(",0.1\n"), "c.csv:5: the last line has no end"),
        (GOOD + "0.005,1,0.1,7\n", "c.csv:6: 4 cells, but line 1 names 3 columns"),
        (GOOD.replace("0.00", "0.0"), "c.csv: its rows are at 80 Hz, not at the sample_rate"),
        (GOOD.replace("1,0.1", "9,0.1"), "motor: the plan asks for 9 V in sample 2, outside"),
    ],
)  # fmt: skip
def test_files_that_cannot_be_played_are_refused_with_file_and_line(tmp_path, text, message):
    if text is not None:
        (tmp_path / "c.csv").write_text(text)
    with pytest.raises(ConfigError) as refused:
        play(tmp_path)
    said = str(refused.value)
    assert message in said
    assert said.startswith(f"{tmp_path / 'e.yaml'}:"), said
    if "plan" not in message:
        assert ": file: " in said


def test_a_jump_at_either_end_is_mentioned_beforehand(tmp_path, commands):
    remarks = loaded(tmp_path, protocol="play", file="c.csv").experiment.remarks()
    assert "begins with a jump" in remarks[0] and "ends with a jump" in remarks[0]
