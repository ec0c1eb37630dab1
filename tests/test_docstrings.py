"""Examples in docstrings run, and everything that daq and sysid export has one."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import daq
import haptics
import protocols
import sim_rig
import sysid

# Examples that take seconds.
LONG = {
    "daq.designs.design.design",
    "daq.identification.campaign.campaign",
    "daq.identification.comparison.ComparisonResult",
    "sysid.campaigns.runs.campaign",
    "sysid.experiments.discrimination.discriminate",
}


def modules_of(package):
    yield package.__name__
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith("__main__"):
            yield module.name


def examples():
    """The docstrings that have examples, by the objects' names."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    for package in (daq, haptics, protocols, sim_rig, sysid):
        for name in modules_of(package):
            for test in finder.find(importlib.import_module(name)):
                if test.examples:
                    marks = [pytest.mark.soak] * (test.name in LONG)
                    yield pytest.param(test, id=test.name, marks=marks)


@pytest.mark.parametrize("example", list(examples()))
def test_an_example_prints_what_it_says(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report: list[str] = []
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    results = doctest.DocTestRunner(optionflags=flags).run(example, out=report.append)
    assert not results.failed, "".join(report)


@pytest.mark.parametrize(
    "exported", [(package, name) for package in (daq, sysid) for name in package.__all__], ids=str
)
def test_what_is_exported_has_an_example(exported):
    package, name = exported
    assert doctest.DocTestParser().get_examples(getattr(package, name).__doc__)
