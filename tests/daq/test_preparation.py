"""Foreign logs that are cut, merged, moved, detrended and decimated before they are used."""

import dataclasses
import re
import shlex

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.signal import lfilter

from daq import ConfigError
from daq.files import digest
from daq.identification import records
from daq.identification.fit import identify_files, load_logs
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from daq.report.publication import publish
from daq.report.reprint import redraw
from sysid import GASSI, Dataset
from sysid.examples import lag
from sysid.problem.faults import data_faults
from sysid.problem.preparation import Preparation, low_pass, prepare
from tests.daq.support import OF_LAG, rig

GAIN, TAU, DT, N = 3.0, 0.04, 1e-3, 3000


def between_levels(count, hold):
    """A table of the lag thrown between two levels, each held for so many samples, with noise."""
    rng = np.random.default_rng(0)
    inputs = np.repeat(rng.choice([-1.0, 1.0], count), hold)
    outputs = np.zeros(len(inputs))
    for k, u in enumerate(inputs[:-1]):
        outputs[k + 1] = GAIN * u + (outputs[k] - GAIN * u) * np.exp(-DT / TAU)
    outputs[1:] += 0.01 * rng.standard_normal(len(outputs) - 1)
    return pd.DataFrame({"t": DT * np.arange(len(inputs)), "u": inputs, "y": outputs})


def clean():
    """A lag at 1 kHz under levels that hold for 23 samples, without noise."""
    u = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, N // 23 + 1), 23)[:N]
    y = np.zeros(N)
    for k in range(N - 1):
        y[k + 1] = GAIN * u[k] + (y[k] - GAIN * u[k]) * np.exp(-DT / TAU)
    return Dataset(u, y, DT, "lag")


def fitted(record):
    return GASSI(lag(), population=20, generations=3).fit([record]).parameters_


def test_a_decimated_record_gives_the_parameters_of_the_whole():
    record = clean()
    made = prepare(lag(), record, Preparation(decimate=10))
    assert made.dataset.dt == pytest.approx(10 * DT)
    found = fitted(made.dataset)
    assert found["gain"] == pytest.approx(GAIN, rel=0.01)
    assert found["tau"] == pytest.approx(TAU, rel=0.02)
    # Every tenth sample as it stands folds what is faster than the new rate into the signals.
    thinned = fitted(Dataset(record.inputs[::10], record.outputs[::10], 10 * DT))
    assert abs(thinned["gain"] / GAIN - 1.0) > 0.05


@pytest.mark.parametrize(("words", "scale"), [(["detrend.y=constant"], 1), (["decimate=10"], 10)])
def test_what_is_held_back_of_a_prepared_log_is_no_copy(tmp_path, words, scale):
    (tmp_path / "lag.py").write_text("from sysid.examples import lag\nmodel = lag()\n")
    between_levels(130, 23).to_csv(tmp_path / "log.csv", index=False)
    settings = ["hold_back=0.3", *words]
    request = SettingsRequest(None, {"model": str(tmp_path / OF_LAG["model"])}, settings)
    made = problem_of(request)
    begins, ends = records.hold_back(load_logs(made, [tmp_path / "log.csv"], [])[0], 0.3)
    for log in (*begins, *ends):
        assert log.unmended.n_samples == pytest.approx(scale * log.dataset.n_samples, abs=scale)
    assert sum(log.unmended.n_samples for log in (*begins, *ends)) <= 130 * 23
    parts = [[log.unmended for log in logs] for logs in (begins, ends)]
    assert "copy" not in [fault.kind for fault in data_faults(made.model, *parts)]


def test_the_low_pass_stops_what_would_fold_into_its_passband():
    for factor in (2, 7, 10):
        taps = low_pass(factor)
        frequency = np.linspace(0.0, 1.0, 2000)  # in parts of the Nyquist frequency
        phases = np.exp(-1j * np.pi * np.outer(frequency, np.arange(len(taps))))
        gain = np.abs(phases @ taps)
        assert np.allclose(gain[frequency < 0.75 / factor], 1.0, atol=2e-3)
        assert gain[frequency > 1.25 / factor].max() < 2e-3
        assert np.allclose(taps, taps[::-1])


@pytest.mark.parametrize("late", [3e-3, 3.4e-3, -2.5e-3])
def test_an_output_that_comes_late_is_moved_back(late):
    record = clean()
    times = record.time - late
    smooth = np.sin(20.0 * record.time)
    moved = dataclasses.replace(record, outputs=np.sin(20.0 * times))
    made = prepare(lag(), moved, Preparation(delay={"y": late}))
    first = round(made.start / DT)
    then = slice(first, first + made.dataset.n_samples)
    inner = slice(20, -20)
    assert np.allclose(made.dataset.outputs[inner, 0], smooth[then][inner], atol=1e-6)
    assert np.array_equal(made.dataset.inputs, record.inputs[then])


def test_samples_that_were_not_measured_take_no_part():
    record = clean()
    outputs = record.outputs + 2.0 + 3.0 * record.time[:, None]
    outputs[1000:1100] = np.nan
    record = dataclasses.replace(record, outputs=outputs)
    flat = prepare(lag(), record, Preparation(detrend={"y": "linear"})).dataset.outputs[:, 0]
    known = np.isfinite(flat)
    assert known.sum() == N - 100
    assert np.allclose(np.polyfit(record.time[known], flat[known], 1), 0.0, atol=1e-9)
    made = prepare(lag(), record, Preparation(decimate=10))
    lost = np.flatnonzero(np.isnan(made.dataset.outputs[:, 0])) * made.dataset.dt + made.start
    assert 0.95 <= lost.min() <= 1.01 and 1.09 <= lost.max() <= 1.15


def test_white_noise_is_known_behind_the_filter():
    rng, n = np.random.default_rng(1), 40_000
    record = Dataset(
        rng.standard_normal(n), rng.standard_normal(n), DT, input_noise=[1.0], output_noise=[1.0]
    )
    made = prepare(lag(), record, Preparation(decimate=8)).dataset
    assert made.input_noise[0] == pytest.approx(np.std(made.inputs), rel=0.05)
    assert made.output_noise[0] == pytest.approx(np.std(made.outputs), rel=0.05)


@pytest.mark.parametrize("time", [3e-3, 40e-3, 1e-5])
def test_a_filter_is_taken_out_and_its_noise_is_white_as_before(time):
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal((2, 20_000))
    y[50] = np.nan
    pole = np.exp(-1e-2 / time)
    passed = lfilter([1.0 - pole], [1.0, -pole], u)  # from rest
    noise = {"input_noise": np.array([passed.std()]), "output_noise": np.array([0.3])}
    record = Dataset(passed, y, 0.01, **noise)
    made = prepare(lag(), record, Preparation(filtered={"u": time, "nobody": 1.0}))
    np.testing.assert_allclose(made.dataset.inputs[1:, 0], u[1:], atol=1e-9)
    np.testing.assert_array_equal(made.dataset.outputs[:, 0], y)
    assert made.dataset.input_noise == pytest.approx([1.0], rel=0.1)
    assert made.dataset.output_noise == [0.3]
    assert made.steps == (f"unfiltered: u {1e3 * time:.4g} ms",)
    gaps = prepare(lag(), record, Preparation(filtered={"y": 3e-3})).dataset.outputs[:, 0]
    assert np.flatnonzero(np.isnan(gaps)).tolist() == [50, 51]


@pytest.fixture
def folder(tmp_path):
    """A log whose force stands in a file of its own, faster, later, and with an offset."""
    record = clean()
    (tmp_path / "lag.py").write_text("from sysid.examples import lag\nmodel = lag()\n")
    pd.DataFrame({"t": record.time, "u": record.inputs[:, 0]}).to_csv(
        tmp_path / "day1.csv", index=False
    )
    fast = np.arange(-200, 2 * N - 400) * DT / 2.0
    force = np.interp(fast - 4e-3, record.time, record.outputs[:, 0])
    pd.DataFrame({"t": fast, "y": force}).to_csv(tmp_path / "day1_force.csv", index=False)
    return tmp_path


def problem(folder, **changes):
    path = folder / "id.yaml"
    path.write_text(yaml.safe_dump({**OF_LAG, **changes}))
    return problem_of(SettingsRequest(str(path)))


def loaded(folder, **changes):
    asked = problem(folder, **changes)
    return records.load(folder / "day1.csv", asked.model, asked.mapping, asked.selection)


@pytest.mark.soak
def test_a_log_is_merged_moved_cut_and_decimated_and_the_report_shows_it(folder):
    steps = {"merge": "*_force.csv", "use": "0.1 s .. 2.7 s", "delay": {"y": "4 ms"}, "decimate": 5}
    problem(folder, **steps)
    notes = []
    request = SettingsRequest(str(folder / "id.yaml"))
    result = identify_files([folder / "day1.csv"], [], request, folder / "out", notes.append)
    found = result.parameters["value"]
    assert found["gain"] == pytest.approx(GAIN, rel=0.02)
    assert found["tau"] == pytest.approx(TAU, rel=0.05)
    document = yaml.safe_load((folder / "out" / "parameters.yaml").read_text("utf-8"))
    entry = document["preparation"][0]
    assert entry["before"]["sample_time"] == pytest.approx(DT)
    assert entry["after"]["sample_time"] == pytest.approx(5 * DT)
    told = "; ".join(entry["steps"])
    assert "day1_force.csv" in told and "y 4 ms earlier" in told and "become" in told
    assert any(told in getattr(note, "text", "") for note in notes)
    publish(result, folder / "out")
    page = (folder / "out" / "report.html").read_text("utf-8")
    assert 'id="preparation"' in page and "y 4 ms earlier" in page
    for log in ("day1.csv", "day1_force.csv"):
        assert digest(folder / log) in page
    drawn = redraw(folder / "out", ["png"], folder / "again", trust=True)
    names = {path.stem for path in drawn}
    assert {"preparation", "preparation-closer"} <= names


def test_a_long_log_is_searched_by_parts_and_that_is_told(folder):
    between_levels(400, 20).to_csv(folder / "long.csv", index=False)
    problem(folder, search_samples=2048)
    request = SettingsRequest(str(folder / "id.yaml"))
    result = identify_files([folder / "long.csv"], [], request, folder / "out", lambda _: None)
    values = result.parameters["value"]
    assert values["gain"] == pytest.approx(GAIN, rel=0.01)
    assert values["tau"] == pytest.approx(TAU, rel=0.01)
    excerpt = yaml.safe_load((folder / "out" / "parameters.yaml").read_text())["search"]["excerpt"]
    assert (excerpt["samples"], excerpt["of"]) == (2048, 8000)
    assert excerpt["parts"][0] == {"log": str(folder / "long.csv"), "rows": [1, 1024]}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"delay": {"z": 0.1}}, "delay.z: the model has no such channel"),
        ({"filtered": {"z": 0.1}}, "filtered.z: the model has no such channel"),
        ({"filtered": {"y": "-3 ms"}}, "filtered.y"),
        ({"merge": "*_force.csv", "filtered": {"y": "9 s"}}, "9 s is more than a tenth of"),
        ({"detrend": {"y": "quadratic"}}, "detrend.y"),
        ({"decimate": 0}, "decimate"),
        ({"merge": "*_force.csv", "decimate": 900}, "needs at least"),
        ({"merge": "*_force.csv", "delay": {"y": "9 s"}}, "the delay must be far shorter"),
        ({"merge": "missing.csv"}, "merge: there is no"),
        ({}, "has no column 'y'"),
    ],
)
def test_what_a_log_does_not_have_is_told_at_its_key(folder, changes, told):
    with pytest.raises(ConfigError, match=r"id\.yaml") as caught:
        loaded(folder, **changes)
    assert told in str(caught.value)


def test_files_whose_times_do_not_meet_are_refused(folder):
    late = pd.read_csv(folder / "day1_force.csv").assign(t=lambda table: table.t + 100.0)
    late.to_csv(folder / "day1_force.csv", index=False)
    with pytest.raises(ConfigError, match="no time is in all of"):
        loaded(folder, merge="*_force.csv")


def test_a_gap_is_cut_out_by_the_setting_that_is_named_for_it(folder):
    log = clean()
    frame = pd.DataFrame({"t": 100.0 + log.time, "u": log.inputs[:, 0], "y": log.outputs[:, 0]})
    frame.drop(index=range(800, 900)).to_csv(folder / "gap.csv", index=False)
    problem(folder)

    def faults(*settings):
        asked = problem_of(SettingsRequest(str(folder / "id.yaml"), {}, settings))
        loaded = records.load(folder / "gap.csv", asked.model, asked.mapping, asked.selection)
        return data_faults(asked.model, [loaded.dataset])

    (gap,) = faults()
    assert (gap.kind, gap.settings) == ("gap", ("use.gap=100.9 s .. 102.999 s",))
    assert faults(*gap.settings) == ()


def test_what_is_wrong_with_a_log_is_told_of_it_as_logged(folder):
    """A low-pass rings beside levels, which looks like clipping, and closes short gaps."""
    between_levels(150, 40).drop(index=range(3000, 3030)).to_csv(folder / "day1.csv", index=False)
    problem(folder, decimate=4)
    request = SettingsRequest(str(folder / "id.yaml"))
    result = identify_files([folder / "day1.csv"], [], request, folder / "out", lambda _: None)
    assert {fault.kind for fault in result.faults} == {"gap"}


def test_a_pattern_of_files_is_typed_as_in_a_file(folder):
    words = "--set", "merge=*_force.csv", "--population", "20", "--generations", "3"
    problem(folder)
    done = rig("identify", "day1.csv", "--config", "id.yaml", *words, "--no-report", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "merged with day1_force.csv" in done.stderr


def test_a_replay_reads_a_log_as_the_identification_did(folder):
    problem(folder)
    log = clean()
    late = np.interp(log.time - 4e-3, log.time, log.outputs[:, 0])
    frame = pd.DataFrame({"t": log.time, "u": log.inputs[:, 0], "y": -late})
    frame.to_csv(folder / "late.csv", index=False)
    small = "--population", "20", "--generations", "3", "--no-report"
    words = "--config", "id.yaml", "--set", "delay.y=4 ms", "--set", "columns.outputs.y.sign=-1"
    done = rig("identify", "late.csv", "--hold-back", "0.3", *words, *small, cwd=folder)
    shown = next(line for line in done.stdout.splitlines() if "rig replay" in line)
    again = shlex.split(shown.partition("rig replay ")[2])
    replayed = rig("replay", *again, cwd=folder)
    assert replayed.returncode == 0, replayed.stderr
    fit = re.search(r"^ y .* ([\d.-]+)$", replayed.stdout, re.MULTILINE)[1]
    assert float(fit) > 99.0, "neither moved nor turned round it fits far worse"
    assert str(folder) not in done.stdout
