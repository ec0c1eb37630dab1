"""Searches of long records by parts of them: which parts, and that the answer is that of all."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sysid import GASSI, BatchSimulator, Dataset, Input, Output, Parameter, State
from sysid.fitting.objective import Objective
from sysid.gassi.excerpt import Excerpt
from sysid.gassi.nudged import nudged
from sysid.judging.examination import verdict_of
from sysid.problem.space import SearchSpace
from tests.soak import mostly_soak
from tests.sysid.support import lag, prbs

N = 12_000
SETTINGS = {"population": 20, "generations": 6}


def staircase():
    """Levels held for 2000 samples, a ramp of 100 between them, with noise throughout."""
    rng = np.random.default_rng(0)
    level = np.repeat([0.0, 1.0, -2.0, 3.0, -1.0, 2.0], 2000)
    ramp = np.convolve(level, np.full(100, 0.01), mode="full")[: len(level)]
    noise = 0.01 * rng.standard_normal((len(level), 2))
    return Dataset(level[:, None] + noise[:, :1], ramp[:, None] + noise[:, 1:], 0.01)


def test_parts_are_where_channels_change():
    excerpt = Excerpt.of([staircase()], 5120)
    begins = [part.begin for part in excerpt.parts]
    assert begins[0] == 0 and begins == sorted(begins) and len(begins) == 5
    assert all(later - begin >= 1024 for begin, later in pairwise(begins))
    steps = {2000, 4000, 6000, 8000, 10_000}
    seen = {s for s in steps for p in excerpt.parts if p.begin < s and s + 100 < p.end}
    assert len(seen) == 4  # one in each part behind the first, which begins at row 0


def test_a_part_within_a_record_is_compared_once_its_start_is_forgotten():
    record = staircase()
    first, later = Excerpt.of([record], 2048).datasets()[:2]
    assert np.isfinite(first.outputs).all()
    seen = np.isfinite(later.outputs[:, 0])
    assert seen[0] and not seen[1:256].any() and seen[256:].all()


def test_every_record_has_its_share():
    long, short = staircase(), staircase().part(0, 1500, "short")
    excerpt = Excerpt.of([long, short], 4096)
    assert excerpt.places == [0, 0, 0, 0, 1]
    assert excerpt.parts[-1] == (1, 0, 1500)
    assert excerpt.n_samples == 4 * 1024 + 1500


@pytest.mark.parametrize("samples", [0, 6000, 20_000])
def test_short_records_are_searched_whole(samples):
    assert Excerpt.of([staircase()], samples) is None


def hidden_lag_derivative(x, u, p):
    return ((p[0] * u[0] - x[0]) / p[1], (x[0] - x[1]) / 0.02)


def hidden_lag():
    """A lag seen through another, whose own start is not measured."""
    return lag(
        states=(State("inside", "1", initial_range=(-5.0, 5.0)), State("y", "1")),
        outputs=(Output("y", "1"),),
        parameters=(
            Parameter("gain", "1", 2.0, 0.2, 20.0, "log"),
            Parameter("tau", "s", 0.05, 0.005, 0.5, "log"),
        ),
        derivative=hidden_lag_derivative,
    )


def test_a_record_starts_where_the_part_at_its_beginning_does():
    long, short = staircase(), staircase().part(0, 1500, "short")
    excerpt = Excerpt.of([long, short], 4096)
    plain = SearchSpace.of(hidden_lag())
    of_parts = plain.with_starts(excerpt.datasets())
    whole, (chromosome,) = excerpt.on_all(
        of_parts, [np.array([2.0, 0.05, 1.0, 2.0, 3.0, 4.0, 5.0])]
    )
    assert whole.names == ("gain", "tau", "inside(0) 1", "inside(0) 2")
    assert chromosome.tolist() == [2.0, 0.05, 1.0, 5.0]
    parts = excerpt.on_parts(whole, of_parts, chromosome)
    assert parts.tolist() == [2.0, 0.05, 1.0, *[of_parts.parameters[-2].nominal] * 3, 5.0]
    bare, (alone,) = excerpt.on_all(plain, [np.array([2.0, 0.05])])
    assert bare.names == plain.names and alone.tolist() == [2.0, 0.05]


def test_of_many_short_records_those_that_differ_most_are_enough():
    steps = staircase()
    level = steps.part(100, 1100, "level")
    records = [level, level, steps.part(1500, 2500, "step"), level, steps.part(3600, 4600, "far")]
    blank = replace(level, outputs=np.full_like(level.outputs, np.nan))
    excerpt = Excerpt.of([blank, *records, blank], 2048, every=False)
    assert Excerpt.of([blank, *records, blank], 2048) is None
    assert excerpt.places == [3, 5] and excerpt.n_samples == 2000
    lost = np.full(1000, np.nan)
    unseen = [Dataset(r.inputs, np.c_[r.outputs, lost], 0.01) for r in records]
    seen = Dataset(level.inputs, np.c_[lost, lost], 0.01)
    seen.outputs[500, 1] = 1.0  # what no other measures
    assert 10 in Excerpt.of([*unseen, *unseen, seen], 2048, every=False).places
    plain = SearchSpace.of(hidden_lag())
    of_parts = plain.with_starts(excerpt.datasets())
    whole, (chromosome,) = excerpt.on_all(of_parts, [np.array([2.0, 0.05, 1.0, 3.0])])
    declared = whole.parameters[-1].nominal
    assert chromosome.tolist() == [2.0, 0.05, *[declared] * 3, 1.0, declared, 3.0, declared]


@pytest.fixture(scope="module")
def long_record():
    rng, model = np.random.default_rng(1), hidden_lag()
    inputs = prbs(rng, N, -1.0, 1.0)[:, None]
    blank = Dataset(inputs, np.full((N, 1), np.nan), 0.01)
    start = np.array([[3.0, 0.0]])
    outputs = BatchSimulator(model, accuracy=1e-6).trajectories(model.nominal, blank, starts=start)
    noisy = outputs[0] + 0.05 * rng.standard_normal((N, 1))
    noisy[0] = 0.0
    return Dataset(inputs, noisy, 0.01)


@pytest.mark.parametrize("criterion", ["likelihood", "error"])
def test_minima_of_an_excerpt_are_fitted_to_all(long_record, criterion):
    whole, parts = (
        GASSI(hidden_lag(), criterion=criterion, search_samples=samples, **SETTINGS).fit(
            long_record
        )
        for samples in (0, 2048)
    )
    assert whole.excerpt_ is None and parts.excerpt_.n_samples == 2048
    assert parts.vector_ == pytest.approx(whole.vector_, rel=1e-4)
    assert parts.error_ == pytest.approx(whole.error_, rel=1e-6)
    (start,) = parts.initial_states_
    assert start["inside"] == pytest.approx(3.0, abs=0.3)
    assert parts.space_.names == ("gain", "tau", "inside(0)")
    gain, tau, *_ = parts.uncertainty(long_record).parameters
    assert gain.low < 2.0 < gain.high and tau.low < 0.05 < tau.high
    assert gain.std == pytest.approx(whole.uncertainty(long_record).parameters[0].std, rel=0.05)


def test_an_interrupted_search_of_an_excerpt_tells_the_error_of_all(long_record):
    def stop(progress):
        if progress.stage == "refine":
            raise KeyboardInterrupt

    estimator = GASSI(hidden_lag(), search_samples=2048, **SETTINGS)
    estimator.fit(long_record, on_progress=stop)
    assert estimator.stopped_ == "interrupted" and estimator.space_.names[-1] == "inside(0)"
    of_all = Objective(BatchSimulator(hidden_lag()), estimator.space_, [long_record])
    assert estimator.error_ == of_all.evaluate(estimator.chromosome_[None])[0][0]


def test_what_writes_the_thesis_searches_all_samples(long_record):
    estimator = GASSI(hidden_lag(), preset="thesis", search_samples=2048, **SETTINGS)
    assert estimator.fit(long_record).excerpt_ is None


def test_of_short_records_that_repeat_each_other_a_few_are_enough():
    rng = np.random.default_rng(3)

    def repeated(size):
        inputs = size * prbs(rng, 1000, -1.0, 1.0)
        return Dataset(inputs, np.convolve(inputs, np.full(5, 0.2))[:1000], 0.01)

    records = [repeated(1.0) for _ in range(5)]
    assert Excerpt.of(records, 8192).n_samples == 2000
    assert Excerpt.of(records[:3], 8192) is None  # two would be more than half
    assert Excerpt.of(records, 0) is None
    for size in (0.1, 10.0):
        assert Excerpt.of([*records, repeated(size)], 8192) is None


def swing_derivative(x, u, p):
    return (x[1], p[0] * p[0] * (u[0] - x[0]) - p[1] * x[1])


def swing():
    """A pendulum whose free run of the wrong frequency is out of step after a few swings."""
    return lag(
        states=(State("angle", "rad"), State("rate", "rad/s", initial_range=(-50.0, 50.0))),
        inputs=(Input("u", "rad"),),
        outputs=(Output("angle", "rad"),),
        parameters=(
            Parameter("frequency", "rad/s", 8.0, 2.0, 60.0, "log"),
            Parameter("damping", "1/s", 0.2, 0.02, 2.0, "log"),
        ),
        derivative=swing_derivative,
    )


SWINGING = np.array([23.0, 0.3])


@pytest.fixture(scope="module")
def very_long_record():
    rng, n = np.random.default_rng(1), 40_000
    inputs = np.repeat(rng.uniform(-1.0, 1.0, n // 400), 400)[:, None]
    blank = Dataset(inputs, np.full((n, 1), np.nan), 0.01)
    outputs = BatchSimulator(swing(), accuracy=1e-6).trajectories(SWINGING, blank)[0]
    return Dataset(inputs, outputs + 1e-4 * rng.standard_normal((n, 1)), 0.01)


@pytest.mark.parametrize("seed", mostly_soak([0, 1, 2]))
def test_a_very_long_record_is_fitted_by_parts_however_it_swings(very_long_record, seed):
    estimator = GASSI(swing(), search_samples=4096, random_state=seed, **SETTINGS)
    estimator.fit(very_long_record)
    assert estimator.excerpt_.cut and estimator.excerpt_.n_samples == 4096
    assert estimator.vector_ == pytest.approx(SWINGING, rel=1e-4)
    # Precise enough an angle's start is estimated; each only where the record begins.
    assert estimator.space_.names == ("frequency", "damping", "angle(0)", "rate(0)")
    assert estimator.initial_states_ == [pytest.approx({"angle": 0.0, "rate": 0.0}, abs=1e-3)]
    found = estimator.uncertainty(very_long_record)
    assert tuple(estimate.name for estimate in found.parameters) == estimator.space_.names
    for estimate, truth in zip(found.parameters, [*SWINGING, 0.0, 0.0], strict=True):
        assert estimate.low < truth < estimate.high
    assert found.covariance.shape == (4, 4) and found.factor.shape[1] == 4
    assert verdict_of(estimator, [very_long_record]).parameters.trust == "good"
    free = BatchSimulator(swing()).trajectories(estimator.vector_, very_long_record)[0]
    assert np.std(free - very_long_record.outputs) == pytest.approx(1e-4, rel=0.05)


def test_what_is_measured_with_noise_is_not_held_to_it(very_long_record):
    rng, simulator = np.random.default_rng(2), BatchSimulator(swing())
    noise = 0.2 * rng.standard_normal(very_long_record.outputs.shape)
    noisy = replace(very_long_record, outputs=very_long_record.outputs + noise)
    calibrated = replace(very_long_record, output_noise=np.array([0.01]))
    held, (driven,) = nudged(simulator, [very_long_record])
    assert len(held.model.inputs) == driven.inputs.shape[1] == 3
    for record in (noisy, calibrated):
        assert nudged(simulator, [record]) is None


def test_a_part_whose_speed_is_a_mean_before_it_starts_as_the_fit_wants():
    record = staircase()
    windows = np.zeros((*record.outputs.shape, 2))
    windows[..., 0] = -0.01
    record, model = replace(record, windows=windows), lag()
    excerpt = replace(Excerpt.of([record], 2048), cut=True)
    plain = SearchSpace.of(model)
    assert plain.with_starts(excerpt.datasets()).names == ("gain", "tau", "y(0) 2")
    assert plain.with_starts(replace(excerpt, cut=False).datasets()).names == ("gain", "tau")
    # Each tells of which record it is, whose sensors' zeros they share.
    twice = replace(Excerpt.of([record, record], 4096), cut=True)
    assert [part.log for part in twice.datasets()] == twice.places == [0, 0, 1, 1]
