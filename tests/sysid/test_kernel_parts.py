"""The pieces the kernels are made of: matrix functions, vector functions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from sysid import BatchSimulator, Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.engine import vector_math as _vector_math
from sysid.engine.batch_kernel import BatchKernel
from sysid.engine.phi import scheme_matrices
from sysid.engine.scheme import LANES
from sysid.engine.structure import analyse


def tables(pattern):
    """Arguments of ``scheme_matrices`` for a pattern that is its own closure."""
    m = len(pattern)
    triples = [
        (pattern.index((i, k)), pattern.index((k, j)), pattern.index((i, j)))
        for i, k in pattern
        for row, j in pattern
        if row == k
    ]
    return np.array(pattern), np.array(triples), np.arange(4 * m).reshape(4, m)


def scheme(a, h):
    """Q, F, G, H, from the exponential of a block matrix."""
    n = len(a)
    blocks = np.zeros((4 * n, 4 * n))
    blocks[:n, :n] = h * a
    for k in range(3):
        blocks[k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
    whole = expm(blocks)
    half = np.zeros((2 * n, 2 * n))
    half[:n, :n], half[:n, n:] = h / 2.0 * a, np.eye(n)
    phi = [h * whole[:n, k * n : (k + 1) * n] for k in (1, 2, 3)]
    return (
        h / 2.0 * expm(half)[:n, n:],
        phi[0],
        2.0 * phi[1] - 4.0 * phi[2],
        4.0 * phi[2] - phi[1],
    )


@pytest.mark.parametrize("triangular", [False, True])
def test_matrix_functions_agree_with_the_exponential_of_a_block_matrix(triangular):
    """Lanes of very different size side by side."""
    rng = np.random.default_rng(0)
    n = 5
    pattern = [(i, j) for i in range(n) for j in range(n) if i <= j or not triangular]
    steps = 3e-4 * rng.uniform(0.5, 2.0, LANES)
    lanes = np.zeros((LANES, n, n))
    for lane in range(LANES):
        size = 10.0 ** rng.uniform(0.0, 5.0)
        full = size * (rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-1, 1, (n, 1)) - np.eye(n))
        lanes[lane] = np.triu(full) if triangular else full
    stored = np.array([[a[entry] for a in lanes] for entry in pattern])
    found = np.empty((4 * len(pattern), LANES))
    scheme_matrices(stored, steps, *tables(pattern), found)
    for lane in range(LANES):
        for k, exact in enumerate(scheme(lanes[lane], steps[lane])):
            got = np.zeros((n, n))
            for entry, value in zip(pattern, found[k * len(pattern) :, lane], strict=False):
                got[entry] = value
            np.testing.assert_allclose(got, exact, atol=3e-11 * np.abs(exact).max())


def test_a_lane_that_is_not_finite_gives_not_a_number_and_disturbs_no_other():
    pattern = [(0, 0), (0, 1), (1, 1)]
    stored = np.tile([[-1.0], [2.0], [-3.0]], LANES)
    clean, found = np.empty((12, LANES)), np.empty((12, LANES))
    scheme_matrices(stored.copy(), np.ones(LANES), *tables(pattern), clean)
    stored[1, 2], stored[0, 5], stored[2, 7] = math.inf, math.nan, 1e200
    scheme_matrices(stored, np.ones(LANES), *tables(pattern), found)
    assert np.isnan(found[:, [2, 5, 7]]).all()
    others = np.delete(np.arange(LANES), [2, 5, 7])
    np.testing.assert_array_equal(found[:, others], clean[:, others])


@pytest.mark.parametrize(
    ("name", "low", "high", "tolerance"),
    [
        ("exp", -700.0, 700.0, 1e-15),
        ("exp", -1.0, 1.0, 1e-15),
        ("tanh", -25.0, 25.0, 1e-15),
        ("tanh", -1e-6, 1e-6, 1e-15),
        ("sin", -1e5, 1e5, 1e-15),
        ("cos", -1e5, 1e5, 1e-15),
        ("log", 0.0, 1e9, 1e-15),
        ("log", 0.9, 1.1, 1e-15),
        ("log", 0.0, 1e-300, 1e-15),
    ],
)
def test_vector_functions_are_as_exact_as_the_library(name, low, high, tolerance):
    values = np.random.default_rng(1).uniform(low, high, 3000)
    found = np.array([getattr(_vector_math, name)(v) for v in values])
    exact = np.array([getattr(math, name)(v) for v in values])
    # Near a zero of sine and cosine the argument's own rounding is what counts.
    size = np.maximum(np.abs(exact), 1e-2 if name in ("sin", "cos") else 0.0)
    assert np.max(np.abs(found - exact) / size) < tolerance


def test_powers_are_as_exact_as_the_library():
    rng = np.random.default_rng(2)
    x, y = np.exp(rng.uniform(-8.0, 8.0, 3000)), rng.uniform(-5.0, 5.0, 3000)
    found = np.array([_vector_math.pow(a, b) for a, b in zip(x, y, strict=True)])
    np.testing.assert_allclose(found, x**y, rtol=1e-14)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (0.0, 0.5, 0.0), (0.0, 0.0, 1.0), (0.0, -1.5, math.inf), (-2.0, 3.0, -8.0),
        (-2.0, -2.0, 0.25), (-2.0, 0.5, math.nan), (math.inf, 0.5, math.inf),
        (1e300, 2.0, math.inf), (math.nan, 2.0, math.nan), (2.0, math.nan, math.nan),
    ],
)  # fmt: skip
def test_powers_at_the_edges(x, y, expected):
    assert _vector_math.pow(x, y) == pytest.approx(expected, rel=1e-14, nan_ok=True)


def test_logarithms_at_the_edges():
    found = [_vector_math.log(x) for x in (0.0, -1.0, math.inf, 1.0)]
    assert found == pytest.approx([-math.inf, math.nan, math.inf, 0.0], nan_ok=True)


@pytest.mark.parametrize("name", ["exp", "tanh", "sin", "cos", "log"])
def test_vector_functions_pass_not_a_number_on(name):
    assert math.isnan(getattr(_vector_math, name)(math.nan))


@pytest.mark.soak
def test_parts_that_are_alike_share_their_matrices_and_run_as_each_alone():
    """Two oscillators of the same parameters, each driven by an input of its own."""
    rng = np.random.default_rng(0)
    inputs, values = rng.standard_normal((40, 2)), np.array([30.0, 4.0, 0.5])
    record, pair = Dataset(inputs, np.zeros((40, 2)), 0.02), oscillators(2)
    both = BatchSimulator(pair).trajectories(values, record, 3, np.zeros((1, 4)))[0]
    for k in range(2):
        own = Dataset(inputs[:, [k]], np.zeros(40), 0.02)
        alone = BatchSimulator(oscillators(1)).trajectories(values, own, 3, np.zeros((1, 2)))[0]
        np.testing.assert_array_equal(both[:, k], alone[:, 0])
    one, two = (BatchKernel(m, analyse(m)) for m in (oscillators(1), pair))
    assert two.n_entries == one.n_entries > 0


def oscillators(count):
    """x'' = w (u - x) - d x' - c x^3, so many times beside one another."""

    def derivative(x, u, p):
        rows = []
        for k in range(count):
            place, speed = x[2 * k], x[2 * k + 1]
            force = p[0] * (u[k] - place) - p[1] * speed - p[2] * place * place * place
            rows += [speed, force]
        return tuple(rows)

    return ProcessModel(
        name=f"oscillators{count}",
        states=tuple(State(f"{kind}{k}", "1") for k in range(count) for kind in "xv"),
        inputs=tuple(Input(f"u{k}", "1") for k in range(count)),
        outputs=tuple(Output(f"x{k}", "1") for k in range(count)),
        parameters=tuple(Parameter(name, "1", 1.0, 0.1, 100.0) for name in ("w", "d", "c")),
        derivative=derivative,
        output=lambda x, u, p: tuple(x[2 * k] for k in range(count)),
    )
