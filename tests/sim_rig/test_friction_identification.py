"""With friction in the plant the physical model that has it beats ARMAX, and the comparison
says that one without it is worse."""

import pytest

from benchmarks.friction import LINEAR, WITH, WITHOUT, demands, measure

pytestmark = pytest.mark.soak

ORDERS = {"na": (2, 3), "nb": (2, 3), "nc": (2, 3), "nk": (0, 1)}


@pytest.fixture(scope="module")
def found():
    """One pair of logs; a smaller search, no weights and fewer orders than the benchmark's."""
    settings = {"population": 120, "generations": 15, "criterion": "error"}
    return measure(0, orders=ORDERS, settings=settings)


def test_it_beats_armax_on_every_output(found):
    ours, linear = (found["structures"][name]["rmse"] for name in (WITH, LINEAR))
    for output, value in ours.items():
        assert value < linear[output], output
        assert value < found["hindsight"][output], output
    assert ours["omega"] < 0.5 * linear["omega"]


def test_it_is_near_what_the_true_parameters_would_get(found):
    for output, value in found["structures"][WITH]["rmse"].items():
        assert value < 1.1 * found["true_parameters"][output], output


def test_without_friction_is_called_worse(found):
    without = found["structures"][WITHOUT]
    assert without["verdict"] == "worse" and without["dbic"] > 100.0
    assert without["squared_errors_relative"][1] > 1.05
    assert found["preferred"] == WITH
    assert f"{WITHOUT} has squared errors" in found["verdict"]


def test_what_the_benchmark_demands(found):
    assert set(demands([found]).values()) == {1}
