"""What a model's functions may be made of: each compiles and follows SciPy."""

from __future__ import annotations

import math
import types
from pathlib import Path

import numpy as np
import pytest

from sysid import (
    BatchSimulator,
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    State,
)
from tests.soak import mostly_soak
from tests.sysid.reference import simulate as reference
from tests.sysid.support import blank, normalised_rms, prbs

STIFFNESS = 30.0


def one_state(x, u, p):
    return (p[0] * (1.0 - x[0]),)


def saturated(value, limit):
    if value > limit:
        return limit
    return max(value, -limit)


def spring(x, p):
    return -STIFFNESS * saturated(x, p)


def helpers(x, u, p):
    return x[1], spring(x[0], 0.5) - p[0] * x[1] + u[0]


def mathematics(x, u, p):
    size = abs(x[0]) if x[0] < 0.0 else 2.0 * x[0]
    return (
        math.sin(p[0] * x[1]) + math.exp(-x[0] * x[0]) - x[0] - 0.1 * size,
        math.tanh(u[0]) - math.sqrt(abs(x[1]) + 1.0) * x[1] ** 3 + (u[0] if u[0] > 0.0 else 0.0),
    )


def powers(x, u, p):
    return (
        x[1] - abs(x[0]) ** (p[0] - 1.0) * x[0] + math.log(1.0 + x[1] * x[1]),
        u[0] - 1.7 ** x[1] - math.pow(abs(x[0]), 0.5 * p[0]) - x[1] ** 3.0,
    )


def times(a, b):
    return a * b


def closure(factor, inner):
    def derivative(x, u, p, shift=0.25):
        return inner(x[1], factor) + shift, u[0] - p[0] * x[1] * abs(x[1]) ** 0.5 - x[0]

    return derivative


toolbox = types.ModuleType("toolbox")
toolbox.times = times
toolbox.FACTOR = 0.7


def through_a_module(x, u, p, product=times):
    return toolbox.times(x[1], toolbox.FACTOR), product(u[0], 0.7) - p[0] * x[1] - x[0]


def double(x, u, p):
    a, b = times(x[0], 2.0), times(x[1], 2.0)
    return (a * b + p[0] * u[0], a, b)


MODELS = {
    "mathematics and conditions": {"derivative": mathematics},
    "one_state_no_inputs": {"derivative": one_state, "states": 1, "inputs": 0},
    "powers and logarithms": {"derivative": powers},
    "closure, defaults and powers": {"derivative": closure(1.5, times)},
    "module, a helper as a default": {"derivative": through_a_module},
    "helpers and output": {"derivative": helpers, "output": double, "outputs": 3},
}


def build(name, derivative, states=2, inputs=1, output=None, outputs=None):
    state_list = tuple(State(f"x{i}", "1", 0.2 * (i + 1)) for i in range(states))
    outputs = (
        tuple(Output(s.name, "1") for s in state_list)
        if outputs is None
        else tuple(Output(f"o{i}", "1") for i in range(outputs))
    )
    return ProcessModel(
        name=name,
        states=state_list,
        inputs=tuple(Input(f"u{i}", "1", "foh") for i in range(inputs)),
        outputs=outputs,
        parameters=(Parameter("p", "1", 1.3, 0.5, 2.0),),
        derivative=derivative,
        output=output,
    )


@pytest.mark.parametrize("name", mostly_soak(list(MODELS)))
def test_it_compiles_and_follows_scipy(name):
    model = build(name, **MODELS[name])
    rng = np.random.default_rng(1)
    inputs = np.column_stack([prbs(rng, 60, -2, 2) for _ in model.inputs] or [np.empty((60, 0))])
    record = blank(model, inputs, 0.05)
    vectors = np.array([[0.6], [1.3], [1.9]])
    found = BatchSimulator(model, accuracy=1e-8).trajectories(vectors, record)
    exact = np.array([reference(model, p, record) for p in vectors])
    # Jumps and kinks between steps cost some of the accuracy asked for.
    assert normalised_rms(found, exact).max() < 1e-3
    assert np.ptp(exact, axis=1).min() > 1e-3


def on_a_list(x, u, p):
    terms = [str(x[0]), "1.0"]
    return (float(terms[0]), -p[0] * x[1])


class Gain:
    factor = 2.0


GAIN = Gain()


def on_an_object(x, u, p):
    return (GAIN.factor * x[1], -p[0] * x[1] if x[1] > 0.0 else 0.0)


def clipped(x, u, p):
    return (np.clip(x[1], -1.0, 1.0), -p[0] * x[1])


@pytest.mark.parametrize("derivative", [on_a_list, on_an_object, clipped])
def test_a_function_that_cannot_be_compiled_says_so(derivative):
    model = build("odd", derivative)
    with pytest.raises(ModelError) as caught:
        BatchSimulator(model).trajectories(np.array([[1.3]]), blank(model, np.zeros((10, 1)), 0.05))
    text = str(caught.value)
    assert text.startswith("model odd: its functions cannot be compiled: ")
    assert "They may use floats, tuples, math functions" in text
    assert "Traceback" not in text
    assert len(text) < 700
    assert f"{Path(__file__).name}:" in text
    if derivative is clipped:
        line = clipped.__code__.co_firstlineno + 1
        assert f":{line}: clip is not understood" in text and "(use min and max)" in text
