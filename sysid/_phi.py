"""Functions of a small matrix that exponential integration needs.

phi_1(Z) = (e^Z - 1)/Z, phi_2 = (phi_1 - 1)/Z, phi_3 = (phi_2 - 1/2)/Z. A Taylor series of
phi_3 at Z / 2^s, then doubling by phi_k(2Z) = 2^-k (e^Z phi_k(Z) + sum_j phi_j(Z) / (k-j)!)
(Skaflestad & Wright, "The scaling and modified squaring method for matrix functions related to
the exponential", Applied Numerical Mathematics 59, 2009).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sysid.model import FloatArray, IntArray

_SMALL = 0.5  # norm at which the series takes over
_TERMS = 10  # leaves 0.5^10/13! = 2e-13


@njit(error_model="numpy")
def multiply(a: FloatArray, b: FloatArray, c: FloatArray, triples: IntArray) -> None:
    """C = A B, where only the products a[i, k] b[k, j] of the triples (i, k, j) are not zero."""
    c[:] = 0.0
    for t in range(triples.shape[0]):
        i, k, j = triples[t, 0], triples[t, 1], triples[t, 2]
        c[i, j] += a[i, k] * b[k, j]


@njit(error_model="numpy")
def balance(a: FloatArray, d: FloatArray) -> None:
    """Scale A to D^-1 A D, D of powers of two, so that rows and columns weigh alike."""
    n = a.shape[0]
    d[:] = 1.0
    for _ in range(4):
        for i in range(n):
            row = 0.0
            column = 0.0
            for j in range(n):
                if j != i:
                    row += abs(a[i, j])
                    column += abs(a[j, i])
            if row > 0.0 and column > 0.0:
                f = 2.0 ** round(0.5 * math.log2(row / column))
                d[i] *= f
                for j in range(n):
                    a[i, j] /= f
                    a[j, i] *= f


@njit(error_model="numpy")
def phi_matrices(  # noqa: PLR0912  (one function: each call between them would copy arrays)
    a: FloatArray, h: float, triples: IntArray, out: FloatArray
) -> None:
    """For Z = h A: h/2 phi_1(Z/2), then h phi_1(Z), h phi_2(Z), h phi_3(Z), into ``out``.

    a: (n, n), overwritten; out: (4, n, n). triples: (m, 3), see ``multiply``, for the pattern of
    e^a. Not-a-number throughout when A is not finite.
    """
    n = a.shape[0]
    d = np.empty(n)
    balance(a, d)
    norm = 0.0
    for j in range(n):
        column = 0.0
        for i in range(n):
            column += abs(a[i, j]) * h
        norm = max(norm, column)
    if not norm < 1e18:
        out[:] = math.nan
        return
    halvings = 1
    while norm / 2.0**halvings > _SMALL:
        halvings += 1
    z = a * (h / 2.0**halvings)
    e = np.empty((n, n))
    p1 = np.empty((n, n))
    p2 = np.empty((n, n))
    p3 = np.zeros((n, n))
    work = np.empty((n, n))
    factorial = 1.0
    for k in range(2, _TERMS + 4):
        factorial *= k
    for i in range(n):
        p3[i, i] = 1.0 / factorial
    for k in range(_TERMS + 3, 3, -1):  # Horner: sum of Z^m / (m + 3)!
        factorial /= k
        multiply(z, p3, work, triples)
        for i in range(n):
            for j in range(n):
                p3[i, j] = work[i, j]
            p3[i, i] += 1.0 / factorial
    multiply(z, p3, p2, triples)
    for i in range(n):
        p2[i, i] += 0.5
    multiply(z, p2, p1, triples)
    for i in range(n):
        p1[i, i] += 1.0
    multiply(z, p1, e, triples)
    for i in range(n):
        e[i, i] += 1.0
    for doubling in range(halvings):
        if doubling == halvings - 1:
            for i in range(n):
                for j in range(n):
                    out[0, i, j] = 0.5 * h * p1[i, j] * d[i] / d[j]
        multiply(e, p3, work, triples)
        for i in range(n):
            for j in range(n):
                p3[i, j] = 0.125 * (work[i, j] + 0.5 * p1[i, j] + p2[i, j] + p3[i, j])
        multiply(e, p2, work, triples)
        for i in range(n):
            for j in range(n):
                p2[i, j] = 0.25 * (work[i, j] + p1[i, j] + p2[i, j])
        multiply(e, p1, work, triples)
        for i in range(n):
            for j in range(n):
                p1[i, j] = 0.5 * (work[i, j] + p1[i, j])
        multiply(e, e, work, triples)
        for i in range(n):
            for j in range(n):
                e[i, j] = work[i, j]
    for i in range(n):
        for j in range(n):
            back = h * d[i] / d[j]
            out[1, i, j] = p1[i, j] * back
            out[2, i, j] = p2[i, j] * back
            out[3, i, j] = p3[i, j] * back
