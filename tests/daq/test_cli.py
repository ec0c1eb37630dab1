"""The ``rig`` command as people, pipes and other programs meet it."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.daq.support import (
    RIG,
    environment,
    few_free,
    only_capture,
    rig,
    until,
    write_experiment,
    write_rig,
    write_yaml,
)
from tests.daq.test_bad_input import MODEL

PROJECT = Path(__file__).parents[2] / "pyproject.toml"
COMMANDS = ("run", "check", "identify", "figures", "campaign", "replay", "models", "scope")


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A capture of the ideal rig, at the working folder of the tests that only read it."""
    root = tmp_path_factory.mktemp("captured")
    write_experiment(root / "e.yaml", validation={"motor": {"seed": 77}})
    write_rig(root / "rig.yaml", options={"ideal": True})
    write_yaml(root / "few.yaml", few_free())
    assert rig("run", "e.yaml", "--rig", "rig.yaml", cwd=root).returncode == 0
    return root, only_capture(root)


def files_under(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# --- help ---------------------------------------------------------------------------------


def test_help_lists_the_commands_and_where_to_start(tmp_path):
    result = rig("--help", cwd=tmp_path)
    assert result.returncode == 0 and result.stderr == ""
    assert "rig run prbs.yaml --identify" in result.stdout
    for command in COMMANDS:
        assert re.search(rf"\b{command}\b", result.stdout)
    assert result.stdout.count("...") == 1, "a command's line is cut; but for ARGS..."


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_each_command_has_an_example(tmp_path, command):
    result = rig(command, "--help", cwd=tmp_path)
    assert result.returncode == 0 and f"Example:  rig {command}" in result.stdout


def test_the_installed_command_is_the_module(tmp_path):
    script = Path(sys.executable).with_name("rig")
    installed = subprocess.run(
        [script, "models"], cwd=tmp_path, env=environment(), capture_output=True,
        encoding="utf-8", check=True,
    )  # fmt: skip
    assert installed.stdout == rig("models", cwd=tmp_path).stdout
    version = re.search(r'^version = "(.+)"', PROJECT.read_text("utf-8"), re.M)[1]
    assert rig("--version", cwd=tmp_path).stdout == f"hybrid-rig {version}\n"


# --- JSON ---------------------------------------------------------------------------------


@pytest.mark.soak
def test_json_of_a_run_with_identification_is_one_document(tmp_path):
    model = "actuator:friction=none"
    validation = {"motor": {"seed": 77}}
    write_experiment(tmp_path / "e.yaml", duration=0.2, validation=validation, model=model)
    write_yaml(tmp_path / "id.yaml", few_free())
    result = rig("run", "e.yaml", "--identify", "--config", "id.yaml", "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    assert document["run"]["samples"] == document["validation"]["samples"] == 160
    assert document["run"]["folder"] != document["validation"]["folder"]
    found = document["identification"]
    assert found["model"] == model
    assert len(found["parameters"]) == 21 and found["search"]["generations"] == 2
    assert len(found["metrics"]["training"]) == len(found["metrics"]["validation"]) == 1
    assert (tmp_path / found["files"]["parameters"]).exists()


@pytest.mark.soak
def test_json_of_identify_check_models_and_replay(captured, tmp_path):
    root, folder = captured
    out = tmp_path / "out"
    small = ("--config", "few.yaml", "--out", out)
    identified = rig("identify", folder, *small, "--json", cwd=root)
    assert identified.returncode == 0, identified.stderr
    report = json.loads(identified.stdout)
    assert report["model"] == "actuator" and report["error"]["value"] > 0.0
    kept = yaml.safe_load((out / "parameters.yaml").read_text("utf-8"))
    assert kept["parameters"]["K_m"]["value"] == report["parameters"]["K_m"]["value"]

    replayed = rig("replay", folder, "--parameters", out / "parameters.yaml", "--json", cwd=root)
    metrics = json.loads(replayed.stdout)["outputs"]
    trained = report["metrics"]["training"][0]["outputs"]
    assert metrics["omega"]["rmse"] == pytest.approx(trained["omega"]["rmse"], rel=1e-9)

    checked = json.loads(rig("check", "e.yaml", "--json", cwd=root).stdout)
    assert checked["samples"] == 400 and checked["channels"]["motor"]["highest_volts"] == 0.85
    models = json.loads(rig("models", "--json", cwd=root).stdout)
    assert "actuator" in models and len(models["actuator"]["parameters"]) == 21
    one = json.loads(rig("models", "actuator", "--json", cwd=root).stdout)
    assert one == models["actuator"]


def test_replay_with_the_rigs_own_parameters_follows_an_ideal_log(captured):
    root, folder = captured
    result = rig("replay", folder, "--rig", "rig.yaml", "--json", cwd=root)
    outputs = json.loads(result.stdout)["outputs"]
    # The load torque between samples is interpolated; the currents hardly depend on it.
    assert outputs["current_brake"]["rmse"] < 1e-3
    assert outputs["current_motor"]["rmse"] < 0.02


# --- check --------------------------------------------------------------------------------


def test_check_touches_nothing(captured):
    root, _ = captured
    before = files_under(root)
    result = rig("check", "e.yaml", "--rig", "rig.yaml", cwd=root)
    assert result.returncode == 0 and "Next: rig run e.yaml" in result.stdout
    assert files_under(root) == before


def test_what_check_suggests_next_is_a_command_that_works(captured):
    root, _ = captured
    result = rig("check", "e.yaml", "--rig", "rig.yaml", cwd=root)
    (line,) = [s for s in result.stdout.splitlines() if s.startswith("Next: ")]
    assert line == "Next: rig run e.yaml --rig rig.yaml --identify"


# --- terminals and pipes ------------------------------------------------------------------


def on_terminal(args, cwd, answer=None):
    """Run ``rig`` with its standard error on a terminal.

    answer: called with the text so far and the process, whenever more has come. Returns status,
    terminal text and standard output.
    """
    import pty  # not on Windows

    master, slave = pty.openpty()
    process = subprocess.Popen(
        [*RIG, *map(str, args)], cwd=cwd, env=environment(TERM="xterm", COLUMNS="120"),
        stdin=slave, stdout=subprocess.PIPE, stderr=slave, text=True,
    )  # fmt: skip
    os.close(slave)
    text = ""
    try:
        while True:
            try:
                data = os.read(master, 65536)
            except OSError:  # the last process on the terminal has gone
                break
            if not data:
                break
            text += data.decode(errors="replace")
            if answer is not None:
                answer(text, process)
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
        os.close(master)
    return process.returncode, text, out


@pytest.mark.soak
def test_a_terminal_shows_progress_as_it_goes(tmp_path):
    write_experiment(tmp_path / "e.yaml", duration=1.5)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    status, text, out = on_terminal(["run", "e.yaml", "--rig", "rig.yaml"], tmp_path)
    assert status == 0 and "Log: " in out
    seen = {int(n) for n in re.findall(r"(\d+)/1200 samples", text)}
    assert 1200 in seen and len(seen) > 3, "the bar moves while the run goes on"
    assert "\x1b[" in text


def test_a_pipe_shows_one_plain_line_per_phase(tmp_path):
    write_experiment(tmp_path / "e.yaml", homing={"turns": 0.5, "timeout": 30})
    result = rig("run", "e.yaml", cwd=tmp_path)
    lines = result.stderr.splitlines()
    assert [re.sub(r" \(.*", "", line) for line in lines] == [
        "rig: note: e on simulated rig",
        "Offset calibration: 16/16 samples",
        "Winding the load: 0.5/0.5 turns",
        "Exciting and logging: 400/400 samples",
    ]
    assert "\x1b" not in result.stderr + result.stdout and "\r" not in result.stderr


@pytest.mark.soak
def test_a_reader_that_leaves_early_causes_no_traceback(tmp_path):
    for args in (["models"], ["models", "actuator"], ["models", "--json"], ["--help"]):
        reader, writer = os.pipe()
        os.close(reader)
        process = subprocess.run(
            [*RIG, *args], cwd=tmp_path, env=environment(), stdout=writer, stderr=subprocess.PIPE,
            text=True, check=False,
        )  # fmt: skip
        os.close(writer)
        assert process.stderr == "", args


# --- names --------------------------------------------------------------------------------


def test_a_bare_name_means_the_shipped_file_unless_there_is_one_here(tmp_path):
    shipped = json.loads(rig("check", "prbs.yaml", "--json", cwd=tmp_path).stdout)
    assert shipped["samples"] == 1000 and Path(shipped["experiment"]).parent.name == "protocols"
    without = json.loads(rig("check", "prbs", "--json", cwd=tmp_path).stdout)
    assert without == shipped
    write_experiment(tmp_path / "prbs.yaml")
    here = json.loads(rig("check", "prbs.yaml", "--json", cwd=tmp_path).stdout)
    assert here["samples"] == 400 and here["experiment"] == "prbs.yaml"


def test_a_rig_file_here_goes_before_the_shipped_one(tmp_path):
    write_rig(tmp_path / "simulated.yaml", name="my own")
    assert json.loads(rig("check", "prbs.yaml", "--json", cwd=tmp_path).stdout)["rig"] == "my own"


# --- a model and a log of one's own ---------------------------------------------------------


def foreign_log(path, tau=0.2, n=400, dt=0.01):
    """A first-order lag behind -1 * u + 3 mm, in millimetres and milliseconds."""
    rng = np.random.default_rng(8)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 20), 20)
    y = np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = u[k] + 0.003 + (y[k] - u[k] - 0.003) * np.exp(-dt / tau)
    lines = ["Time (ms), Input, Position"]
    lines += [f"{1e3 * dt * k:.0f}, {-u[k]}, {1e3 * y[k]}" for k in range(n)]
    path.write_text("\n".join(lines) + "\n")


OWN_MODEL = MODEL.replace("(u[0] - x[0])", "(u[0] + u[1] - x[0])").replace(
    'inputs=(Input("u", "m"),)', 'inputs=(Input("u", "m"), Input("bias", "m"))'
)
OWN_CONFIG = """\
model: lag.py:model
population: 30
generations: 8
columns:
  time: {column: Time (ms), unit: ms}
  inputs:
    u: {column: Input, sign: -1}
    bias: {constant: 3, unit: mm}
  outputs:
    y: {column: Position, unit: mm}
"""


@pytest.mark.soak
def test_a_model_and_a_csv_of_ones_own_work_like_the_built_in(tmp_path):
    work = tmp_path / "work"
    work.mkdir()
    foreign_log(work / "bench.csv")
    (tmp_path / "lag.py").write_text(OWN_MODEL)
    (tmp_path / "id.yaml").write_text(OWN_CONFIG)
    # The model's file is named relative to the configuration that names it.
    result = rig("identify", "bench.csv", "--config", "../id.yaml", "--out", "../found", cwd=work)
    assert result.returncode == 0, result.stderr
    assert "Parameters of lag" in result.stdout
    found = yaml.safe_load((tmp_path / "found" / "parameters.yaml").read_text("utf-8"))
    assert found["parameters"]["tau"]["value"] == pytest.approx(0.2, rel=1e-3)
    assert found["metrics"]["training"][0]["outputs"]["y"]["max_abs"] == pytest.approx(1.0, rel=0.1)
    # The command that it suggests works as it stands.
    (line,) = [s for s in result.stdout.splitlines() if s.startswith("Next: rig ")]
    replayed = rig(*line.removeprefix("Next: rig ").split(), "--json", cwd=work)
    assert replayed.returncode == 0, replayed.stderr
    assert json.loads(replayed.stdout)["outputs"]["y"]["fit_percent"] > 99.0


@pytest.mark.soak
def test_a_log_whose_columns_are_called_as_the_model_calls_them_needs_no_mapping(tmp_path):
    foreign_log(tmp_path / "bench.csv")
    _, *rows = (tmp_path / "bench.csv").read_text("utf-8").splitlines()
    numbers = np.array([row.split(",") for row in rows], dtype=float) * [1e-3, -1.0, 1e-3]
    named = [f"{y!r},{t!r},{u!r},0.003" for t, u, y in numbers.tolist()]
    (tmp_path / "mine.csv").write_text("\n".join(["y,t,u,bias", *named]) + "\n")
    (tmp_path / "lag.py").write_text(OWN_MODEL)
    command = ["identify", "mine.csv", "--model", "lag.py:model", "--set", "population=30"]
    more = "--generations", 8, "--out", "found"
    result = rig(*command, *more, cwd=tmp_path, report=True)
    assert result.returncode == 0, result.stderr
    found = yaml.safe_load((tmp_path / "found" / "parameters.yaml").read_text("utf-8"))
    assert found["parameters"]["tau"]["value"] == pytest.approx(0.2, rel=1e-3)
    assert (tmp_path / "found" / "figures" / "signals.svg").exists()
    (line,) = [s for s in result.stdout.splitlines() if s.startswith("Next: rig ")]
    replayed = rig(*shlex.split(line.removeprefix("Next: rig ")), "--json", cwd=tmp_path)
    assert json.loads(replayed.stdout)["outputs"]["y"]["fit_percent"] > 99.0
    (tmp_path / "mine.csv").write_text("\n".join(["x,t,u,b", *named]) + "\n")
    lacking = rig(*command, cwd=tmp_path)
    assert lacking.returncode == 2
    assert "mine.csv:1: model lag needs bias, y, of which there is no column" in lacking.stderr


@pytest.mark.soak
def test_uneven_times_and_cells_without_a_number_are_taken_as_they_are(tmp_path):
    foreign_log(tmp_path / "even.csv")
    head, *rows = (tmp_path / "even.csv").read_text("utf-8").splitlines()
    kept = [row for k, row in enumerate(rows) if k % 7 not in {2, 3} or k % 20 == 0]
    for k in (0, 9):
        kept[k] = kept[k].rsplit(",", 1)[0] + ", "
    times = [int(row.split(",")[0]) + k % 4 for k, row in enumerate(kept)]
    shifted = [f"{t},{row.split(',', 1)[1]}" for t, row in zip(times, kept, strict=True)]
    (tmp_path / "bench.csv").write_text("\n".join([head, *shifted]) + "\n")
    (tmp_path / "lag.py").write_text(OWN_MODEL)
    (tmp_path / "id.yaml").write_text(OWN_CONFIG)
    command = ["identify", "bench.csv", "--config", "id.yaml", "--out", "found", "--no-report"]
    uneven = rig(*command, cwd=tmp_path)
    assert uneven.returncode == 2 and "bench.csv:6: Time (ms): samples are" in uneven.stderr
    assert "say 'grid: 0.001' (s) in 'columns: time:'" in uneven.stderr
    (tmp_path / "id.yaml").write_text(OWN_CONFIG.replace("unit: ms", "unit: ms, grid: 50 ms"))
    coarse = rig(*command, cwd=tmp_path)
    assert coarse.returncode == 2 and "id.yaml:5:39: columns.time.grid: 0.05 s" in coarse.stderr
    (tmp_path / "id.yaml").write_text(OWN_CONFIG.replace("unit: ms", "unit: ms, grid: 10 ms"))
    result = rig(*command, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    found = yaml.safe_load((tmp_path / "found" / "parameters.yaml").read_text("utf-8"))
    assert found["parameters"]["tau"]["value"] == pytest.approx(0.2, rel=1e-3)


@pytest.mark.soak
def test_theta_in_place_of_omega(captured, tmp_path):
    root, folder = captured
    outputs = ["current_motor", "current_brake", "theta"]
    chosen = "--model", "actuator", "--set", f"outputs=[{','.join(outputs)}]"
    out = tmp_path / "out"
    few = write_yaml(tmp_path / "few.yaml", few_free())
    result = rig("identify", folder, "--config", few, *chosen, "--set", "initial.omega=[-1,1]",
                 "--out", out, "--json", cwd=root)  # fmt: skip
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    (trained,) = report["metrics"]["training"]
    assert list(trained["outputs"]) == outputs
    assert trained["outputs"]["theta"]["fit_percent"] > 90.0
    # What was chosen is in the parameters' file, and replay keeps to it.
    replayed = rig("replay", folder, "--parameters", out / "parameters.yaml", "--json", cwd=root)
    metrics = json.loads(replayed.stdout)["outputs"]
    assert metrics["theta"]["rmse"] == pytest.approx(trained["outputs"]["theta"]["rmse"], rel=1e-6)
    assert list(metrics) == outputs


@pytest.mark.soak
def test_an_output_that_does_not_count_needs_no_column(tmp_path):
    foreign_log(tmp_path / "bench.csv")
    two = OWN_MODEL.replace('Output("y", "m"),)', 'Output("y", "m"), Output("half", "m"))')
    two = two.replace("derivative=derivative", "derivative=derivative, output=output")
    two = two.replace("model = ", "def output(x, u, p):\n    return x[0], 0.5 * x[0]\n\n\nmodel = ")
    (tmp_path / "lag.py").write_text(two)
    (tmp_path / "id.yaml").write_text(OWN_CONFIG)
    missing = rig("identify", "bench.csv", "--config", "id.yaml", cwd=tmp_path)
    assert missing.returncode == 2 and "'half' of model lag is missing" in missing.stderr
    result = rig("identify", "bench.csv", "--config", "id.yaml", "--set", "outputs=[y]",
                 "--set", "initial={y: 0.0}", "--set", "hold={u: zoh}", "--out", "found",
                 cwd=tmp_path)  # fmt: skip
    assert result.returncode == 0, result.stderr
    found = yaml.safe_load((tmp_path / "found" / "parameters.yaml").read_text("utf-8"))
    assert found["outputs"] == ["y"] and found["initial"] == {"y": 0.0}
    assert found["parameters"]["tau"]["value"] == pytest.approx(0.2, rel=1e-3)
    (line,) = [s for s in result.stdout.splitlines() if s.startswith("Next: rig ")]
    replayed = rig(*line.removeprefix("Next: rig ").split(), "--json", cwd=tmp_path)
    assert replayed.returncode == 0, replayed.stderr


@pytest.mark.soak
def test_the_end_of_each_log_is_held_back(captured, tmp_path):
    root, folder = captured
    whole = np.genfromtxt(folder / "log.csv", delimiter=",", names=True)
    small = ("--config", "few.yaml", "--json", "--out", tmp_path / "out")
    result = rig("identify", folder, "--hold-back", 0.25, *small, cwd=root)
    assert result.returncode == 0, result.stderr
    metrics = json.loads(result.stdout)["metrics"]
    for part, rows, share in (
        ("training", whole[:300], "first 75 %"), ("validation", whole[300:], "last 25 %"),
    ):  # fmt: skip
        (entry,) = metrics[part]
        assert entry["name"] == f"{folder.name} ({share})"
        assert entry["outputs"]["omega"]["max_abs"] == np.abs(rows["omega"]).max()
    # The same as a log that ends there: what is held back has no part in the search.
    head = (folder / "log.csv").read_text("utf-8").splitlines(keepends=True)[:301]
    (tmp_path / "head.csv").write_text("".join(head))
    alone = rig("identify", tmp_path / "head.csv", *small, cwd=root)
    values = [json.loads(r.stdout)["error"]["value"] for r in (result, alone)]
    assert values[0] == values[1]


@pytest.mark.soak
def test_ranges_from_a_data_sheet_and_from_the_log(captured, tmp_path):
    root, folder = captured
    (tmp_path / "motor.yaml").write_text(
        "R_m: {value: 1.18, tolerance: 10 %, source: S23 data sheet}\n"
        "L_m: {value: 1.18, unit: mH, fixed: true}\n"
        "R_b: {range: [100, 150]}\n"
    )
    (tmp_path / "id.yaml").write_text(
        "preset: thesis\npopulation: 20\ngenerations: 2\ndatasheet: motor.yaml\nfixed: {R_b: 126}\n"
    )
    out = tmp_path / "out"
    result = rig("identify", folder, "--config", tmp_path / "id.yaml", "--guess", "--out", out,
                 cwd=root)  # fmt: skip
    assert result.returncode == 0, result.stderr
    found = yaml.safe_load((out / "parameters.yaml").read_text("utf-8"))["parameters"]
    sheet = tmp_path / "motor.yaml"
    assert found["R_m"]["source"] == f"{sheet}:1 (S23 data sheet)"
    assert found["R_m"]["range"] == pytest.approx([1.062, 1.298])
    assert found["L_m"]["source"] == f"{sheet}:2" and found["L_m"]["fixed"] is True
    assert found["L_m"]["value"] == pytest.approx(1.18e-3)
    # The configuration goes before the data sheet.
    assert found["R_b"]["value"] == 126 and found["R_b"]["source"] == f"{tmp_path}/id.yaml:5"
    assert "current_motor over its command" in found["K_dm"]["source"]
    assert folder.name in found["K_dm"]["source"]
    low, high = found["K_dm"]["range"]
    assert 10.0 < low < 120.0 < high < 500.0
    assert "K_dm searched as the data suggest: current_motor over its command" in result.stdout
    assert found["J_m"]["source"] == "model"


@pytest.mark.soak
def test_the_report_says_where_every_range_came_from(tmp_path):
    foreign_log(tmp_path / "bench.csv")
    two = OWN_MODEL.replace("1.0, \"log\"),)", "1.0, \"log\"), "
                            "Parameter(\"a\", \"1\", 1, 0, 2), Parameter(\"b\", \"1\", 1, 0, 2),"
                            "Parameter(\"c\", \"1\", 1, 0, 2))")  # fmt: skip
    (tmp_path / "lag.py").write_text(two.replace("p[0],)", "p[0] * p[1] / p[2] * p[3],)"))
    (tmp_path / "id.yaml").write_text(OWN_CONFIG + "ranges:\n  tau: [0.1, null]\ntied: {b: a}\n")
    result = rig(
        "identify", "bench.csv", "--config", "id.yaml", "--set", "fixed.a=1.5", "--set",
        "population=20", "--out", "found", cwd=tmp_path,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    found = yaml.safe_load((tmp_path / "found" / "parameters.yaml").read_text("utf-8"))
    assert found["search"]["population"] == 20
    parameters = found["parameters"]
    assert {name: entry["source"] for name, entry in parameters.items()} == {
        "tau": "id.yaml:12", "a": "command line", "b": "id.yaml:13", "c": "model",
    }  # fmt: skip
    assert parameters["tau"]["range"] == [0.1, 1.0] and parameters["tau"]["scale"] == "log"
    assert parameters["a"]["value"] == parameters["b"]["value"] == 1.5
    assert parameters["a"]["fixed"] is True and parameters["b"]["tied"] == "a"
    for line in ("0.1 .. (1)", "= a", "id.yaml:13", "command line"):
        assert line in result.stdout


@pytest.mark.soak
def test_a_log_without_time_has_its_rate_in_the_configuration(tmp_path):
    foreign_log(tmp_path / "bench.csv")
    text = (tmp_path / "bench.csv").read_text("utf-8")
    lines = [line.split(", ", 1)[1] for line in text.splitlines()]
    (tmp_path / "bench.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "lag.py").write_text(OWN_MODEL)
    config = OWN_CONFIG.replace("{column: Time (ms), unit: ms}", "{sample_rate: 100}")
    (tmp_path / "id.yaml").write_text(config)
    result = rig("identify", "bench.csv", "--config", "id.yaml", "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)["parameters"]["tau"]["value"]
    assert found == pytest.approx(0.2, rel=1e-3)


@pytest.mark.soak
def test_a_result_that_is_replaced_is_told(captured, tmp_path):
    root, folder = captured
    words = ["identify", root / folder, "--config", root / "few.yaml", "--out", "free"]
    first = rig(*words, cwd=tmp_path)
    assert first.returncode == 0 and "replaces" not in first.stderr, first.stderr
    again = rig(*words, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    replaced = "note: free/parameters.yaml: this replaces the result of 1 log with actuator, "
    assert replaced in again.stderr
    assert "; --out DIR keeps it" in again.stderr
    mistaken = rig(*words, "--population", "1", cwd=tmp_path)
    assert mistaken.returncode == 2 and "replaces" not in mistaken.stderr
    compared = [*words[:-1], "both", "--arx"]
    for said in (False, True):
        done = rig(*compared, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        line = "note: both/comparison.yaml: this replaces the comparison of 1 log, "
        assert (line in done.stderr) == said


def test_one_seed_gives_one_result(captured, tmp_path):
    root, folder = captured
    values = []
    for index, seed in enumerate((4, 4, 5)):
        result = rig(
            "identify", folder, "--population", 20, "--generations", 3, "--seed", seed,
            "--preset", "thesis", "--out", tmp_path / str(index), "--json", cwd=root,
        )  # fmt: skip
        values.append(json.loads(result.stdout)["parameters"]["K_m"]["value"])
    assert values[0] == values[1] != values[2]


@pytest.mark.soak
def test_what_is_said_of_parameters_is_the_same_for_every_seed_of_the_search(tmp_path):
    """Also where searches end on other sides of a valley, of which one looks like a further set."""
    assert rig("run", "prbs.yaml", cwd=tmp_path).returncode == 0
    told = []
    for seed in (0, 3):
        words = ("runs", "--seed", seed, "--no-report", "--out", tmp_path / str(seed), "--json")
        result = rig("identify", *words, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        told.append(json.loads(result.stdout)["parameters"])
    first, *more = told
    for parameters in more:
        for name, row in first.items():
            again = parameters[name]
            assert again.get("undetermined") == row.get("undetermined"), name
            ends = [end for end in row.get("interval", ()) if end is not None]
            if len(ends) == 2:
                assert again["interval"] == pytest.approx(ends, abs=0.2 * (ends[1] - ends[0]))
            else:
                assert len([end for end in again.get("interval", ()) if end is not None]) == len(
                    ends
                )


# --- Ctrl-C -------------------------------------------------------------------------------


@pytest.mark.soak
def test_ctrl_c_during_a_search_prints_the_parameters_found_so_far(captured, tmp_path):
    root, folder = captured
    asked = []

    def interrupt(text, process):
        done = [int(n) for n in re.findall(r"generation (\d+)/", text)]
        if done and max(done) >= 2 and not asked:
            asked.append(max(done))
            process.send_signal(signal.SIGINT)

    status, text, out = on_terminal(
        ["identify", folder, "--population", 60, "--generations", 100000, "--out", tmp_path / "o"],
        root,
        interrupt,
    )
    assert asked and status == 1, text + out
    assert "Stopped by Ctrl-C after" in out and "Parameters of actuator" in out
    assert "Traceback" not in text
    kept = yaml.safe_load((tmp_path / "o" / "parameters.yaml").read_text("utf-8"))
    assert kept["search"]["stopped"] == "interrupted" and len(kept["parameters"]) == 21
    assert kept["search"]["generations"] >= asked[0]


@pytest.mark.soak
def test_ctrl_c_before_there_is_any_result_says_so_in_one_line(tmp_path):
    write_experiment(tmp_path / "e.yaml", homing={"turns": 500, "timeout": 3600})
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    process = subprocess.Popen(
        [*RIG, "run", "e.yaml", "--rig", "rig.yaml"], cwd=tmp_path, env=environment(),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    until(lambda: list((tmp_path / "runs").glob("*/log.csv")), "a log")
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.splitlines()[-1] == "rig: stopped by hand (Ctrl-C, or Stop in the scope)"


@pytest.mark.soak
def test_results_of_a_folder_of_logs_do_not_go_into_that_folder(tmp_path, captured):
    folder = tmp_path / "logs"
    folder.mkdir()
    shutil.copy(captured[1] / "log.csv", folder / "one.csv")
    few = write_yaml(tmp_path / "few.yaml", few_free())
    result = rig("identify", "logs", "--config", few, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert [path.name for path in folder.iterdir()] == ["one.csv"]
    assert len(list(tmp_path.glob("runs/*-identify-*/identification/parameters.yaml"))) == 1
