"""Examples in docstrings run, and everything that sysid exports has one."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import sysid

# Exported objects whose docstring has no example yet; empties as they get theirs.
MISSING = {
    "ARMAX",
    "ARX",
    "BatchResult",
    "BatchSimulator",
    "GASSI",
    "LinearModel",
    "Status",
    "Stepper",
    "equilibrium",
    "free_run",
    "jacobian",
    "linearize",
    "select_orders",
}


def examples():
    """The docstrings of all modules of sysid that have examples, by the objects' names."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    modules = [sysid.__name__, *(m.name for m in pkgutil.walk_packages(sysid.__path__, "sysid."))]
    tests = [test for name in modules for test in finder.find(importlib.import_module(name))]
    return [pytest.param(test, id=test.name) for test in tests if test.examples]


@pytest.mark.parametrize("example", examples())
def test_an_example_prints_what_it_says(example):
    report: list[str] = []
    flags = doctest.NORMALIZE_WHITESPACE
    results = doctest.DocTestRunner(optionflags=flags).run(example, out=report.append)
    assert not results.failed, "".join(report)


@pytest.mark.parametrize("name", sysid.__all__)
def test_what_is_exported_has_an_example(name):
    has_example = bool(doctest.DocTestParser().get_examples(getattr(sysid, name).__doc__))
    assert has_example != (name in MISSING)
