"""Matrices of the integration scheme, for lanes of small matrices of one pattern.

phi_1(Z) = (e^Z - 1)/Z, phi_2 = (phi_1 - 1)/Z, phi_3 = (phi_2 - 1/2)/Z. A Taylor series of
phi_3 at Z / 2^s, then doubling by phi_k(2Z) = 2^-k (e^Z phi_k(Z) + sum_j phi_j(Z) / (k-j)!)
(Skaflestad & Wright, "The scaling and modified squaring method for matrix functions related to
the exponential", Applied Numerical Mathematics 59, 2009).

Only entries that can differ from zero are kept: a matrix is an array (entries, lanes). Each lane
doubles as often as its own norm asks for, so that what it gets does not depend on the others.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from sysid.arrays import FloatArray, IntArray
from sysid.engine.intrinsics import from_bits, multiply_add, shared, to_bits, wide_vectors
from sysid.engine.scheme import LANES, work_area

_SMALL = 0.5  # norm at which the series takes over
_TERMS = 10  # leaves 0.5^10/13! = 2e-13
_HUGE = 1e18  # a norm at which nothing sensible is left


@njit(error_model="numpy")
def _multiply(a: FloatArray, b: FloatArray, c: FloatArray, triples: IntArray) -> None:
    """C = A B: for each triple (i, j, k), entry i of A times entry j of B adds to entry k."""
    wide_vectors()
    c[:] = 0.0
    for t in range(triples.shape[0]):
        multiply_add(c, triples[t, 2], a, triples[t, 0], b, triples[t, 1])


@njit(error_model="numpy")
def _root(x: float) -> float:
    """A power of two near the square root of a positive number."""
    exponent = (to_bits(x) >> 52) - 1023
    root: float = from_bits((((exponent + 1) >> 1) + 1023) << 52)
    return root


@njit(error_model="numpy")
def _balance(  # noqa: PLR0912  (likewise)
    a: FloatArray, entries: IntArray, d: FloatArray, row: FloatArray, column: FloatArray
) -> None:
    """Scale A to D^-1 A D, D of powers of two, so that rows and columns weigh alike.

    row, column: (lanes,), to work in.
    """
    wide_vectors()
    d[:] = 1.0
    for _ in range(4):
        balanced = True
        for i in range(d.shape[0]):
            row[:] = 0.0
            column[:] = 0.0
            for k in range(entries.shape[0]):
                if entries[k, 0] == i and entries[k, 1] != i:
                    for lane in range(LANES):
                        row[lane] += abs(a[k, lane])
                if entries[k, 1] == i and entries[k, 0] != i:
                    for lane in range(LANES):
                        column[lane] += abs(a[k, lane])
            for lane in range(LANES):
                linked = row[lane] > 0.0 and column[lane] > 0.0
                factor = _root(row[lane] / column[lane]) if linked else 1.0
                d[i, lane] *= factor
                row[lane] = 1.0 / factor
                column[lane] = factor
            for lane in range(LANES):
                balanced = balanced and column[lane] == 1.0
            for k in range(entries.shape[0]):
                if entries[k, 0] == i and entries[k, 1] != i:
                    for lane in range(LANES):
                        a[k, lane] *= row[lane]
                if entries[k, 1] == i and entries[k, 0] != i:
                    for lane in range(LANES):
                        a[k, lane] *= column[lane]
        if balanced:
            break


@njit(error_model="numpy")
def _scale(
    a: FloatArray, h: FloatArray, entries: IntArray, total: FloatArray, halvings: FloatArray
) -> int:
    """Scale each lane's A to h A / 2^halvings, small enough for the series; most halvings."""
    wide_vectors()
    norm = np.zeros(LANES)
    whole = np.zeros(LANES)
    for j in range(entries[-1, 1] + 1):
        total[:] = 0.0
        for k in range(entries.shape[0]):
            if entries[k, 1] == j:
                for lane in range(LANES):
                    total[lane] += abs(a[k, lane])
        for lane in range(LANES):
            norm[lane] = max(norm[lane], total[lane] * h[lane])
            whole[lane] += total[lane] * h[lane]  # a maximum may lose what is not a number
    most = 1
    for lane in range(LANES):
        count = 1
        factor = 0.5 if whole[lane] < _HUGE else math.nan
        while norm[lane] * factor > _SMALL:
            factor *= 0.5
            count += 1
        most = max(most, count)
        halvings[lane] = count
        total[lane] = h[lane] * factor
    for k in range(entries.shape[0]):
        for lane in range(LANES):
            a[k, lane] *= total[lane]
    return most


@njit(error_model="numpy")
def _add(p: FloatArray, entries: IntArray, value: float) -> None:
    """Add a multiple of the unit matrix."""
    for k in range(entries.shape[0]):
        if entries[k, 0] == entries[k, 1]:
            for lane in range(LANES):
                p[k, lane] += value


_aligned: Any = njit(work_area)


@shared("void(f8[:, ::1], f8[::1], i8[:, ::1], i8[:, ::1], i8[:, ::1], f8[:, ::1])")
def scheme_matrices(  # noqa: PLR0912  (a function's call copies its arrays' descriptions)
    a: FloatArray,
    h: FloatArray,
    entries: IntArray,
    triples: IntArray,
    places: IntArray,
    X: FloatArray,
) -> None:
    """Q, F, G and H of the scheme (see ``scheme``) for lanes of A.

    a: (m, lanes), overwritten; h: (lanes,), step sizes. entries: (m, 2), row and column of each
    entry of the pattern of e^A, the diagonal among them, in order. triples: (t, 3), see
    ``_multiply``. places: (4, m), the row of X, (rows, lanes), that gets each entry of each
    matrix, or -1. Not-a-number throughout for a lane whose A is not finite.
    """
    wide_vectors()
    m, n = entries.shape[0], entries[-1, 0] + 1
    matrices = _aligned(5 * m * LANES).reshape((5, m, LANES))
    e, p1, p2, p3, w = matrices[0], matrices[1], matrices[2], matrices[3], matrices[4]
    d = _aligned(n * LANES).reshape((n, LANES))
    row, column, halvings = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    _balance(a, entries, d, row, column)
    most = _scale(a, h, entries, row, halvings)
    factorial = 1.0
    for k in range(2, _TERMS + 4):
        factorial *= k
    p3[:] = 0.0
    _add(p3, entries, 1.0 / factorial)
    for k in range(_TERMS + 3, 3, -1):  # Horner: sum of Z^k / (k + 3)!
        factorial /= k
        p3, w = w, p3
        _multiply(a, w, p3, triples)
        _add(p3, entries, 1.0 / factorial)
    _multiply(a, p3, p2, triples)
    _add(p2, entries, 0.5)
    _multiply(a, p2, p1, triples)
    _add(p1, entries, 1.0)
    _multiply(a, p1, e, triples)
    _add(e, entries, 1.0)
    for doubling in range(most - 1, -1, -1):
        if doubling == 0:
            for k in range(m):
                if places[0, k] >= 0:
                    i, j = entries[k, 0], entries[k, 1]
                    for lane in range(LANES):
                        back = h[lane] * d[i, lane] / d[j, lane]
                        X[places[0, k], lane] = 0.5 * back * p1[k, lane]
        _multiply(e, p3, w, triples)
        for k in range(m):
            for lane in range(LANES):
                new = 0.125 * (w[k, lane] + 0.5 * p1[k, lane] + p2[k, lane] + p3[k, lane])
                p3[k, lane] = new if halvings[lane] > doubling else p3[k, lane]
        _multiply(e, p2, w, triples)
        for k in range(m):
            for lane in range(LANES):
                new = 0.25 * (w[k, lane] + p1[k, lane] + p2[k, lane])
                p2[k, lane] = new if halvings[lane] > doubling else p2[k, lane]
        _multiply(e, p1, w, triples)
        for k in range(m):
            for lane in range(LANES):
                new = 0.5 * (w[k, lane] + p1[k, lane])
                p1[k, lane] = new if halvings[lane] > doubling else p1[k, lane]
        _multiply(e, e, w, triples)
        for k in range(m):
            for lane in range(LANES):
                e[k, lane] = w[k, lane] if halvings[lane] > doubling else e[k, lane]
    for k in range(m):
        i, j = entries[k, 0], entries[k, 1]
        for lane in range(LANES):
            back = h[lane] * d[i, lane] / d[j, lane]
            if places[1, k] >= 0:
                X[places[1, k], lane] = p1[k, lane] * back
            if places[2, k] >= 0:
                X[places[2, k], lane] = (2.0 * p2[k, lane] - 4.0 * p3[k, lane]) * back
            if places[3, k] >= 0:
                X[places[3, k], lane] = (4.0 * p3[k, lane] - p2[k, lane]) * back
