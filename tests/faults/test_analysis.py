"""docs/safety-analysis.md: every row's fault is injected, and ends as its row says."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.faults import perform, trial_of
from tests.faults.faults import FAULTS, VIRTUAL
from tests.soak import mostly_soak

PAGE = Path(__file__).parents[2] / "docs" / "safety-analysis.md"
OUTCOMES = {"stop": "stop", "note": "warning", "no": "missed"}
ALWAYS = "encoder dead"
TRIES = 3


@dataclass(frozen=True)
class Row:
    """A fault and how its run ends by the page, in open and in closed loop; the same on a line."""

    fault: str
    open: str
    closed: str
    open_line: str
    closed_line: str


def rows():
    row = r"^\| ([^|`]+?) " + 4 * r"\| (stop|note|no|-) " + r"\|"
    cells = re.findall(row, PAGE.read_text("utf-8"), re.M)
    return [Row(*row) for row in cells]


def test_every_fault_has_its_row():
    assert sorted(row.fault for row in rows()) == sorted(FAULTS)


def cases(names, suffix=""):
    """Fault, loop and end of every run that there is of these faults."""
    chosen = [row for row in rows() if row.fault in names]
    return [
        (row.fault, loop, end)
        for row in sorted(chosen, key=lambda row: row.fault != ALWAYS)
        for loop in ("open", "closed")
        if (end := getattr(row, loop + suffix)) != "-"
    ]


@pytest.mark.parametrize(("fault", "loop", "end"), mostly_soak(cases(VIRTUAL), always=2))
def test_a_fault_ends_as_the_page_says(fault, loop, end):
    outcome = perform(trial_of(fault, loop, line=False))
    assert outcome.result == OUTCOMES[end], outcome
    assert outcome.reason or end == "no"


# The others take minutes in real time: python -m benchmarks.faults --each --line
LINE = [("encoder dead", "closed"), ("clock 10 % fast", "open"), ("SAFE ignored", "open")]


@pytest.mark.soak
@pytest.mark.parametrize(("fault", "loop"), LINE)
def test_on_a_line_as_well(fault, loop):
    (end,) = (end for *case, end in cases([fault], "_line") if case == [fault, loop])
    for _ in range(TRIES):
        outcome = perform(trial_of(fault, loop, line=True))
        if outcome.result != "before":  # a busy computer that ends the run before its fault
            break
    assert outcome.result == OUTCOMES[end], outcome
