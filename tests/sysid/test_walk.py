"""Ends of intervals that walks come to, against closed forms and fits of everything else."""

from __future__ import annotations

import numpy as np
import pytest

from sysid import BatchSimulator, Dataset, SearchSpace
from sysid.fitting.descent import Restriction
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.uncertainty.covariance import covariance
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.quantities import Coordinate
from sysid.uncertainty.sensitivity import sensitivity
from sysid.uncertainty.ties import ties
from sysid.uncertainty.tracer import Tracer
from sysid.uncertainty.walk import Walk, walked
from tests.sysid.support import Formula, lag, prbs
from tests.sysid.test_uncertainty import Problem, columns, unknown

SIDES = (-1.0, 1.0)


def valley(share, sigma, k=(0.1, 10.0)):
    """Of k and b = k (m - k), where k and m are told apart by a share of the input."""
    problem = Problem(
        lambda p, u: columns((p["k"] + p["b"] / p["k"]) * u[:, 0] + share * p["k"] * u[:, 1]),
        [unknown("k", 1.0, lower=k[0], upper=k[1]), unknown("b", 0.4)],
        sigma=sigma,
        inputs=2,
        seed=4,
    )
    return problem.objective()


def tracer_of(objective, place):
    estimate = refine(objective, objective.space.model.nominal, max_iterations=300).chromosome
    local = sensitivity(objective, estimate)
    spread = covariance(local, ties(local).directions)
    gradient = np.eye(len(estimate))[place]
    return Tracer(local, spread, gradient, Coordinate(objective.space, place))


def smallest_and_largest(tracer, share, quantity):
    """Of a quantity of m and k, in which the outputs are linear, where the error is at the level.

    And b is within its range; None where that ends before.
    """
    (record,) = tracer.objective.records
    rows = record.inputs * [1.0, share]
    best, rest, *_ = np.linalg.lstsq(rows, record.outputs[:, 0], rcond=None)
    n, scale = len(rows), np.abs(record.outputs).max()
    error = np.sqrt(rest[0] / n) / scale + Z95**2 / tracer.factor
    radius = np.sqrt(n * (error * scale) ** 2 - rest[0])
    angle = np.linspace(0.0, 2.0 * np.pi, 1_000_001)
    ellipse = radius * np.linalg.solve(
        np.linalg.cholesky(rows.T @ rows).T, [np.cos(angle), np.sin(angle)]
    )
    m, k = best[:, None] + ellipse
    values = quantity(m, k)[k * (m - k) >= 0.04]
    return (values.min() if values.min() > 0.0401 else None), values.max()


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize(("share", "sigma"), [(0.02, 0.1), (1e-3, 5e-3), (1e-5, 5e-5)])
def test_an_end_is_where_a_quantity_is_largest_of_all_that_explains_the_data(share, sigma, place):
    """However narrow the valley is; b turns back in it, it is at most m^2 / 4."""
    tracer = tracer_of(valley(share, sigma), place)
    expected = smallest_and_largest(
        tracer, share, (lambda m, k: k * (m - k)) if place else lambda m, k: k
    )
    walks = walked([Walk.begun(tracer, sign) for sign in SIDES])
    assert all(walk.count <= 20 for walk in walks)
    for walk, end in zip(walks, expected, strict=True):
        if walk.lost:  # at the turn, or next to it
            assert place == 1
            assert tracer.quantity.value(walk.last.place) == pytest.approx(end, rel=0.01)
        else:
            assert walk.end == (end if end is None else pytest.approx(end, rel=0.01))


@pytest.mark.parametrize("lower", [0.9, 0.66, 0.656, 0.64])
def test_where_a_range_ends_before_there_is_no_end(lower):
    tracer = tracer_of(valley(0.02, 0.1, k=(lower, 10.0)), 0)
    end, _ = smallest_and_largest(tracer, 0.02, lambda _, k: k)
    assert end == pytest.approx(0.6578, abs=1e-4)
    below, above = walked([Walk.begun(tracer, sign) for sign in SIDES])
    assert below.arrived and below.end == (None if lower > end else pytest.approx(end, rel=0.01))
    assert above.arrived and above.end is not None


def test_from_the_end_of_the_only_range_nothing_leads_on():
    problem = Problem(lambda p, u: columns(p["k"] * u[:, 0]), [unknown("k", 2.0, lower=1.9)])
    objective = problem.objective(ranges={"k": (2.1, 20.0)})
    tracer = tracer_of(objective, 0)
    assert objective.space.on_bound(tracer.local.chromosome).all()
    below, above = walked([Walk.begun(tracer, sign) for sign in SIDES])
    assert below.arrived and below.end is None
    assert above.arrived


@pytest.mark.parametrize("exact", [False, True])
def test_there_all_else_fitted_anew_is_at_the_level(exact):
    rng = np.random.default_rng(3)
    record = Dataset(prbs(rng, 200, -1.0, 1.0, hold=3)[:, None], np.full((200, 1), np.nan), 0.01)
    simulator = BatchSimulator(lag())
    outputs = simulator.trajectories(lag().nominal, record)[0]
    record = Dataset(record.inputs, outputs + 0.3 * rng.standard_normal(outputs.shape), 0.01)
    objective = Objective(simulator, SearchSpace.of(lag()), [record])
    if exact:
        objective = objective.with_exact_slopes()
    for place in range(len(objective.space.names)):
        tracer = tracer_of(objective, place)
        for walk in walked([Walk.begun(tracer, sign) for sign in SIDES]):
            assert walk.arrived and walk.end is not None
            held = Restriction(held=(place, float(np.log(walk.end))))
            refit = refine(objective, tracer.local.chromosome, restriction=held)
            statistic = tracer.statistic(refit.error - tracer.local.error)
            assert statistic == pytest.approx(Z95**2, rel=0.02)


def test_a_walk_from_which_no_step_leads_on_is_lost():
    """A wall across the valley that no slope foretells: where it is, a search by fits tells."""
    objective = valley(0.02, 0.1)
    formula = objective.simulator.formula
    tracer = tracer_of(objective, 0)
    wall = np.exp(tracer.centre + 0.3 * tracer.unit)

    def walled(p, u):
        return formula(p, u) + (np.nan if p["k"] > wall else 0.0)

    tracer.objective.simulator = Formula(objective.simulator.model, walled)
    below, above = walked([Walk.begun(tracer, sign) for sign in SIDES])
    assert below.arrived and above.lost and above.end is None
    assert above.last is not None and np.exp(above.last.place) == pytest.approx(wall, rel=0.05)
