"""Difference equations run the plain way, one sample after the other."""

from __future__ import annotations

import numpy as np

from sysid import Dataset


def identity(q):
    return np.eye(q)[None]


# Two outputs of very different size, two inputs, poles at 0.90 +- 0.2i, 0.69 and 0.5 or so.
A = np.array(
    [
        [[1.0, 0.0], [0.0, 1.0]],
        [[-1.4, 0.002], [-30.0, -1.1]],
        [[0.6, -0.001], [10.0, 0.4]],
    ]
)
B = np.array([[[0.0, 0.0], [0.0, 0.0]], [[1.0, 0.3], [50.0, -200.0]], [[0.4, -0.2], [20.0, 80.0]]])
OFFSET = np.array([0.7, -30.0])
C = np.array([[1.0, 1.0], [-0.8, 0.6], [0.3, 0.0]])
SIGMA = np.array([0.2, 20.0])


def recursion(A, B, offset, u, e=None, C=None, past_y=None, past_u=None):
    """Outputs of A(q) y = B(q) u + offset + C(q) e, (n, q).

    past_y (.., q) and past_u (.., m): rows before the first, default zero.
    """
    n, q, m = len(u), A.shape[1], B.shape[2]
    e = np.zeros((n, q)) if e is None else e
    C = np.ones((1, q)) if C is None else C
    lags = max(len(A), len(B), len(C))
    y = np.concatenate((_padded(past_y, lags, q), np.full((n, q), np.nan)))
    u = np.concatenate((_padded(past_u, lags, m), u))
    e = np.concatenate((np.zeros((lags, q)), e))
    for t in range(lags, lags + n):
        value = np.array(offset, dtype=float)
        for lag in range(len(B)):
            value = value + B[lag] @ u[t - lag]
        for lag in range(len(C)):
            value = value + C[lag] * e[t - lag]
        for lag in range(1, len(A)):
            value = value - A[lag] @ y[t - lag]
        y[t] = value
    return y[lags:]


def _padded(past, lags, width):
    rows = np.zeros((lags, width))
    if past is not None:
        rows[lags - len(past) :] = past
    return rows


def forecast(A, B, C, offset, u, y, e, t, k):
    """Outputs of row t from those up to row t-k, which all lags must reach: (q,)."""
    known = y.copy()
    for s in range(t - k + 1, t + 1):
        value = np.array(offset, dtype=float)
        for lag in range(len(B)):
            value = value + B[lag] @ u[s - lag]
        for lag in range(1, len(C)):
            value = value + (C[lag] * e[s - lag] if s - lag <= t - k else 0.0)
        for lag in range(1, len(A)):
            value = value - A[lag] @ known[s - lag]
        known[s] = value
    return known[t]


def telegraph(rng, n, m=2, hold=3):
    """Random binary inputs, each value kept ``hold`` samples; (n, m)."""
    return np.sign(rng.normal(size=(-(-n // hold), m))).repeat(hold, axis=0)[:n]


def record(n=400, seed=0, noise=0.0, C=C, **settings):
    """The system above, at rest before, as a Dataset."""
    rng = np.random.default_rng(seed)
    u = telegraph(rng, n)
    e = noise * SIGMA * rng.normal(size=(n, 2))
    y = recursion(A, B, OFFSET, u, e, C)
    return Dataset(u, y, 0.01, **settings)
