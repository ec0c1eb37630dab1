"""``rig characterise``: rounds in one folder, which go on from wherever they were ended."""

import contextlib
import html
import json
import re
import shutil
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from daq.characterise import characterise as use_case
from daq.characterise.rounds import Request, Round, rounds_of
from daq.errors import DeviceError
from sim_rig.actuator import actuator
from sim_rig.backend import SimulatedDevice
from tests.daq.support import few_free, rig, start_rig, write_yaml

pytestmark = pytest.mark.soak

FREE = {"R_m", "K_m", "B_m"}
QUICK = [
    "candidates=8", "generations=0", "draws=1", "checks=2", "calibration=400", "run=0.5 s",
    "sample_rate=1000",
]  # fmt: skip


def words(*more):
    settings = [word for setting in QUICK for word in ("--set", setting)]
    begin = ["characterise", "--config", "id.yaml", "--model", "actuator", "--out", "c"]
    return [*begin, *settings, *more]


@pytest.fixture
def folder(tmp_path):
    write_yaml(tmp_path / "id.yaml", few_free())
    return tmp_path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A characterisation of three parameters in 1.5 s, to its end."""
    folder = tmp_path_factory.mktemp("finished")
    write_yaml(folder / "id.yaml", few_free())
    done = rig(*words("--time", "1.5", "--json"), cwd=folder, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


def test_it_uses_the_time_and_tells_the_parameters(finished):
    folder, document = finished
    assert document["logged_seconds"] == 1.5
    assert document["ended"] == "the 1.5 s are used up"
    widths = {q["name"]: q["width"] for q in document["quantities"]}
    assert widths.keys() == {"R_m", "K_m", "B_m"}
    page = (folder / "c" / "characterise.html").read_text("utf-8")
    assert "the 1.5 s are used up" in page and document["verdict"]["parameters"]["trust"] in page
    for quantity in document["quantities"]:
        assert f'data-value="{quantity["value"]!r}"' in page
    assert (folder / "c" / "report" / "report.html").exists()


def test_the_model_and_what_its_values_rest_on_are_named(folder):
    shown = rig(*words("--time", "0.5", "--model", "actuator:limits=true"), cwd=folder, timeout=300)
    assert shown.returncode == 0, shown.stderr
    (sentence,) = actuator(limits=True).assumptions
    page, report = (
        html.unescape(
            re.sub(r"\s+", " ", (folder / "c" / name).read_text("utf-8").replace("<wbr>", ""))
        )
        for name in ("characterise.html", "report/report.html")
    )
    for text in (" ".join(shown.stdout.split()), page, report):
        assert "actuator:limits=true" in text and sentence in text


def test_the_intervals_hold_what_the_simulated_rig_is_made_of(finished):
    folder, document = finished
    assert len(rounds_of(folder / "c")) > 1
    model = actuator(parameters="rig")
    truth = dict(zip(model.parameter_names, model.nominal.tolist(), strict=True))
    determined = {q["name"]: q for q in document["quantities"] if q["width"] is not None}
    for name, quantity in determined.items():
        off = abs(1.0 - truth[name] / quantity["value"])
        assert off <= 1.5 * quantity["width"]  # three standard deviations
        half = 0.5 * (quantity["high"] - quantity["low"])
        assert half == pytest.approx(quantity["width"] * quantity["value"])
    # 1.5 s and a calibration of 400 samples tell little of 2 mN m of bearings.
    assert all(determined[name]["width"] < 0.1 for name in ("R_m", "K_m"))


def test_intervals_come_out_as_they_were_predicted(finished):
    """By noise as the fit's filter has it: a compensated fit's would be half as wide again."""
    last = rounds_of(finished[0] / "c")[-1]
    ratios = [i.width / i.expected for i in last.intervals() if i.width]
    assert len(ratios) > 1 and all(0.8 < ratio < 1.25 for ratio in ratios)


def test_what_the_model_may_lack_is_tested_at_the_end(finished):
    *before, last = rounds_of(finished[0] / "c")
    assert "missing" in last.result
    assert before and not any("missing" in each.result for each in before)


def test_what_was_done_is_not_done_again(finished, tmp_path):
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "c" / "report")  # as a kill after the last identification leaves it
    logs = {path: path.stat().st_mtime_ns for path in (tmp_path / "c").rglob("log.csv")}
    done = rig("characterise", "--resume", "c", "--json", cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["quantities"] == finished[1]["quantities"]
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "c").rglob("log.csv")} == logs
    assert (tmp_path / "c" / "report" / "report.html").exists()


def test_more_time_given_with_resume_is_recorded_and_used(finished, tmp_path):
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True)
    more = ["--resume", "c", "--time", "2.5", "--precision", "0.9%"]
    done = rig("characterise", *more, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "It ended because the 2.5 s are used up" in done.stdout
    recorded = Request.load(tmp_path / "c")
    assert (recorded.time, recorded.precision) == (2.5, 0.9)
    assert len(rounds_of(tmp_path / "c")) > len(rounds_of(finished[0] / "c"))
    marks = {words[0]: words[-1] for line in done.stdout.splitlines() if (words := line.split())}
    assert (marks["K_m"], marks["B_m"]) == ("met", "missed")
    assert "Wider than the 0.9 % wanted: " in done.stdout
    page = (tmp_path / "c" / "characterise.html").read_text("utf-8")
    assert page.count("<td>met</td>") + page.count("<td>missed</td>") == len(marks.keys() & FREE)
    assert "rig characterise --resume c --time 5" in done.stdout


def test_an_option_that_resuming_cannot_change_is_refused(finished, tmp_path):
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True)
    before = (tmp_path / "c" / "characterise.json").read_text("utf-8")
    for more, named in (
        (["simulated.yaml"], "RIG.yaml"),
        (["--model", "actuator", "--set", "run=1 s"], "--model, --set"),
        (["--config", "id.yaml", "--time", "9"], "--config"),
        (["--out", "d"], "--out"),
        (["--plant", "actuator"], "--plant"),
    ):
        done = rig("characterise", *more, "--resume", "c", cwd=tmp_path)
        assert done.returncode == 2
        assert f"c: {named} cannot be changed on resuming" in done.stderr
        assert "leave out all but --time, --precision and --ask" in done.stderr
    assert (tmp_path / "c" / "characterise.json").read_text("utf-8") == before


def test_a_later_round_begins_where_the_last_one_left_no_quantity_without_an_end(
    finished, tmp_path
):
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True)
    first = rounds_of(tmp_path / "c")[0]
    file = first.identification / "parameters.yaml"
    for ends, goes_on in (
        ([0.1, 0.2], True),
        ([None, 0.2], True),
        ([0.1, None], True),
        (None, False),
    ):
        content = yaml.safe_load(file.read_text("utf-8"))
        content["parameters"]["K_m"]["interval"] = ends
        file.write_text(yaml.safe_dump(content))
        earlier = first.as_earlier_fit
        assert earlier.minima.is_settled == goes_on
        assert ("K_m" in earlier.intervals) == (ends is not None and None not in ends)
        assert earlier.minima.values[0]["K_m"] == content["parameters"]["K_m"]["value"]
        assert earlier.minima.noise.keys() == set(content["criterion"].get("noise", ()))


def test_each_run_has_noise_of_its_own(finished):
    logs = sorted((finished[0] / "c").rglob("log.csv"))
    noise = {json.dumps(json.loads(run.read_text("utf-8"))["calibration"]["noise"]) for run in (
        log.parent / "run.json" for log in logs
    )}  # fmt: skip
    assert len(noise) == len(logs) > 1


def test_a_folder_that_is_taken_is_not_written_to(finished):
    folder, _ = finished
    done = rig(*words("--time", "1.5"), cwd=folder)
    assert done.returncode == 2
    assert "go on with it: rig characterise --resume c" in done.stderr


def test_mistakes_are_named_before_anything_is_written(folder):
    for more, named in (
        (["--precision", "five"], "--precision: 'five' is no number above 0 in %"),
        (["--set", "protocols=[play]"], "protocol play has no settings"),
        (["serial.yaml"], "name a model of the whole plant"),
    ):
        done = rig(*words(*more), cwd=folder)
        assert done.returncode == 2
        assert named in done.stderr
    assert not (folder / "c").exists()
    done = rig("characterise", "--resume", "c", cwd=folder)
    assert done.returncode == 2
    assert "name the folder that rig characterise made" in done.stderr


def test_a_first_design_that_promises_nothing_is_refused_in_words(folder):
    deaf = ["--set", "noise={current_motor: 1e4, current_brake: 1e4, omega: 1e7, torque: 1e4}"]
    resumed = ["characterise", "--resume", "c"]
    for words_of_it in (words("--time", "1", *deaf), resumed, [*resumed, "--time", "2"]):
        done = rig(*words_of_it, cwd=folder, timeout=120)
        assert done.returncode == 2
        assert "no run within the limits would tell the parameters better" in done.stderr
        assert "give more time or longer runs" in done.stderr
        assert "go on with" not in done.stderr


def test_a_person_is_asked_for_the_mounting_that_tells_more(folder):
    """Wound up by next to nothing the cable leaves hardly any room; off the shaft there is more."""
    free = {"backend": "simulated", "options": {"plant": {"load": "free"}}}
    write_yaml(folder / "free.yaml", free)
    change = {"take the load off": {"rig": "free.yaml"}}
    tight = {"backend": "simulated", "limits": {"speed": 4.0}, "mountings": change}
    write_yaml(folder / "rig.yaml", tight)
    begin = [*words("rig.yaml", "--time", "1.5", "--json"), "--ask"]
    done = rig(*begin, cwd=folder, timeout=400)  # nobody answers
    assert done.returncode == 2
    assert "round 2: take the load off" in done.stderr
    assert "--resume c --ask" in done.stderr
    waiting = rig("characterise", "--resume", "c", cwd=folder, timeout=100)
    assert waiting.returncode == 2
    assert "round 2 is for another mounting: take the load off" in waiting.stderr
    again = ["characterise", "--resume", "c", "--ask", "--json"]
    done = rig(*again, cwd=folder, timeout=400, input="\n" * 5)
    assert done.returncode == 0, done.stderr
    first, second, *_ = rounds_of(folder / "c")
    assert (folder / "rig.yaml").samefile(first.rig)
    assert (folder / "free.yaml").samefile(second.rig)


def test_runs_are_those_of_an_experiment_whose_name_begins_another(tmp_path):
    """designed-1 of a round of ten runs or more; two within a second have a number behind."""
    runs = tmp_path / "round-1" / "runs"
    for k, (name, status) in enumerate(
        [
            ("designed-1", "interlock"),
            ("designed-10", "completed"),
            ("designed-1-2", "interlock"),
            ("designed-11", "completed"),
        ]
    ):
        folder = runs / f"2026010{k + 1}T000000Z-{name}"
        folder.mkdir(parents=True)
        (folder / "run.json").write_text(json.dumps({"status": status}))
    first = Round(tmp_path, 1)
    assert first.stops(Path("designed-1.yaml")) == 2
    assert first.is_left_out(Path("designed-1.yaml"))
    assert len(first.captures(Path("designed-10.yaml"))) == 1


@pytest.mark.parametrize(
    ("given", "named"), [({}, "actuator:limits=true"), ({"model": "actuator"}, None)]
)
def test_without_a_name_the_model_has_the_ends_of_its_amplifiers(
    tmp_path, monkeypatch, given, named
):
    monkeypatch.setattr(use_case, "resume", lambda folder, **_: Request.load(folder))
    config = write_yaml(tmp_path / "id.yaml", given)
    request = use_case.characterise("simulated.yaml", 10.0, out=tmp_path / "c", config=config)
    assert request.model == named
    assert Request.load(tmp_path / "c").model == named


@pytest.mark.parametrize(("fastest", "rate"), [(20_000.0, None), (2500.0, 2000.0), (800.0, 800.0)])
def test_the_runs_sample_no_faster_than_the_device(tmp_path, monkeypatch, fastest, rate):
    opened = SimulatedDevice.open
    monkeypatch.setattr(
        SimulatedDevice, "open", lambda self: replace(opened(self), max_rate=fastest)
    )
    monkeypatch.setattr(use_case, "resume", lambda folder, **_: Request.load(folder))
    request = use_case.characterise("simulated.yaml", 10.0, out=tmp_path / "c")
    assert request.settings == (() if rate is None else (f"sample_rate={rate}",))
    if rate is not None:
        with pytest.raises(DeviceError, match=r"up to \d+ Hz; sample_rate 4000 Hz is too"):
            use_case.characterise(
                "simulated.yaml", 10.0, out=tmp_path / "d", settings=["sample_rate=4000"]
            )
        assert not (tmp_path / "d").exists()


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL")
def test_a_killed_characterisation_goes_on_to_the_same_end(finished, folder):
    """Killed again at every further file that it goes on to write."""
    begin = words("--time", "1.5", "--json")
    for until in ("design.json", "log.csv", "search.ckpt", "parameters.yaml"):
        process = start_rig(*begin, cwd=folder)
        while process.poll() is None and not list((folder / "c").rglob(until)):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.01)
        process.send_signal(signal.SIGKILL)
        _, said = process.communicate()
        assert process.returncode == -signal.SIGKILL, said
        assert Round(folder / "c", 1).folder.exists()
        begin = ["characterise", "--resume", "c", "--json"]
    done = rig("characterise", "--resume", "c", "--json", cwd=folder, timeout=300)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["quantities"] == finished[1]["quantities"]
