"""The pieces the batch kernel is made of: structure, matrix functions, vector functions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from sim_rig.actuator import actuator
from sysid import Input, Output, Parameter, ProcessModel, State, _vector_math
from sysid._phi import phi_matrices
from sysid._structure import analyse


def structure(derivative, hold="zoh"):
    model = ProcessModel(
        name="traced",
        states=(State("a", "1", 0.5), State("b", "1", 0.25)),
        inputs=(Input("u", "1", hold),),
        outputs=(Output("a", "1"),),
        parameters=(Parameter("p", "1", 2.0, 1.0, 3.0), Parameter("q", "1", 2.0, 1.0, 3.0)),
        derivative=derivative,
    )
    return analyse(model)


def limited(x):
    return min(max(x, -1.0), 1.0)


CASES = {
    # name: (derivative, constant entries, driven rows, nonlinear)
    "linear": (lambda x, u, p: (x[1], -p[0] * x[0] / p[1] + u[0]), ((0, 1), (1, 0)), (), False),
    "product of states": (lambda x, u, p: (x[0] * x[1], -x[1]), ((1, 1),), (0,), True),
    "state times input": (lambda x, u, p: (x[0] * u[0], -x[1]), ((1, 1),), (0,), True),
    "absolute": (lambda x, u, p: (x[1] - abs(x[0]), x[0]), ((0, 1), (1, 0)), (0,), True),
    "square": (lambda x, u, p: (x[1] ** 2, -x[1]), ((1, 1),), (0,), True),
    "saturation": (lambda x, u, p: (limited(x[0]), -x[1]), ((1, 1),), (0,), True),
    "math": (lambda x, u, p: (math.tanh(x[0]), math.exp(p[0]) * x[0]), ((1, 0),), (0,), True),
    "a branch": (lambda x, u, p: (x[1] if x[0] > 0 else -x[1], x[0]), (), (0, 1), True),
    "division by state": (lambda x, u, p: (1.0 / x[0], x[0] - x[1]), ((1, 0), (1, 1)), (0,), True),
    "input squared": (lambda x, u, p: (u[0] * u[0] - x[0], x[0]), ((0, 0), (1, 0)), (), False),
}


@pytest.mark.parametrize("name", CASES)
def test_linear_parts_are_recognised(name):
    derivative, constant, driven, nonlinear = CASES[name]
    found = structure(derivative)
    assert found.constant == constant
    assert found.driven == driven
    assert found.nonlinear is nonlinear


def test_an_interpolated_input_drives_its_row():
    found = structure(lambda x, u, p: (x[1], u[0] - x[0]), hold="foh")
    assert found.driven == (1,)
    assert not found.nonlinear


def test_the_actuator_is_linear_but_for_its_mechanics():
    model = actuator()
    found = analyse(model)
    assert [model.state_names[i] for i in found.driven] == ["omega", "z"]


def test_matrix_functions_agree_with_the_exponential_of_a_block_matrix():
    rng = np.random.default_rng(0)
    n, h = 5, 3e-4
    triples = np.array([(i, k, j) for i in range(n) for k in range(n) for j in range(n)])
    for size in (1.0, 1e3, 1e5):
        a = size * rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-1, 1, (n, 1)) - size * np.eye(
            n
        )
        blocks = np.zeros((4 * n, 4 * n))
        blocks[:n, :n] = h * a
        for k in range(3):
            blocks[k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
        whole = expm(blocks)
        half = np.zeros((2 * n, 2 * n))
        half[:n, :n], half[:n, n:] = h / 2.0 * a, np.eye(n)
        expected = [h / 2.0 * expm(half)[:n, n:]]
        expected += [h * whole[:n, k * n : (k + 1) * n] for k in (1, 2, 3)]
        found = np.empty((4, n, n))
        phi_matrices(a.copy(), h, triples, found)
        for got, exact in zip(found, expected, strict=True):
            np.testing.assert_allclose(got, exact, atol=1e-11 * np.abs(exact).max())


def test_a_matrix_that_is_not_finite_gives_not_a_number():
    found = np.empty((4, 1, 1))
    phi_matrices(np.array([[math.inf]]), 1.0, np.array([(0, 0, 0)]), found)
    assert np.isnan(found).all()


@pytest.mark.parametrize(
    ("name", "low", "high", "tolerance"),
    [
        ("exp", -700.0, 700.0, 1e-15),
        ("exp", -1.0, 1.0, 1e-15),
        ("tanh", -25.0, 25.0, 1e-15),
        ("tanh", -1e-6, 1e-6, 1e-15),
        ("sin", -1e5, 1e5, 1e-15),
        ("cos", -1e5, 1e5, 1e-15),
    ],
)
def test_vector_functions_are_as_exact_as_the_library(name, low, high, tolerance):
    values = np.random.default_rng(1).uniform(low, high, 3000)
    found = np.array([getattr(_vector_math, name)(v) for v in values])
    exact = np.array([getattr(math, name)(v) for v in values])
    # Near a zero of sine and cosine the argument's own rounding is what counts.
    size = np.maximum(np.abs(exact), 1e-2 if name in ("sin", "cos") else 0.0)
    assert np.max(np.abs(found - exact) / size) < tolerance


@pytest.mark.parametrize("name", ["exp", "tanh", "sin", "cos"])
def test_vector_functions_pass_not_a_number_on(name):
    assert math.isnan(getattr(_vector_math, name)(math.nan))
