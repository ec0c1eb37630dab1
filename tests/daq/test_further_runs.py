"""What comes next where data hardly tell a quantity: the command that designs runs for it."""

import json
import shlex
from dataclasses import replace

import pytest

from daq import record
from daq.cli.design import design
from daq.identification.further_runs import design_command, hardly_known, knowledge
from sysid.uncertainty import Ambiguity, Estimate, Uncertainty
from tests.daq.support import write_yaml


def estimate(name, low, high, why=""):
    return Estimate(name, "1", 2.0, low=low, high=high, why=why)


NARROW, WIDE = estimate("J", 1.9, 2.1), estimate("R_m", 1.6, 2.4)
ONE_SIDED, VAGUE = estimate("c1", 1.0, None), estimate("c0", None, None, "vague")


def of(*parameters, combined=()):
    told = Ambiguity("tied", ("A", "alpha1"), tuple(combined), ("A",))
    return Uncertainty(parameters, (told,), None, None, 1)


def test_what_is_hardly_known_is_what_experiments_can_tell_the_widest_first():
    product, start = estimate("A alpha1", 1.0, 3.0), estimate("alpha1 z(0)", 0.5, 3.0)
    tied, rival = estimate("A", None, None, "tied"), estimate("L_m", 1.0, 3.0, "rival")
    found = hardly_known(of(NARROW, WIDE, VAGUE, tied, rival, combined=[product, start]))
    assert [e.name for e in found] == ["c0", "A alpha1", "R_m"]
    assert hardly_known(of(NARROW, tied)) == []


def test_it_is_said_in_few_words():
    assert knowledge([WIDE]) == "Little is known of R_m (to 20 %)"
    many = [VAGUE, ONE_SIDED, *(replace(WIDE, name=f"p{k}") for k in range(4))]
    assert knowledge(many) == (
        "Little is known of c0 (hardly felt), c1 (one end only), p0, p1 (to 20 %), "
        "2 more (to no better than 10 %)"
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return record("prbs.yaml", out=tmp_path_factory.mktemp("runs"), options={"ideal": True})


def test_the_command_is_of_the_rig_and_the_calibration_of_the_run(run):
    words = shlex.split(design_command(run.folder / "identification", [run.path]))
    result = str(run.folder / "identification")
    assert words == ["rig", "design", "--rig", "simulated.yaml", "--parameters", result,
                     "--log", str(run.folder), "--precision", "10%"]  # fmt: skip
    assert {word[2:] for word in words if word.startswith("--")} <= set(design.__annotations__)


def test_a_rig_that_is_not_simulated_is_given_its_plant(run, tmp_path):
    rig_file = str(write_yaml(tmp_path / "bench.yaml", SERIAL))
    log = copied(run, tmp_path, rig_file=rig_file, rig=SERIAL)
    assert design_command(tmp_path, [log]).endswith(" --plant PLANT")


@pytest.mark.parametrize("rig_file", ["", "gone.yaml"])
def test_there_is_no_command_where_nobody_knows_the_rig(run, tmp_path, rig_file):
    log = copied(run, tmp_path / "run", rig_file=rig_file)
    assert design_command(tmp_path, [log]) is None
    assert design_command(tmp_path, [run.path, log]) is None
    assert design_command(tmp_path, [tmp_path / "of-another-program.csv"]) is None


SERIAL = {"name": "bench", "backend": "serial", "options": {"port": ""}}


def copied(run, folder, **changes):
    """The log of a run whose record has been changed."""
    folder.mkdir(exist_ok=True)
    content = json.loads((run.folder / "run.json").read_text("utf-8"))
    (folder / "run.json").write_text(json.dumps({**content, **changes}))
    (folder / "log.csv").write_bytes(run.path.read_bytes())
    return folder / "log.csv"
