"""Exported logs, as the programs read them that they are made for."""

import json
from datetime import datetime

import numpy as np
import pytest

from daq.logs.recording import load
from tests.daq.support import only_capture, rig, write_experiment, write_rig


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    write_experiment(folder / "e.yaml", duration=0.2)
    write_rig(folder / "rig.yaml")
    done = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=folder)
    assert done.returncode == 0, done.stderr
    return only_capture(folder)


@pytest.fixture(scope="module")
def frame(capture):
    return load(capture).frame


def exported(capture, kind, *more):
    done = rig("export", kind, str(capture), "--json", *more, cwd=capture)
    assert done.returncode == 0, done.stderr
    return capture / json.loads(done.stdout)["file"]


def test_a_mat_file_has_the_columns_units_and_the_record(capture, frame):
    from scipy.io import loadmat

    file = exported(capture, "mat")
    assert file == capture / "log.mat"
    found = loadmat(file, squeeze_me=True, struct_as_record=False)
    for name in frame:
        np.testing.assert_array_equal(found[name], frame[name])
    assert found["units"].torque == "N*m" and not hasattr(found["units"], "flags")
    assert found["dt"] == pytest.approx(1.0 / 800.0)
    assert json.loads(str(found["record"])) == json.loads((capture / "run.json").read_text("utf-8"))


def test_an_identification_reads_the_mat_file(capture, frame):
    from daq.logs.matlab import columns_of

    columns = columns_of(exported(capture, "mat"))
    np.testing.assert_array_equal(columns["omega"], frame["omega"])


def test_a_parquet_table_has_the_columns_units_and_the_record(capture, frame):
    import pandas as pd
    from pyarrow import parquet

    file = exported(capture, "parquet", "--out", "table.parquet")
    pd.testing.assert_frame_equal(pd.read_parquet(file), frame)
    schema = parquet.read_schema(file)
    assert schema.field("omega").metadata[b"unit"] == b"rad/s"
    assert json.loads(schema.metadata[b"record"])["status"] == "completed"


def test_an_mcap_has_a_message_a_sample_at_its_time_of_day(capture, frame):
    from mcap.reader import make_reader

    with exported(capture, "mcap").open("rb") as file:
        reader = make_reader(file)
        found = list(reader.iter_messages())
        (attachment,) = reader.iter_attachments()
    record = json.loads(attachment.data)
    assert [channel.topic for _, channel, _ in found] == ["/samples"] * len(frame)
    rows = [json.loads(message.data) for _, _, message in found]
    for name in ("t", "torque", "omega"):
        values = [row[name] for row in rows]
        np.testing.assert_allclose(values, frame[name], rtol=1e-12, atol=1e-14)
    began = datetime.fromisoformat(record["started"]).timestamp()
    times = np.array([message.log_time for _, _, message in found]) * 1e-9 - began
    np.testing.assert_allclose(times, frame["t"], atol=1e-5)
    schema = json.loads(found[0][0].data)
    assert schema["properties"]["current_motor"]["description"] == "[A]"


@pytest.mark.parametrize("kind", ["mat", "mcap", "parquet"])
def test_what_cannot_be_exported_is_a_mistake_that_leaves_nothing(tmp_path, kind):
    (tmp_path / "log.csv").write_text("t,omega\n0,nonsense\n")
    for name in ("log.csv", "nowhere"):
        done = rig("export", kind, name, cwd=tmp_path)
        assert done.returncode == 2 and name in done.stderr and "Traceback" not in done.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["log.csv"]


@pytest.mark.parametrize("head", ["Zeit [ms];Weg [mm]", "t;omega"])
def test_columns_of_no_run_are_not_exported_and_no_wrong_option_is_named(tmp_path, head):
    (tmp_path / "belt.csv").write_text(f"{head}\n0,0;1,5\n1,0;1,6\n")
    done = rig("export", "parquet", "belt.csv", cwd=tmp_path)
    assert done.returncode == 2 and f"it has {head.replace(';', ', ')}" in done.stderr
    assert "--config" not in done.stderr and "rig identify" in done.stderr


@pytest.mark.parametrize("kind", ["mat", "mcap", "parquet", "fmu"])
@pytest.mark.parametrize(
    ("out", "cure"), [("a.csv", "name it a."), ("nodir/a", "there is no folder nodir, make it")]
)
def test_a_file_of_another_format_or_without_a_folder_is_not_written(
    tmp_path, capture, kind, out, cure
):
    done = rig("export", kind, str(capture), "--out", out, cwd=tmp_path)
    assert done.returncode == 2 and cure in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_log_of_another_program_is_exported_without_a_record(tmp_path):
    names = "t,cmd_voltage_motor,cmd_voltage_brake,current_motor,current_brake,torque,theta,omega"
    (tmp_path / "day1.csv").write_text(f"{names}\n0,1,0,0,0,0,0,0\n0.1,1,0,0.5,0,0,0,0\n")
    done = rig("export", "mcap", "day1.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "day1.mcap").exists()
