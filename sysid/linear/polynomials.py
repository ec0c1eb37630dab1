"""Matrix polynomials in the delay q^-1: roots, stability, and moving roots inside the circle.

A polynomial P(q) = P_0 + P_1 q^-1 + ... is an array (n_lags + 1, rows, columns): the first index
is the lag.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg
from scipy.linalg import lapack

from sysid.arrays import ComplexArray, FloatArray

# A noise model that forgets more slowly than this needs thousands of samples to start.
NOISE_RADIUS = 0.999
# A reflected pole stays this far inside, so that a pole found on the circle becomes stable.
POLE_RADIUS = 0.9999


def poles(A: FloatArray) -> ComplexArray:
    """Roots of det A(q), complex (n_lags * n_outputs,), largest first.

    A: (n_lags + 1, n_outputs, n_outputs) with A[0] the identity.
    """
    roots = _eigenvalues(companion(A)) if len(A) > 1 else np.zeros(0, dtype=np.complex128)
    return roots[np.argsort(-np.abs(roots), kind="stable")]


def companion(A: FloatArray) -> FloatArray:
    """Transition matrix of A(q) y = w for the state (y(t-1), ..., y(t-n_lags))."""
    lags, q = len(A) - 1, A.shape[1]
    F = np.eye(lags * q, k=-q)
    F[:q] = -np.hstack(list(A[1:])) if lags else F[:q]
    return F


def reflect_noise(c: FloatArray) -> FloatArray:
    """C(q) with the same spectrum and all roots inside the unit circle.

    c: (nc,), the coefficients after the leading 1. Roots outside are mirrored, and none is left
    beyond ``NOISE_RADIUS``. The predictor is stable only with C's roots inside.
    """
    return _with_roots(c, lambda size: np.minimum(1.0 / size, NOISE_RADIUS))


def limit_noise(c: FloatArray) -> FloatArray:
    """C(q) with roots beyond ``NOISE_RADIUS`` moved back to it along their direction."""
    return _with_roots(c, lambda size: np.full_like(size, NOISE_RADIUS))


def _with_roots(c: FloatArray, radius: Callable[[FloatArray], FloatArray]) -> FloatArray:
    roots = np.roots(np.concatenate(([1.0], c)))
    size = np.maximum(np.abs(roots), np.finfo(float).tiny)
    if len(roots) == 0 or size.max() <= NOISE_RADIUS:
        return c
    moved = np.where(size > NOISE_RADIUS, roots / size * radius(size), roots)
    result: FloatArray = np.real(np.poly(moved))[1:]
    return result


def reflect_poles(A: FloatArray) -> FloatArray:
    """A(q) with its unstable poles mirrored in the unit circle.

    An unstable pole p becomes 1/conj(p), or ``POLE_RADIUS`` in size if that is less. Stable ones
    keep their directions among the outputs too. Entries of A that were zero may change.
    """
    if not np.any(np.abs(poles(A)) >= 1.0):
        return A
    lags, q = len(A) - 1, A.shape[1]
    T, Z = scipy.linalg.schur(companion(A))
    # What comes first in a Schur form keeps its directions when the rest changes.
    stable = np.concatenate([np.full(b.stop - b.start, size < 1.0) for b, size in _blocks(T)])
    T, Z = lapack.dtrsen(stable, T, Z, job="N")[:2]
    for block, size in _blocks(T):
        if size >= 1.0:
            T[block, block] *= min(1.0 / size, POLE_RADIUS) / size
    F = Z @ T @ Z.T
    # The state is no longer a list of past outputs: read the recursion off those it produces.
    produced = [np.eye(q, lags * q, k=(lags - 1) * q)]
    for _ in range(lags):
        produced.append(produced[-1] @ F)
    past = np.linalg.solve(np.vstack(produced[:lags]).T, -produced[lags].T).T
    # Oldest first there, most recent first here.
    return np.concatenate((A[:1], past.reshape(q, lags, q).transpose(1, 0, 2)[::-1]))


def _blocks(T: FloatArray) -> list[tuple[slice, float]]:
    """The diagonal blocks of a real Schur form, a pole or a conjugate pair, and their size."""
    found, start = [], 0
    while start < len(T):
        pair = start + 1 < len(T) and T[start + 1, start] != 0.0
        block = slice(start, start + 1 + pair)
        found.append((block, float(np.abs(np.linalg.eigvals(T[block, block])).max())))
        start = block.stop
    return found


def _eigenvalues(matrix: FloatArray) -> ComplexArray:
    return np.linalg.eigvals(matrix).astype(np.complex128)
