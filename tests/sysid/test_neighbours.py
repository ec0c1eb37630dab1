"""Slopes by neighbours that move starts of several records at once: as if each moved alone."""

from dataclasses import replace

import numpy as np
import pytest

from sysid import BatchSimulator, Dataset, SearchSpace, State
from sysid.fitting.neighbours import Neighbours
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import simulations_per_iteration
from tests.sysid.support import lag


def objective_of(estimated):
    """Of a lag and records of different lengths, of which some estimate where it starts."""
    rng, model = np.random.default_rng(3), lag(states=(State("y", "1", initial_range=(-2.0, 2.0)),))
    records = [
        Dataset(*rng.standard_normal((2, 40 + 10 * k, 1)), 0.01) for k in range(len(estimated))
    ]
    whole = SearchSpace.of(model).with_starts(records)
    kept = [k for k, is_estimated in enumerate(estimated) if is_estimated]
    space = replace(
        whole,
        parameters=(*whole.parameters[:2], *(whole.parameters[2 + k] for k in kept)),
        estimated=tuple(whole.estimated[k] for k in kept),
    )
    return Objective(BatchSimulator(model), space, records)


@pytest.mark.parametrize(
    ("estimated", "count"),
    [((False,), 2), ((True,), 3), ((True, True, True), 3), ((False, True, False, True), 3)],
)
def test_starts_of_different_records_share_a_neighbour(estimated, count):
    objective = objective_of(estimated)
    space, n_free = objective.space, 2 + sum(estimated)
    neighbours = Neighbours.of(objective)
    assert neighbours.count == count
    without = simulations_per_iteration(objective_of((False,)))
    assert simulations_per_iteration(objective) == without + count - 2
    at = space.encode(np.array([1.7, 0.04, *np.linspace(-0.5, 0.5, sum(estimated))]))
    distance = 1e-4 * np.linspace(1.0, 2.0, n_free) * np.where(np.arange(n_free) % 2, -1.0, 1.0)
    steps = np.array([8] * len(estimated))

    def values(rows):
        return objective.residuals(space.decode(rows), steps).values

    slopes = neighbours.slopes(values(neighbours.around(at, distance * space.width)), distance)
    alone = values(np.vstack([at, at + np.diag(distance * space.width)]))
    expected = (alone[..., 1:] - alone[..., :1]) / distance
    assert np.abs(expected).max(axis=(0, 1)).all()
    np.testing.assert_allclose(slopes.dense, expected, atol=1e-9 * np.abs(expected).max())
