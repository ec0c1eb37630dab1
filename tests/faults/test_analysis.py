"""docs/safety-analysis.md: every row's fault is injected, and ends as its row says."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.faults import Trial, perform
from tests.faults.faults import FAULTS, VIRTUAL
from tests.soak import mostly_soak

PAGE = Path(__file__).parents[2] / "docs" / "safety-analysis.md"
OUTCOMES = {"stop": "stop", "note": "warning", "no": "missed"}
AT = 0.6  # s, when open loop excites and closed loop turns the shaft
ALWAYS = ("encoder dead", "rate dead", "motor output stuck 1 V", "SAFE ignored")


@dataclass(frozen=True)
class Row:
    """A fault and how its run ends by the page, in open and in closed loop."""

    fault: str
    open: str
    closed: str


def rows():
    cells = re.findall(
        r"^\| ([^|`]+?) \| (stop|note|no|-) \| (stop|note|no|-) \|", PAGE.read_text("utf-8"), re.M
    )
    return [Row(*row) for row in cells]


def test_every_fault_has_its_row():
    assert sorted(row.fault for row in rows()) == sorted(FAULTS)


CASES = [
    (row.fault, loop, getattr(row, loop))
    for row in sorted(rows(), key=lambda row: row.fault not in ALWAYS)
    for loop in ("open", "closed")
    if row.fault in VIRTUAL and getattr(row, loop) != "-"
]


@pytest.mark.parametrize(("fault", "loop", "end"), mostly_soak(CASES, always=2 * len(ALWAYS)))
def test_a_fault_ends_as_the_page_says(fault, loop, end):
    protocol = {"open": "prbs.yaml", "closed": "constant_velocity.yaml"}[loop]
    outcome = perform(Trial(0, protocol, fault, loop, at=AT))
    assert outcome.result == OUTCOMES[end], outcome
    if end == "stop":
        assert outcome.reason
