"""The polynomials of A(q) y = B(q) u + offset + C(q) e: coefficients, poles, running through time.

A (n_lags + 1, q, q) and B (n_lags + 1, q, m) are full, C (nc + 1, q) is a diagonal; by lag.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
from scipy.linalg import blas, lapack

from sysid.arrays import ComplexArray, FloatArray, IntArray
from sysid.problem.model import ModelError

# A number for all entries, or a table with one for each.
Order = int | Sequence[int] | Sequence[Sequence[int]] | IntArray

_POLE_RADIUS = 0.9999  # largest of a reflected pole, so that one on the circle becomes stable
_CIRCLE = 1.0 - 1e-12  # from here on a pole is on the circle but for rounding


class Layout:
    """Which coefficients a model of q outputs and m inputs has, of the orders of ``ARMAX``.

    free: (q, q + m + 2, n_lags + 1), true for a coefficient, by equation, signal that it weighs
    (minus the outputs, inputs, 1, noise) and its lag; the parameter vector has this order. lag:
    rows of a record that have no complete past. Raises ModelError for orders that make no sense.
    """

    def __init__(self, q: int, m: int, *, offset: bool, na: Order, nb: Order, nc: Order, nk: Order):
        self.na, self.nb = order_table("na", na, (q, q)), order_table("nb", nb, (q, m))
        self.nc, self.nk = order_table("nc", nc, (q,)), order_table("nk", nk, (q, m))
        self.offset = bool(offset)
        first = np.column_stack((np.ones((q, q)), self.nk, np.zeros(q), np.ones(q)))
        counts = np.column_stack((self.na, self.nb, np.full(q, self.offset), self.nc))
        lag = np.arange(int((first + counts).max()))
        self.free = (first[..., None] <= lag) & (lag < (first + counts)[..., None])
        for row in np.flatnonzero(counts.sum(axis=1) == 0):
            raise ModelError(
                f"the equation of output {row} has no coefficients: "
                "give na, nb or nc above 0, or offset=True"
            )
        reach = np.where(counts > 0, first + counts, 1).max(axis=0).astype(int)
        self._sizes = int(reach[:q].max()), int(reach[q:-1].max()), int(reach[-1])
        self.lag = max(self._sizes[:2]) - 1

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coefficients: ``a2[0,1]`` weighs y_1(t-2) in the equation of y_0."""
        q, m = self.nb.shape
        names = [f"a{{1}}[{{0}},{j}]" for j in range(q)] + [f"b{{1}}[{{0}},{j}]" for j in range(m)]
        names += ["offset[{0}]", "c{1}[{0}]"]
        return tuple(names[signal].format(row, lag) for row, signal, lag in np.argwhere(self.free))

    def polynomials(self, theta: FloatArray, leading: float = 1.0) -> tuple[FloatArray, ...]:
        """A, B, C and offset (q,) of a parameter vector; leading: the diagonal of A_0 and C_0."""
        q, table = len(self.na), np.zeros(self.free.shape)
        table[self.free] = theta
        table = table.transpose(2, 0, 1)
        table[0, :, :q], table[0, :, -1] = leading * np.eye(q), leading
        a, b, c = self._sizes
        return table[:a, :, :q], table[:b, :, q:-2], table[:c, :, -1], table[0, :, -2]


def order_table(name: str, order: Order, shape: tuple[int, ...]) -> IntArray:
    """An order as whole numbers of a shape; ModelError for one that makes no sense."""
    try:
        values = np.asarray(order)
    except ValueError:
        raise ModelError(f"{name} is ragged: give one number or a table of shape {shape}") from None
    if values.dtype.kind not in "iu":
        raise ModelError(f"{name} is {order!r}; it must be a whole number or a table of them")
    if values.ndim and values.shape != shape:
        each = "one per output"
        meaning = {"na": "outputs x outputs", "nc": each, "nf": each}.get(name, "outputs x inputs")
        raise ModelError(f"{name} has shape {values.shape}; give one number, or {meaning}: {shape}")
    if np.any(values < 0):
        raise ModelError(f"{name} is {order!r}; it must be 0 or more")
    return np.broadcast_to(values.astype(np.int64), shape)


def filtered(P: FloatArray, x: FloatArray) -> FloatArray:
    """P(q) x where its past is complete, (n - n_lags, rows); x: (n, columns)."""
    n = len(x) - len(P) + 1
    terms = [x[len(P) - 1 - lag :][:n] @ matrix.T for lag, matrix in enumerate(P)]
    return np.asarray(np.sum(terms, axis=0), dtype=np.float64)


def all_pole(f: FloatArray, columns: FloatArray, begins: Sequence[int] = ()) -> FloatArray:
    """Columns (n, k) filtered by 1/F(q), from zero at the first row and at each of ``begins``.

    f: (nf,), F's coefficients after the leading 1.

    >>> all_pole(np.array([-0.5]), np.ones((3, 1)))[:, 0]
    array([1.  , 1.5 , 1.75])
    """
    # scipy.signal, which has a filter, takes half a second to load.
    bands = np.ones((len(f) + 1, len(columns)), order="F")
    bands[1:] = f[:, None]
    for begin in begins:
        for lag in range(1, len(f) + 1):
            bands[lag, max(begin - lag, 0) : begin] = 0.0
    filtered, _ = lapack.dtbtrs(bands, columns, uplo="L", diag="U")
    return np.asarray(filtered, dtype=np.float64)


def innovations(
    A: FloatArray, C: FloatArray, drive: FloatArray, past: FloatArray, outputs: Any = np.nan
) -> tuple[FloatArray, FloatArray]:
    """Outputs with lost samples (NaN) predicted, and one-step prediction errors, each (n, q).

    drive: (n, q), B(q) u + offset; past: outputs before the first row, n_lags or more, without
    noise. Where an output is lost its error is zero. The recursion is a triangular banded system,
    solved by forward substitution: a loop over time at the speed of compiled code.
    """
    if not len(drive):
        return drive, drive
    # Unknown is the output where it was lost, else minus the error.
    lost, q = np.broadcast_to(np.isnan(outputs), drive.shape), len(A[0])
    measured, noise = np.where(lost, 0.0, outputs), C[:, None, :] * np.eye(q)
    # Columns of the band matrices, each from its diagonal down.
    bands = np.zeros((2, q, max(len(A), len(C)) * q))
    for P, band in ((A, bands[0]), (noise, bands[1])):
        for j in range(q):
            band[j, : len(P) * q - j] = P.reshape(-1, q)[j:, j]
    matrix = np.where(lost[..., None], bands[0], bands[1]).reshape(lost.size, -1).T
    # What an unstable model overflows to shows in the result.
    with np.errstate(all="ignore"):
        right = drive - filtered(A, np.vstack((past, measured)))[-len(drive) :]
        unknown = blas.dtbsv(len(matrix) - 1, matrix, right.ravel(), lower=1, diag=1)
    unknown = unknown.reshape(lost.shape)
    return np.where(lost, unknown, measured), np.where(lost, 0.0, -unknown)


def poles(A: FloatArray) -> ComplexArray:
    """Roots of det A(q), complex (n_lags * q,), largest first."""
    roots = np.linalg.eigvals(_companion(A)).astype(np.complex128)
    return roots[np.argsort(-np.abs(roots), kind="stable")]


def reflect_poles(A: FloatArray) -> FloatArray:
    """A(q) with its unstable poles p mirrored to 1/conj(p); the others keep their directions."""
    if not np.any(np.abs(poles(A)) >= 1.0):
        return A
    lags, q = len(A) - 1, A.shape[1]
    T, Z = scipy.linalg.schur(_companion(A))
    # What comes first in a Schur form keeps its directions when the rest changes.
    T, Z = lapack.dtrsen(_sizes(T) < _CIRCLE, T, Z, job="N")[:2]
    size, pairs = np.maximum(_sizes(T), _CIRCLE), np.tril(T, -1) != 0.0
    outside = (np.eye(len(T), dtype=bool) | pairs | pairs.T) & (size > _CIRCLE)
    T = np.where(outside, T * np.minimum(1.0 / size, _POLE_RADIUS) / size, T)
    # The state is no longer a list of past outputs: read the recursion off those it produces.
    outputs = [np.eye(q, lags * q, k=(lags - 1) * q)]
    for _ in range(lags):
        outputs.append(outputs[-1] @ Z @ T @ Z.T)
    past = np.linalg.solve(np.vstack(outputs[:lags]).T, -outputs[lags].T).T
    # Oldest first there, most recent first here.
    return np.concatenate((A[:1], past.reshape(q, lags, q).transpose(1, 0, 2)[::-1]))


def _companion(A: FloatArray) -> FloatArray:
    """Transition matrix of A(q) y = w for the state (y(t-1), ..., y(t-n_lags))."""
    lags, q = len(A) - 1, A.shape[1]
    F = np.eye(lags * q, k=-q)
    F[:q] = -A[1:].transpose(1, 0, 2).reshape(q, lags * q)[: len(F)]
    return F


def _sizes(T: FloatArray) -> FloatArray:
    """Of the poles on the diagonal of a real Schur form; those of a conjugate pair are alike."""
    squares, pairs = np.diag(T) ** 2, np.diag(T, -1) * np.diag(T, 1)
    squares[:-1] -= pairs
    squares[1:] -= pairs
    return np.sqrt(squares)
