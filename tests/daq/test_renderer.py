"""Figures made by two processes are those of one, in their order, also where the other ends."""

import sys

import pytest

from daq.figures import style
from daq.report import renderer
from daq.report.page import Picture


def pictures():
    for k in range(3):
        figure, (panel,) = style.stack([0.5])
        panel.plot([0.0, 1.0], [0.0, float(k)])
        yield Picture(f"line {k}", "data", "A line.", figure)


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setattr(renderer, "available_cores", lambda: 2)


def rendered():
    with renderer.Renderer() as both:
        return [
            (picture.name, files["svg"]) for picture, files in both.rendered(pictures(), ["svg"])
        ]


def test_the_other_process_draws_the_same_in_order(monkeypatch):
    alone = [(picture.name, style.render(picture.figure, "svg")) for picture in pictures()]
    calls = []
    render = style.render
    monkeypatch.setattr(style, "render", lambda *a: calls.append(a) or render(*a))
    assert rendered() == alone
    assert len(calls) < len(alone)  # the rest was the other's


@pytest.mark.parametrize("program", ["false", "no such program"])
def test_without_another_process_all_is_drawn_here(monkeypatch, program):
    monkeypatch.setattr(sys, "executable", program)
    assert rendered() == [(p.name, style.render(p.figure, "svg")) for p in pictures()]
