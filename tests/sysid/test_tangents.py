"""Tangents of simulated outputs against complex steps of an independent integrator."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sysid import (
    BatchSimulator,
    Dataset,
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    State,
)
from sysid.fitting.objective import Objective
from tests.sysid.support import blank

DT = 0.01
VALUES = {"m": 0.8, "k": 40.0, "alpha": 5.0, "A": 2.0, "beta": 30.0}
N = len(VALUES)


def derivative(x, u, p):
    """A mass on a spring with smooth hysteresis."""
    m, k, alpha, A, beta = p
    y, v, z = x
    speed = v * math.tanh(3.0 * v)
    return (v, (u[0] - v - k * y - alpha * z) / m, A * v - beta * speed * z)


def oscillator():
    """Force and position are seen."""
    return ProcessModel(
        name="oscillator",
        states=(State("y", "m"), State("v", "m/s"), State("z", "1")),
        inputs=(Input("force", "N", "foh"),),
        outputs=(Output("y", "m"), Output("spring", "N")),
        parameters=tuple(
            Parameter(name, "1", value, value / 4.0, value * 4.0, "log")
            for name, value in VALUES.items()
        ),
        derivative=derivative,
        output=lambda x, u, p: (x[0], p[1] * x[0] + p[2] * x[2]),
    )


def drag(derivative):
    """A body that is slowed down by dry friction and by the square of its speed."""
    return ProcessModel(
        name="drag",
        states=(State("v", "m/s", initial=0.1),),
        inputs=(Input("force", "N"),),
        outputs=(Output("v", "m/s"),),
        parameters=(
            Parameter("m", "kg", 0.1, 0.01, 1.0, "log"),
            Parameter("dry", "N", 0.2, 0.01, 1.0, "log"),
            Parameter("square", "N*s^2/m^2", 0.3, 0.01, 1.0, "log"),
        ),
        derivative=derivative,
    )


def with_magnitudes(x, u, p):
    m, dry, square = p
    v = x[0]
    return ((u[0] - dry * math.copysign(1.0, v) - square * v * abs(v)) / m,)


def with_conditions(x, u, p):
    m, dry, square = p
    v = x[0]
    if v > 0.0:
        return ((u[0] - dry - square * v * v) / m,)
    drive = u[0] + square * v * v
    return ((drive + dry) / m,) if v < 0.0 else (drive / m,)


def record(n=30, seed=0):
    force = 4.0 * np.random.default_rng(seed).standard_normal(n)
    return blank(oscillator(), force[:, None], DT)


def of_log_parameters(vectors):
    """Directions in which the logarithm of each parameter moves."""
    return vectors[:, :, None] * np.eye(vectors.shape[1])


def complex_step(record, start, values, size=1e-30):
    """Derivatives of the outputs by the logarithms of the parameters, then by the starts."""
    n, rows = len(values), []
    for j in range(n + len(start)):
        p = np.array(values, complex)
        x = np.array(start, complex)
        if j < n:
            p[j] *= 1.0 + 1j * size
        else:
            x[j - n] += 1j * size
        rows.append(responses(record.inputs[:, 0], x, p).imag / size)
    return np.stack(rows, axis=-1)


def responses(force, x, p):
    m, k, alpha, A, beta = p
    outputs = []
    for i in range(len(force)):
        outputs.append([x[0], k * x[0] + alpha * x[2]])
        if i + 1 == len(force):
            return np.array(outputs)

        def slope(t, s, i=i):
            y, v, z = s
            u = force[i] + (force[i + 1] - force[i]) * t / DT
            dz = A * v - beta * v * np.tanh(3.0 * v) * z
            return [v, (u - v - k * y - alpha * z) / m, dz]

        x = solve_ivp(slope, (0.0, DT), x, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    raise AssertionError


@pytest.mark.soak
def test_tangents_are_those_of_an_independent_integrator():
    simulator, data = BatchSimulator(oscillator()), record(12)
    vectors = np.array([list(VALUES.values()), [1.2, 60.0, 2.0, 3.0, 20.0]])
    starts = np.array([[0.1, -0.4, 0.02], [0.0, 0.5, 0.0]])
    along = np.concatenate([of_log_parameters(vectors), np.zeros((2, 3, N))], axis=1)
    of_start = np.repeat(np.concatenate([np.zeros((N, 3)), np.eye(3)])[None], 2, axis=0)
    steps = np.array([[16], [32]])
    (tangents,) = simulator.tangents(vectors, [data], along, steps, [starts], [of_start])
    for tangent, vector, start in zip(tangents, vectors, starts, strict=True):
        exact = complex_step(data, start, vector)
        assert np.abs(tangent - exact).max() < 1e-6 * np.abs(exact).max()
        sizes = np.abs(exact).max(axis=(0, 1))
        assert np.all(np.abs(tangent - exact).max(axis=(0, 1)) < 1e-5 * sizes)


@pytest.mark.soak
def test_tangents_are_derivatives_of_what_is_simulated_however_coarse_the_steps():
    simulator = BatchSimulator(oscillator())
    records = [record(seed=1), record(20, seed=2)]
    p = np.array([list(VALUES.values())])
    steps = np.array([[1, 2]])
    tangents = simulator.tangents(p, records, of_log_parameters(p), steps)
    for data, tangent, n_steps in zip(records, tangents, steps[0], strict=True):
        up, down = (
            simulator.trajectories(p * np.exp(sign * 1e-6 * np.eye(N)), data, int(n_steps))
            for sign in (1.0, -1.0)
        )
        differences = np.moveaxis((up - down) / 2e-6, 0, -1)
        assert tangent[0] == pytest.approx(differences, abs=1e-7 * np.abs(differences).max())


def test_a_structurally_null_direction_moves_nothing():
    # z scaled by s: A too, alpha by 1 / s; only their product acts.
    simulator, data = BatchSimulator(oscillator()), record(400)
    p = np.array([list(VALUES.values())])
    (tangents,) = simulator.tangents(p, [data], of_log_parameters(p), np.array([[1]]))
    slopes = tangents[0].reshape(-1, N)
    null = np.array([0.0, 0.0, -1.0, 1.0, 0.0])
    information = slopes.T @ slopes
    assert null @ information @ null < 1e-20 * np.linalg.eigvalsh(information)[-1]


def test_equations_with_conditions_have_the_tangents_of_those_without():
    force = np.repeat([1.0, -0.8, 0.6, -1.2], 25)
    p = np.array([[0.1, 0.2, 0.3]])
    plain, branching = (
        BatchSimulator(drag(equations)).tangents(
            p, [blank(drag(equations), force[:, None], DT)], of_log_parameters(p), np.array([[4]])
        )[0]
        for equations in (with_magnitudes, with_conditions)
    )
    assert np.abs(plain).max() > 1.0
    assert branching == pytest.approx(plain, abs=1e-12)


def test_equations_that_cannot_be_differentiated_are_refused_in_words():
    def looked_up(x, u, p):
        return (math.gamma(x[0]),)

    model = drag(looked_up).with_initial({"v": 1.0})
    with pytest.raises(ModelError, match="drag: its equations cannot be differentiated"):
        BatchSimulator(model).tangents(
            np.ones((1, 3)),
            [blank(model, np.zeros((5, 1)), DT)],
            np.ones((1, 1, 3)),
            np.ones((1, 1), int),
        )


def test_slopes_of_residuals_are_those_of_differences():
    """Of records that start anywhere, of means over windows, and of samples that were lost."""
    n, rng = 40, np.random.default_rng(3)
    states = State("y", "m"), State("v", "m/s"), State("z", "1", initial_range=(-1.0, 1.0))
    model = replace(oscillator(), states=states)
    windows = np.zeros((n, 2, 2))
    windows[:, 1] = -0.7 * DT, 0.4 * DT
    records = []
    for seed in (4, 5):
        outputs = rng.standard_normal((n, 2))
        outputs[7:9, 1] = np.nan
        records.append(Dataset(record(n, seed).inputs, outputs, DT, windows=windows))
    space = SearchSpace.of(model).with_starts(records)
    objective = Objective(BatchSimulator(model), space, records)
    at = space.encode(np.array([*VALUES.values(), 0.3, -0.2]))
    steps = np.array([[2, 3]])
    exact = objective.tangents(space.decode(at[None]), steps)[0].dense
    shift = 1e-5 * np.eye(len(at))
    ahead, behind = (
        objective.residuals(space.decode(at + way * shift), steps[0]).values for way in (1.0, -1.0)
    )
    differences = (ahead - behind) / 2e-5
    assert exact == pytest.approx(differences, abs=1e-7 * np.abs(differences).max())
    assert not exact[7:9, 1].any() and not exact[:n, :, -1].any() and exact[n:, :, -1].any()
    unit = np.arange(1.0, 1.0 + len(at))
    (longer,) = objective.tangents(space.decode(at[None]), steps, unit)
    assert longer.dense == pytest.approx(exact * unit, rel=1e-12)
