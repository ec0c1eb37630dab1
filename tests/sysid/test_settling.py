from __future__ import annotations

import numpy as np

from sysid import BatchSimulator, Dataset, SearchSpace
from sysid.objective import Objective
from sysid.settling import settle
from tests.sysid.support import lag


def test_a_minimum_that_cannot_be_simulated_stays_as_it_is_and_is_never_chosen():
    record = Dataset(np.ones(300), np.linspace(1.0, 2.0, 300), 0.01)
    target = Objective(BatchSimulator(lag()), SearchSpace.of(lag()), [record])
    unbounded, good = np.array([0.5, -0.001]), np.array([2.0, 0.05])
    alone = settle(target, [unbounded])
    np.testing.assert_array_equal(alone.chromosome, unbounded)
    assert alone.loss == np.inf
    assert np.isfinite(settle(target, [unbounded, good]).loss)
