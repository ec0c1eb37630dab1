"""What ``rig identify`` tells of how far its numbers can be trusted, and where it knows it from."""

import html
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy.signal import lfilter

from daq.errors import ConfigError
from daq.identification import records as datasets
from daq.identification.rows import Rows
from daq.logs.capture import RUN_NAME
from daq.report.pictures import _loops, _parameters
from sim_rig.actuator import actuator
from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from tests.daq.support import few_free, forked_rig, only_capture, write_experiment

# A gain of which only a product acts, another that wants to be lower than its range allows, and a
# parameter that nothing depends on.
MODEL = """
from sysid import Input, Output, Parameter, ProcessModel, State


def derivative(x, u, p):
    tau, a, b, c, idle = p
    return ((a * b * u[0] + c * u[1] + 1e-7 * idle - x[0]) / tau,)


model = ProcessModel(
    name="gains",
    states=(State("y", "m"),),
    inputs=(Input("u", "V"), Input("w", "V"), Input("still", "V")),
    outputs=(Output("y", "m"),),
    parameters=(
        Parameter("tau", "s", 0.3, 0.05, 1.0, "log"),
        Parameter("a", "m/kg", 2.0, 0.5, 10.0, "log"),
        Parameter("b", "kg", 1.0, 0.2, 5.0, "log"),
        Parameter("c", "m/V", 0.1, 0.05, 1.0, "log"),
        Parameter("idle", "m", 0.1, 0.01, 1.0, "log"),
    ),
    derivative=derivative,
)
"""
CONFIG = """
model: gains.py:model
population: 40
generations: 8
initial: {y: first}
columns:
  time: {column: t}
  inputs: {u: {column: u}, w: {column: w}, still: {constant: 0}}
  outputs: {y: {column: y}}
"""
TAU, GAIN, LOW, DT = 0.2, 1.5, 0.045, 0.01


def write_log(path, seed, n=500):
    rng = np.random.default_rng(seed)
    u, w = (np.repeat(rng.choice([-1.0, 1.0], n // 20), 20) for _ in range(2))
    pole = np.exp(-DT / TAU)
    y = lfilter([0.0, 1.0 - pole], [1.0, -pole], GAIN * u + LOW * w)
    y += 0.05 * rng.standard_normal(n)
    rows = "".join(f"{DT * k:.2f},{u[k]},{w[k]},{y[k]:.6f}\n" for k in range(n))
    path.write_text("t,u,w,y\n" + rows)


@pytest.fixture(scope="module")
def command():
    with forked_rig() as run:
        yield run


@pytest.fixture(scope="module")
def identify(command, folder):
    """Standard output of an identification from the two logs."""

    def run(*args):
        logs = ("training.csv", "--validate", "validation.csv", "--config", "id.yaml")
        result = command(("identify", *logs, *args), folder)
        assert result.returncode == 0, result.stderr
        return result.stdout

    return run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("report")
    write_log(root / "training.csv", 1)
    write_log(root / "validation.csv", 2)
    (root / "gains.py").write_text(MODEL)
    (root / "id.yaml").write_text(CONFIG)
    return root


@pytest.fixture(scope="module")
def told(identify, folder):
    """The report for people, and what ``parameters.yaml`` says of the same."""
    text = identify("--out", "found")
    return text, yaml.safe_load((folder / "found" / "parameters.yaml").read_text("utf-8"))


def row(text, first):
    """Cells of the table row that begins with a name."""
    (line,) = re.findall(rf"^ {re.escape(first)}  .*$", text, flags=re.MULTILINE)
    return re.split(r"\s{2,}", line.strip())


def ends(cell):
    low, high = cell.split(" .. ")
    return float(low), float(high)


# --- the report -----------------------------------------------------------------------------------


def test_what_the_data_determine_has_an_interval(told):
    text, document = told
    tau = document["parameters"]["tau"]
    name, value, interval, unit, searched = row(text, "tau")
    assert (name, unit, searched) == ("tau", "s", "0.05 .. 1")
    assert float(value) == pytest.approx(tau["value"], abs=0.51 * tau["std"])
    assert ends(interval) == pytest.approx(tau["interval"], abs=0.51 * tau["std"])
    low, high = tau["interval"]
    assert low < TAU < high and low < tau["value"] < high
    assert "undetermined" not in tau and tau["on_bound"] is False


def test_what_they_do_not_determine_has_none_and_says_why(told):
    text, document = told
    for name in ("a", "b"):
        entry, cells = document["parameters"][name], row(text, name)
        assert entry["undetermined"] == "tied" and not {"std", "interval"} & set(entry)
        assert cells[2] == "-" and cells[-1].startswith("only together")
    idle = document["parameters"]["idle"]
    assert idle["undetermined"] == "vague" and "interval" not in idle
    assert row(text, "idle")[2] == "-" and row(text, "idle")[-1].startswith("hardly felt")


def test_what_the_range_holds_has_one_end(told):
    text, document = told
    entry, cells = document["parameters"]["c"], row(text, "c")
    low, high = entry["interval"]
    assert low is None and 0.05 < high < 0.06 and "std" not in entry
    # The true one is less than two standard deviations beyond: nothing calls for a wider range.
    assert entry["on_bound"] is entry["harmless"] is True and entry["pushed"] is False
    assert cells[2].startswith("< ") and "at its end" not in cells
    assert "set 'ranges'" not in text


def test_what_acts_only_together_is_told_with_what_would_help(told):
    text, document = told
    (exact,) = document["ambiguities"]
    assert (exact["kind"], exact["parameters"], exact["measure"]) == ("tied", ["b", "a"], ["b"])
    (product,) = exact["determined"]
    low, high = product["interval"]
    assert product["name"] == "a b" and low < GAIN < high
    assert "  b, a act only together." in text
    (shown,) = re.findall(r"a b = (\S+) m, 95 % interval (\S+ \.\. \S+)", text)
    assert float(shown[0]) == pytest.approx(product["value"], abs=0.51 * product["std"])
    assert ends(shown[1]) == pytest.approx((low, high), abs=0.51 * product["std"])
    assert "measure b by other means" in text and "under 'fixed'" in text
    # Of tau, b a, c and idle, however little that moves.
    assert document["determined_directions"] == 4
    determined = "1 of 5 free parameters each by itself, 1 on one side and 1 combination"
    assert f"Determined: {determined}." in " ".join(text.split())
    together = "Of 100 repetitions each interval holds the true value in 95, all 3 at once in"
    assert together in " ".join(text.split())


def test_the_digits_shown_are_those_that_are_known(told):
    text, document = told
    tau = document["parameters"]["tau"]
    shown = row(text, "tau")[1]
    last = 10.0 ** -len(shown.partition(".")[2])
    # Rounding costs nothing, and no digit is noise alone.
    assert tau["std"] / 100.0 < last <= tau["std"]


def test_residual_tests_and_verdict_are_those_of_the_document(told):
    text, document = told
    (validated,) = document["metrics"]["validation"]
    output = validated["outputs"]["y"]
    assert validated["name"] == "validation" and output["rmse"] > 0.0
    assert set(output["residual_independent_of"]) == {"u", "w"}, "the last never changes"
    cells = row(text[text.index("Residuals, validation") :], "y")
    independent = output["residual_independent_of"]
    shares = (output["residual_autocorrelation_in_band"], independent["u"], independent["w"])
    assert cells == ["y", *(f"{100.0 * share:.0f} %" for share in shares)]
    assert document["verdict"]["trust"] == "good", "an end that decides nothing is no reason"
    for subject in ("predictions", "parameters"):
        statement = document["verdict"][subject]
        said = f"{subject.capitalize()}: {statement['trust']}. {' '.join(statement['reasons'])}"
        assert said in text
    # By less than its uncertainty beyond the end: what is missing can still be told.
    assert document["missing"]["findings"] == []


@pytest.mark.soak
def test_without_validation_the_residuals_are_those_of_the_training(command, folder):
    result = command(("identify", "training.csv", "--config", "id.yaml", "--out", "alone"), folder)
    assert "Residuals, training: share of correlations" in result.stdout
    assert "Predictions: limited. No data were held back for validation" in result.stdout


def test_json_is_what_the_file_holds(identify, folder, told):
    document = json.loads(identify("--out", "json", "--json"))
    kept = yaml.safe_load((folder / "json" / "parameters.yaml").read_text("utf-8"))
    assert document.pop("files") == {"parameters": str(Path("json/parameters.yaml"))}
    assert document == json.loads(json.dumps(kept))
    # And one seed gives one report.
    before = json.loads(json.dumps(told[1]))
    for part in ("parameters", "ambiguities", "verdict", "metrics", "singular_values"):
        assert document[part] == before[part]


@pytest.mark.soak
def test_replay_reads_the_parameters_of_a_report(command, folder, told):
    parameters = ("--parameters", "found/parameters.yaml", "--config", "id.yaml")
    result = command(("replay", "validation.csv", *parameters, "--trust", "--json"), folder)
    assert result.returncode == 0, result.stderr
    again = json.loads(result.stdout)["outputs"]["y"]
    (validated,) = told[1]["metrics"]["validation"]
    assert again["rmse"] == pytest.approx(validated["outputs"]["y"]["rmse"], rel=1e-6)


@pytest.mark.soak
def test_fixing_what_should_be_measured_gives_all_the_rest(identify):
    settings = ("--set", "fixed.b=1", "--set", "fixed.idle=0.1")
    report = json.loads(identify("--out", "fixed", "--json", *settings))
    assert report["ambiguities"] == []
    a = report["parameters"]["a"]
    assert a["interval"][0] < GAIN < a["interval"][1]


@pytest.mark.soak
def test_the_thesis_preset_has_no_intervals_and_says_nothing_of_them(identify, folder):
    text = identify("--preset", "thesis", "--out", "thesis")
    assert "95 % interval" not in text and "act only together" not in text
    assert "Determined: " not in text and "Parameters: limited. " in text
    assert "The parameters have no intervals" in text
    document = yaml.safe_load((folder / "thesis" / "parameters.yaml").read_text("utf-8"))
    assert not {"ambiguities", "determined_directions", "correlations"} & set(document)
    for entry in document["parameters"].values():
        assert not {"std", "interval", "undetermined"} & set(entry)
    assert document["verdict"]["trust"] in {"good", "limited", "poor"}


# --- what the calibration of a run tells ----------------------------------------------------------


@pytest.fixture(scope="module")
def captured(command, tmp_path_factory):
    root = tmp_path_factory.mktemp("captured")
    write_experiment(root / "e.yaml", calibration={"samples": 1600}, duration=0.2)
    result = command(("run", "e.yaml"), root)
    assert result.returncode == 0, result.stderr
    return only_capture(root)


def loaded(folder):
    return datasets.load(folder, actuator(), None).dataset


@pytest.fixture
def record(captured):
    """The run record, put back after the test has written another."""
    path = captured / RUN_NAME
    text = path.read_text("utf-8")
    yield json.loads(text)
    path.write_text(text)


def test_noise_and_zeros_of_a_run_reach_the_data(captured, record):
    model, data = actuator(), loaded(captured)
    noise = record["calibration"]["noise"]
    assert record["calibration"]["samples"] == 1600
    # 10 mV rms at 0.5 A/V and 0.706 N*m/V, to the 2 % that 1600 samples give, and quantisation.
    expected = {"current_motor": 5e-3, "current_brake": 5e-3, "torque": 7.06e-3}
    assert noise == pytest.approx(expected, rel=0.08)
    inputs, outputs = model.input_names, model.output_names
    torque = inputs.index("torque")
    assert data.input_noise[torque] == noise["torque"]
    assert data.input_zero[torque] == pytest.approx(noise["torque"] / math.sqrt(1600))
    known = {"current_motor", "current_brake"}
    for name, zero in zip(outputs, data.output_zero, strict=True):
        assert zero == pytest.approx(noise[name] / 40.0 if name in known else 0.0)
    # What was commanded is known; what the encoder counts has no zero of its own.
    others = [i for i in range(len(inputs)) if i != torque]
    assert not data.input_noise[others].any() and not data.input_zero[others].any()


def test_a_run_recorded_without_calibration_still_loads(captured, record):
    del record["calibration"]
    (captured / RUN_NAME).write_text(json.dumps(record))
    data = loaded(captured)
    assert not any(v.any() for v in (data.input_noise, data.input_zero, data.output_zero))
    (captured / RUN_NAME).unlink()
    assert not loaded(captured).input_noise.any()


MALFORMED = {
    "a number": 16,
    "nothing": None,
    "a list": [1, 2],
    "noise a number": {"samples": 16, "noise": 0.1},
    "noise negative": {"samples": 16, "noise": {"torque": -0.1}},
    "noise not a number": {"samples": 16, "noise": {"torque": "low"}},
    "noise nan": {"samples": 16, "noise": {"torque": math.nan}},
    "noise null": {"samples": 16, "noise": {"torque": None}},
    "no samples": {"samples": 0, "noise": {"torque": 0.1}},
    "samples a word": {"samples": "many", "noise": {"torque": 0.1}},
    "samples without end": {"samples": math.inf, "noise": {"torque": 0.1}},
}


@pytest.mark.parametrize("case", MALFORMED)
def test_a_calibration_that_makes_no_sense_is_refused(captured, record, case):
    path = captured / RUN_NAME
    path.write_text(json.dumps({**record, "calibration": MALFORMED[case]}))
    with pytest.raises(ConfigError) as error:
        loaded(captured)
    said = str(error.value)
    assert str(path) in said and "'calibration'" in said and "delete it to go without" in said


@pytest.mark.soak
def test_the_ends_of_amplifiers_are_named_with_what_rests_on_them(command, captured):
    root = captured.parent
    (root / "few.yaml").write_text(yaml.safe_dump(few_free("R_b", limits=True)))
    words = ("--model", "actuator:limits=true", "--config", "few.yaml", "--out", "limited")
    result = command(("identify", captured, *words), root, report=True)
    assert result.returncode == 0, result.stderr
    assert "Parameters of actuator:limits=true\n" in result.stdout
    page = (root / "limited" / "report.html").read_text("utf-8")
    said = " ".join(html.unescape(re.sub("<[^>]*>", "", page)).split())
    assert "Identification of the model “actuator:limits=true”" in said
    assert "dib/dt=sat(vb,24)−Rbib" in re.sub(r"\s", "", said)
    (sentence,) = actuator(limits=True).assumptions
    assert sentence in said and sentence in " ".join(result.stdout.split())
    assert (root / "limited" / "figures" / "hysteresis.svg").exists()
    replayed = command(("replay", captured, "--parameters", "limited"), root)
    assert "through actuator:limits=true with the parameters of limited" in replayed.stdout


@pytest.mark.soak
def test_starts_of_states_are_in_the_table_and_not_in_the_figure(command, captured):
    root = captured.parent
    (root / "tied.yaml").write_text(yaml.safe_dump(few_free("R_m", "alpha0", "alpha1", "A")))
    words = ("--model", "actuator", "--config", "tied.yaml", "--out", "tied")
    result = command(("identify", captured, *words), root, report=True)
    assert result.returncode == 0, result.stderr
    page = (root / "tied" / "report.html").read_text("utf-8")
    assert re.search(r'data-quantity="[^"]*z\(0\)', page)
    assert "Those with starts of states in the logs are in the table." in page
    rows = Rows.of(json.loads((root / "tied" / "report.json").read_text("utf-8")))
    figure = next(p.figure for p in _parameters(rows) if p.name == "intervals")
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert any("alpha" in label for label in labels)
    assert not any("(0)" in label for label in labels)


@pytest.mark.soak
def test_starts_of_many_logs_are_a_line_and_no_parameters(command, tmp_path):
    (tmp_path / "hidden.py").write_text(
        "from sysid import Input, Output, Parameter, ProcessModel, State\n"
        "model = ProcessModel(\n"
        "    name='hidden', inputs=(Input('u', 'V'),), outputs=(Output('y', 'm'),),\n"
        "    states=(State('x', 'A', initial_range=(-3.0, 3.0)),),\n"
        "    parameters=(Parameter('a', 'A/V', 1.0, 0.1, 10.0, 'log'),\n"
        "                Parameter('b', 'm/A', 1.0, 0.1, 10.0, 'log')),\n"
        "    derivative=lambda x, u, p: ((p[0] * u[0] - x[0]) / 0.2,),\n"
        "    output=lambda x, u, p: (p[1] * x[0],),\n"
        ")\n"
    )
    logs = [f"log{k}.csv" for k in range(4)]
    for k, log in enumerate(logs):
        write_log(tmp_path / log, k)
    words = ["--model", "hidden.py:model", "--population", 40, "--generations", 8]
    result = command(["identify", *logs, *words, "--out", "all"], tmp_path, report=True)
    assert result.returncode == 0, result.stderr
    text = " ".join(result.stdout.split())
    assert "each by itself, 1 combination and 4 starts of logs." in text
    assert re.search(r"(a, b, x\(0\)|b, a, x\(0\)|x\(0\), \w, \w) act only together\.", text)
    document = yaml.safe_load((tmp_path / "all" / "parameters.yaml").read_text("utf-8"))
    (exact,) = document["ambiguities"]
    starts = {row["name"]: row["value"] for row in exact["determined"] if "(0)" in row["name"]}
    assert len(starts) == 4
    first = next(iter(starts))
    (shown,) = re.findall(rf"{re.escape(first[:-2])} = (\S+ \.\. \S+) \S+ in the 4 logs", text)
    assert ends(shown) == pytest.approx([min(starts.values()), max(starts.values())], rel=0.1)
    page = (tmp_path / "all" / "report.html").read_text("utf-8")
    folded = page.partition('<details id="starts">')[2].partition("</details>")[0]
    assert all(f'data-quantity="{name}"' in folded for name in starts)
    assert page.count(f'"{first}"') == folded.count(f'"{first}"')


def test_the_command_line_refuses_it_too(command, captured, record):
    path = captured / RUN_NAME
    path.write_text(json.dumps({**record, "calibration": {"noise": {"torque": -1}}}))
    result = command(("identify", captured), captured.parent)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.count("\n") == 1 and f"{path}: 'calibration' must hold" in result.stderr


def test_a_users_model_has_its_forces_over_its_motion():
    model = ProcessModel(
        name="damper",
        states=(State("position", "m"),),
        inputs=(Input("velocity", "m/s"), Input("current", "A")),
        outputs=(Output("force", "N"), Output("position", "m")),
        parameters=(Parameter("c", "N*s/m", 1.0, 0.1, 10.0),),
        derivative=lambda x, u, p: (u[0],),
        output=lambda x, u, p: (p[0] * u[0], x[0]),
    )
    u, y = np.random.default_rng(0).normal(size=(2, 50, 2))
    data = Dataset(u, y, 0.01, "one")
    log = SimpleNamespace(dataset=data)
    (picture,) = _loops(SimpleNamespace(model=model, training=[(log, 2.0 * y)]))
    assert picture.topic == "torque" and picture.caption.startswith("force over velocity")
    drawn = {
        (panel.get_xlabel(), line.get_label()): line.get_xydata()
        for panel in picture.figure.axes
        for line in panel.lines
    }
    np.testing.assert_array_equal(drawn["velocity [m/s]", "measured"], np.c_[u[:, 0], y[:, 0]])
    twice = np.c_[2.0 * y[:, 1], 2.0 * y[:, 0]]
    np.testing.assert_array_equal(drawn["position [m]", "identified"], twice)
