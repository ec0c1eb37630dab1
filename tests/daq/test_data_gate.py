"""What of a log is used, what is wrong with it, and how it is said before and after a fit."""

import json

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.io import savemat

from daq import ConfigError, identify, record
from daq.identification import records
from daq.identification.fit import faults_of, load_logs
from daq.identification.replay import read_parameters
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from daq.logs.table import read_table
from daq.lookup.shipped import find_file
from sysid.examples import lag_record
from tests.daq.support import OF_LAG, rig

MODEL = "from sysid.examples import lag\nmodel = lag()\n"


def table(seed=0):
    log = lag_record(seed=seed)
    return pd.DataFrame({"t": log.time, "u": log.inputs[:, 0], "y": log.outputs[:, 0]})


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "lag.py").write_text(MODEL)
    for seed, name in enumerate(("day1", "day2")):
        table(seed).to_csv(tmp_path / f"{name}.csv", index=False)
    return tmp_path


def configured(folder, **changes):
    path = folder / "id.yaml"
    path.write_text(yaml.safe_dump({**OF_LAG, **changes}))
    return path


def loaded(folder, name="day1.csv", **changes):
    problem = problem_of(SettingsRequest(str(configured(folder, **changes))))
    return records.load(folder / name, problem.model, problem.mapping, problem.selection)


def settled(folder, *settings, name="day1.csv", **changes):
    """Settings as typed over a file, read and checked."""
    return problem_of(SettingsRequest(str(configured(folder, **changes)), {}, list(settings)))


@pytest.mark.parametrize(
    ("use", "first", "last"),
    [
        ("0.5 s .. 1 s", 50, 100),
        ("500 ms .. 1000 ms", 50, 100),
        ("0.5 ..", 50, 199),
        (".. 1 s", 0, 100),
        ("rows 51 .. 101", 50, 100),
        ("rows 51 ..", 50, 199),
        ({"day1.csv": "0.5 s .. 1 s", "day2": "rows 1 .. 10"}, 50, 100),
        ({"day2": "rows 1 .. 10"}, 0, 199),
    ],
)
def test_a_part_of_a_log_is_used(folder, use, first, last):
    rows = table().iloc[first : last + 1]
    log = loaded(folder, use=use)
    assert log.dataset.inputs[:, 0].tolist() == rows["u"].tolist()
    assert log.dataset.outputs[:, 0].tolist() == rows["y"].tolist()
    assert log.unmended is log.dataset, "what is left out has no faults"


def test_a_cut_is_recorded_and_shown(folder):
    (made, whole) = (loaded(folder, use=use).preparation for use in ("0.5 s .. 1 s", ".. 100 s"))
    assert made.steps == ("cut to 0.5 s .. 1 s, rows 51 .. 101 of 200",)
    assert (made.before.n_samples, made.after.n_samples, made.start) == (200, 51, 0.5)
    assert whole is None


def test_times_are_those_of_the_file(folder):
    late = table().assign(t=lambda rows: rows["t"] + 1000.0)
    late.to_csv(folder / "late.csv", index=False)
    record = loaded(folder, "late.csv", use="1000.5 s .. 1001 s").dataset
    assert record.n_samples == 51


def test_a_run_in_is_simulated_and_not_compared(folder):
    for run_in in ("0.2 s", 0.2, "20 rows"):
        record = loaded(folder, run_in=run_in, use="0.5 s ..").dataset
        assert record.n_samples == 150 and np.isfinite(record.outputs[0, 0])
        assert np.flatnonzero(np.isnan(record.outputs[:, 0])).tolist() == list(range(1, 20))


def test_a_run_in_that_nothing_measured_is_kept(folder):
    rows = table()
    rows.loc[:39, "y"] = np.nan
    rows.to_csv(folder / "late.csv", index=False)
    assert loaded(folder, "late.csv").dataset.n_samples == 160
    record = loaded(folder, "late.csv", run_in="0.4 s").dataset
    assert record.n_samples == 200 and np.isnan(record.outputs[:40]).all()


def test_recordings_and_tables_are_cut_alike(folder):
    problem = settled(folder, use="rows 11 .. 20")
    used = records.from_frame(table(), "t", problem.model, problem.selection).dataset
    assert used.outputs[:, 0].tolist() == table()["y"].tolist()[10:20]


MISTAKES = {
    "no range": ({"use": "20 s"}, "use: write '0 s .. 20 s' or 'rows 1 .. 1000'"),
    "a unit of another kind": ({"use": "1 V .. 2 V"}, "use: 'V' does not convert to 's'"),
    "ends that change places": ({"use": "2 s .. 1 s"}, "its first end, 2, is not below its last"),
    "row zero": ({"use": "rows 0 .. 5"}, "use: rows are counted from 1"),
    "beyond the log": (
        {"use": "20 s .. 30 s"},
        "day1.csv lie in it: the log has rows 1 .. 200, 0 s .. 1.99 s; choose a part of that",
    ),
    "no such log": ({"use": {"day3": "0 s .. 1 s"}}, "use.day3: none of the logs has this name"),
    "noise below zero": ({"noise": {"y": -1.0}}, "noise.y: "),
    "noise of no channel": ({"noise": {"yy": 1.0}}, "noise.yy: the model has no such channel; did"),
    "noise in another unit": ({"noise": {"y": "3 V"}}, "noise.y: 'V' does not convert to 'm'"),
    "a run-in of volts": ({"run_in": "3 V"}, "run_in: 'V' does not convert to 's'"),
    "a run-in of everything": (
        {"run_in": "9 s"},
        "run_in: nothing is left to compare of the 200 samples of",
    ),
    "a freed name of none": (
        {"fixed": {"gian": None}},
        "fixed.gian: the model has no such name; did you mean 'gain'?",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told_with_its_place_and_cure(folder, name):
    changes, message = MISTAKES[name]
    configured(folder, **changes)
    result = rig("identify", "day1.csv", "--config", "id.yaml", cwd=folder)
    assert result.returncode == 2 and message in result.stderr
    assert result.stderr.startswith("rig: id.yaml:") and "Traceback" not in result.stderr


def test_null_frees_a_parameter_again(folder):
    fixed = settled(folder, fixed={"gain": 2.0})
    freed = settled(folder, "fixed.gain=null", fixed={"gain": 2.0})
    assert fixed.settings.fixed == {"gain": 2.0} and freed.settings.fixed == {}


def test_null_frees_a_parameter_that_the_model_fixes(folder):
    fixing = "from dataclasses import replace\n" + MODEL
    fixing += "gain, tau = model.parameters\n"
    fixing += "model = replace(model, parameters=(replace(gain, fixed=True), tau))\n"
    (folder / "lag.py").write_text(fixing)
    assert settled(folder, "fixed.gain=null").settings.ranges == {"gain": (0.2, 20.0)}
    nowhere = fixing.replace("fixed=True", "fixed=True, lower=2.0, upper=2.0")
    (folder / "lag.py").write_text(nowhere)
    with pytest.raises(ConfigError, match=r"fixed\.gain: .*give one: ranges\.gain=\[low, high\]"):
        settled(folder, "fixed.gain=null")


def test_a_reciprocal_is_a_unit(folder):
    columns = json.loads(json.dumps(OF_LAG["columns"]))
    columns["inputs"]["u"] = {"constant": "5 1/mm"}
    text = (MODEL + "from dataclasses import replace\n"
            "model = replace(model, inputs=(replace(model.inputs[0], unit='1/m'),))\n")  # fmt: skip
    (folder / "lag.py").write_text(text)
    assert loaded(folder, columns=columns).dataset.inputs[0, 0] == 5000.0


def test_noise_of_a_channel_is_told_in_units_of_its_own(folder):
    slope = "model = replace(model, inputs=(replace(model.inputs[0], unit='V'),))\n"
    (folder / "lag.py").write_text(f"{MODEL}from dataclasses import replace\n{slope}")
    noisy = loaded(folder, noise={"u": "3 mV"}).dataset
    assert noisy.input_noise == pytest.approx([0.003]) and noisy.output_noise == [0.0]
    assert loaded(folder).dataset.input_noise == [0.0]


@pytest.mark.parametrize(("noise", "trust"), [(0.03, "good"), (0.01, "limited")])
def test_noise_that_is_given_tells_whether_more_could_be_explained(folder, noise, trust):
    config = configured(folder, noise={"y": noise}, population=64, generations=10)  # 0.03 in truth
    verdict = identify(folder / "day1.csv", folder / "day2.csv", config=config).verdict
    assert verdict.parameters.trust == trust
    predicted = " ".join(verdict.predicted.reasons)
    parameters = " ".join(verdict.parameters.reasons)
    assert ("y down to the noise" in predicted) == (trust == "good")
    assert ("y errs 2.7 times as much as its sensors' noise" in parameters) == (trust == "limited")


def test_a_matlab_file_is_a_log(folder):
    rows = table()
    savemat(folder / "day1.mat", {"t": rows["t"], "data": {"u": rows["u"], "y": rows["y"]}})
    columns = {
        "time": {"column": "t"},
        "inputs": {"u": {"column": "data.u"}},
        "outputs": {"y": {"column": "data.y"}},
    }
    record = loaded(folder, "day1.mat", columns=columns).dataset
    np.testing.assert_array_equal(record.outputs[:, 0], rows["y"])
    matrix = {"table": rows.to_numpy()}
    savemat(folder / "matrix.mat", matrix)
    read, _, torn = read_table(folder / "matrix.mat", ["table(:,2)"])
    assert read["table(:,2)"].tolist() == rows["u"].tolist() and not torn


def matlab_mistakes(folder):
    yield "newer.mat", b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM", "of version 7.3"
    yield "text.mat", b"t,u,y\n0,1,2\n" * 20, "no MAT file, or a damaged one"
    yield "none.mat", b"", "no MAT file, or a damaged one"
    savemat(folder / "packed.mat", {"t": np.arange(500.0) ** 0.5}, do_compression=True)
    content = (folder / "packed.mat").read_bytes()
    yield "torn.mat", content[: len(content) // 2], "no MAT file, or a damaged one"
    flipped = content[:-20] + bytes([content[-20] ^ 1]) + content[-19:]
    yield "flipped.mat", flipped, "no MAT file, or a damaged one"


def test_a_matlab_file_that_does_not_read_is_refused_with_the_way_to_convert_it(folder):
    configured(folder)
    for name, content, message in matlab_mistakes(folder):
        (folder / name).write_bytes(content)
        result = rig("identify", name, "--config", "id.yaml", cwd=folder)
        assert result.returncode == 2 and message in result.stderr, result.stderr
        assert "'-v7'" in result.stderr and "Traceback" not in result.stderr
    savemat(folder / "other.mat", {"t": np.arange(5.0), "u": np.arange(4.0), "y": np.arange(5.0)})
    result = rig("identify", "other.mat", "--config", "id.yaml", cwd=folder)
    assert result.returncode == 2 and "differ in length: t has 5, u has 4" in result.stderr


@pytest.mark.parametrize(
    ("text", "n", "torn"),
    [
        ("t,y\n0,1\n1,2", 2, False),
        ("t;y\n0;1,5\n1;2,5", 2, False),
        ("t,y\n0,1.25\n1,2.50\n2,3.7", 2, True),
        ("t,y\n0,1.25\n1,2.50\n2,3.75", 3, False),
        ("t,y\n0,1.25\n1,2.5\n2,3.7", 3, False),
        ("t,y\n0,1\n1", 1, True),
        ("t,y\n0,1\n1,", 1, True),
        ("t,y\n0,1\n1,-", 1, True),
        ("t,y\n0,nan\n1,2", 2, False),
    ],
)
def test_a_last_line_without_newline_is_data_where_it_is_whole(tmp_path, text, n, torn):
    path = tmp_path / "foreign.csv"
    path.write_text(text)
    read, _, is_torn = read_table(path, ["t", "y"], gaps=["y"])
    assert (len(read["t"]), is_torn) == (n, torn)
    killed = tmp_path / "log.csv"
    killed.write_text(text)
    assert read_table(killed, ["t", "y"], gaps=["y"])[2]


def with_faults(folder):
    rows = table()
    rows.loc[[30, 90, 140], "y"] += 60.0
    rows.to_csv(folder / "jolted.csv", index=False)
    return rows


def test_a_fault_is_told_before_the_fit_and_stands_in_the_result(folder):
    with_faults(folder)
    configured(folder)
    result = rig("identify", "jolted.csv", "--config", "id.yaml", "--json", cwd=folder)
    assert result.returncode == 0, result.stderr
    (fault,) = json.loads(result.stdout)["data_faults"]
    assert (fault["kind"], fault["channel"], fault["moves_parameters"]) == ("outliers", "y", True)
    warning = result.stderr.index("rig: warning: jolted: 3 samples of y (1.5 %) stand off")
    assert warning < result.stderr.index("Genetic search") if "Genetic" in result.stderr else True
    assert "'robust: true'" in fault["sentence"]


def test_robust_leaves_outliers_out(folder):
    with_faults(folder)
    plain, robust, clean = (
        identify(folder / name, config=configured(folder), **changes, generations=10, population=64)
        for name, changes in (
            ("jolted.csv", {}), ("jolted.csv", {"robust": True}), ("day1.csv", {})
        )
    )  # fmt: skip
    gains = [abs(r.parameters.loc["gain", "value"] / 3.0 - 1.0) for r in (plain, robust, clean)]
    assert gains[0] > 0.02 and gains[1] < 0.01 and gains[2] < 0.01
    (fault,) = robust.faults
    assert (fault.severity, fault.moves_parameters) == ("note", False)
    assert "count as not measured" in fault.sentence
    record = loaded(folder, "jolted.csv", robust=True).dataset
    assert np.flatnonzero(np.isnan(record.outputs[:, 0])).tolist() == [30, 90, 140]


def test_a_copy_of_the_training_log_is_no_validation(folder):
    configured(folder)
    (folder / "other.csv").write_bytes((folder / "day1.csv").read_bytes())
    table().round(3).to_csv(folder / "rounded.csv", index=False)
    for copy in ("other.csv", "rounded.csv"):
        for command in (["day1.csv", "--validate", copy], ["day1.csv", copy]):
            result = rig("identify", *command, "--config", "id.yaml", cwd=folder)
            assert result.returncode == 2
            assert f"{copy}: its samples are those of day1.csv, which is" in result.stderr


@pytest.mark.soak
def test_errors_stand_in_physical_units_everywhere(folder):
    configured(folder)
    words = ("identify", "day1.csv", "--validate", "day2.csv", "--config", "id.yaml")
    result = rig(*words, "--out", "results", cwd=folder, report=True)
    assert result.returncode == 0, result.stderr
    document = json.loads((folder / "results" / "report.json").read_text("utf-8"))
    (log,) = document["metrics"]["validation"]
    errors = log["outputs"]["y"]
    expected = errors["rmse"] * errors["max_abs"]
    assert errors["rmse_absolute"] == pytest.approx(expected) and errors["unit"] == "m"
    rows = pd.read_csv(folder / "results" / "errors.csv")
    row = rows[rows["part"] == "validation"].iloc[0]
    assert row["rmse_absolute"] == pytest.approx(expected) and row["unit"] == "m"
    page = (folder / "results" / "report.html").read_text("utf-8")
    assert f'data-value="{errors["rmse_absolute"]!r}"' in page and 'data-log="day2"' in page
    assert r"\begin{tabular}" in (folder / "results" / "errors.tex").read_text("utf-8")
    assert " mm " in result.stdout


@pytest.mark.soak
def test_a_report_of_a_part_of_a_log_is_drawn_again(folder):
    configured(folder, use="0.5 s ..", run_in="5 rows")
    words = ("identify", "day1.csv", "--config", "id.yaml", "--out", "results")
    assert rig(*words, cwd=folder, report=True).returncode == 0
    figure = folder / "results" / "figures" / "training.svg"
    before = figure.read_bytes()
    figure.unlink()
    again = rig("figures", "results", "--format", "svg", "--trust", cwd=folder)
    assert again.returncode == 0, again.stderr
    assert figure.read_bytes() == before


RUBBING = {"equation": "y", "of": "y", "shape": "sign", "scale": 0.01, "range": [-50.0, 50.0]}


def test_terms_are_added_to_a_model_and_kept_in_its_result(folder):
    problem = settled(folder, terms=[RUBBING])
    assert problem.model.parameter_names == ("gain", "tau", "sign_of_y")
    assert problem.model.parameters[-1].unit == "m/s"
    at = ((1.0,), (0.0,), (2.0, 0.5, -3.0))
    assert problem.model.derivative(*at) == (-5.0,)
    typed = settled(folder, f"terms=[{json.dumps(RUBBING)}]", "ranges.tau=[1e-6, 9]")
    assert typed.settings.ranges["tau"] == (1e-6, 9.0)
    assert typed.model.parameter_names == problem.model.parameter_names
    # A result is read with them.
    values = {"gain": {"value": 2.0}, "tau": {"value": 0.5}, "sign_of_y": {"value": -3.0}}
    document = {"model": str(folder / "lag.py:model"), "terms": [RUBBING], "parameters": values}
    (folder / "found.yaml").write_text(yaml.safe_dump(document))
    model, found = read_parameters(folder / "found.yaml", trust=True)
    assert model.derivative(at[0], at[1], tuple(found[n] for n in model.parameter_names)) == (-5.0,)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"of": "speed"}, r"id.yaml:\d+:\d+: terms.0: .*no state, input or parameter 'speed'"),
        ({"scale": -1.0}, r"terms.0.scale"),
        ({"shape": "wave"}, r"terms.0.shape"),
        ({"range": [3.0, 2.0]}, r"terms.0: .*low end at or above"),
    ],
)
def test_a_term_that_is_none_is_named(folder, change, named):
    with pytest.raises(ConfigError, match=named):
        settled(folder, terms=[{**RUBBING, **change}])


@pytest.mark.soak
def test_a_sensor_between_motor_and_brake_is_not_taken_for_one_at_the_load(tmp_path):
    text = find_file("protocol", "constant_velocity.yaml").read_text(encoding="utf-8")
    quick = {"velocities": [20.0], "brake_commands": [0.0], "measure": 0.5}
    (tmp_path / "quick.yaml").write_text(yaml.safe_dump({**yaml.safe_load(text), **quick}))
    run = record(tmp_path / "quick.yaml", options={"seed": 0}, out=tmp_path)
    sentences = {}
    for model in ("actuator", "actuator:load=free,sensor=between"):
        problem = problem_of(SettingsRequest(None, {"model": model}))
        faults = faults_of(problem, load_logs(problem, [run.folder], []))
        sentences[model] = [fault.sentence for fault in faults if fault.kind == "place"]
    assert "--model actuator:load=free,sensor=between" in sentences["actuator"][0]
    assert not sentences["actuator:load=free,sensor=between"]
