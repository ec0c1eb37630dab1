"""Checkpoints: a search that was killed goes on to the bit, and only with what it began with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid import GASSI, Dataset, ModelError
from sysid.gassi import checkpoint
from tests.soak import mostly_soak
from tests.sysid.support import lag, motor, motor_record

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = {"population": 30, "generations": 24, "random_state": 5}

# Stops itself without any goodbye once it has come so far.
KILLED = """
import os, signal, sys
import numpy as np
from sysid import GASSI, Dataset
from sysid.gassi import checkpoint
from tests.sysid.test_checkpoint import SETTINGS, noisy
from tests.sysid.support import motor

checkpoint.INTERVAL = 0.0
steps = 0

def stop(progress):
    global steps
    steps += 1
    if steps == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)

GASSI(motor(), **SETTINGS).fit(noisy(), on_progress=stop, checkpoint=sys.argv[1])
"""


def noisy(shift=0.0):
    noise = np.random.default_rng(0).normal(0.0, 0.02, (200, 2))
    clean = motor_record()
    outputs = clean.outputs + noise * np.abs(clean.outputs).max(axis=0) + shift
    return Dataset(clean.inputs, outputs, clean.dt, "bench")


@pytest.fixture(scope="module")
def whole():
    steps = []
    found = GASSI(motor(), **SETTINGS).fit(noisy(), on_progress=steps.append)
    assert {step.stage for step in steps} == {"search", "refine", "weigh"}
    return found, steps


def searching(steps):
    """Those that a checkpoint is written after; what comes then is soon done again."""
    return [step for step in steps if step.stage != "weigh"]


def assert_same(found, expected):
    np.testing.assert_array_equal(found.vector_, expected.vector_)
    np.testing.assert_array_equal(found.history_, expected.history_)
    for name in (
        "error_", "search_error_", "n_simulations_", "flagged_", "stopped_", "feasible_",
        "initial_states_",
    ):  # fmt: skip
        assert getattr(found, name) == getattr(expected, name), name


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
@pytest.mark.parametrize("share", mostly_soak([0.3, 0.97], always=0))
def test_a_killed_search_goes_on_to_the_bit(tmp_path, whole, share):
    expected, steps = whole
    steps = searching(steps)
    path = tmp_path / "search.ckpt"
    step = max(1, round(share * len(steps)))
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, str(path), str(step)],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=False,
    )  # fmt: skip
    assert killed.returncode == -signal.SIGKILL
    rest = []
    found = GASSI(motor(), **SETTINGS).fit(noisy(), resume=path, on_progress=rest.append)
    assert_same(found, expected)
    assert searching(rest) == steps[step:]


class Stop:
    def __init__(self, stage, after=1):
        self.stage, self.left = stage, after

    def __call__(self, progress):
        self.left -= progress.stage == self.stage
        if self.left == 0:
            raise KeyboardInterrupt


@pytest.mark.parametrize("stage", ["search", "refine"])
def test_ctrl_c_leaves_a_checkpoint(tmp_path, whole, stage):
    path = tmp_path / "search.ckpt"
    stopped = GASSI(motor(), **SETTINGS).fit(noisy(), on_progress=Stop(stage, 3), checkpoint=path)
    assert stopped.stopped_ == "interrupted"
    found = GASSI(motor(), **SETTINGS).fit(noisy(), resume=path)
    assert_same(found, whole[0])


def test_a_finished_search_is_only_read_again(tmp_path, whole):
    path = tmp_path / "search.ckpt"
    GASSI(motor(), **SETTINGS).fit(noisy(), checkpoint=path)
    steps = []
    assert_same(
        GASSI(motor(), **SETTINGS).fit(noisy(), resume=path, on_progress=steps.append), whole[0]
    )
    assert searching(steps) == []


@pytest.mark.soak
def test_estimated_starts_go_on_too(tmp_path):
    model = lag(
        states=(replace(lag().states[0], initial_range=(-5.0, 5.0)),),
        outputs=(replace(lag().outputs[0], name="seen"),),
        output=lambda x, u, p: (x[0],),
    )
    t = np.arange(100) * 0.01
    record = Dataset(np.zeros(100), 3.0 * np.exp(-t / 0.05) + 0.01 * np.sin(40.0 * t), 0.01)
    settings = {"population": 20, "generations": 12, "fixed": {"gain": 2.0}}
    expected = GASSI(model, **settings).fit(record)
    assert expected.initial_states_[0]["y"] == pytest.approx(3.0, rel=0.05)
    path = tmp_path / "search.ckpt"
    GASSI(model, **settings).fit(record, on_progress=Stop("refine", 3), checkpoint=path)
    assert_same(GASSI(model, **settings).fit(record, resume=path), expected)


@pytest.mark.parametrize("preset", ["thesis", "classic"])
def test_every_preset(tmp_path, preset):
    settings = SETTINGS | {"preset": preset}
    path = tmp_path / "search.ckpt"
    GASSI(motor(), **settings).fit(noisy(), on_progress=Stop("search", 7), checkpoint=path)
    found = GASSI(motor(), **settings).fit(noisy(), resume=path)
    assert_same(found, GASSI(motor(), **settings).fit(noisy()))


# --- whose checkpoint it is -----------------------------------------------------------------


@pytest.fixture
def begun(tmp_path):
    path = tmp_path / "search.ckpt"
    GASSI(motor(), **SETTINGS).fit(noisy(), on_progress=Stop("search"), checkpoint=path)
    return path


def dynamo():
    return replace(motor(), name="dynamo")


def other_motor():
    model = motor()
    return replace(model, derivative=lambda x, u, p: (x[1], -p[0] * x[0] + u[0]))


@pytest.mark.parametrize(
    ("model", "records", "settings", "message"),
    [
        (motor, [noisy(1e-9)], {}, r"record 1 \(bench\) has other values"),
        (motor, [noisy(), noisy()], {}, r"it has 1 record\(s\), here are 2"),
        (motor, [replace(noisy(), dt=0.02)], {}, "sample time 0.01, here 0.02"),
        (motor, [noisy()], {"population": 31}, "population is 30, here 31"),
        (motor, [noisy()], {"random_state": 6}, "random_state is 5, here 6"),
        (motor, [noisy()], {"fixed": {"damping": 2e-5}}, "fixed is None, here {'damping': 2e-05}"),
        (other_motor, [noisy()], {}, "the equations of model motor have changed"),
        (lambda: motor(3.0), [noisy()], {}, "signals and parameters of model motor have changed"),
        (
            lambda: replace(motor(), name="dynamo"),
            [noisy()],
            {},
            "searches model motor, this is dynamo",
        ),
    ],
)
def test_another_search_is_refused(begun, model, records, settings, message):
    before = begun.read_bytes()
    with pytest.raises(ModelError, match=message) as caught:
        GASSI(model(), **(SETTINGS | settings)).fit(records, resume=begun)
    assert str(begun) in str(caught.value)
    assert begun.read_bytes() == before


def test_threads_do_not_matter(begun, whole):
    assert_same(GASSI(motor(), **SETTINGS, threads=1).fit(noisy(), resume=begun), whole[0])


def test_what_is_no_checkpoint_is_said_to_be_none(tmp_path, begun):
    def resume(path):
        GASSI(motor(), **SETTINGS).fit(noisy(), resume=path)

    with pytest.raises(ModelError, match="there is no checkpoint"):
        resume(tmp_path / "nowhere.ckpt")
    text = tmp_path / "text.ckpt"
    text.write_text("hello")
    with pytest.raises(ModelError, match="not a checkpoint of a search"):
        resume(text)
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(begun.read_bytes()[:-200])
    with pytest.raises(ModelError, match="not a checkpoint of a search"):
        resume(cut)
    foreign = tmp_path / "foreign.npz"
    np.savez(foreign, json=np.array(json.dumps({"format": checkpoint.FORMAT + 1})))
    with pytest.raises(ModelError, match="another version"):
        resume(foreign)


def test_a_place_that_cannot_be_written_is_refused_before_the_search(tmp_path):
    def never(progress):
        raise AssertionError("it searched")

    with pytest.raises(ModelError, match="the checkpoint cannot be written"):
        GASSI(motor(), **SETTINGS).fit(
            noisy(), checkpoint=tmp_path / "no" / "folder" / "x.ckpt", on_progress=never
        )


def test_a_disk_that_fills_up_later_does_not_lose_the_search(tmp_path, whole, monkeypatch):
    folder = tmp_path / "there"
    folder.mkdir()

    def vanish(progress):
        if folder.exists():
            for path in folder.iterdir():
                path.unlink()
            folder.rmdir()

    with pytest.warns(UserWarning, match="cannot be written"):
        found = GASSI(motor(), **SETTINGS).fit(
            noisy(), checkpoint=folder / "search.ckpt", on_progress=vanish
        )
    assert_same(found, whole[0])


def test_states_that_follow_at_once_are_not_written_one_by_one(tmp_path, monkeypatch):
    """Writing waits for the disk; the last state is kept until then."""
    clock = [100.0]
    monkeypatch.setattr("sysid.gassi.checkpoint.time.perf_counter", lambda: clock[0])
    path = tmp_path / "search"
    keeper = checkpoint.Checkpoint(path, ORIGIN)
    written = []
    for step, later in enumerate(
        [0.0, 0.4 * checkpoint.INTERVAL, 0.4 * checkpoint.INTERVAL, 0.4 * checkpoint.INTERVAL]
    ):
        clock[0] += later
        keeper.save({"step": step})
        written.append(checkpoint.load(path, ORIGIN)["step"])
    assert written == [0, 0, 0, 3]
    keeper.save({"step": 4})
    keeper.flush()
    assert checkpoint.load(path, ORIGIN)["step"] == 4


ORIGIN = {
    "model": {"name": "lag", "signals and parameters": "", "equations": ""},
    "records": [],
    "settings": {},
}
