from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_rig.actuator import actuator
from sim_rig.plant import Plant
from sysid import (
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    State,
    equilibrium,
    jacobian,
    linearize,
)
from sysid.response.linearization import linear_models
from tests.sysid.support import lag, motor, motor_matrices, outputs_of

MODELS = {
    "motor": motor(),
    "actuator": actuator(),
    "actuator n=2": actuator(exponent=2.0),
    "plant": Plant().build(),
}


def central_differences(function, point, width):
    columns = []
    for i in range(len(point)):
        step = width * max(1.0, abs(point[i]))
        ahead, back = point.copy(), point.copy()
        ahead[i] += step
        back[i] -= step
        columns.append((np.array(function(ahead)) - np.array(function(back))) / (2.0 * step))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("name", MODELS)
@given(seed=st.integers(0, 2**32 - 1))
def test_jacobians_agree_with_finite_differences(name, seed):
    model, rng = MODELS[name], np.random.default_rng(seed)
    # Away from the kinks of |x| and of the limits, where no derivative exists.
    x = rng.uniform(0.05, 0.9, len(model.states)) * rng.choice([-1.0, 1.0], len(model.states))
    u = rng.uniform(-0.9, 0.9, len(model.inputs))
    p = model.nominal * rng.uniform(0.5, 2.0, len(model.parameters))
    x, u, p = x.tolist(), u.tolist(), tuple(p.tolist())
    x, u = np.array(x), np.array(u)
    found = linearize(model, x, u, np.array(p))
    for matrix, function, point in (
        (found.A, lambda v: model.derivative(tuple(v), tuple(u), p), x),
        (found.B, lambda v: model.derivative(tuple(x), tuple(v), p), u),
        (found.C, lambda v: outputs_of(model, tuple(v), tuple(u), p), x),
        (found.D, lambda v: outputs_of(model, tuple(x), tuple(v), p), u),
    ):
        expected = central_differences(function, point, 1e-6)
        size = np.abs(expected).max(axis=1, keepdims=True) + 1e-9
        np.testing.assert_allclose(matrix / size, expected / size, atol=2e-6)


def test_the_motor_gives_its_matrices():
    A, B, C, D = linearize(motor(), np.zeros(2), np.zeros(2))
    expected = motor_matrices(motor().nominal)
    for found, exact in zip((A, B), expected[:2], strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-14)
    np.testing.assert_array_equal(C, np.eye(2))
    np.testing.assert_array_equal(D, np.zeros((2, 2)))


def every_function(x, u, p):
    a = x[0]
    return (
        math.exp(a) + math.sin(a) * math.cos(2.0 * a) - math.tanh(3.0 * a)
        + math.sqrt(a) + math.log(a) + math.atan(a) + a**p[0] + 2.0**a + 1.0 / (1.0 + a * a)
        + max(a, 0.1) + min(a, 9.0) + abs(-a) + math.hypot(a, 2.0) + math.pow(a, 1.5) + u[0] * a,
    )  # fmt: skip


def test_elementary_functions_are_differentiated():
    model = ProcessModel(
        name="functions",
        states=(State("a", "1", 0.7),),
        inputs=(Input("b", "1"),),
        outputs=(Output("a", "1"),),
        parameters=(Parameter("n", "1", 1.7, 1.0, 2.0),),
        derivative=every_function,
    )
    for value in (0.2, 0.7, 3.0):
        expected = central_differences(
            lambda v: every_function(tuple(v), (0.4,), (1.7,)), np.array([value]), 1e-6
        )
        found = jacobian(model, np.array([value]), np.array([0.4]))
        np.testing.assert_allclose(found, expected, rtol=1e-8)


# --- several parameter vectors at once ------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
@given(seed=st.integers(0, 2**32 - 1))
def test_jacobians_of_many_are_those_of_each(name, seed):
    model, rng = MODELS[name], np.random.default_rng(seed)
    x, u = rng.normal(size=len(model.states)), rng.normal(size=len(model.inputs))
    x[rng.random(len(x)) < 0.2] = 0.0
    p = model.nominal * rng.uniform(0.5, 2.0, (5, len(model.parameters)))
    p[:, rng.random(p.shape[1]) < 0.5] = model.nominal[rng.integers(p.shape[1])]
    expected = [jacobian(model, x, u, row) for row in p]
    np.testing.assert_allclose(linear_models(model, x, u, p).A, expected, rtol=1e-9, atol=1e-300)


def test_of_a_root_at_zero_no_slope_is_known():
    tank = ProcessModel(
        name="tank",
        states=(State("level", "m"),),
        inputs=(Input("flow", "m/s"),),
        outputs=(Output("level", "m"),),
        parameters=(Parameter("a", "m^0.5/s", 1.0, 0.1, 10.0),),
        derivative=lambda x, u, p: (u[0] - p[0] * math.sqrt(max(x[0], 0.0)),),
    )
    found = linear_models(tank, np.zeros(1), np.ones(1), np.ones((3, 1))).A
    assert found.shape == (3, 1, 1) and np.isnan(found).all()


def elementary(x, u, p):
    a, b = x
    k, n = p
    return (
        math.exp(k * a) + math.sin(a) * math.cos(k * a) - math.tanh(k * a) + math.sqrt(k * a)
        + math.log(k + a) + math.atan2(a, k) + (k * a) ** n + k**a + k / (1.0 + n * a * a),
        max(k * a, b, 0.1) + min(a, n * b) + abs(k - a) * b + math.hypot(a, k * b) + math.pow(a, n)
        + math.exp(k) * b + math.fabs(-k * b) + (k - b) + math.copysign(b, k) + math.floor(a),
    )  # fmt: skip


def branching(x, u, p):
    a, b = x
    return (p[0] * a if p[0] * a > b else p[1] * b, a)


@pytest.mark.parametrize("derivative", [elementary, branching])
def test_jacobians_of_many_differentiate_and_branch_as_one(derivative):
    model = ProcessModel(
        name="functions",
        states=(State("a", "1"), State("b", "1")),
        inputs=(),
        outputs=(Output("a", "1"),),
        parameters=(Parameter("k", "1", 1.0, 0.5, 2.0), Parameter("n", "1", 1.7, 1.0, 2.0)),
        derivative=derivative,
    )
    p = np.random.default_rng(3).uniform(0.6, 1.9, (20, 2))
    for x in np.array([[0.7, 0.9], [1.4, 0.3]]):
        expected = [jacobian(model, x, np.zeros(0), row) for row in p]
        np.testing.assert_allclose(linear_models(model, x, np.zeros(0), p).A, expected, rtol=1e-9)


def counting(x, u, p):
    """What parameters alone decide may be anything Python can do: a count, a NumPy function."""
    return (sum(x[1] * np.tanh(p[0]) for _ in range(int(p[1]))), -x[0] % 1.5 + x[0] // 2.0)


def iterated(x, u, p):
    """The root of y^3 + y = a by Newton's method: as many rounds as the point needs."""
    a, y = x
    while abs(y * y * y + y - a) > 1e-12:
        y = y - (y * y * y + y - a) / (3.0 * y * y + 1.0)
    return (y, p[0] * a if a else x[1])


def both_sides(x, u, p):
    a, b = x
    return (math.sqrt(max(a, 0.0)) + u[0] * (b > 0.0), min(a, b, p[0]) if a != b else p[1] * a)


@pytest.mark.parametrize("derivative", [branching, counting, iterated, both_sides])
def test_each_point_is_differentiated_along_its_own_way(derivative):
    """One way after another, and again, on one model that remembers them."""
    model = ProcessModel(
        name="ways",
        states=(State("a", "1", 0.4), State("b", "1", 0.3)),
        inputs=(Input("u", "1"),),
        outputs=(Output("a", "1"),),
        parameters=(Parameter("k", "1", 1.1, 0.5, 2.0), Parameter("n", "1", 2.2, 1.0, 4.0)),
        derivative=derivative,
    )
    rng = np.random.default_rng(4)
    points = rng.uniform(-2.0, 2.0, (12, 2))
    for x in (*points, *points):
        p = rng.uniform([0.5, 1.0], [2.0, 4.0])
        A, B, _, _ = linearize(model, x, np.array([0.7]), p)
        by_x = central_differences(lambda v, p=p: derivative(tuple(v), (0.7,), p), x, 1e-6)
        by_u = central_differences(
            lambda v, x=x, p=p: derivative(tuple(x), tuple(v), p), np.array([0.7]), 1e-6
        )
        np.testing.assert_allclose(A, by_x, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(B, by_u, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("derivative", "message"),
    [
        (lambda x, u, p: (math.gamma(2.0 + x[0]), x[1]), "the derivative of gamma is not known"),
        (lambda x, u, p: (float(x[0]), x[1]), r"float\(\) argument must be"),
    ],
)
def test_what_cannot_be_differentiated_says_so(derivative, message):
    model = ProcessModel(
        name="odd",
        states=(State("a", "1"), State("b", "1")),
        inputs=(),
        outputs=(Output("a", "1"),),
        parameters=(Parameter("k", "1", 1.0, 0.5, 2.0),),
        derivative=derivative,
    )
    with pytest.raises(ModelError, match=f"model odd cannot be differentiated: {message}"):
        jacobian(model, np.ones(2), np.zeros(0))
    with pytest.raises(ModelError, match=f"model odd cannot be differentiated: {message}"):
        linear_models(model, np.ones(2), np.zeros(0), np.array([[1.0], [1.5]]))


# --- operating points -----------------------------------------------------------------------


def test_an_equilibrium_is_one():
    model = actuator()
    u = np.array([0.2, 0.05, 0.0])
    x = equilibrium(model, u, hold={"omega": 3.0, "theta": 1.0})
    slopes = np.array(model.derivative(tuple(x), tuple(u), tuple(model.nominal)))
    free = [0, 1, 2, 3, 5]
    scale = np.abs(jacobian(model, x, u)) @ np.abs(x)
    assert np.all(np.abs(slopes[free]) < 1e-9 * scale[free])
    assert x[4] == 3.0 and x[6] == 1.0
    # In steady sliding the hysteresis stands at z0 = A / (beta + gamma).
    A, beta, gamma = (model.parameter(name).nominal for name in ("A", "beta", "gamma"))
    assert x[5] == pytest.approx(A / (beta + gamma), rel=1e-6)


def test_where_nothing_rests_there_is_an_error():
    model = ProcessModel(
        name="drift",
        states=(State("a", "1"),),
        inputs=(),
        outputs=(Output("a", "1"),),
        parameters=(Parameter("k", "1", 1.0, 0.5, 2.0),),
        derivative=lambda x, u, p: (p[0] + x[0] * x[0],),
    )
    with pytest.raises(ModelError, match="no equilibrium found"):
        equilibrium(model, np.zeros(0))


@pytest.mark.parametrize("wrong", [{"x": np.zeros(3)}, {"u": np.zeros(1)}, {"p": np.zeros(2)}])
def test_wrong_shapes_are_named(wrong):
    arguments = {"x": np.zeros(2), "u": np.zeros(2), "p": motor().nominal} | wrong
    with pytest.raises(ModelError, match="shape"):
        linearize(motor(), **arguments)


def test_numpys_functions_have_derivatives_too():
    def derivative(x, u, p):
        return (np.float64(2.0) * u[0] - np.sign(x[0]) * np.tanh(x[0] * p[0]),)

    model = lag(derivative=derivative)
    linear = linearize(model, np.array([-0.3]), np.zeros(1), np.array([2.0, 1.0]))
    assert linear.A.item() == pytest.approx(2.0 / np.cosh(0.6) ** 2)
    assert linear.B.item() == 2.0
