"""What results show of themselves at a prompt and in a notebook."""

import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from daq import check, identify, load, record, replay, tune
from daq.characterise.characterise import Characterisation
from daq.characterise.rounds import Interval, Round
from daq.identification.comparison import SeedsResult
from daq.identification.rows import AmbiguityRow, ParameterRow, QuantityRow, Rows
from daq.run.runner import RunResult
from daq.views import Shown
from sysid import Dataset
from tests.daq.support import few_free


class Named(Shown):
    headline = "<b> & co"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return load(record("prbs.yaml", out=tmp_path_factory.mktemp("runs")).folder)


def table_of(result):
    """Rows of texts of the table that a notebook shows."""
    page = ET.fromstring(f"<div>{result._repr_html_()}</div>")
    return [[cell.text or "" for cell in row] for row in page.iter("tr")]


def test_a_recording_says_its_length_and_shows_its_channels(log):
    assert repr(log) == f"<Recording: {log.name}, 1000 samples, 1.25 s at 800 Hz>"
    rows = {row[0]: row for row in table_of(log)}
    assert float(rows["omega"][4]) == pytest.approx(log.frame["omega"].max(), rel=1e-3)
    assert rows["torque"][1] == "N*m" and "t" not in rows


def test_a_replay_shows_fit_and_errors(log):
    result = replay(log)
    assert repr(result).startswith("<Replay: ") and "actuator" in repr(result)
    shown = {row[0]: float(row[1]) for row in table_of(result)[1:]}
    assert shown == pytest.approx(result.fit, abs=0.06)


@pytest.mark.soak
def test_an_identification_says_what_may_be_used_and_shows_intervals(log):
    result = identify(log, **few_free())
    words = f"predictions {result.verdict.predicted.trust}"
    assert words in repr(result) and log.name in repr(result) and "\n" not in repr(result)
    shown = {row[0]: row for row in table_of(result)}
    low, high = (float(end) for end in shown["K_m"][2].split(" .. "))
    assert low < float(shown["K_m"][1]) < high and shown["K_m"][3] == "N*m/A"
    assert shown["L_m"][2:] == ["-", "mH", "fixed"]
    parts = ("model", "estimator", "problem", "uncertainty", "training", "suspicion")
    lengths = {part: len(repr(getattr(result, part))) for part in parts}
    assert max(lengths.values()) < 700, lengths
    assert len(repr(result.rows)) < 100 and len(repr(result.verdict)) < 100
    assert table_of(result.rows) == table_of(result)
    assert {row[2] for row in table_of(result.verdict)[1:]} >= set(result.reasons)
    fit = result.training[0].result.metrics.fit[-1]
    assert float(shown["fit of omega"][1]) == pytest.approx(fit, abs=0.06)
    assert repr(result.training[0].result).startswith("<RecordResult: ")
    assert f"{len(log.frame)} samples" in result.training[0]._repr_html_()


def test_combinations_stand_below_the_parameters_that_act_only_together():
    searched = {"undetermined": "tied", "range": (1e-5, 1e-3)}
    inertia = [ParameterRow(name, 5e-5, "kg*m^2", **searched) for name in ("J_m", "J_b")]
    total = QuantityRow("J_m + J_b", 1.05e-4, "kg*m^2", (1.0e-4, 1.1e-4))
    tied = AmbiguityRow("tied", ("J_m", "J_b"), (total,), ())
    rows = Rows(tuple(inertia), (tied,), (), {}, {"training": (), "validation": ()}, refined=True)
    assert repr(rows) == "<Rows: 0 of 2 free parameters each by itself and 1 combination>"
    shown = {row[0]: row[1:] for row in table_of(rows)}
    assert shown["J_m + J_b"] == ["1.05e-4", "1.00e-4 .. 1.10e-4", "kg*m^2", ""]
    assert shown["J_b"][3] == "only together"


def test_a_tied_parameter_is_not_called_fixed():
    assert ParameterRow("K_e", 0.2, "V*s", tied="K_m").held == "= K_m"
    assert ParameterRow("K_e", 0.2, "V*s", range=(0.1, 1.0)).held == ""


def test_a_preview_and_a_controller_say_what_they_are():
    assert repr(check("prbs.yaml")) == "<Preview: prbs: 1.25 s at 800 Hz, within the limits>"
    tuning = tune("torque.yaml", model="actuator:parameters=rig")
    assert repr(tuning).startswith("<Tuning: ") and "\n" not in repr(tuning)
    assert ["motor_constant", "0.1412"] in [row[:2] for row in table_of(tuning)]


def test_a_dataset_is_one_line():
    data = Dataset(np.zeros((1000, 2)), np.zeros((1000, 3)), dt=0.001, name="bench")
    assert repr([data]) == "[<Dataset: bench, 1000 samples, dt=0.001 s, 2 in, 3 out>]"


def test_a_run_says_where_it_is_and_what_is_in_doubt():
    folder = Path("runs/a")
    run = RunResult(folder, 1000, {}, {}, ["it is warm"], [])
    assert repr(run) == f"<RunResult: 1000 samples in {folder}, 1 doubts>"
    assert table_of(run) == [["doubts"], ["it is warm"]]
    assert "<table" not in RunResult(folder, 1000, {}, {}, [], [])._repr_html_()


def test_a_characterisation_says_why_it_ended_and_shows_half_widths():
    intervals = (Interval("R_m", "ohm", 1.2, 0.031, 0.03), Interval("L_m", "H", 5e-4, None, None))
    end = Path("c"), (Round(Path("c"), 1),), intervals, 12.5, "precise", {}, Path("p"), Path("r")
    result = Characterisation(*end)
    assert repr(result) == "<Characterisation: 1 round, 12.5 s logged in c: precise>"
    assert table_of(result)[1:] == [["R_m", "1.20 ohm", "3.1", "3"], ["L_m", "500 µH", "-", "-"]]


def test_the_best_of_several_seeds_is_shown():
    best = SimpleNamespace(headline="actuator from a", lines=lambda: [["parameter"], ["R_m"]])
    result = SeedsResult(best, SimpleNamespace(outcomes=(1, 2)))
    assert repr(result) == "<SeedsResult: best of 2 seeds: actuator from a>"
    assert table_of(result) == [["parameter"], ["R_m"]]


def test_names_are_no_markup():
    assert ET.fromstring(Named()._repr_html_()).text == Named.headline
