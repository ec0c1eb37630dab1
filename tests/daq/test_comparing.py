"""``rig identify`` with several models: a ranking that says how sure it is."""

import json
import re
import shlex

import numpy as np
import pandas as pd
import pytest
import yaml

from tests.daq.support import rig
from tests.daq.test_campaign import DOUBLE, LAG, MODELS, SETTINGS
from tests.daq.test_publishing import Page

OTHER = """
def pair():
    def derivative(x, u, p):
        return ((u[0] - x[0]) / p[0], -x[1])

    return ProcessModel(
        name="pair",
        states=(State("y", "m"), State("w", "m")),
        inputs=(Input("u", "m"),),
        outputs=(Output("y", "m"), Output("w", "m")),
        parameters=(Parameter("tau", "s", 0.05, 0.01, 0.5, "log"),),
        derivative=derivative,
    )


def twofold():
    def derivative(x, u, p):
        return ((u[0] - x[0]) / (p[0] * p[1]),)

    return ProcessModel(
        name="twofold",
        states=(State("y", "m"),),
        inputs=(Input("u", "m"),),
        outputs=(Output("y", "m"),),
        parameters=(
            Parameter("tau", "s", 0.05, 0.01, 0.5, "log"),
            Parameter("share", "1", 1.0, 0.5, 2.0, "log"),
        ),
        derivative=derivative,
    )
"""
TWOFOLD = "models.py:twofold"


@pytest.fixture
def folder(tmp_path):
    """A lag's log for training and one for validation, its model and wrong ones, settings."""
    (tmp_path / "models.py").write_text(MODELS + OTHER)
    (tmp_path / "id.yaml").write_text(SETTINGS)
    for seed, name in enumerate(("training", "validation")):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(-1.0, 1.0, 25), 8)
        y = np.zeros(200)
        for k in range(199):
            y[k + 1] = u[k] + (y[k] - u[k]) * np.exp(-0.01 / 0.1)
        y += 0.01 * rng.normal(size=200)
        frame = pd.DataFrame({"t": 0.01 * np.arange(200), "u": u, "y": y})
        frame.to_csv(tmp_path / f"{name}.csv", index=False)
    return tmp_path


def identify(folder, *args):
    return rig("identify", "training.csv", "--config", "id.yaml", "--jobs", 1, *args, cwd=folder)


def document(folder, *args):
    result = identify(folder, *args, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def short(name):
    return name.rpartition("/")[2]


@pytest.mark.soak
def test_structures_and_a_linear_model_are_ranked_on_validation(folder):
    models = ("--model", DOUBLE, "--model", TWOFOLD, "--model", LAG)
    report = document(
        folder, "--validate", "validation.csv", *models, "--armax", "--oe", "--out", "found"
    )
    rows = {re.sub(":n[af].*", "", row["name"]): row for row in report["structures"]}
    assert set(rows) == {DOUBLE, TWOFOLD, LAG, "ARMAX", "OE"}
    # One product of two parameters acts: as good as the lag, and no worse for its third number.
    assert [rows[n]["free_parameters"] for n in (LAG, TWOFOLD)] == [1, 2]
    assert [rows[n]["effective_parameters"] for n in (LAG, TWOFOLD)] == [1, 1]
    assert rows[DOUBLE]["verdict"] == "worse"
    assert rows[DOUBLE]["squared_errors_relative"]["interval_95"][0] > 10.0
    assert rows[DOUBLE]["squared_errors_relative"]["p_value"] < 0.01
    assert report["preferred"] in (LAG, TWOFOLD)
    for row in (rows[LAG], rows["ARMAX"], rows["OE"]):
        # Noise of 0.01 in parts of max|y|, and the lag starts at a noisy sample.
        assert row["outputs"]["y"]["rmse"] < 0.015 and row["outputs"]["y"]["fit_percent"] > 95.0
    for error in (
        rows[LAG]["training_rmse_absolute"]["y"],
        rows[LAG]["outputs"]["y"]["rmse_absolute"],
    ):
        assert error == pytest.approx(0.01, rel=0.2)  # m
    assert rows[LAG]["dbic"] < rows["ARMAX"]["dbic"] < rows[DOUBLE]["dbic"]
    assert report["verdict"].count("times those of") == 4
    # What is printed is kept, and each model's result is one that other commands read.
    kept = yaml.safe_load((folder / report["files"]["comparison"]).read_text("utf-8"))
    assert kept["structures"] == report["structures"]
    for name in (DOUBLE, TWOFOLD, LAG):
        parameters = folder / rows[name]["parameters_file"]
        assert short(yaml.safe_load(parameters.read_text("utf-8"))["model"]) == name
    found = yaml.safe_load((folder / rows[LAG]["parameters_file"]).read_text("utf-8"))
    assert found["parameters"]["tau"]["value"] == pytest.approx(0.1, rel=0.02)


@pytest.mark.soak
def test_tables_for_people_and_a_page_that_says_how_to_do_it_again(folder):
    args = ("identify", "training.csv", "--validate", "validation.csv", "--config", "id.yaml",
            "--model", DOUBLE, "--model", LAG, "--arx", "--out", "found")  # fmt: skip
    text = rig(*args, cwd=folder, report=True).stdout
    page = Page((folder / "found/comparison.html").read_text(encoding="utf-8"))
    assert "Page: found/comparison.html\n" in text and page.open == []
    assert not {"script", "link", "img"} & set(page.tags)
    assert {"figure-ratios", "figure-validation"} <= set(page.ids)
    kept = yaml.safe_load((folder / "found/comparison.yaml").read_text("utf-8"))
    assert kept["preferred"] == LAG and f"{LAG} is preferred." in page.text
    shown = {given["data-structure"]: values for given, values in page.rows
             if "data-structure" in given}  # fmt: skip
    for row in kept["structures"]:
        errors = row["outputs"]["y"]
        given = [errors[key] for key in ("rmse", "rmse_absolute", "fit_percent")]
        assert shown[row["name"]][:3] == given
    (command,) = re.findall(r"rig (identify training.csv .*)", page.text)
    again = rig(*shlex.split(command), "--out", "again", "--json", cwd=folder)
    assert (
        json.loads(again.stdout)["structures"][0]["outputs"] == (kept["structures"][0]["outputs"])
    )
    assert "Validation, free run: RMSE in parts of max|y| (fit in %)" in text
    assert "RMSE of the free run in the outputs' units" in text
    assert re.search(r"structure +data +y \[m\]", text)
    assert re.findall(r" (validation|training) +\d", text) == ["validation", "training"] * 3
    left_out = kept["samples_left_out"]
    assert left_out > 0 and f"without the first {left_out} samples of each log" in text
    assert f"without the first {left_out} samples of each log" in " ".join(page.text.split())
    assert "dAIC" in text and "dBIC" in text and "worse, by more than chance" in text
    assert "ARX:na=" in text and "comparison.yaml" in text


@pytest.mark.soak
def test_without_validation_bic_ranks_and_that_is_said(folder):
    report = document(folder, "--model", DOUBLE, "--model", LAG)
    assert not report["validated"] and report["preferred"] == LAG
    assert report["verdict"].startswith("Without validation data this ranks by BIC")
    assert "outputs" not in report["structures"][0]
    assert report["structures"][0]["training_rmse_absolute"]["y"] == pytest.approx(0.01, rel=0.2)


@pytest.mark.soak
def test_the_end_of_the_log_can_be_held_back(folder):
    report = document(folder, "--model", DOUBLE, "--model", LAG, "--hold-back", 0.4)
    assert report["validated"] and report["preferred"] == LAG


@pytest.mark.soak
def test_seeds_of_one_model_give_the_best_of_them(folder):
    several = document(folder, "--model", LAG, "--seeds", "0:2", "--out", "several")
    errors = [
        document(folder, "--model", LAG, "--seed", seed, "--out", f"seed-{seed}")["error"]["value"]
        for seed in range(2)
    ]
    assert several["error"]["value"] == min(errors) == several["seeds"]["best"]
    assert several["seeds"]["worst"] == max(errors) and several["seeds"]["runs"] == 2
    assert several["search"]["seed"] == errors.index(min(errors))
    text = identify(folder, "--model", LAG, "--seeds", "0:2").stdout
    assert "Parameters of lag" in text and "error of 2 seeds" in text


@pytest.mark.parametrize(
    ("args", "what"),
    [
        (["--model", LAG, "--model", "models.py:pair"], "'w' of model pair is missing"),
        (["--model", LAG, "--model", LAG], f"--model: {LAG} is given twice"),
        (["--seed", "1", "--seeds", "0:2"], "--seed and --seeds: give one of them"),
        (["--model", LAG, "--armax", "--validate", "training.csv"], "the same log is given"),
    ],
)
def test_mistakes_are_named_with_their_cure(folder, args, what):
    result = identify(folder, *args)
    assert result.returncode == 2
    assert what in result.stderr and "Traceback" not in result.stderr


def test_structures_of_different_outputs_cannot_be_ranked(folder):
    (folder / "id.yaml").write_text(SETTINGS + "    w: {column: again}\n")
    log = pd.read_csv(folder / "training.csv")
    log.assign(again=log["y"]).to_csv(folder / "training.csv", index=False)
    result = identify(folder, "--model", LAG, "--model", "models.py:pair")
    assert result.returncode == 2
    assert "models.py:lag has the outputs y" in result.stderr
    assert "to be compared they must have the same" in result.stderr
