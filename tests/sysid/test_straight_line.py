"""Runs of assignments written as instructions, against Python that runs the same text."""

import gc
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from sysid.engine import vector_math
from sysid.engine.straight_line import intrinsics, outlined

PARTS = """
def mixed(x, u):
    a = x[0] * u[1] - 3
    b = -a if a > x[1] else a / 2
    return (a + b, b ** 3) + (max(a, b, 0.5),)

def kernel(X, rows, n, flag):
    total = 0.0
    level = 0
    for k in range(n):
        x = X[k]
        y = rows[k, 1]
        p, q, r = mixed((x, y), (total, 1.5))
        X[k] = p * q
        X[k] += k / 2
        rows[k, 0] = math.tanh(q) - min(r, y)
        total += math.sqrt(abs(p)) if p == p and not flag else r ** -2
        level += 2 * k - 1
        small = abs(q) < 1.0 or x <= y and total != 2.0
        last = 1.0 if small else 0.0
        rows[k, 1] = last
        if level > 3:
            total -= last
            level = -level
    return total, level, small, q
"""


def _compiled(text: str, name: str, module: Any) -> Callable[..., Any]:
    scope: dict[str, Any] = {"math": module}
    content = outlined(text, scope)
    runs = intrinsics(content, dict(scope))
    assert runs, "nothing was outlined"
    exec(compile(content, "<test>", "exec"), scope)
    scope |= runs
    function: Callable[..., Any] = njit(error_model="numpy")(scope[name])
    return function


def _plain(text: str, name: str) -> Callable[..., Any]:
    scope: dict[str, Any] = {"math": math}
    exec(text, scope)
    function: Callable[..., Any] = scope[name]
    return function


@pytest.mark.parametrize("flag", [False, True])
def test_a_run_does_what_python_does(flag):
    rng = np.random.default_rng(4)
    ours, python = _compiled(PARTS, "kernel", math), _plain(PARTS, "kernel")
    for _ in range(20):
        X, rows = rng.normal(size=6), rng.normal(size=(6, 2))
        given, expected = (X.copy(), rows.copy()), (X.copy(), rows.copy())
        assert ours(*given, 6, flag) == pytest.approx(python(*expected, 6, flag), rel=1e-12)
        for one, other in zip(given, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12)


NAMES = ("a", "b", "c")
NUMBERS = st.floats(-3, 3).map(lambda x: repr(round(x, 3))) | st.integers(-3, 3).map(str)


def _expressions(parts: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    two = st.tuples(parts, parts)
    return (
        st.tuples(st.sampled_from("+-*"), two).map(lambda t: f"({t[1][0]} {t[0]} {t[1][1]})")
        | st.tuples(st.sampled_from(["max", "min"]), two).map(
            lambda t: f"{t[0]}({', '.join(t[1])})"
        )
        | st.tuples(two, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), two).map(
            lambda t: f"({t[0][0]} if {t[2][0]} {t[1]} {t[2][1]} else {t[0][1]})"
        )
        | st.tuples(parts, st.integers(0, 3)).map(lambda t: f"(({t[0]}) ** {t[1]})")
        | parts.map(lambda text: f"(-({text}))")
        | parts.map(lambda text: f"abs({text})")
    )


EXPRESSIONS = st.recursive(st.sampled_from(NAMES) | NUMBERS, _expressions, max_leaves=8)
LINES = st.lists(st.tuples(st.sampled_from(NAMES), EXPRESSIONS), min_size=4, max_size=6)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(LINES)
def test_any_run_does_what_python_does(lines):
    text = ["def run(X, n):", "    a, b, c = X[0], X[1], X[2]", "    for k in range(n):"]
    text += [f"        {name} = 1.0 * {value} + 0.1 * {name}" for name, value in lines]
    text += ["    return a, b, c", ""]
    ours, python = (make("\n".join(text), "run") for make in (_of_math, _plain))
    X = np.array([0.3, -1.2, 2.0])
    np.testing.assert_allclose(ours(X, 2), python(X.tolist(), 2), rtol=1e-9, atol=1e-9)


def _of_math(text: str, name: str) -> Callable[..., Any]:
    return _compiled(text, name, math)


def test_what_is_not_a_number_chooses_as_in_python():
    text = """
def kernel(X):
    a = max(X[0], X[1])
    b = min(X[0], X[1])
    c = 1.0 if X[0] != X[0] else 2.0
    d = 1.0 if not X[0] < 0.0 else 2.0
    X[2] = a
    X[3] = b
    for k in range(1):
        X[4] = c
        X[5] = d
"""
    ours, python = _of_math(text, "kernel"), _plain(text, "kernel")
    for first, second in ((math.nan, 1.0), (1.0, math.nan), (0.0, -0.0), (math.inf, 1.0)):
        given, expected = (np.array([first, second, 0, 0, 0, 0]) for _ in range(2))
        ours(given)
        python(expected)
        np.testing.assert_array_equal(given, expected)


def test_functions_of_other_modules_are_called():
    text = """
def kernel(X):
    for k in range(3):
        a = math.exp(X[k])
        b = math.pow(a, 1.5)
        c = math.floor(b)
        X[k] = math.sin(a) + b - c
"""
    X = np.array([0.1, -2.0, 1.3])
    expected = X.tolist()
    _plain(text, "kernel")(expected)
    _compiled(text, "kernel", vector_math)(X)
    np.testing.assert_allclose(X, expected, rtol=1e-12)


def _let_others_work(phase, info):
    time.sleep(0.0)


def test_threads_may_do_it_at_once():
    """Python's parser fails where another thread parses while it collects garbage."""
    threshold = gc.get_threshold()
    gc.callbacks.append(_let_others_work)
    gc.set_threshold(100)
    try:
        with ThreadPoolExecutor(4) as pool:
            texts = list(pool.map(lambda _: outlined(PARTS * 4, {"math": math}), range(8)))
    finally:
        gc.callbacks.remove(_let_others_work)
        gc.set_threshold(*threshold)
    assert len(set(texts)) == 1
