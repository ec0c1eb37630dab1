"""``rig campaign``: logs x models x seeds, here and on a cluster."""

import json
import signal

import numpy as np
import pandas as pd
import pytest
import yaml

from daq.errors import ConfigError
from daq.identification import campaign as use_case
from daq.identification.campaign import Workers, parse_seeds
from daq.identification.request import SettingsRequest
from daq.progress import Progress
from tests.daq.support import (
    few_free,
    rig,
    slide_log,
    slide_model,
    start_rig,
    until,
    write_experiment,
    write_yaml,
)

MODELS = """\
from sysid import Input, Output, Parameter, ProcessModel, State


def lag(gain: float = 1.0):
    def derivative(x, u, p):
        return ((gain * u[0] - x[0]) / p[0],)

    return ProcessModel(
        name="lag",
        states=(State("y", "m"),),
        inputs=(Input("u", "m"),),
        outputs=(Output("y", "m"),),
        parameters=(Parameter("tau", "s", 0.05, 0.01, 0.5, "log"),),
        derivative=derivative,
    )
"""
SETTINGS = """\
population: 20
generations: 2
ranges:
  tau: [0.02, 0.4]
columns:
  time: {column: t}
  inputs:
    u: {column: u}
  outputs:
    y: {column: y}
"""
LAG, DOUBLE = "models.py:lag", "models.py:lag:gain=2"


@pytest.fixture
def folder(tmp_path):
    """Two training logs with lags of 0.1 and 0.2 s, one log for validation, model and settings."""
    (tmp_path / "models.py").write_text(MODELS)
    (tmp_path / "id.yaml").write_text(SETTINGS)
    for seed, (name, tau) in enumerate({"fast": 0.1, "slow": 0.2, "check": 0.1}.items()):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(-1.0, 1.0, 25), 8)
        y = np.zeros(200)
        for k in range(199):
            y[k + 1] = u[k] + (y[k] - u[k]) * np.exp(-0.01 / tau)
        y += 0.003 * rng.normal(size=200)
        frame = pd.DataFrame({"t": 0.01 * np.arange(200), "u": u, "y": y})
        frame.to_csv(tmp_path / f"{name}.csv", index=False)
    return tmp_path


def campaign(folder, *args, **options):
    result = rig(
        "campaign", "fast.csv", "slow.csv", "--model", LAG, "--model", DOUBLE, "--config",
        "id.yaml", "--validate", "check.csv", "--seeds", "0:2", "--json", *args, cwd=folder,
        **options,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def settled(document):
    """Rows without the time they took."""
    return [{k: v for k, v in row.items() if k != "seconds"} for row in document["runs"]]


@pytest.mark.soak
def test_every_log_with_every_model_and_seed(folder):
    document = campaign(folder, "--jobs", 2, "--out", "found")
    rows = document["runs"]
    assert len(rows) == 8 and not document["interrupted"]
    assert {(r["model"], r["data"], r["seed"]) for r in rows} == {
        (m, d, s) for m in (LAG, DOUBLE) for d in ("fast", "slow") for s in (0, 1)
    }
    for row in rows:
        if row["model"] == LAG:
            truth = {"fast": 0.1, "slow": 0.2}[row["data"]]
            assert row["tau"] == pytest.approx(truth, rel=0.02)
            assert 0.0 < row["rmse_y"] < 0.02  # m
    table = pd.read_csv(folder / "found" / "campaign.csv")
    assert set(table["model"]) == {LAG, DOUBLE}
    assert list(table["tau"]) == pytest.approx([r["tau"] for r in rows], rel=1e-12)
    # The best of each is a result like that of `rig identify`.
    best = next(s for s in document["spread"] if s["model"] == LAG and s["data"] == "slow")
    kept = yaml.safe_load((folder / best["parameters_file"]).read_text("utf-8"))
    assert kept["parameters"]["tau"]["value"] == pytest.approx(0.2, rel=0.02)
    assert kept["metrics"]["training"][0]["name"] == "slow"
    assert kept["metrics"]["validation"][0]["name"] == "check"
    assert kept["error"]["value"] == best["best"]


@pytest.mark.soak
def test_what_a_campaign_keeps_starts_where_its_fit_did(tmp_path):
    slide_log(3.0).to_csv(tmp_path / "slide.csv", index=False)
    model = slide_model(tmp_path)
    result = rig(
        "campaign", "slide.csv", "--model", model, "--set", "initial.v=0", "--json", cwd=tmp_path
    )
    assert result.returncode == 0 and result.stderr.count("where x starts is estimated") == 1
    document = json.loads(result.stdout)
    kept = document["spread"][0]["parameters_file"]
    replayed = rig("replay", "slide.csv", "--parameters", kept, "--trust", "--json", cwd=tmp_path)
    assert replayed.returncode == 0, replayed.stderr
    rmse = json.loads(replayed.stdout)["outputs"]["x"]["rmse_absolute"]
    assert rmse == pytest.approx(document["runs"][0]["rmse_x"], rel=1e-3) and rmse < 0.0105  # noise


@pytest.mark.soak
def test_each_run_is_identified_with_the_model_of_its_experiment(tmp_path):
    models = {"bouc": "actuator", "dahl": "actuator:hysteresis=dahl"}
    for name, model in models.items():
        written = write_experiment(tmp_path / f"{name}.yaml", model=model)
        assert rig("run", written, cwd=tmp_path).returncode == 0
    write_yaml(tmp_path / "id.yaml", {**few_free(), "preset": "thesis"})
    result = rig("campaign", "runs", "--config", "id.yaml", "--out", "found", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    rows = pd.read_csv(tmp_path / "found" / "campaign.csv")
    assert dict(zip(rows["data"].str.split("-").str[-1], rows["model"], strict=True)) == models
    assert "Intervals: 2/2 of the best runs" in result.stderr
    together = rig("campaign", "runs", "--config", "id.yaml", "--together", cwd=tmp_path)
    assert together.returncode == 2 and "are for different models" in together.stderr


def test_what_a_campaign_does_is_timed_from_where_it_begins(folder, monkeypatch):
    monkeypatch.chdir(folder)
    request = use_case.CampaignRequest(
        [folder / "fast.csv"], models=[LAG], settings=SettingsRequest("id.yaml"),
        workers=Workers(1), out=folder / "out",
    )  # fmt: skip
    steps = []
    use_case.campaign(request, steps.append)
    steps = [(step.activity, step.done) for step in steps if isinstance(step, Progress)]
    assert steps == [(name, n) for name in ("Identification", "Intervals") for n in (0, 1)]


@pytest.mark.soak
def test_one_parameter_set_for_all_logs_together(folder):
    document = campaign(folder, "--together", "--jobs", 1, "--hold-back", 0.3, "--set", "seed=9")
    assert [(r["data"], r["seed"]) for r in document["runs"]] == [("2 logs", 0), ("2 logs", 1)] * 2
    assert 0.1 < document["runs"][0]["tau"] < 0.2
    path = folder / document["spread"][0]["parameters_file"]
    kept = yaml.safe_load(path.read_text("utf-8"))
    validated = [entry["name"] for entry in kept["metrics"]["validation"]]
    assert validated == ["fast (last 30 %)", "slow (last 30 %)", "check"]


@pytest.mark.soak
def test_a_dask_cluster_by_one_setting_gives_the_same(folder):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    here = campaign(folder, "--jobs", 1)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", dashboard_address=":0"
    ) as cluster:
        there = campaign(folder, "--dask", cluster.scheduler_address, env={"PYTHONWARNINGS": ""},
                         fresh=True)  # fmt: skip
    assert settled(there) == settled(here)


@pytest.mark.soak
def test_ctrl_c_keeps_what_is_finished(folder):
    process = start_rig(
        "campaign", "fast.csv", "--model", LAG, "--config", "id.yaml", "--seeds", "0:5000",
        "--jobs", 1, "--out", "found", "--json", cwd=folder,
    )  # fmt: skip
    until((folder / "found" / "campaign.csv").exists, "the first finished run")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 1, err
    document = json.loads(out)
    assert document["interrupted"] and 1 <= len(document["runs"]) < 5000
    assert len(pd.read_csv(folder / "found" / "campaign.csv")) == len(document["runs"])


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("0:3", [0, 1, 2]), ("4:6", [4, 5]), (":2", [0, 1]), ("7", [7]), ("3,1,3", [3, 1])],
)
def test_seeds_are_a_range_or_a_list(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    ("args", "what"),
    [
        (["--seeds", "5:5"], "--seeds: '5:5' holds no seed; write 0:10"),
        (["--seeds", "a"], "--seeds: 'a' is no list of seeds; write 0:10"),
        (["--seeds", "0:4000000000"], "makes 4000000000 seeds, of which 1000000 are the most"),
        (["--seeds=-1"], "--seeds: -1 is outside 0 .. 4294967295"),
        (["--jobs", "0"], "--jobs: 0 runs at a time do nothing; give 1 or more"),
        (["--model", LAG], f"--model: {LAG} is given twice"),
        (["--validate", "fast.csv"], "the same log is given for training and for validation"),
    ],
)
def test_mistakes_are_named_with_their_cure(folder, args, what):
    before = sorted(folder.iterdir())
    result = rig("campaign", "fast.csv", "--model", LAG, "--config", "id.yaml", *args, cwd=folder)
    assert result.returncode == 2
    assert what in result.stderr and "Traceback" not in result.stderr
    assert [p for p in sorted(folder.iterdir()) if p.name != "__pycache__"] == before


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    monkeypatch.setattr(use_case, "CONNECT_TIMEOUT", 0.3)
    with (
        pytest.raises(
            ConfigError, match=r"no scheduler answers at tcp://127.0.0.1:9 .*dask worker"
        ),
        Workers(dask="tcp://127.0.0.1:9").ready(),
    ):
        pass
