"""What two processes make of a report is what one makes, also where the other ends."""

import sys

import pytest

from daq.figures import style
from daq.report import second_process
from daq.report.page import Picture
from daq.report.publication import draw


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
