"""What two processes make is what one makes, also where the other ends."""

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from daq import second_process
from daq.figures import style
from daq.identification.draft import Draft
from daq.identification.fit import fit
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from daq.report.page import Picture
from daq.report.publication import draw
from sysid.examples import lag_record
from sysid.judging.score_tests import ScoreTests
from tests.soak import mostly_soak


def pictures():
    for k in range(3):
        figure, (panel,) = style.stack([0.5])
        panel.plot([0.0, 1.0], [0.0, float(k)])
        yield Picture(f"line {k}", "data", "A line.", figure)


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setattr(second_process, "available_cores", lambda: 2)


def drawn(folder, second=None):
    return [(p.name, files["svg"]) for p, files in draw(pictures(), folder, ["svg"], second)]


def test_figures_are_the_same_and_in_order(monkeypatch, tmp_path):
    alone = drawn(tmp_path)
    calls = []
    render = style.render
    monkeypatch.setattr(style, "render", lambda *a: calls.append(a) or render(*a))
    with second_process.SecondProcess() as second:
        assert drawn(tmp_path, second) == alone
    assert len(calls) < len(alone)  # the rest was the other's


@pytest.mark.parametrize("program", ["false", "no such program"])
def test_without_another_process_all_is_done_here(monkeypatch, tmp_path, program):
    monkeypatch.setattr(sys, "executable", program)
    with second_process.SecondProcess() as second:
        assert drawn(tmp_path, second) == drawn(tmp_path)
        assert second.call(lambda: "not to be sent").result() == "not to be sent"


MODEL = """
from dataclasses import replace

from sysid.examples import lag

OFFSET = 0.0
model = replace(lag(), derivative=lambda x, u, p: ((p[0] * u[0] - x[0]) / p[1] + OFFSET,))
"""


class Waiting(Draft):
    """One whose process has nothing left to do when the search ends."""

    def begin(self, problem, logs):
        super().begin(problem, logs)
        self.second.call(divmod, 7, 2).result()  # jobs are done in their order


@pytest.fixture
def problem(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("plant.py").write_text(MODEL)
    record = lag_record()
    table = {"t": record.time, "u": record.inputs[:, 0], "y": 0.2 + record.outputs[:, 0]}
    pd.DataFrame(table).to_csv("log.csv", index=False)
    settings = {"model": "plant.py:model", "population": 20, "generations": 4}
    return problem_of(SettingsRequest(None, settings))


@pytest.mark.parametrize(
    ("ends", "report"), mostly_soak([(False, True), (False, False), (True, True)])
)
def test_what_the_model_may_lack_is_found_as_by_one(monkeypatch, problem, ends, report):
    alone = fit(problem, [Path("log.csv")], [])
    here, tests = [], ScoreTests.__init__
    processes, started = [], subprocess.Popen
    monkeypatch.setattr(ScoreTests, "__init__", lambda *a: here.append(a) or tests(*a))
    monkeypatch.setattr(
        subprocess, "Popen", lambda *a, **k: processes.append(started(*a, **k)) or processes[-1]
    )
    with second_process.SecondProcess() as second:
        draft = Waiting(second, report)
        if ends:
            begun = draft.score_tests
            monkeypatch.setattr(
                draft, "score_tests", lambda *a: (begun(*a), processes[0].kill())[0]
            )
        result = fit(problem, [Path("log.csv")], [], draft=draft)
    assert {f.kind for f in result.suspicion.findings} == {"offset"}
    assert result.document == alone.document
    assert bool(here) == ends
