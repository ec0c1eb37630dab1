"""What the commands do as functions: ``from daq import ...``, tables in and out."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import daq
from daq import ConfigError, identify, load, record, replay
from tests.daq.support import environment, few_free, rig, write_experiment, write_rig, write_yaml

QUICK = few_free()
NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebook.ipynb"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run and its validation run, recorded in Python, and where."""
    root = tmp_path_factory.mktemp("recorded")
    write_experiment(root / "e.yaml", validation={"motor": {"seed": 77}})
    write_rig(root / "rig.yaml")
    where = {"rig": root / "rig.yaml", "out": root / "runs"}
    training = record(root / "e.yaml", **where)
    return root, training, record(str(root / "e.yaml"), validation=True, **where)


@pytest.fixture(scope="module")
def found(recorded):
    _, training, validation = recorded
    return identify(training, validation, **QUICK)


def test_a_recorded_run_is_the_one_the_command_records(recorded):
    root, training, validation = recorded
    rig("run", "e.yaml", "--rig", "rig.yaml", "--out", "others", cwd=root)
    (other,) = (root / "others").iterdir()
    pd.testing.assert_frame_equal(load(other).frame, training.frame)
    assert len(training.frame) == 400 and training.record["status"] == "completed"
    assert training.folder.parent == root / "runs" and training.warning is None
    assert not validation.frame["cmd_voltage_motor"].equals(training.frame["cmd_voltage_motor"])


@pytest.mark.parametrize("seed", [None, 5])
def test_runs_on_a_simulated_rig_share_noise_only_where_its_file_names_a_seed(
    tmp_path, monkeypatch, seed
):
    """Logs of one noise confirm each other's errors, and are refused as copies."""
    write_experiment(tmp_path / "e.yaml")
    rig_file = write_yaml(tmp_path / "rig.yaml", {"options": {"seed": seed} if seed else {}})
    runs = [record(tmp_path / "e.yaml", rig_file, tmp_path / "runs") for _ in range(3)]
    seeds = [run.record["rig"]["options"]["seed"] for run in runs]
    assert seeds == ([5, 5, 5] if seed else [0, 1, 2])
    # What is no motion: the torque's changes from sample to sample.
    noise = [np.diff(run.frame["torque"], 3) for run in runs]
    shared = np.corrcoef(noise)[np.triu_indices(3, 1)]
    assert np.all(shared == pytest.approx(1.0)) if seed else np.all(np.abs(shared) < 0.3)
    # Nor with those of a design, which are in a folder of their own and identified with them.
    monkeypatch.chdir(tmp_path)
    nested = [record("e.yaml", "rig.yaml", f"runs/{name}") for name in ("design", "second")]
    seeds += [run.record["rig"]["options"]["seed"] for run in nested]
    assert len(set(seeds)) == (1 if seed else 5)
    # What is written down makes the same run anew.
    again = record(tmp_path / "e.yaml", rig_file, tmp_path / "new", options={"seed": seeds[1]})
    assert again.frame.equals(runs[1].frame)


@pytest.mark.soak
def test_an_identification_is_the_one_the_command_makes(recorded, found):
    root, training, validation = recorded
    config = write_yaml(root / "id.yaml", QUICK)
    options = ["--config", config, "--validate", validation.folder, "--json"]
    result = rig("identify", training.folder, *options, cwd=root)
    told = json.loads(result.stdout)
    table = found.parameters
    assert list(table.columns) == ["value", "low", "high", "unit", "note"]
    with pd.option_context("display.width", 80):
        assert "..." not in repr(table)  # of 80 columns, which pandas takes in a terminal
    for name, entry in told["parameters"].items():
        assert table.loc[name, "value"] == entry["value"]
        ends = entry.get("interval") or (None, None)
        low, high = (np.nan if end is None else end for end in ends)
        np.testing.assert_equal(table.loc[name, ["low", "high"]].tolist(), [low, high])
    fit = found.metrics.loc[("validation", validation.name, "omega"), "fit_percent"]
    assert fit == told["metrics"]["validation"][0]["outputs"]["omega"]["fit_percent"]
    assert found.trust == told["verdict"]["trust"]
    assert list(found.reasons) == told["verdict"]["reasons"]


@pytest.mark.soak
def test_a_table_does_for_a_log(recorded, tmp_path):
    _, training, validation = recorded
    columns = ["t", "applied_voltage_motor", "applied_voltage_brake", "torque"]
    columns += ["omega", "current_brake", "current_motor"]  # the order does not matter
    # A table says nothing of noise: by a criterion that asks for none the values are the same.
    settings = {**QUICK, "criterion": "likelihood"}
    from_table = identify(training.frame[columns], **settings)
    # Nor of an encoder; a log without the record of its run does as little.
    alone = tmp_path / "log.csv"
    alone.write_bytes(training.path.read_bytes())
    from_log = identify(alone, [validation.folder], **settings)
    assert from_table.parameters["value"].equals(from_log.parameters["value"])


@pytest.mark.soak
def test_a_replay_is_the_same_from_the_result_and_from_its_file(recorded, found, tmp_path):
    _, _, validation = recorded
    replayed = replay(validation, found)
    found.save(tmp_path / "identification")
    for result in ("identification/parameters.yaml", "identification", ""):  # the run's folder
        again = replay(validation.folder, tmp_path / result)
        pd.testing.assert_frame_equal(replayed.frame, again.frame)
    measured = replayed.frame.dropna()  # of some samples an encoder's speed is not known
    omega = measured["omega"]
    error = omega - measured["omega_simulated"]
    fit = 100.0 * (1.0 - np.linalg.norm(error) / np.linalg.norm(omega - omega.mean()))
    assert replayed.fit["omega"] == pytest.approx(fit)
    assert replay(validation).fit["omega"] != fit  # by the simulated rig's own parameters


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.drop(columns="torque"), "needs the column 'torque'"),
        (lambda f: f.assign(omega="fast"), "a column is not of numbers"),
        (lambda f: f.iloc[::-1], "time does not advance"),
        (lambda f: f.assign(torque=np.nan), "torque: it is not finite"),
        (lambda f: f.assign(omega=np.inf), ":0: omega: it is not finite; NaN stands for what"),
        (lambda f: f.assign(omega=f.omega + 1j), "omega: its numbers are complex; give real"),
        (lambda f: f.iloc[:1], "at least 2 are needed"),
    ],
    ids=["no column", "text", "backwards", "missing input", "infinite", "complex", "one row"],
)
def test_a_table_that_will_not_do_is_refused(recorded, change, words):
    _, training, _ = recorded
    with pytest.raises(ConfigError, match=words):
        identify(change(training.frame), **QUICK)


def test_mistakes_are_told_before_anything_moves(recorded, tmp_path):
    _, training, _ = recorded
    with pytest.raises(ConfigError, match="same log is given for training and for validation"):
        identify(training, training, **QUICK)
    with pytest.raises(ConfigError, match="poplation"):
        identify(training, poplation=3)
    write_experiment(tmp_path / "e.yaml")
    with pytest.raises(ConfigError, match="no 'validation' section"):
        record(tmp_path / "e.yaml", validation=True, out=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
    with pytest.raises(AttributeError, match="no attribute 'identfy'"):
        daq.identfy  # noqa: B018


def test_importing_daq_imports_nothing_heavy(tmp_path):
    code = "import sys, daq; dir(daq); print([m for m in sys.modules if m in sys.argv[1:]])"
    heavy = ("numpy", "pandas", "scipy", "numba", "sklearn", "sysid", "sim_rig")
    result = subprocess.run(
        [sys.executable, "-c", code, *heavy],
        cwd=tmp_path, env=environment(), capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert result.stdout == "[]\n"


def test_an_identification_loads_no_statistics_package():
    # Each takes half a second or more of every command.
    code = (
        "import sys, sysid.gassi, sysid.linear, daq.identification.fit, daq.cli.identify, "
        "daq.identification.baseline, sim_rig.backend\n"
        "from sysid.problem.copies import shared_samples\n"
        "from sysid.examples import lag_record\n"
        "shared_samples([lag_record(seed=0), lag_record(seed=1)])\n"
        "print([m for m in sys.modules if m in sys.argv[1:]])"
    )
    scipy = ("scipy.stats", "scipy.signal", "scipy.interpolate")
    heavy = (*scipy, "sklearn", "pandas", "matplotlib", "joblib")
    result = subprocess.run(
        [sys.executable, "-c", code, *heavy],
        env=environment(), capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert result.stdout == "[]\n"


@pytest.mark.soak
def test_the_notebook_does_what_it_shows(tmp_path, monkeypatch):
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] and cell["outputs"] for cell in code)
    assert not any(out["output_type"] == "error" for cell in code for out in cell["outputs"])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(os.environ, "MPLBACKEND", "agg")
    names = {"QUICK": QUICK}
    for cell in code:
        source = "".join(cell["source"]).replace("seed=0", "**QUICK")
        exec(source, names)
    assert names["found"].parameters.loc["K_m", "unit"] == "N*m/A"


def test_no_log_at_all_is_refused_in_words():
    with pytest.raises(ConfigError, match="no log is given to train on; name a run's folder"):
        identify([])
