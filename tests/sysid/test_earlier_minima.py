"""A search that begins where a fit of some of the records has ended as well."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sysid import (
    GASSI,
    Dataset,
    EarlierMinima,
    Input,
    Output,
    Parameter,
    ProcessModel,
    State,
)
from sysid.engine.simulation import BatchSimulator

DT, NOISE, WIDTH = 0.01, 0.01, 0.015
TRUTH = {"first": 0.62, "second": 0.37, "tau": 0.05}
NEAR = {"first": 0.623, "second": 0.368, "tau": 0.06}
FAR = {"first": 0.3, "second": 0.8, "tau": 0.2}
# Too few, and begun too far away, to come upon so small a place.
FEW = {"population": 6, "generations": 2, "random_state": 1}


def acting(u, first, second):
    """1 where both inputs are near these values, else next to nothing."""
    return 1.0 / (1.0 + ((u[0] - first) / WIDTH) ** 2 + ((u[1] - second) / WIDTH) ** 2) ** 4


def peak():
    """A lag behind inputs that act at one place alone: elsewhere nothing is felt."""
    return ProcessModel(
        name="peak",
        states=(State("y", "V"),),
        inputs=(Input("u", "V", hold="foh"), Input("v", "V", hold="foh")),
        outputs=(Output("y", "V"),),
        parameters=(
            Parameter("first", "V", 0.4, 0.0, 1.0),
            Parameter("second", "V", 0.6, 0.0, 1.0),
            Parameter("tau", "s", 0.2, 0.01, 1.0, "log"),
        ),
        derivative=lambda x, u, p: ((acting(u, p[0], p[1]) - x[0]) / p[2],),
    )


def record(seed):
    """What a slow ramp beside a quicker triangle makes, integrated by SciPy."""
    time = np.arange(0.0, 30.0, DT)
    inputs = np.column_stack([time / 30.0, np.abs((2.0 * time) % 2.0 - 1.0)])

    def rate(t, y):
        u = [np.interp(t, time, each) for each in inputs.T]
        return (acting(u, TRUTH["first"], TRUTH["second"]) - y) / TRUTH["tau"]

    motion = solve_ivp(rate, (0.0, time[-1]), [0.0], "LSODA", time, max_step=2e-3, rtol=1e-8)
    noise = NOISE * np.random.default_rng(seed).standard_normal(len(time))
    return Dataset(inputs, motion.y[0] + noise, DT, name=str(seed))


@pytest.fixture(scope="module")
def records():
    return [record(0), record(1)]


def fitted(records, earlier=None, **settings):
    return GASSI(peak(), **FEW, **settings).fit(records, earlier=earlier)


@pytest.mark.soak
@pytest.mark.parametrize("process", [{}, {"process_noise": {"y": 0.01}}])
def test_a_search_ends_no_higher_than_the_minimum_beside_an_earlier_fit(records, process):
    alone = fitted(records, **process)
    assert alone.parameters_["first"] != pytest.approx(TRUTH["first"], abs=WIDTH)
    for values, noise in (([NEAR], {"y": NOISE}), ([NEAR, FAR], {}), ([FAR, NEAR], {"y": NOISE})):
        together = fitted(records, EarlierMinima(values, noise), **process)
        for name, value in TRUTH.items():
            assert together.parameters_[name] == pytest.approx(value, rel=0.1)


def test_nothing_is_searched_for_where_an_earlier_fit_is_settled(records):
    begun = fitted(records, EarlierMinima([NEAR], is_settled=True))
    assert begun.parameters_["first"] == pytest.approx(TRUTH["first"], abs=0.1 * WIDTH)
    long = {**FEW, "generations": 100}
    settled, searched = (
        GASSI(peak(), **long).fit(records, earlier=EarlierMinima([NEAR], is_settled=whether))
        for whether in (True, False)
    )
    assert settled.parameters_ == pytest.approx(begun.parameters_, rel=1e-4)
    assert settled.n_simulations_ < 0.5 * searched.n_simulations_


def pendulum():
    """One that falls to rest within a few samples, some of which it swings twice in."""
    return ProcessModel(
        name="pendulum",
        states=(State("angle", "rad"), State("speed", "rad/s")),
        inputs=(Input("torque", "N*m"),),
        outputs=(Output("angle", "rad"),),
        parameters=(
            Parameter("rate", "rad/s", 100.0, 0.1, 3e3, "log"),
            Parameter("decay", "1/s", 20.0, 1.0, 400.0, "log"),
        ),
        derivative=lambda x, u, p: (x[1], -(p[0] ** 2) * math.sin(x[0]) - p[1] * x[1] + u[0]),
    )


def test_an_earlier_fit_may_be_far_stiffer_than_the_middle_of_the_ranges():
    truth, time = {"rate": 2000.0, "decay": 200.0}, np.arange(0.0, 0.3, DT)
    rest = Dataset(np.zeros((len(time), 1)), np.full((len(time), 1), 2.0), DT)
    exact = BatchSimulator(pendulum(), accuracy=1e-6, max_steps=4096)
    angle = exact.trajectories(np.array([[*truth.values()]]), rest)[0]
    noise = NOISE * np.random.default_rng(0).standard_normal(angle.shape) * (time > 0.0)[:, None]
    log = Dataset(rest.inputs, angle + noise, DT)
    begun = GASSI(pendulum(), **FEW).fit(log, earlier=EarlierMinima([truth], is_settled=True))
    assert begun.parameters_ == pytest.approx(truth, rel=0.05)
