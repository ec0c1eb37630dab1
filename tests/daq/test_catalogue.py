"""``rig runs``: recorded runs listed, searched, noted upon and compared."""

import datetime
import json
import os
import shutil
import sqlite3
import sys

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from daq.catalogue.entries import RunEntry
from daq.catalogue.index import INDEX_NAME
from daq.catalogue.query import ordered, select
from daq.config.metadata import Metadata
from tests.daq.support import on_terminal, rig, write_experiment

# The current follows its command by a gain and a lag: identified in a second.
MODEL = """
from sysid import Input, Output, Parameter, ProcessModel, State

coil = ProcessModel(
    name="coil",
    states=(State("current_motor", "A"),),
    inputs=(Input("applied_voltage_motor", "V"),),
    outputs=(Output("current_motor", "A"),),
    parameters=(
        Parameter("gain", "A/V", 0.5, 0.1, 2.0, "log"),
        Parameter("tau", "s", 1e-3, 1e-4, 1e-2, "log"),
    ),
    derivative=lambda x, u, p: ((p[0] * u[0] - x[0]) / p[1],),
)
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Three runs, of which two were identified, by two operators."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "coil.py").write_text(MODEL)
    noted = {"operator": "Ann", "sample": "MRB-1", "tags": ["new", "warm"], "temperature": 21.5}
    write_experiment(folder / "first.yaml", metadata=noted)
    write_experiment(folder / "second.yaml", motor={"seed": 5})
    write_experiment(folder / "third.yaml", metadata=noted, motor={"seed": 6})
    commands = (
        ("run", "first.yaml"),
        ("run", "second.yaml", "--note", "operator=Bob", "--note", "brushes replaced"),
        ("run", "third.yaml", "--note", "temperature=30", "--note", "sample="),
    )
    for command in commands:
        result = rig(*command, cwd=folder)
        assert result.returncode == 0, result.stderr
    for capture in captures(folder)[:2]:
        words = ("--model", "coil.py:coil", "--population", 10, "--generations", 5)
        result = rig("identify", capture, *words, cwd=folder)
        assert result.returncode == 0, result.stderr
    return folder


def listed(lab, *words):
    """What ``rig runs --json`` prints of the runs."""
    result = rig("runs", *words, "--json", cwd=lab)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)["runs"]


def captures(lab):
    """Folders of the runs, the oldest first."""
    return [f"runs/{run['folder']}" for run in listed(lab)]


def operators(runs):
    return [run["metadata"].get("operator") for run in runs]


def test_a_run_is_listed_with_what_it_was_and_what_came_of_it(lab):
    first, second, third = listed(lab)
    assert (first["protocol"], first["rig"], first["status"]) == (
        "prbs",
        "simulated rig",
        "completed",
    )
    assert first["metadata"] == {
        "operator": "Ann", "sample": "MRB-1", "tags": ["new", "warm"], "temperature": 21.5,
    }  # fmt: skip
    assert second["metadata"] == {"operator": "Bob", "note": "brushes replaced"}
    assert third["metadata"] == {"operator": "Ann", "tags": ["new", "warm"], "temperature": 30}
    parameters = yaml.safe_load(
        (lab / "runs" / first["folder"] / "identification" / "parameters.yaml").read_text("utf-8")
    )
    gain = next(row for row in first["quantities"] if row["name"] == "gain")
    assert gain["value"] == parameters["parameters"]["gain"]["value"]
    assert gain["interval"] == parameters["parameters"]["gain"]["interval"]
    assert first["trust"] == parameters["verdict"]["trust"]
    assert (third["trust"], third["quantities"]) == ("", [])


@pytest.mark.parametrize(
    ("terms", "expected"),
    [
        ((), ["Ann", "Bob", "Ann"]),
        (("operator=ann",), ["Ann", "Ann"]),
        (("operator!=Ann",), ["Bob"]),
        (("temperature>25",), ["Ann"]),
        (("temperature<=30", "sample=MRB-*"), ["Ann"]),
        (("tag=warm", "--last", "1"), ["Ann"]),
        (("brushes",), ["Bob"]),
        (("gain>0.1",), ["Ann", "Bob"]),
        (("started>2020-01-01", "nothing of that kind"), []),
        (("--sort", "operator"), ["Ann", "Ann", "Bob"]),
        (("--sort", "temperature", "--last", "1"), ["Ann"]),
    ],
)
def test_runs_are_selected_by_what_is_known_of_them(lab, terms, expected):
    assert operators(listed(lab, *terms)) == expected


def test_no_run_of_a_parameter_that_others_have_is_an_answer(lab):
    words = ("gain>99", "--parameters", "gain", "--sort", "gain", "--compare")
    result = rig("runs", *words, cwd=lab)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.startswith("0 of 3 runs in runs. ")


def test_of_several_folders_any_is_meant(lab):
    first, second, _ = captures(lab)
    assert operators(listed(lab, first, lab / second)) == ["Ann", "Bob"]
    assert operators(listed(lab, first.removeprefix("runs/"), "operator=Bob")) == []


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("oprator=Ann",), "did you mean 'operator'?"),
        (("--sort", "gian"), "did you mean 'gain'?"),
        (("gain>high",), "'high' is no number, as gain is"),
        (("started>=20.9.2026",), "'20.9.2026' is no date, as started is"),
        (("--parameters", "gian"), "did you mean 'gain'?"),
        (("--in", "nowhere"), "record a run"),
        (("--tag", "x"), "say of which runs"),
        (("nobody", "--tag", "x"), "no run is meant, and nothing was noted"),
        (("ann", "--tag", " "), "is no tag"),
        (("ann", "--note", "tags=" + "x" * 90), "at most 80 letters"),
        (("--plot", "runs.bmp"), "figures are written as svg, pdf, png"),
        ((".",), "no run below runs"),
        (("runs/nothere",), "runs/nothere: there is no such folder of a run"),
        (("ann", "--untag", "nwe"), "there is no tag 'nwe'; did you mean 'new'?"),
        (("ann", "--note", "protocol=zz"), "'protocol' means the run's own protocol"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_the_cure(lab, words, complaint):
    result = rig("runs", *words, cwd=lab)
    assert result.returncode == 2
    assert complaint in " ".join(result.stderr.split())


def test_runs_stand_beside_each_other_in_a_table_and_in_a_figure(lab, tmp_path):
    picture = tmp_path / "runs.png"
    result = rig("runs", "--compare", "--plot", picture, cwd=lab)
    assert result.returncode == 0, result.stderr
    row = next(line for line in result.stdout.splitlines() if line.strip().startswith("gain"))
    first, second, _ = listed(lab)
    for run in (first, second):
        value = next(q["value"] for q in run["quantities"] if q["name"] == "gain")
        assert f"{value:.4f}"[:5] in row
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_parameters_that_are_listed_have_their_units(lab):
    done = rig("runs", "operator=Ann", "--parameters", "gain,tau", cwd=lab)
    assert "gain [A/V]" in done.stdout and "tau [s]" in done.stdout


@pytest.mark.parametrize("minutes", [4, 175])
def test_the_axis_of_dates_has_marks_for_runs_however_far_apart(lab, tmp_path, minutes):
    for capture in captures(lab):
        shutil.copytree(lab / capture, tmp_path / capture)
    record = tmp_path / captures(lab)[0] / "run.json"
    content = json.loads(record.read_text("utf-8"))
    earlier = datetime.datetime.fromisoformat(content["started"])
    content["started"] = (earlier - datetime.timedelta(minutes=minutes)).isoformat()
    record.write_text(json.dumps(content))
    result = rig("runs", "--plot", "all.png", "--parameters", "gain", cwd=tmp_path)
    assert result.returncode == 0 and "warning" not in result.stderr, result.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")
def test_eighty_columns_hold_what_is_listed_compared_and_refused(lab):
    def at_80_columns(*words):
        text = on_terminal(words, lab, columns=80)
        assert max(map(len, text.splitlines())) <= 80, text
        return text

    ann = at_80_columns("runs", "operator=Ann", "--parameters", "gain")
    assert "2 of 3 runs in runs; protocol prbs; rig simulated rig;" in ann
    row = next(line for line in ann.splitlines() if line.split()[-1:] == ["30"])
    assert row.split()[0] == listed(lab)[2]["folder"]  # which says the date
    assert "note brushes replaced" in " ".join(at_80_columns("runs", "brushes").split())
    compared = at_80_columns("runs", "--compare")
    assert "of 3 runs the identified are compared" in " ".join(compared.split())
    assert compared.count("Z-") == 2 and "gain" in compared
    refused = " ".join(at_80_columns("runs", "--sort", "nothing").split())
    assert "known are" in refused and "parameters, predictions, protocol" in refused


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")
def test_a_terminal_shows_the_last_of_many_runs_and_a_pipe_all(tmp_path):
    for k in range(300):
        folder = tmp_path / "runs" / f"{k:03d}-run"
        folder.mkdir(parents=True)
        (folder / "log.csv").touch()
    piped = rig("runs", cwd=tmp_path).stdout.splitlines()
    assert [line.split()[0] for line in piped if "-run" in line] == [
        f"{k:03d}-run" for k in range(300)
    ]
    shown = on_terminal(["runs"], tmp_path, columns=80)
    assert "300 of 300 runs" in shown and "the last 200 are shown; --last N" in shown
    assert shown.count("-run") == 200 and "299-run" in shown
    assert on_terminal(["runs", "--last", "250"], tmp_path, columns=80).count("-run") == 250


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")
def test_free_keys_that_have_no_room_are_named_and_runs_keep_their_names(tmp_path):
    names = [f"20260101T12000{k}Z-prbs-{'after_' * k}repair" for k in (0, 1)]
    keys = ("temperature", "sample_of_the_fluid", "supply_of_the_motor")
    for k, name in enumerate(names):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        (folder / "log.csv").touch()
        notes = [word for key in keys for word in ("--note", f"{key}={k} as measured")]
        rig("runs", name, *notes, cwd=tmp_path)
    shown = on_terminal(["runs"], tmp_path, columns=80)
    assert max(map(len, shown.splitlines())) <= 80
    assert all(name in shown for name in names) and "1 as measured" in shown
    assert "no room for sample_of_the_fluid: --details" in " ".join(shown.split())


def test_in_a_pipe_a_run_is_one_line_whatever_is_noted_of_it(tmp_path):
    folder = tmp_path / "runs" / "noted"
    folder.mkdir(parents=True)
    (folder / "log.csv").touch()
    rig("runs", "noted", "--note", "note=first line\nsecond line", cwd=tmp_path)
    (line,) = [line for line in rig("runs", cwd=tmp_path).stdout.splitlines() if "noted" in line]
    assert line.split("   ")[-1] == "first line second line"


def test_runs_without_samples_are_left_out_of_a_figure_and_of_an_identification(lab, tmp_path):
    for capture in captures(lab):
        shutil.copytree(lab / capture, tmp_path / capture)
    log = tmp_path / captures(lab)[2] / "log.csv"
    log.write_text(
        log.read_text("utf-8").partition("\n")[0] + "\n"
    )  # it failed before the first sample
    result = rig("runs", "--plot", "all.png", cwd=tmp_path)
    assert result.returncode == 0 and "Figure: all.png" in result.stdout
    assert "its signals are not drawn: " in result.stderr
    assert (tmp_path / "all.png").exists()
    shutil.copy(lab / "coil.py", tmp_path)
    words = ("--model", "coil.py:coil", "--population", 10, "--generations", 5, "--json")
    second = tmp_path / captures(lab)[1]
    second.rename(f"{second}-validation")
    result = rig("identify", "runs", *words, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert len(json.loads(result.stdout)["metrics"]["training"]) == 2
    assert f"{second.name}-validation: recorded to validate by, and fitted" in result.stderr


def test_numbers_and_dates_that_were_edited_into_nonsense_end_no_listing(lab, tmp_path):
    first, second, _ = captures(lab)
    for capture in (first, second):
        shutil.copytree(lab / capture, tmp_path / capture)
    result = tmp_path / first / "identification" / "parameters.yaml"
    content = yaml.safe_load(result.read_text("utf-8"))
    content["parameters"]["gain"]["interval"] = ["abc", 1.0]
    result.write_text(yaml.safe_dump(content))
    record = tmp_path / second / "run.json"
    record.write_text(json.dumps({**json.loads(record.read_text("utf-8")), "started": {"a": 1}}))
    for words in (("--parameters", "gain"), ("--compare", "--plot", "all.png")):
        seen = rig("runs", *words, cwd=tmp_path)
        assert seen.returncode == 0, seen.stderr
        told = seen.stderr.replace(os.sep, "/")
        assert all(f"{capture}: not as it was written" in told for capture in captures(lab)[:2])


def test_tags_and_notes_are_put_on_runs_and_taken_away(lab):
    (run,) = listed(lab, "brushes", "--tag", "ageing", "--note", "operator=", "--note", "brake=3")
    assert run["metadata"] == {"note": "brushes replaced", "tags": ["ageing"], "brake": 3}
    path = lab / "runs" / run["folder"] / "metadata.yaml"
    assert yaml.safe_load(path.read_text("utf-8")) == run["metadata"]
    (again,) = listed(
        lab, "brake=3", "--untag", "ageing", "--note", "brake=", "--note", "operator=Bob"
    )
    assert again["metadata"] == {"note": "brushes replaced", "operator": "Bob"}
    assert operators(listed(lab)) == ["Ann", "Bob", "Ann"]


def test_what_is_edited_by_hand_counts_at_once(lab):
    path = lab / "runs" / listed(lab)[0]["folder"] / "metadata.yaml"
    before = path.read_text("utf-8")
    path.write_text(before + "humidity: 40\n")
    assert len(listed(lab, "humidity=40")) == 1
    path.write_text(before)
    assert rig("runs", "humidity=40", cwd=lab).returncode == 2


def test_a_folder_of_runs_is_identified_together(lab):
    words = ("--model", "coil.py:coil", "--population", 10, "--generations", 5, "--json")
    result = rig("identify", "runs", *words, "--out", "together", cwd=lab)
    assert result.returncode == 0, result.stderr
    logs = json.loads(result.stdout)["metrics"]["training"]
    assert [f"runs/{log['name']}" for log in logs] == sorted(captures(lab))


def test_a_joint_result_is_listed_with_the_runs_that_it_used_and_compared(lab, tmp_path):
    shutil.copytree(lab, tmp_path, dirs_exist_ok=True)
    runs = [run["folder"] for run in listed(tmp_path)]
    words = ("--model", "coil.py:coil", "--population", 10, "--generations", 5)
    result = rig("identify", "runs", *words, "--out", "runs/both", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    result = rig("identify", f"runs/{runs[0]}", *words, "--out", "runs/a/again", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    results = {run["folder"]: run for run in listed(tmp_path) if run["folder"] not in runs}
    assert {name: run["status"] for name, run in results.items()} == {
        "both": "joint", "a/again": "identified"
    }  # fmt: skip
    assert results["both"]["logs"] == runs and results["both"]["trust"]
    assert len(listed(tmp_path)) == 5
    assert [run["folder"] for run in listed(tmp_path, "status=joint")] == ["both"]
    assert [run["folder"] for run in listed(tmp_path, "runs/both")] == ["both"]
    shown = rig("runs", cwd=tmp_path).stdout
    assert "5 of 5 runs and results in runs" in shown
    assert next(line for line in shown.splitlines() if " both " in line).split()[3:5] == [
        "joint", results["both"]["trust"]
    ]  # fmt: skip
    details = rig("runs", "runs/both", "--details", cwd=tmp_path).stdout
    assert f"identified from: {', '.join(runs)}" in " ".join(details.split())
    compared = rig("runs", "--compare", "--parameters", "gain", cwd=tmp_path).stdout
    assert "both" in next(line for line in compared.splitlines() if line.startswith(" parameter"))
    noted = rig("runs", "runs/both", "--note", "sample=MRB-2", cwd=tmp_path)
    assert noted.returncode == 0 and len(listed(tmp_path, "sample=MRB-2")) == 1
    drawn = rig("runs", "--plot", "p.png", cwd=tmp_path)
    assert drawn.returncode == 0 and "not drawn" not in drawn.stderr


@pytest.mark.parametrize("damage", ["deleted", "no database", "a folder", "another layout"])
def test_the_index_can_be_lost(lab, damage):
    before = listed(lab)
    index = lab / "runs" / INDEX_NAME
    assert index.exists()
    if damage == "another layout":
        connection = sqlite3.connect(index)
        with connection:
            connection.execute("UPDATE layout SET name = 'older'")
            connection.execute("UPDATE runs SET entry = '{}'")
        connection.close()
    else:
        index.unlink()
    if damage == "no database":
        index.write_bytes(os.urandom(5000))
    elif damage == "a folder":
        index.mkdir()
    assert listed(lab) == before
    if damage == "a folder":
        index.rmdir()


def test_a_folder_that_cannot_be_read_as_a_run_hides_no_other(lab):
    odd = lab / "runs" / "odd" / "deeper"
    odd.mkdir(parents=True)
    (odd / "run.json").write_text('{"status": "running", "experiment": 3')
    (odd / "metadata.yaml").write_text("operator: [unfinished")
    (odd / "identification").mkdir()
    (odd / "identification" / "parameters.yaml").write_text("verdict: none\n")
    result = rig("runs", cwd=lab)
    assert result.returncode == 0
    assert "odd/deeper" in result.stdout
    for name in ("run.json", "metadata.yaml", "odd/deeper: not as it was written"):
        assert name in result.stderr.replace(os.sep, "/")
    for path in sorted(odd.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    odd.rmdir()
    odd.parent.rmdir()
    assert len(listed(lab)) == 3


def test_metadata_of_an_experiment_is_checked_with_it(tmp_path):
    write_experiment(tmp_path / "bad.yaml", metadata={"operator": ["Ann"], "tags": ["a,b"]})
    result = rig("check", "bad.yaml", cwd=tmp_path)
    assert result.returncode == 2
    assert "metadata.operator" in result.stderr
    assert "metadata.tags" in result.stderr


@pytest.mark.parametrize("key", [*RunEntry("a").described, "tag", "run"])
def test_what_a_run_is_known_by_is_no_key_to_note_under(key):
    with pytest.raises(ValidationError, match=f"'{key}' means the run's own"):
        Metadata.model_validate({key: "zz"})


def test_facts_are_refused_in_an_experiment_and_when_it_is_run(tmp_path):
    write_experiment(tmp_path / "bad.yaml", metadata={"status": "fine"})
    write_experiment(tmp_path / "good.yaml")
    for words in (("check", "bad.yaml"), ("run", "good.yaml", "--note", "protocol=zz")):
        result = rig(*words, cwd=tmp_path)
        assert result.returncode == 2 and "choose another key" in result.stderr
    assert not (tmp_path / "runs").exists()


_DATES = st.datetimes(
    datetime.datetime(2000, 1, 1), datetime.datetime(2100, 1, 1), timezones=st.just(datetime.UTC)
)


@given(st.lists(st.tuples(_DATES, st.none() | st.floats(-1e6, 1e6)), max_size=8), st.data())
def test_conditions_and_orders_are_those_of_numbers_and_dates(tmp_path_factory, runs, data):
    root = tmp_path_factory.getbasetemp()
    entries = [
        RunEntry(str(k), date.isoformat(), metadata={} if size is None else {"size": size})
        for k, (date, size) in enumerate(runs)
    ]
    if any(size is not None for _, size in runs):
        limit = data.draw(st.floats(-1e6, 1e6))
        larger = [k for k, (_, size) in enumerate(runs) if size is not None and size > limit]
        selected = select(root, entries, [f"size>{limit!r}"])
        assert [int(entry.folder) for entry in selected] == larger
        sizes = [entry.facts.get("size") for entry in ordered(entries, "size")]
        present = [size for size in sizes if size is not None]
        assert sizes == [None] * (len(sizes) - len(present)) + sorted(present)
    if runs:
        day = data.draw(_DATES).date()
        since = [k for k, (date, _) in enumerate(runs) if date.date() >= day]
        selected = select(root, entries, [f"started>={day.isoformat()}"])
        assert [int(entry.folder) for entry in selected] == since
