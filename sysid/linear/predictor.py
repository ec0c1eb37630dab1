"""A linear model as numbers: free run from inputs, predictions from past outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.linear import recursion

# A response to a start beyond this many times the start is that of an unstable model.
_GROWN = 1e6


@dataclass(frozen=True)
class Predictor:
    """A(q) y = B(q) u + offset + C(q) e, resting at an operating point before every record.

    A: (na + 1, q, q); B: (nb + nk, q, m); offset: (q,); C: (nc + 1, q), the diagonal; the first
    index is the lag. rest_u: (m,), rest_y: (q,). lag: rows of a record with no complete past.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    offset: FloatArray
    rest_u: FloatArray
    rest_y: FloatArray
    lag: int

    def drive(self, inputs: FloatArray) -> FloatArray:
        """What inputs and offset add to each row's equation, (n, q)."""
        return recursion.filtered(self.B, inputs, self._before(self.rest_u)) + self.offset

    def run(self, inputs: FloatArray, initial: FloatArray | None = None) -> FloatArray:
        """Free run, (n, q). initial: (k, q) outputs of the first rows, kept as they are."""
        w, past = self.drive(inputs), self._before(self.rest_y)
        if initial is None:
            return recursion.free_run(self.A, w, past)
        past = np.concatenate((self._before(initial[0]), initial))
        return np.concatenate((initial, recursion.free_run(self.A, w[len(initial) :], past)))

    def follow(self, inputs: FloatArray, measured: FloatArray) -> FloatArray:
        """Free run whose first ``lag`` rows are those that explain the record best, (n, q)."""
        if not self.lag:
            return self.run(inputs)
        first = held(measured[: self.lag], self.rest_y)
        plain = self.run(inputs, first)
        return plain + self._better_start(measured - plain)

    def _better_start(self, residual: FloatArray) -> FloatArray:
        """What a free run gains by starting elsewhere than at its measured first rows, (n, q).

        residual: (n, q), NaN where an output was lost. The outputs depend linearly on the last
        rows before the recursion begins: least squares, each output in units of its residual.
        A model whose response to them grows out of proportion starts where it was measured.
        """
        if len(residual) <= self.lag:
            return np.zeros_like(residual)
        seen = np.isfinite(residual)
        with np.errstate(over="ignore", invalid="ignore"):
            unit = np.sqrt(np.mean(np.where(seen, residual, 0.0)[self.lag :] ** 2, axis=0))
        if not (np.all(np.isfinite(unit)) and np.all(unit > 0.0)):
            return np.zeros_like(residual)
        responses = self._responses(unit, len(residual))
        if not np.all(np.abs(responses) < _GROWN):
            return np.zeros_like(residual)
        move = np.linalg.lstsq(responses[:, seen].T, (residual / unit)[seen])[0]
        better: FloatArray = unit * np.tensordot(move, responses, axes=1)
        return better

    def _responses(self, unit: FloatArray, n: int) -> FloatArray:
        """Free runs from one unit in each value of the rows that the recursion begins with.

        unit: (q,). The result, (n_lags q, n, q), is in these units; without inputs and offset.
        """
        na, q = len(self.A) - 1, len(unit)
        start = self.lag
        found = np.zeros((na * q, n, q))
        for i, response in enumerate(found):
            response[start - 1 - i // q, i % q] = unit[i % q]
            past = np.concatenate((np.zeros((na, q)), response[:start]))
            response[start:] = recursion.free_run(self.A, np.zeros((n - start, q)), past)
        return found / unit

    def ahead(self, inputs: FloatArray, measured: FloatArray, k: int) -> FloatArray:
        """Row t predicted from the outputs up to row t-k and the inputs up to row t; (n, q)."""
        n, w, past = len(measured), self.drive(inputs), self._before(self.rest_y)
        # No noise is read off rows without a complete past.
        known = np.concatenate((past, held(measured[: self.lag], self.rest_y)))
        quiet = np.zeros_like(known)
        y, e = recursion.innovations(
            self.A, self.C, w[self.lag :], measured[self.lag :], known, quiet
        )
        return recursion.ahead(
            self.A,
            self.C,
            np.concatenate((past, w)),
            np.concatenate((known, y)),
            np.concatenate((quiet, e)),
            min(k, n),
            len(past),
        )

    def _before(self, row: FloatArray) -> FloatArray:
        """Rows before a record that all equal one."""
        return np.tile(row, (max(len(self.A), len(self.B), len(self.C)), 1))


def held(outputs: FloatArray, otherwise: FloatArray) -> FloatArray:
    """The same rows with each lost sample replaced by the last one before it.

    Failing that by the first after it, failing that by ``otherwise`` (q,).
    """
    filled = outputs.copy()
    for j in range(filled.shape[1]):
        known = np.flatnonzero(np.isfinite(outputs[:, j]))
        if len(known) == 0:
            filled[:, j] = otherwise[j]
        else:
            last = np.searchsorted(known, np.arange(len(outputs)), side="right") - 1
            filled[:, j] = outputs[known[np.maximum(last, 0)], j]
    return filled
