"""Campaigns: the same results wherever they run, and nothing lost when a run fails."""

import copy
import importlib
import os
import shutil
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import joblib
import numpy as np
import pytest
from joblib.externals.loky import get_reusable_executor

from sysid import (
    GASSI,
    Constraint,
    Dataset,
    ModelError,
    Run,
    campaign,
    combinations,
    fit_percent,
    study,
)
from sysid.campaigns.parcels import pack, unpack
from tests.soak import mostly_soak
from tests.sysid.support import lag

SETTINGS = {"population": 32, "generations": 4}

NEIGHBOUR = """
FACTOR = 2.0

def twice(x):
    return FACTOR * x
"""

MODEL_FILE = """
import gains_of_mine
from sysid import Input, Output, Parameter, ProcessModel, State

def derivative(x, u, p):
    return ((gains_of_mine.twice(p[0]) * u[0] - x[0]) / p[1],)

model = ProcessModel(
    "mine", (State("y", "1"),), (Input("u", "1"),), (Output("y", "1"),),
    (Parameter("gain", "1", 1.0, 0.1, 10.0), Parameter("tau", "s", 0.05, 0.005, 0.5)),
    derivative,
)
"""


def record(seed=0, n=120, dt=0.01, gain=3.0, tau=0.04):
    """A lag's exact response to held random levels, with a little noise, and its model's start."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 8 + 1), 8)[:n]
    y = np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = gain * u[k] + (y[k] - gain * u[k]) * np.exp(-dt / tau)
    return Dataset(u, y + 0.01 * rng.normal(size=n), dt, f"log {seed}")


def closure(order):
    """A structure of its own, from a closure: two lags behind one another, or one."""

    def derivative(x, u, p):
        return ((p[0] * u[0] - x[0]) / p[1] * order,)

    return lag(name=f"order {order}", derivative=derivative)


def models():
    return {"one": lag(), "half": closure(0.5)}


def runs(seeds=(0, 1), **changes):
    logs = {"first": [record(0)], "both": [record(0), record(1, n=80)]}
    return combinations(models(), logs, seeds, SETTINGS | changes, validation=[record(5)])


@pytest.fixture(scope="module")
def serial():
    todo = runs()
    return todo, campaign(todo, n_jobs=1)


def same(a, b):
    """Equal to the bit: parameters, errors, predictions' metrics."""
    assert len(a.outcomes) == len(b.outcomes)
    for x, y in zip(a.outcomes, b.outcomes, strict=True):
        assert (x.run.name, x.run.data, x.run.seed) == (y.run.name, y.run.data, y.run.seed)
        assert x.problem == y.problem == ""
        assert x.estimator.parameters_ == y.estimator.parameters_
        assert x.error == y.error
        for p, q in zip(x.validation, y.validation, strict=True):
            assert np.array_equal(p.rmse, q.rmse)


@pytest.mark.soak
def test_every_combination_is_fitted_as_by_itself(serial):
    todo, found = serial
    assert len(found.outcomes) == len(todo) == 8 and not found.interrupted and not found.failed
    for run, outcome in zip(todo, found.outcomes, strict=True):
        alone = GASSI(run.model, **run.settings, random_state=run.seed).fit(run.records)
        assert outcome.run is run
        assert outcome.estimator.parameters_ == alone.parameters_
        validation = run.validation[0]
        by_hand = fit_percent(validation.outputs, alone.predict(validation))
        assert outcome.validation[0].fit == pytest.approx(by_hand)
        # What came back is whole: it predicts.
        assert np.array_equal(outcome.estimator.predict(validation), alone.predict(validation))


@pytest.mark.soak
def test_processes_give_the_serial_result_to_the_bit_and_compile_nothing(
    serial, tmp_path, monkeypatch
):
    todo, found = serial
    cache = shutil.copytree(os.environ["RIG_CACHE_DIR"], tmp_path / "kernels")
    before = {path.name for path in cache.rglob("*") if path.is_file()}
    assert before
    monkeypatch.setenv("RIG_CACHE_DIR", str(cache))
    # Workers have the environment that they were started with.
    get_reusable_executor().shutdown(wait=True)
    same(found, campaign(todo, n_jobs=2))
    get_reusable_executor().shutdown(wait=True)
    assert {path.name for path in cache.rglob("*") if path.is_file()} == before


@pytest.mark.soak
def test_a_model_of_a_users_file_and_its_neighbour_travel(tmp_path, monkeypatch):
    (tmp_path / "gains_of_mine.py").write_text(NEIGHBOUR)
    (tmp_path / "model_of_mine.py").write_text(MODEL_FILE)
    monkeypatch.syspath_prepend(tmp_path)
    import model_of_mine

    # As when the file is imported by its path: no process finds it by name.
    monkeypatch.undo()
    found = campaign(
        combinations({"mine": model_of_mine.model}, {"a": [record()]}, (0, 1), SETTINGS), n_jobs=2
    )
    assert not found.failed, found.failed[0].problem
    for outcome in found.outcomes:
        assert outcome.estimator.parameters_["gain"] == pytest.approx(1.5, rel=0.02)


@pytest.mark.parametrize("folder", ["site-packages", "dist-packages"])
def test_what_any_installer_has_put_somewhere_travels_by_its_name(tmp_path, monkeypatch, folder):
    place = tmp_path / folder
    place.mkdir()
    name = f"gains_in_{folder.replace('-', '_')}"
    (place / f"{name}.py").write_text(NEIGHBOUR)
    monkeypatch.syspath_prepend(place)
    module = importlib.import_module(name)
    assert unpack(pack("function", module.twice)) is module.twice


def test_a_failed_run_is_kept_and_spoils_no_other(serial):
    todo, found = serial
    wrong = replace(todo[0], settings={**SETTINGS, "fixed": {"mass": 1.0}}, name="wrong")
    mixed = campaign([todo[0], wrong, todo[1]])
    assert [bool(o.problem) for o in mixed.outcomes] == [False, True, False]
    assert "mass" in mixed.outcomes[1].problem and mixed.failed == (mixed.outcomes[1],)
    assert mixed.outcomes[1].error == np.inf
    assert mixed.outcomes[2].estimator.parameters_ == found.outcomes[1].estimator.parameters_
    frame = mixed.frame()
    assert list(frame["problem"] != "") == [False, True, False]
    assert ("wrong", wrong.data) not in mixed.best()
    (of_wrong,) = [s for s in mixed.spread() if s.model == "wrong"]
    assert (of_wrong.runs, of_wrong.failed, of_wrong.agreeing) == (1, 1, 0)


def test_the_best_and_the_spread_over_seeds(serial):
    _, found = serial
    frame = found.frame()
    for (name, data), best in found.best().items():
        group = frame[(frame["model"] == name) & (frame["data"] == data)]
        assert best.error == group["error"].min()
        (spread,) = [s for s in found.spread() if (s.model, s.data) == (name, data)]
        assert (spread.runs, spread.failed) == (2, 0)
        assert spread.best == group["error"].min() and spread.worst == group["error"].max()
        near = group[group["error"] <= 1.01 * spread.best]
        assert spread.agreeing == len(near)
        assert spread.parameters["gain"] == (near["gain"].min(), near["gain"].max())


def test_what_violates_the_constraints_is_not_the_best(serial):
    _, found = serial
    outcomes = [replace(o, estimator=copy.copy(o.estimator)) for o in found.outcomes[:2]]
    low, high = sorted(outcomes, key=lambda o: o.error)
    low.estimator.feasible_ = False
    chosen = replace(found, outcomes=tuple(outcomes)).best()
    assert list(chosen.values()) == [high]


@pytest.mark.parametrize("n_jobs", mostly_soak([1, 2]))
def test_an_interrupt_keeps_what_is_finished(serial, n_jobs):
    todo, found = serial

    def stop(outcome):
        raise KeyboardInterrupt

    cut = campaign(todo, n_jobs=n_jobs, on_outcome=stop)
    assert cut.interrupted and len(cut.outcomes) == 1
    (kept,) = cut.outcomes
    (whole,) = [o for o in found.outcomes if o.run is kept.run]
    assert kept.error == whole.error


@pytest.mark.soak
def test_the_cores_are_shared_among_the_runs(monkeypatch):
    seen = []
    original = GASSI.fit

    def fit(self, *args, **kwargs):
        seen.append(self.threads)
        return original(self, *args, **kwargs)

    monkeypatch.setattr(GASSI, "fit", fit)
    monkeypatch.setattr("sysid.campaigns.runs.available_cores", lambda: 8)
    todo = runs(seeds=(0,))
    with joblib.parallel_config(backend="threading"):
        campaign(todo, n_jobs=3)
        campaign(todo[:2], n_jobs=3)
    campaign(todo[:1])
    campaign(combinations(models(), {"a": [record()]}, (0,), SETTINGS | {"threads": 5})[:1])
    assert seen == [2, 2, 2, 2, 4, 4, 8, 5]


def test_what_cannot_travel_or_be_done_is_said():
    lock = threading.Lock()

    def derivative(x, u, p):
        return ((p[0] * u[0] - x[0]) / (p[1] + 0.0 * (lock is None)),)

    with pytest.raises(ModelError, match=r"model lag cannot be sent(.|\n)*locks"):
        campaign([Run(lag(derivative=derivative), [record()])])
    with pytest.raises(ModelError, match="at least one run"):
        campaign([])


@pytest.mark.soak
def test_every_run_of_a_lost_worker_is_accounted_for():
    def deadly(p):
        if isinstance(p[0], np.ndarray):  # in the search, not when the model is made
            os._exit(1)
        return -1.0

    model = lag(constraints=(Constraint("alive", deadly),))
    found = campaign(combinations({"deadly": model}, {"a": [record()]}, (0, 1), SETTINGS), n_jobs=2)
    assert len(found.failed) == 2 and not found.interrupted
    assert "worker" in found.failed[0].problem


def gain_of(seed):
    """What a study may ask for each seed; not of the third."""
    if seed == 2:
        raise ValueError("no such rig")
    found = GASSI(lag(), random_state=seed, threads=1, **SETTINGS).fit(record(seed))
    return seed, found.parameters_["gain"]


@pytest.mark.soak
def test_a_study_gives_the_same_in_other_processes_and_keeps_what_failed():
    seen = []
    here = study(gain_of, range(4))
    there = study(gain_of, range(4), n_jobs=2, on_result=seen.append)
    assert [value[0] for value in here.values] == [0, 1, 3] and there.values == here.values
    for found in (here, there):
        (failed,) = found.failed
        assert (failed.item, failed.problem) == (2, "ValueError: no such rig")
    assert {result.item for result in seen} == {0, 1, 2, 3}
    with pytest.raises(ModelError, match=r"the study's function cannot be sent(.|\n)*locks"):
        study(threading.Lock().acquire, [0])
    with pytest.raises(ModelError, match="at least one item"):
        study(gain_of, [])


def test_ctrl_c_ends_a_study_and_keeps_what_is_done():
    def interrupt(result):
        if result.item == 1:
            raise KeyboardInterrupt

    found = study(lambda k: k, range(4), on_result=interrupt)
    assert found.interrupted and found.values == [0, 1]


@pytest.mark.soak
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
@pytest.mark.filterwarnings("ignore")  # of dask, that a worker has gone
def test_a_worker_of_a_cluster_that_is_killed_costs_no_run(serial):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    todo, found = serial
    values, killed = study(gain_of, range(4)).values, []
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0"
        ) as cluster,
        distributed.Client(cluster),
        joblib.parallel_config(backend="dask"),
    ):

        def kill(_):
            if not killed:
                killed.append(cluster.workers[0].process.pid)
                os.kill(killed[0], signal.SIGKILL)

        same(found, campaign(todo, on_outcome=kill))
        assert study(gain_of, range(4)).values == values
    assert killed


@pytest.mark.soak
def test_the_threads_of_a_worker_pack_at_the_same_time():
    def pack_often(_):
        return [pack("model", lag()) for _ in range(10)]

    with ThreadPoolExecutor(4) as pool:
        packed = list(pool.map(pack_often, range(4)))
    assert all(unpack(each[0]).name == lag().name for each in packed)
