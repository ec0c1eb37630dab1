"""Steps along constraints against SciPy's quadratic programming."""

import numpy as np
import pytest
from scipy.optimize import minimize

from sysid import Constraint, Parameter, SearchSpace
from sysid.fitting.quadratic import Constraints
from tests.sysid.support import lag


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_move_is_the_quadratic_programmes_solution(seed):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 7)), int(rng.integers(1, 4))
    root = rng.normal(size=(n, n))
    curvature = root @ root.T + 0.1 * np.eye(n)
    gradient = rng.normal(size=n)
    # At a point within all constraints, on some of them.
    near = Constraints(-rng.uniform(0.0, 0.5, m) * rng.integers(0, 2, m), rng.normal(size=(m, n)))
    inverse = np.linalg.inv(curvature)
    found = near.nearest(-inverse @ gradient, inverse)

    def cost(x):
        return gradient @ x + 0.5 * x @ curvature @ x

    keep = {
        "type": "ineq",
        "fun": lambda x: -(near.value + near.slope @ x),
        "jac": lambda x: -near.slope,
    }
    expected = minimize(
        cost, np.zeros(n), jac=lambda x: gradient + curvature @ x, constraints=[keep],
        method="SLSQP", options={"ftol": 1e-14, "maxiter": 500},
    )  # fmt: skip
    assert np.all(near.value + near.slope @ found <= 0.0)
    assert cost(found) == pytest.approx(expected.fun, rel=1e-4, abs=1e-5)


def test_slopes_are_those_of_the_constraints_by_moves():
    constraint = Constraint("circle", lambda p: p[0] ** 2 + p[1] ** 2 - 5.0)
    model = lag(
        constraints=(constraint,),
        parameters=(
            Parameter("gain", "1", 2.0, 0.5, 4.0),
            Parameter("tau", "s", 0.05, 0.005, 0.5, "log"),
        ),
    )
    space = SearchSpace.of(model)
    at = space.encode(np.array([2.0, 0.1]))
    width = space.encode(space.upper) - space.encode(space.lower)
    near = Constraints.at(space, at, width)
    assert near.value == pytest.approx([4.0 + 0.01 - 5.0])
    # dg/dgain = 2 gain; dg/dln tau = 2 tau^2.
    assert near.slope[0] == pytest.approx([4.0 * 3.5, 0.02 * np.log(100.0)])
    # A parameter that may not move, and a constraint that is then out of reach.
    assert near.among(np.array([1])).slope.shape == (1, 1)
    assert len(near.among(np.array([], dtype=np.int64)).value) == 0
