"""The report of an identification: one page that needs nothing else and says what the data say."""

import copy
import json
import math
import re
import shlex
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from daq import notation
from daq.identification.rows import Rows
from daq.report import explanation
from tests.daq.support import forked_rig

NASTY = "k_<b>&%$"
TRAINING = "train &_%" if sys.platform == "win32" else "train <&_%>"
# Only the product of two gains acts; names hold what HTML and LaTeX take for their own.
MODEL = f"""
from sysid import Input, Output, Parameter, ProcessModel, State


def derivative(x, u, p):
    tau, a, b, c = p
    return ((a * b * u[0] + c * u[1] - x[0]) / tau,)


model = ProcessModel(
    name="lag <i>&_%",
    description="a lag & <script>alert(1)</script>",
    states=(State("y", "m"),),
    inputs=(Input("u", "V"), Input("w_<x>&", "V")),
    outputs=(Output("y", "m"),),
    parameters=(
        Parameter("tau", "s", 0.3, 0.05, 1.0, "log", description="time constant, 50 % & <more>"),
        Parameter("a", "m/kg", 2.0, 0.5, 10.0, "log"),
        Parameter("b", "kg", 1.0, 0.2, 5.0, "log"),
        Parameter({NASTY!r}, "m/V", 0.1, 0.05, 1.0, "log"),
    ),
    derivative=derivative,
    equations=("tau dy/dt = a*b*u - y + <b>k</b>*w",),
)
"""
CONFIG = """
model: my_model.py:model
population: 30
generations: 6
columns:
  time: {sample_rate: 50.0}
  inputs:
    u: {column: u}
    w_<x>&: {column: w}
  outputs:
    y: {column: y}
"""


def record(seed, n=600):
    rng = np.random.default_rng(seed)
    u, w = np.sign(rng.normal(size=(2, n // 10))).repeat(10, axis=1)
    pole = math.exp(-0.02 / 0.2)
    driven = np.concatenate([[0.0], (2.0 * u + 0.3 * w)[:-1]])
    y = lfilter([1.0 - pole], [1.0, -pole], driven) + 0.02 * rng.normal(size=n)
    return np.column_stack([u, w, y])


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    (folder / "my_model.py").write_text(MODEL)
    (folder / "id.yaml").write_text(CONFIG)
    for name, seed in ((f"{TRAINING}.csv", 1), ("check.csv", 2)):
        np.savetxt(folder / name, record(seed), delimiter=",", header="u,w,y", comments="")
    return folder


@pytest.fixture(scope="module")
def rig():
    with forked_rig() as run:
        yield run


@pytest.fixture(scope="module")
def result(work, rig):
    args = ["identify", f"{TRAINING}.csv", "--validate", "check.csv", "--config", "id.yaml"]
    done = rig([*args, "--out", "found"], cwd=work, report=True)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def document(result, work):
    return json.loads((work / "found/report.json").read_text("utf-8"))


class Page(HTMLParser):
    """Tags opened and closed, addresses that are fetched, and rows with their exact numbers."""

    VOID = ("meta", "link", "br", "img", "hr", "input", "wbr")

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.addresses, self.ids = [], [], [], []
        self.rows, self.values, self.text = [], [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        self.addresses += [v for k, v in attrs if k.split(":")[-1] in ("src", "href", "srcset")]
        self.addresses += re.findall(r"url\(([^)]*)\)", given.get("style") or "")
        self.ids += [given["id"]] if "id" in given else []
        if tag == "tr":
            self.values = []
            self.rows.append((given, self.values))
        if "data-value" in given:
            self.values.append(float(given["data-value"]))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def page(result, work):
    return Page((work / "found/report.html").read_text(encoding="utf-8"))


@pytest.mark.soak
def test_files_are_there_and_named_after_the_printed_result(result, work):
    printed = result.stdout.index("Predictions: ")
    assert result.stdout.index("Report: found/report.html") > printed
    assert {path.name for path in (work / "found").iterdir()} == {
        "parameters.yaml", "report.html", "report.json", "parameters.tex", "figures",
            "errors.csv", "errors.tex",
    }  # fmt: skip
    assert re.search(r"^Report: \d+ figures \([\d.]+ s\)$", result.stderr, re.MULTILINE)


def test_the_page_needs_nothing_else(page, work):
    text = (work / "found/report.html").read_text(encoding="utf-8")
    assert all(address.startswith(("#", "data:")) for address in page.addresses)
    assert not {"script", "link", "iframe", "img", "object"} & set(page.tags)
    assert "@import" not in text
    assert "on that side alone" not in text, "no interval has one end"
    assert "first 50 lags" not in text, "three time constants are 30 samples, and all are tested"
    assert page.open == []
    assert len(set(page.ids)) == len(page.ids)
    # What clips and glyphs refer to is on the page.
    assert {a[1:] for a in page.addresses if a.startswith("#")} <= set(page.ids)


def test_every_figure_file_is_on_the_page(page, work):
    files = {path.stem for path in (work / "found/figures").glob("*.svg")}
    assert {"validation", "training", "signals", "convergence", "ranges", "intervals",
            "residuals", "spectra", "bode-y"} <= files  # fmt: skip
    assert {i.removeprefix("figure-") for i in page.ids if i.startswith("figure-")} == files


TWO_LAGS = """
from sysid import Input, Output, Parameter, ProcessModel, State

model = ProcessModel(
    name="two lags",
    states=(State("y", "m"), State("z", "m"), State("slow", "V"), State("hardly", "V")),
    inputs=(Input("u", "V"),),
    outputs=(Output("y", "m"), Output("z", "m")),
    parameters=(Parameter("tau", "s", 0.3, 0.05, 1.0, "log"),),
    derivative=lambda x, u, p: (
        (2.0 * u[0] - x[0]) / p[0], (2.0 * u[0] - x[1]) / p[0], u[0] - x[2], -5e-324 * x[3]
    ),
)
"""


@pytest.mark.soak
def test_gaps_of_an_output_do_not_take_away_the_frequency_response_of_another(tmp_path, rig):
    (tmp_path / "lags.py").write_text(TWO_LAGS)
    signals = ["u: {column: u}", "y: {column: y}", "z: {column: z}"]
    (tmp_path / "id.yaml").write_text(
        "model: lags.py:model\npopulation: 20\ngenerations: 3\ncolumns:\n"
        f"  time: {{sample_rate: 50.0}}\n  inputs: {{{signals[0]}}}\n"
        f"  outputs: {{{signals[1]}, {signals[2]}}}\n"
    )
    u, w, y = record(1).T
    cells = ["" if k % 15 == 7 else repr(value) for k, value in enumerate((y + 0.01 * w).tolist())]
    rows = [f"{a},{b},{c}" for a, b, c in zip(u.tolist(), y.tolist(), cells, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["u,y,z", *rows]) + "\n")
    done = rig(
        ["identify", "log.csv", "--config", "id.yaml", "--out", "found"], cwd=tmp_path, report=True
    )
    assert done.returncode == 0, done.stderr
    drawn = {path.stem for path in (tmp_path / "found/figures").glob("bode-*.svg")}
    assert drawn == {"bode-y"}
    page = (tmp_path / "found/report.html").read_text("utf-8")
    assert "No frequency response of z is drawn" in page
    assert "<th>note</th>" not in page, "there are none"
    # The slow state remembers for three seconds, of which residuals are drawn.
    assert "shares are of the first 50 lags" in page


def test_text_from_users_is_text(page):
    assert "lag <i>&_%" in page.text
    assert "a lag & <script>alert(1)</script>" in page.text
    assert "τ dy/dt = a\u2009b\u2009u − y + <b>k</b>\u2009w" in page.text
    assert "time constant, 50 % & <more>" in page.text
    assert TRAINING in page.text
    assert NASTY in page.text


def test_numbers_of_the_page_are_those_of_the_document(page, document):
    rows = {given["data-parameter"]: values for given, values in page.rows
            if "data-parameter" in given}  # fmt: skip
    assert set(rows) == set(document["parameters"])
    for name, one in document["parameters"].items():
        assert rows[name] == [one["value"], *one.get("interval", [])]
    (combination,) = [
        values for given, values in page.rows if given.get("data-combination") == "a b"
    ]
    (known,) = [e for a in document["ambiguities"] for e in a["determined"]]
    assert combination == [known["value"], *known["interval"]]
    assert known["unit"] == "m"


def test_errors_stand_beside_those_of_linear_models(page, document):
    first, hindsight = document["comparison"]["baselines"]
    assert (first["name"], hindsight["name"]) == ("OE", "OE, in hindsight")
    models = {"identified": document["metrics"], "OE": first["metrics"]}
    fits = {}
    for part in ("validation", "training"):
        shown = [
            (given["data-model"], values)
            for given, values in page.rows
            if given.get("data-part") == part and "data-model" in given
        ]
        expected = models | ({hindsight["name"]: hindsight["metrics"]} if part[0] == "v" else {})
        keys = ("rmse", "msd", "rmse_absolute", "fit_percent")
        assert shown == [
            (name, [metrics[part][0]["outputs"]["y"][key] for key in keys])
            for name, metrics in expected.items()
        ]
        fits[part] = {name: values[-1] for name, values in shown}
    # The plant is linear: nothing but noise is left, whatever was fitted.
    floor = fits["validation"]["identified"]
    assert fits["validation"] == pytest.approx(dict.fromkeys(fits["validation"], floor), abs=0.5)
    assert hindsight["metrics"]["training"] == []


def test_verdict_in_two_sentences_and_how_to_do_it_again(page, document, work, rig):
    for subject in ("predictions", "parameters"):
        assert f"{subject.capitalize()}: {document['verdict'][subject]['trust']}." in page.text
    assert re.search(r"determine 2 of 4 free parameters by themselves and 1 comb", page.text)
    # What would tell more is known: one of the two that act together.
    (ambiguity,) = document["ambiguities"]
    assert re.search(rf"Measure {ambiguity['measure'][0]} by other means", page.text)
    assert "give the values under fixed in a file for --config:" in page.text
    (folder, result) = re.search(
        r"log of the rig, in (\S+): rig replay LOG --parameters (\S+) --config id.yaml --trust",
        page.text,
    ).groups()
    assert folder == document["reproduction"]["folder"]
    assert (Path(folder) / result).is_file()
    for log in document["reproduction"]["logs"]:
        assert log["sha256"] in page.text
    assert document["software"]["numpy"] in page.text
    command = document["reproduction"]["command"]
    assert command in page.text
    assert folder not in command  # names are those in that folder
    done = rig([*shlex.split(command)[1:], "--out", "again", "--json"], cwd=work)
    assert done.returncode == 0, done.stderr
    again = json.loads(done.stdout)["parameters"]
    for name, one in document["parameters"].items():
        assert again[name]["value"] == one["value"]


def test_a_doubtful_validation_may_feel_what_the_training_hardly_does(document):
    changed = copy.deepcopy(document)
    name = next(n for n, p in changed["parameters"].items() if p.get("interval"))

    def asked():
        plain = SimpleNamespace(name="plain", parameters=(), state_names=())
        steps = explanation.view(plain, changed, Rows.of(changed))["steps"]
        return [list(s.names) for s in steps if s.before.startswith("Fit the logs of the valid")]

    changed["verdict"]["predictions"]["trust"] = "limited"
    assert asked() == []
    changed["parameters"][name]["interval"][1] = None
    assert asked() == [[name]]
    changed["verdict"]["predictions"]["trust"] = "good"
    assert asked() == []


def test_parameters_that_are_bounded_are_no_part_of_the_rest(document):
    changed = copy.deepcopy(document)
    plain = SimpleNamespace(name="plain", parameters=(), state_names=())

    def sentence():
        return explanation.view(plain, changed, Rows.of(changed))["determined"]

    name = next(n for n, p in changed["parameters"].items() if p.get("interval"))
    changed["parameters"][name]["interval"][1] = None
    assert ", and bound 1 more on one side. The rest is not to be used" in sentence()
    for parameter in changed["parameters"].values():
        if not parameter.get("interval"):
            parameter["source"] = "fixed"
            parameter.pop("range", None)
    assert sentence().endswith(", and bound 1 more on one side.")


def test_latex_holds_every_parameter_and_compiles(result, document, work, tmp_path):
    table = (work / "found/parameters.tex").read_text(encoding="utf-8")
    rows = [line for line in table.splitlines() if line.endswith(r"\\")][1:]
    assert len(rows) == len(document["parameters"]) + 1
    assert r"50 \% \& \textless{}more\textgreater{}" in rows[0]
    assert any(notation.tex(NASTY) in row for row in rows)
    for row in rows:
        assert len(re.findall(r"(?<!\\)&", row)) == 4
        assert row.count("{") - row.count(r"\{") == row.count("}") - row.count(r"\}")
        assert not re.search(r"(?<!\\)[%#]", row)
    if shutil.which("pdflatex") is None:
        return  # checked above as far as that goes without it
    source = "\\documentclass{article}\\begin{document}\n" + table + "\\end{document}\n"
    (tmp_path / "t.tex").write_text(source, encoding="utf-8")
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"],
        cwd=tmp_path, capture_output=True, text=True, errors="replace", check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:]


def test_no_report_writes_none(work, rig):
    args = ["identify", "check.csv", "--config", "id.yaml", "--generations", "2", "--no-report"]
    done = rig([*args, "--out", "bare"], cwd=work)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in (work / "bare").iterdir()] == ["parameters.yaml"]
    assert "Report:" not in done.stdout


@pytest.mark.soak
def test_without_intervals_and_validation_the_page_says_so(work, rig):
    args = ["identify", "check.csv", "--config", "id.yaml", "--preset", "thesis", "--json"]
    done = rig([*args, "--generations", "3", "--out", "plain"], cwd=work, report=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["files"]["report"] == "plain/report.html"
    page = Page((work / "plain/report.html").read_text(encoding="utf-8"))
    assert "There are no intervals: the preset thesis does not refine to a minimum." in page.text
    assert "none was held back to judge it" in page.text
    assert not any("data-quantity" in given for given, _ in page.rows)


@pytest.mark.soak
def test_spectra_of_inputs_are_of_all_samples_also_where_an_output_was_not_measured(work, rig):
    lines = (work / "check.csv").read_text("utf-8").splitlines()
    lost = [line.rpartition(",")[0] + "," if n == 300 else line for n, line in enumerate(lines)]
    (work / "lost.csv").write_text("\n".join(lost) + "\n")
    counts = []
    for name in ("check", "lost"):
        args = ["identify", f"{name}.csv", "--config", "id.yaml", "--out", name]
        done = rig(args, cwd=work, report=True)
        assert done.returncode == 0, done.stderr
        page = Page((work / name / "report.html").read_text(encoding="utf-8"))
        counts += re.findall(r"Welch.s estimate from (\d+) segments", page.text)
    assert len(counts) == 2 and counts[0] == counts[1]


@pytest.mark.soak
def test_figures_are_drawn_again_in_other_formats(result, work, rig):
    formats = ["--format", "png", "--format", "svg"]
    done = rig(["figures", "found", "--trust", *formats, "--out", "drawn", "--json"], cwd=work)
    assert done.returncode == 0, done.stderr
    files = json.loads(done.stdout)["figures"]
    assert len(files) == 2 * len(list((work / "found/figures").iterdir()))
    assert (work / "drawn/validation.png").read_bytes().startswith(b"\x89PNG")
    for name in ("intervals", "signals", "validation"):
        again, before = (work / place / f"{name}.svg" for place in ("drawn", "found/figures"))
        assert again.read_bytes() == before.read_bytes()


@pytest.mark.soak
def test_figures_of_a_report_from_before_rivals_had_intervals(result, work, rig, tmp_path):
    shutil.copytree(work / "found", tmp_path / "found")
    data = tmp_path / "found/report.json"
    document = json.loads(data.read_text("utf-8"))
    values = {name: 1.1 * entry["value"] for name, entry in document["parameters"].items()}
    document = {k: v for k, v in document.items() if k not in ("together", "disagreement")}
    data.write_text(json.dumps({**document, "rivals": [values]}))
    done = rig(["figures", "found", "--trust", "--json"], cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.soak
def test_columns_of_a_file_for_another_model_of_the_same_signals_serve(result, work, rig):
    (work / "other.yaml").write_text(CONFIG.replace("my_model.py:model", "actuator"))
    args = ["replay", "check.csv", "--parameters", "found/parameters.yaml", "--trust"]
    done = rig([*args, "--config", "other.yaml", "--figure", "replay.png"], cwd=work)
    assert done.returncode == 0, done.stderr
    assert re.search(
        r"Next: rig replay ANOTHER_LOG .* --config \S*other.yaml --trust\n", done.stdout
    )


@pytest.mark.soak
def test_figures_of_what_is_not_there_any_more(result, work, rig, tmp_path):
    shutil.copytree(work / "found", tmp_path / "found")
    data = tmp_path / "found/report.json"
    for wrong, said in (
        ({"folder": str(tmp_path)}, "check.csv: this log of the report is gone"),
        ({"hold_back": "x"}, "not a readable report"),
    ):
        document = json.loads((work / "found/report.json").read_text("utf-8"))
        document["reproduction"] |= wrong
        document["reproduction"]["logs"].reverse()
        data.write_text(json.dumps(document))
        done = rig(["figures", "found", "--trust"], cwd=tmp_path)
        assert done.returncode == 2
        assert said in done.stderr
    (tmp_path / "copy.csv").write_text((work / "check.csv").read_text("utf-8") + "0,0,0\n")
    document = json.loads((work / "found/report.json").read_text("utf-8"))
    document["reproduction"] |= {"folder": str(tmp_path)}
    document["reproduction"]["logs"] = [
        log | {"log": "copy.csv"} for log in document["reproduction"]["logs"]
    ]
    data.write_text(json.dumps(document))
    done = rig(["figures", "found", "--trust"], cwd=tmp_path)
    assert "copy.csv: this log is another than the report's; identify again" in done.stderr
    assert "nowhere: no report.json there" in rig(["figures", "nowhere"], cwd=tmp_path).stderr
    assert "written as svg, pdf, png" in rig(["figures", ".", "--format", "gif"], cwd=work).stderr
