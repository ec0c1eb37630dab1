"""Taking a model's equations apart: dx/dt = A x + N, and what depends on parameters alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_rig.actuator import actuator
from sysid import Input, Output, Parameter, ProcessModel, State
from sysid.engine.structure import analyse


def model_of(derivative, hold="zoh", output=None):
    return ProcessModel(
        name="traced",
        states=(State("a", "1", 0.5), State("b", "1", 0.25)),
        inputs=(Input("u", "1", hold),),
        outputs=(Output("a", "1"),),
        parameters=(Parameter("p", "1", 2.0, 1.0, 3.0), Parameter("q", "1", 2.0, 1.0, 3.0)),
        derivative=derivative,
        output=output,
    )


def taken_apart(model, p, exact=True):
    """A at some parameters, and N(x, u)."""
    found = analyse(model, exact=exact)
    scope = {"math": math, "always_inline": lambda: None, "derivative": model.derivative}
    exec(found.program, scope)
    c = scope["constants"](p)
    assert len(c) == found.n_constants
    A = np.zeros((len(model.states), len(model.states)))
    for (i, j), text in found.coefficients.items():
        A[i, j] = eval(text, {"c": c})
    return A, lambda x, u: np.array(scope["remainder"](x, u, c))


def limited(x, low=-1.0, high=1.0):
    return min(max(x, low), high)


def dead(x, half):
    return max(x - half, 0.0) + min(x + half, 0.0)


CASES = {
    # name: (derivative, entries of A, driven rows, nonlinear)
    "linear": (lambda x, u, p: (x[1], -p[0] * x[0] / p[1] + u[0]), ((0, 1), (1, 0)), (), False),
    "product of states": (lambda x, u, p: (x[0] * x[1], -x[1]), ((1, 1),), (0,), True),
    "state times input": (lambda x, u, p: (x[0] * u[0], -x[1]), ((1, 1),), (0,), True),
    "absolute": (lambda x, u, p: (x[1] - abs(x[0]), x[0]), ((0, 1), (1, 0)), (0,), True),
    "square": (lambda x, u, p: (x[1] ** 2, -x[1]), ((1, 1),), (0,), True),
    "remainder": (lambda x, u, p: (x[0] % 1.5 + x[1] // 2.0, -x[1]), ((1, 1),), (0,), True),
    "math": (lambda x, u, p: (math.tanh(x[0]), math.exp(p[0]) * x[0]), ((1, 0),), (0,), True),
    "NumPy": (
        lambda x, u, p: (np.tanh(np.abs(x[0])) + np.minimum(u[0], 0.5), np.exp(p[0]) * x[0]),
        ((1, 0),),
        (0,),
        True,
    ),
    "a branch": (lambda x, u, p: (x[1] if x[0] > 0 else -x[1], x[0]), (), (0, 1), True),
    "division by state": (lambda x, u, p: (1.0 / x[0], x[0] - x[1]), ((1, 0), (1, 1)), (0,), True),
    "input squared": (lambda x, u, p: (u[0] * u[0] - x[0], x[0]), ((0, 0), (1, 0)), (), False),
    "linear and not": (lambda x, u, p: (3.0 * x[0] + abs(x[0]) + x[1], 0), ((0, 1),), (0,), True),
    "functions of parameters": (
        lambda x, u, p: (
            max(p[0], 2) * abs(-p[1]) * x[0] - 3 * (p[0] ** 2 - min(p[1], p[0])) * x[1],
            (math.sqrt(p[0]) - 1.0 / p[1]) * (x[0] + (2.0 - x[1]) / p[0]),
        ),
        ((0, 0), (0, 1), (1, 0), (1, 1)),
        (),
        False,
    ),
    "numbers of NumPy": (
        lambda x, u, p: (np.float64(2.0) * x[0] - np.int64(3), x[1] / np.float64(4.0)),
        ((0, 0), (1, 1)),
        (),
        False,
    ),
    "saturation": (lambda x, u, p: (limited(x[0]), -x[1]), ((0, 0), (1, 1)), (0,), True),
    "limits among parameters": (
        lambda x, u, p: (p[1] * limited(u[0] - p[0] * x[0], -p[1], p[1] / 2.0), -x[1]),
        ((0, 0), (1, 1)),
        (0,),
        True,
    ),
    "upper limit first": (
        lambda x, u, p: (max(-1.0, min(x[0] + x[1], p[0])), -x[1]),
        ((0, 0), (0, 1), (1, 1)),
        (0,),
        True,
    ),
    "limits within limits": (
        lambda x, u, p: (limited(2.0 * limited(p[0] * x[0]) - x[1], -3.0, 3.0), -x[1]),
        ((0, 0), (0, 1), (1, 1)),
        (0,),
        True,
    ),
    "limits around others": (
        lambda x, u, p: (max(min(limited(x[0]), 0.5), -2.0), -x[1]),
        ((0, 0), (1, 1)),
        (0,),
        True,
    ),
    "limits that move": (
        lambda x, u, p: (limited(x[0], -u[0], u[0]), -x[1]),
        ((1, 1),),
        (0,),
        True,
    ),
    "one limit": (lambda x, u, p: (max(x[0], 0.1) - x[1], -x[1]), ((0, 1), (1, 1)), (0,), True),
    "dead zone": (lambda x, u, p: (-dead(x[0], p[0]) + x[1], -x[1]), ((0, 1), (1, 1)), (0,), True),
    "limited input": (lambda x, u, p: (limited(u[0]) - x[0], x[0]), ((0, 0), (1, 0)), (), False),
    "limited product": (lambda x, u, p: (limited(x[0]) * x[1], -x[1]), ((1, 1),), (0,), True),
    "limited twice": (
        lambda x, u, p: (limited(x[0]) + limited(2.0 * x[0]), -x[1]),
        ((0, 0), (1, 1)),
        (0,),
        True,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_linear_parts_are_recognised(name):
    derivative, entries, driven, nonlinear = CASES[name]
    found = analyse(model_of(derivative))
    assert tuple(sorted(found.coefficients)) == entries
    assert found.driven == driven
    assert found.nonlinear is nonlinear


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("name", CASES)
def test_the_parts_make_up_the_equations(name, exact):
    model, rng = model_of(CASES[name][0]), np.random.default_rng(1)
    for _ in range(50):
        x, u, p = rng.normal(0.0, 2.0, 2), rng.normal(0.0, 2.0, 1), rng.uniform(1.0, 3.0, 2)
        A, remainder = taken_apart(model, tuple(p), exact)
        found = A @ x + remainder(tuple(x), tuple(u))
        np.testing.assert_allclose(found, model.derivative(x, u, p), atol=1e-13)


@pytest.mark.parametrize("exact", [True, False])
def test_the_parts_of_the_actuator_make_up_its_equations(exact):
    model, rng = actuator(), np.random.default_rng(2)
    A, remainder = taken_apart(model, tuple(model.nominal), exact)
    assert A.any() == exact
    for _ in range(20):
        x, u = rng.normal(size=len(model.states)), rng.normal(size=len(model.inputs))
        exactly = np.array(model.derivative(tuple(x), tuple(u), tuple(model.nominal)))
        found = A @ x + remainder(tuple(x), tuple(u))
        np.testing.assert_allclose(found, exactly, atol=1e-12 * np.abs(exactly).max())


def test_nothing_is_left_of_a_limited_row_within_its_limits():
    model = model_of(lambda x, u, p: (1e5 * limited(u[0] - p[0] * x[0], -p[1], p[1]), -x[1]))
    A, remainder = taken_apart(model, (2.0, 3.0))
    assert A[0, 0] == -2e5
    within = remainder((0.5, 0.0), (1.0,))
    assert within[0] == pytest.approx(1e5, abs=1e-9)
    assert remainder((-2.5, 0.0), (1.0,))[0] == pytest.approx(3e5 - 5e5)


def test_an_interpolated_input_drives_its_row():
    found = analyse(model_of(lambda x, u, p: (x[1], u[0] - x[0]), hold="foh"))
    assert found.driven == (1,)
    assert not found.nonlinear


def test_a_held_input_within_limits_does_not_drive_a_row_but_an_interpolated_one_does():
    def derivative(x, u, p):
        return limited(u[0]) - x[0], limited(u[0]) + x[0]

    assert analyse(model_of(derivative)).driven == ()
    assert analyse(model_of(derivative, hold="foh")).driven == (0, 1)


def test_what_parameters_fix_is_worked_out_once():
    def derivative(x, u, p):
        gain = math.exp(p[0]) / (p[0] + p[1])
        return gain * abs(x[0]) + gain * u[0] - x[1] / (p[0] + p[1]), -gain * x[1]

    text = analyse(model_of(derivative)).program
    once, each_time = text.split("def remainder")
    assert once.count("exp") == once.count("1.0 /") == 1
    assert "exp" not in each_time
    assert "/" not in each_time


def test_an_output_that_branches_leaves_the_equations_as_they_are():
    model = model_of(
        lambda x, u, p: (-p[0] * x[0], -x[1]), output=lambda x, u, p: (x[0] if x[0] > 0 else 0.0,)
    )
    found = analyse(model)
    assert tuple(sorted(found.coefficients)) == ((0, 0), (1, 1))
    assert found.calls == {"output"}


def test_the_actuator_is_linear_but_for_its_mechanics():
    model = actuator()
    found = analyse(model)
    assert [model.state_names[i] for i in found.driven] == ["omega", "z"]
