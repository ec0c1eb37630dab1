"""Identification in stages by the command: what a motor alone told, kept for motor and brake."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import yaml

from sysid.examples import lag_record
from tests.daq.support import rig

MODELS = """\
from dataclasses import replace

from sysid.examples import lag as made

lag = made()
other = replace(lag, parameters=tuple(replace(p, name=p.name + "_2") for p in lag.parameters))
coarse = replace(lag, parameters=(lag.parameters[0], replace(lag.parameters[1], unit="ms")))
"""
SETTINGS = {
    "model": "models.py:lag",
    "population": 20,
    "generations": 4,
    "columns": {"time": {"column": "t"}, "inputs": {"u": {"column": "u"}},
                "outputs": {"y": {"column": "y"}}},
}  # fmt: skip


@pytest.fixture(scope="module")
def stages(tmp_path_factory):
    """Logs of two lags that share their time constant, and the result of the first."""
    folder = tmp_path_factory.mktemp("stages")
    (folder / "models.py").write_text(MODELS)
    (folder / "id.yaml").write_text(yaml.safe_dump(SETTINGS))
    for name, gain, seed in (("first", 2.0, 1), ("second", 3.0, 2)):
        record = lag_record(gain=gain, seed=seed)
        rows = {"t": record.time, "u": record.inputs[:, 0], "y": record.outputs[:, 0]}
        pd.DataFrame(rows).iloc[:40].to_csv(folder / f"{name}.csv", index=False)
    result = identify(folder, "first")
    assert result.returncode == 0, result.stderr
    return folder


def identify(folder, log, *args, config="id.yaml"):
    out = args[args.index("--out") + 1 :][:1] if "--out" in args else [log]
    return rig("identify", f"{log}.csv", "--config", config, "--json", "--out", out[0],
               *(a for a in args if a not in ("--out", *out)), cwd=folder)  # fmt: skip


def parameters(result):
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)["parameters"]


def test_a_result_is_kept_with_its_covariance(stages):
    first = yaml.safe_load((stages / "first/parameters.yaml").read_text("utf-8"))
    tau = first["parameters"]["tau"]["value"]
    kept = parameters(identify(stages, "second", "--given", "first", "--set", "ranges.gain=[1,9]"))
    merely = parameters(identify(stages, "second", "--set", f"fixed.tau={tau}", "--out", "fixed"))
    assert kept["tau"]["value"] == tau and kept["tau"]["fixed"]
    assert kept["tau"]["source"].startswith("given: 0.0")
    assert "first/parameters.yaml:" in kept["tau"]["source"]
    assert kept["gain"]["value"] == pytest.approx(merely["gain"]["value"], rel=1e-6)
    wide, narrow = (np.ptp(entry["gain"]["interval"]) for entry in (kept, merely))
    assert wide > 1.02 * narrow
    low, high = kept["gain"]["interval"]
    assert low < 3.0 < high


def test_the_file_is_named_in_the_configuration_too_and_units_are_heeded(stages):
    (stages / "in").mkdir(exist_ok=True)
    settings = {**SETTINGS, "model": "../models.py:coarse", "given": "../first/parameters.yaml"}
    (stages / "in/id.yaml").write_text(yaml.safe_dump({**settings, "ranges": {"gain": [1, 9]}}))
    result = identify(stages, "second", "--set", "generations=1", config="in/id.yaml")
    first = yaml.safe_load((stages / "first/parameters.yaml").read_text("utf-8"))
    # A model that counts in another unit would need other equations; the number is what is tried.
    assert parameters(result)["tau"]["value"] == pytest.approx(
        1e3 * first["parameters"]["tau"]["value"]
    )


def test_what_the_settings_say_goes_before(stages):
    free = ("--set", "ranges.tau=[0.005,0.5]", "--set", "fixed.gain=3.0")
    found = parameters(identify(stages, "second", "--given", "first", *free, "--out", "free"))
    assert "interval" in found["tau"] and found["gain"]["value"] == 3.0


def changed(stages, name, change):
    content = yaml.safe_load((stages / "first/parameters.yaml").read_text("utf-8"))
    change(content)
    (stages / name).write_text(yaml.safe_dump(content, sort_keys=False))
    return name


@pytest.mark.parametrize(
    ("given", "more", "what"),
    [
        (["nowhere.yaml"], [], ["nowhere.yaml"]),
        (["id.yaml"], [], ["id.yaml:1:1: parameters: this key is missing", "or its folder"]),
        (["first"], ["--model", "models.py:other"],
         ["first/parameters.yaml:", "parameters: it found no parameter of model lag"]),
        (["first", "again.yaml"], ["--set", "ranges.gain=[1,9]"],
         ["again.yaml:", "parameters.tau: also in", "keep one"]),
        (["word.yaml"], [], ["word.yaml:", "parameters.tau.value: expected a number, found 'x'"]),
        (["torn.yaml"], [], ["torn.yaml:", "covariance: it does not hold", "identify again"]),
        (["group.yaml"], [], ["group.yaml:", "ambiguities: not as rig identify writes it"]),
        (["unit.yaml"], [], ["unit.yaml:", "parameters.tau.unit"]),
        (["all.yaml"], [], ["every parameter is fixed"]),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_their_cure(stages, given, more, what):
    changes = {
        "again.yaml": lambda content: None,
        "all.yaml": lambda content: None,
        "word.yaml": lambda content: content["parameters"]["tau"].update(value="x"),
        "torn.yaml": lambda content: content["covariance"]["factor"][0].pop(),
        "group.yaml": lambda content: content.update(ambiguities=["tau"]),
        "unit.yaml": lambda content: content["parameters"]["tau"].update(unit="V"),
    }
    for name in given:
        if name in changes:
            changed(stages, name, changes[name])
    options = [word for name in given for word in ("--given", name)]
    result = identify(stages, "second", *options, *more)
    assert result.returncode == 2 and "Traceback" not in result.stderr
    for text in what:
        assert text in result.stderr
