"""Local refinement with jumps between minima."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sysid import (
    GASSI,
    BatchSimulator,
    Constraint,
    Dataset,
    Input,
    Output,
    Parameter,
    ProcessModel,
    State,
)
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import advance, begin, refine
from sysid.gassi import PRESETS, GeneticSearch
from sysid.gassi.local_search import LocalSearch, Minimum
from sysid.gassi.search_run import SearchRun
from sysid.problem.space import SearchSpace
from tests.sysid.support import MOTOR, lag, motor, motor_record

DT = 0.01


def spring_derivative(x, u, p):
    position, speed = x
    stiffness, damping, gain = p
    return (speed, gain * u[0] - stiffness * position - damping * speed)


SPRING = (
    Parameter("stiffness", "1/s^2", 2e5, 1e4, 3e6, "log"),
    Parameter("damping", "1/s", 20.0, 2.0, 200.0, "log"),
    Parameter("gain", "m/s^2", 5e4, 1e3, 1e6, "log"),
)


def spring():
    """An oscillator that is faster than its samples: many frequencies look nearly alike."""
    return ProcessModel(
        "spring", (State("position", "m"), State("speed", "m/s")), (Input("force", "1", "zoh"),),
        (Output("position", "m"),), SPRING, spring_derivative,
    )  # fmt: skip


def spring_record(n=250):
    """Samples by the closed form of a damped oscillation between steps of the force."""
    rng = np.random.default_rng(4)
    force = np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    stiffness, damping, gain = (p.nominal for p in SPRING)
    decay, omega = damping / 2.0, math.sqrt(stiffness - damping**2 / 4.0)
    position = speed = 0.0
    rows = []
    for u in force:
        rows.append(position)
        rest = gain * u / stiffness
        a, b = position - rest, (speed + decay * (position - rest)) / omega
        c, s, e = math.cos(omega * DT), math.sin(omega * DT), math.exp(-decay * DT)
        position = rest + e * (a * c + b * s)
        speed = e * (-decay * (a * c + b * s) + omega * (b * c - a * s))
    return Dataset(force, np.array(rows), DT)


def objective(model, record, accuracy=1e-3):
    return Objective(BatchSimulator(model, accuracy=accuracy), SearchSpace.of(model), [record])


def alias(target):
    """Where a descent from another frequency gets stuck."""
    low = np.array([2.0e4, 20.0, 5e3])
    stuck = refine(target, low)
    assert stuck.error > 0.005
    return stuck.chromosome


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(4))
def test_jumps_leave_a_minimum_that_a_descent_cannot(seed):
    target = objective(spring(), spring_record())
    start = alias(target)
    before = target.simulations
    local = LocalSearch(target, start[None], before + 6000, 300, np.random.default_rng(seed))
    while not local.polished:
        local.step()
    assert local.error < 1e-6
    expected = [p.nominal for p in SPRING]
    np.testing.assert_allclose(target.space.decode(local.best), expected, rtol=1e-4)
    assert target.simulations <= before + 6000


def noisy_motor_record():
    noise = np.random.default_rng(0).normal(0.0, 0.02, (200, 2))
    clean = motor_record()
    return Dataset(
        clean.inputs, clean.outputs + noise * np.abs(clean.outputs).max(axis=0), clean.dt
    )


def test_the_budget_is_kept_and_the_end_is_a_minimum():
    record = noisy_motor_record()
    fitted = GASSI(motor(), population=100, generations=10, criterion="error").fit(record)
    assert 0.7 * 1000 < fitted.n_simulations_ <= 1000
    assert len(fitted.history_) in (8, 9, 10)
    assert np.all(np.diff(fitted.history_) <= 1e-12)
    assert fitted.history_[-1] == fitted.error_
    again = refine(objective(motor(), record), fitted.chromosome_)
    assert fitted.error_ == pytest.approx(again.error, rel=1e-6)


def test_a_search_ends_when_no_more_minima_are_expected():
    record = noisy_motor_record()
    fitted = GASSI(motor(), population=300, generations=40, criterion="error").fit(record)
    assert fitted.n_simulations_ < 0.5 * 12000
    again = refine(objective(motor(), record), fitted.chromosome_)
    assert fitted.error_ == pytest.approx(again.error, rel=1e-6)


def met(*times, varied=2):
    """A search that is between descents, some of which have ended in minima so many times."""
    rng = np.random.default_rng(0)
    target = objective(lag(), Dataset(np.zeros(400), rng.normal(size=400), DT))
    local = LocalSearch(target, np.array([[1.0, 0.1]]), 10**6, 300, rng)
    local.descents, local.error = [], 1.0
    local.minima = [
        Minimum(np.array([0.0, 0.0]), 1.0, np.array([1.0]), varied=varied, met=n) for n in times
    ]
    return local


@pytest.mark.parametrize(
    ("times", "most"),
    # w (n - 1) / (n - w - 2) < w + 1/2 of n descents that ended in w minima, by hand
    [((8,), True), ((7,), False), ((16, 1), True), ((15, 1), False)],
)
def test_descents_tell_how_many_minima_there_are(times, most):
    local = met(*times)
    local.step()
    assert local.polishing == most


def test_nothing_is_over_where_the_best_leaves_more_than_noise():
    local = met(40)
    local.objective = objective(lag(), Dataset(np.zeros(400), np.linspace(-1.0, 1.0, 400), DT))
    local.step()
    assert not local.polishing


def test_nothing_is_over_before_each_minimum_has_been_varied_both_ways():
    local = met(40, varied=1)
    local.step()
    assert not local.polishing


def test_a_budget_too_small_is_exceeded_by_one_descent_to_the_minimum():
    fitted = GASSI(motor(), population=10, generations=2, criterion="error").fit(motor_record())
    again = refine(objective(motor(), motor_record()), fitted.chromosome_)
    assert fitted.error_ <= 1.001 * again.error
    assert fitted.n_simulations_ <= 20 + 50 * 14
    assert len(fitted.history_) == 2


def test_rounding_ends_it_early():
    fitted = GASSI(motor(), population=100, generations=100, criterion="error").fit(motor_record())
    np.testing.assert_allclose(fitted.vector_, list(MOTOR.values()), rtol=1e-6)
    assert fitted.n_simulations_ < 0.3 * 100 * 100


# --- descents in one batch ------------------------------------------------------------------


def test_a_descent_is_the_same_alone_and_among_others():
    record = motor_record()
    factors = np.random.default_rng(1).uniform(0.5, 2.0, (4, 5))
    starts = factors * np.array(list(MOTOR.values()))
    target = objective(motor(), record)
    together = [begin(target, start) for start in starts]
    for _ in range(6):
        together = advance(target, together)
    for start, descent in zip(starts, together, strict=True):
        alone = [begin(target, start)]
        for _ in range(6):
            alone = advance(target, alone)
        np.testing.assert_array_equal(alone[0].point.at, descent.point.at)
        assert alone[0].point.error == descent.point.error


@pytest.mark.soak
def test_flat_directions_cost_nothing():
    """Two parameters of which only the product acts: the descent ends as with one."""

    def derivative(x, u, p):
        return ((p[0] * p[1] * u[0] - x[0]) / p[2],)

    model = lag(
        parameters=(
            Parameter("a", "1", 2.0, 0.2, 20.0, "log"),
            Parameter("b", "1", 1.0, 0.1, 10.0, "log"),
            Parameter("tau", "s", 0.05, 0.005, 0.5, "log"),
        ),
        derivative=derivative,
    )
    inputs = np.sign(np.sin(np.arange(120) / 7.0))
    lumped = lag()
    blank = Dataset(inputs, np.full(120, np.nan), 0.01)
    outputs = BatchSimulator(lumped).trajectories(lumped.nominal, blank)[0]
    record = Dataset(inputs, outputs, 0.01)
    product = refine(objective(model, record), np.array([1.0, 0.7, 0.1]))
    single = refine(objective(lumped, record), np.array([0.7, 0.1]))
    assert product.error < 1e-10
    assert product.iterations <= single.iterations + 2
    assert product.chromosome[0] * product.chromosome[1] == pytest.approx(2.0, rel=1e-8)


@pytest.mark.soak
def test_it_slides_along_a_constraint():
    """The minimum on a slanted constraint, against a search along the line that it is."""
    limit = Constraint("resistance >= 50 constant", lambda p: 50.0 * p[4] - p[0])  # truth: 42
    record = motor_record()
    target = objective(motor(3.0, (limit,)), record, 1e-6)
    start = np.array([1.5, 9e-4, 1.1e-6, 2e-5, 2.2e-2])
    refined = refine(target, start, max_iterations=200)
    assert refined.chromosome[0] >= 50.0 * refined.chromosome[4]
    assert refined.chromosome[0] == pytest.approx(50.0 * refined.chromosome[4], rel=1e-4)

    def tied(x, u, p):
        current, omega = x
        inductance, inertia, damping, constant = p
        return (
            (u[0] - 50.0 * constant * current - constant * omega) / inductance,
            (constant * current - damping * omega - u[1]) / inertia,
        )

    line = ProcessModel(
        "line", motor().states, motor().inputs, motor().outputs, motor(3.0).parameters[1:], tied
    )
    expected = refine(objective(line, record, 1e-6), start[1:], max_iterations=200)
    assert refined.error == pytest.approx(expected.error, rel=1e-3)


def test_where_only_the_search_found_something_feasible_it_goes_on_from_there():
    limit = Constraint("resistance >= 1.05", lambda p: 1.05 - p[0])
    model, rng = motor(2.0, (limit,)), np.random.default_rng(2)
    objective = Objective(BatchSimulator(model), SearchSpace.of(model), [motor_record()])
    search = GeneticSearch(objective.space, PRESETS["default"], 40, 1, rng)
    run = SearchRun(objective, search, 6, likelihood=True)
    while run.local is None:
        run.step()
    assert search.elite_feasible
    beyond = objective.space.encode(model.nominal)  # a resistance of 1
    run.local.best, run.local.error, run.local.feasible = beyond, 1e-9, False
    run.local.minima = [Minimum(beyond, 1e-9, np.full(2, 1e-9))]
    (kept,) = run.minima()
    np.testing.assert_array_equal(kept, search.elite)
    # Once a descent has found a feasible one, it comes before the likelier infeasible one.
    inside = objective.space.encode(search.elite)
    run.local.best, run.local.error, run.local.feasible = inside, 1e-9, True
    np.testing.assert_allclose(run.minima()[0], search.elite)
