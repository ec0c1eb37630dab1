"""Mistakes in a user's own protocol: named with their place, before the run where they can be."""

import json
import sys
from types import SimpleNamespace

import pytest

from daq import analyse, errors, record
from daq.errors import ConfigError, RunError
from tests.daq.support import only_capture, record_of, rig

_FILE = '''
import math
import sys

import numpy as np
from daq.experiment import Answer, ClosedLoop, Plan, Timed
from daq.findings import Axis, Chart, Findings, Number, Series, Table

_WAVES = {
    "oops": lambda n: 1 / 0,
    "quit": lambda n: sys.exit(3),
    "nothing": lambda n: None,
    "transposed": lambda n: np.zeros((2, n)),
    "one channel": lambda n: np.zeros(n),
    "empty": lambda n: np.zeros((0, 2)),
    "complex": lambda n: np.zeros((n, 2), dtype=complex),
}
_PLANS = {
    "no plan": lambda n: None,
    "endless": lambda n: Plan(10**12, np.zeros(2), np.ones(2)),
    "no length": lambda n: Plan(0, np.zeros(2), np.ones(2)),
    "one bound": lambda n: Plan(n, np.zeros(1), np.ones(1)),
    "turned round": lambda n: Plan(n, np.ones(2), np.zeros(2)),
    "long reference": lambda n: Plan(n, np.zeros(2), np.ones(2), references={"a": np.zeros(n + 1)}),
    "a text": lambda n: Plan(n, np.zeros(2), np.array([1.0, 0.1]), remarks="a text"),
}
_ANSWERS = {
    "raises": lambda: [][3],
    "quits": lambda: sys.exit(3),
    "nan": lambda: Answer(math.nan, 0.0, (0.0,)),
    "text": lambda: Answer("1", 0.0, (0.0,)),
    "tuple": lambda: (0.1, 0.0, (0.0,)),
    "beyond": lambda: Answer(3.0, 0.0, (0.0,)),
    "logs nothing": lambda: Answer(0.1, 0.0),
    "logs none": lambda: Answer(0.1, 0.0, (None,)),
    "logs nan": lambda: Answer(0.1, 0.0, (math.nan,)),
}
_FINDINGS = {
    "nothing follows": lambda: int("nothing"),
    "divides": lambda: 1 / 0,
    "a dict": lambda: {"a": 1},
    "ragged": lambda: Findings((), (Table("t", "T", {"a": np.zeros(2), "b": np.zeros(3)}),)),
    "no file name": lambda: Findings((), (Table("a/b", "T", {"a": np.zeros(2)}),)),
    "uneven series": lambda: Series("s", np.zeros(2), np.zeros(3)),
    "empty range": lambda: Findings(ranges={"K_m": (2.0, 1.0)}),
    "lists": lambda: print("a word") or Findings(
        (Number("n", 1, "s", 0.0, math.inf),), (Table("t", "T", {"a": [1]}),)
    ),
}


class Wave(Timed):
    """A waveform that is none."""

    kind: str

    def waveform(self):
        return _WAVES[self.kind](self.n_samples)


class Loop(ClosedLoop):
    """A loop that goes wrong."""

    columns = {"a": "1"}
    kind: str

    def plan(self):
        sound = lambda n: Plan(n, np.zeros(2), np.array([1.0, 0.1]))
        return _PLANS.get(self.kind, sound)(100)

    def describe(self):
        drawn = object() if self.kind == "not JSON" else np.arange(3)
        return {**super().describe(), "excitation": {"drawn": drawn}}

    def controller(self):
        return None if self.kind == "no controller" else Controller(self.kind)

    def findings(self, samples, extra):
        return _FINDINGS.get(self.kind, Findings)()


class Controller:
    def __init__(self, kind):
        self.kind = kind

    def answer(self, sample):
        if self.kind == "misspelt":
            return Answr(0.1, 0.0)
        if sample.tick < 50 or self.kind not in _ANSWERS:
            return Answer(0.1, 0.0, (0.0,))
        return _ANSWERS[self.kind]()
'''


@pytest.fixture
def written(tmp_path):
    """Writes an experiment with a mistake; its path."""
    (tmp_path / "own.py").write_text(_FILE)

    def write(kind, named="Loop"):
        path = tmp_path / "own.yaml"
        length = "duration: 0.2\n" if named == "Wave" else ""
        path.write_text(
            f"protocol: own.py:{named}\n{length}kind: {kind}\ncalibration: {{samples: 100}}\n"
        )
        return path

    return write


_BEFORE = [
    ("Wave", "oops", "ZeroDivisionError: division by zero"),
    ("Wave", "quit", "SystemExit: 3"),
    ("Wave", "nothing", "waveform() returned shape ()"),
    ("Wave", "transposed", "waveform() returned shape (2, 160)"),
    ("Wave", "one channel", "waveform() returned shape (160,)"),
    ("Wave", "empty", "two samples at least"),
    ("Wave", "complex", "complex128"),
    ("Loop", "no plan", "return a daq.experiment.Plan"),
    ("Loop", "endless", "n_samples is 1000000000000"),
    ("Loop", "no length", "n_samples is 0"),
    ("Loop", "one bound", "lowest is of shape (1,)"),
    ("Loop", "turned round", "is above highest"),
    ("Loop", "long reference", "references['a'] is of shape (101,)"),
    ("Loop", "a text", "write a tuple of texts"),
    ("Loop", "no controller", "a method answer(sample)"),
    ("Loop", "misspelt", "when asked for its first answer, at rest: NameError: name 'Answr'"),
    ("Loop", "not JSON", "no type that JSON has"),
]


@pytest.mark.parametrize(("named", "kind", "says"), _BEFORE, ids=[kind for _, kind, _ in _BEFORE])
def test_what_can_be_known_before_the_run_is_told_before_it(
    named, kind, says, written, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as refused:
        record(written(kind, named))
    assert says in str(refused.value)
    assert f"own.py:{named}' failed " in str(refused.value)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("raises", "IndexError: list index out of range ("),
        ("quits", "SystemExit: 3 ("),
        ("nan", "motor nan V"),
        ("text", "TypeError"),
        ("tuple", "answer with a daq.experiment.Answer"),
        ("beyond", "motor 3.0 V, brake 0.0 V, and its plan says 0 to 1 V and 0 to 0.1 V"),
        ("logs nothing", "a finite number for each of its columns is expected: a"),
        ("logs none", "TypeError"),
        ("logs nan", "a finite number for each of its columns is expected: a"),
    ],
)
def test_an_answer_that_is_none_ends_the_run_and_names_sample_and_folder(
    kind, says, written, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError) as failed:
        record(written(kind))
    assert "failed at sample 50: " in str(failed.value) and says in str(failed.value)
    folder = only_capture(tmp_path)
    assert failed.value.__notes__ == [
        f"what was recorded so far: {folder.relative_to(tmp_path)} (50 samples of the run)",
        "both outputs are zero: read back from the device",
    ]
    ended = record_of(folder)
    assert (ended["status"], ended["reason"]) == ("failed", str(failed.value))
    assert ended["experiment"]["excitation"] == {"drawn": [0, 1, 2]}


def test_mistakes_in_findings_leave_the_run_and_name_their_line(written, tmp_path, monkeypatch):
    done = rig("run", str(written("lists")), "--json", cwd=tmp_path)
    assert done.returncode == 0 and "a word" in done.stderr, done.stderr
    assert json.loads(done.stdout)["findings"]["numbers"]["n"]["value"] == 1.0
    folder = only_capture(tmp_path)
    for kind, says in {
        "nothing follows": "no result: invalid literal for int() with base 10: 'nothing' (",
        "divides": "failed in findings(): ZeroDivisionError: division by zero (",
        "a dict": "return daq.findings.Findings or None",
        "ragged": "table 't': its columns must be of one length; a has 2, b has 3 values (",
        "no file name": "'a/b' becomes a file's name",
        "uneven series": "series 's': its columns must be of one length; x has 2, y has 3 values (",
        "empty range": "ranges: K_m: 2 is not below 1 (",
    }.items():
        ended = json.loads((folder / "run.json").read_text("utf-8"))
        ended["experiment"]["kind"] = kind
        (folder / "run.json").write_text(json.dumps(ended))
        with pytest.raises(RunError) as failed:
            analyse(folder, trust=True)
        assert says in str(failed.value)


@pytest.mark.parametrize(
    ("folder", "line"), [("mine", True), ("tests", True), ("protocols", False), ("daq", False)]
)
def test_files_beside_an_editable_install_are_the_users(tmp_path, monkeypatch, folder, line):
    monkeypatch.setattr(errors, "__file__", str(tmp_path / "daq" / "errors.py"))
    file = tmp_path / folder / "fading.py"
    file.parent.mkdir()
    file.write_text("class Fading:\n    def plan(self):\n        return 1 / 0\n")
    names = {"__name__": "fading"}
    exec(compile(file.read_text("utf-8"), str(file), "exec"), names)
    monkeypatch.setitem(sys.modules, "fading", SimpleNamespace(__file__=str(file)))
    with pytest.raises(ZeroDivisionError) as failed:
        names["Fading"]().plan()
    assert errors.raised_in(names["Fading"], failed.value) == (f" ({file}:3)" if line else "")
