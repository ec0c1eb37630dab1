"""Which coefficients a polynomial model has: orders, delays and their layout in a vector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from sysid.arrays import IntArray
from sysid.problem.model import ModelError

# One number for every entry, or a table with one number for each.
Order = int | Sequence[int] | Sequence[Sequence[int]] | IntArray


class Term(NamedTuple):
    """One coefficient of an output's equation: of which polynomial, lag and signal."""

    polynomial: Literal["a", "b", "offset", "c"]
    lag: int
    column: int

    def name(self, row: int) -> str:
        """As in the model's equations: ``a2[0,1]`` weighs y_1(t-2) in the equation of y_0."""
        if self.polynomial == "offset":
            return f"offset[{row}]"
        if self.polynomial == "c":
            return f"c{self.lag}[{row}]"
        return f"{self.polynomial}{self.lag}[{row},{self.column}]"


@dataclass(frozen=True)
class Orders:
    """Orders of A(q) y = B(q) u + C(q) e for q outputs and m inputs.

    na: (q, q) lags of each output in each equation; nb: (q, m) coefficients of each input;
    nc: (q,) lags of the noise; nk: (q, m) samples before an input first acts.
    """

    na: IntArray
    nb: IntArray
    nc: IntArray
    nk: IntArray
    offset: bool

    @classmethod
    def of(
        cls, n_outputs: int, n_inputs: int, *, na: Order, nb: Order, nc: Order, nk: Order,
        offset: bool,
    ) -> Orders:  # fmt: skip
        """Tables from what a user gives: a number counts for every entry.

        Raises ModelError for a negative order, a table of the wrong shape, or no coefficient.
        """
        q, m = n_outputs, n_inputs
        orders = cls(
            _table("na", na, (q, q)),
            _table("nb", nb, (q, m)),
            _table("nc", nc, (q,)),
            _table("nk", nk, (q, m)),
            bool(offset),
        )
        for row in range(q):
            if not orders.terms(row):
                raise ModelError(
                    f"the equation of output {row} has no coefficients: "
                    "give na, nb or nc above 0, or offset=True"
                )
        return orders

    @property
    def n_outputs(self) -> int:
        """Number of outputs, q."""
        return len(self.na)

    @property
    def n_inputs(self) -> int:
        """Number of inputs, m."""
        return int(self.nb.shape[1])

    @property
    def output_lag(self) -> int:
        """Samples that the outputs reach back."""
        return int(self.na.max(initial=0))

    @property
    def input_lag(self) -> int:
        """Samples that the inputs reach back."""
        return int(np.where(self.nb > 0, self.nk + self.nb - 1, 0).max(initial=0))

    @property
    def lag(self) -> int:
        """Rows at the start of a record that have no complete past."""
        return max(self.output_lag, self.input_lag)

    @property
    def layout(self) -> list[tuple[int, Term]]:
        """Output and coefficient of each entry of the parameter vector."""
        return [(row, term) for row in range(self.n_outputs) for term in self.terms(row)]

    def linear_terms(self, row: int) -> list[Term]:
        """Coefficients of one equation in which it is linear once C is known."""
        terms = [Term("a", lag, j) for j, n in enumerate(self.na[row]) for lag in _lags(1, n)]
        terms += [
            Term("b", lag, j)
            for j, (n, delay) in enumerate(zip(self.nb[row], self.nk[row], strict=True))
            for lag in _lags(delay, n)
        ]
        return terms + [Term("offset", 0, 0)] * self.offset

    def terms(self, row: int) -> list[Term]:
        """All coefficients of one equation in the order of the parameter vector."""
        return self.linear_terms(row) + [Term("c", lag, row) for lag in _lags(1, self.nc[row])]


def _lags(first: int, count: int) -> range:
    return range(int(first), int(first) + int(count))


def _table(name: str, given: Order, shape: tuple[int, ...]) -> IntArray:
    try:
        values = np.asarray(given)
    except ValueError:
        raise ModelError(f"{name} is ragged: give one number or a table of shape {shape}") from None
    if values.dtype.kind not in "iu":
        raise ModelError(f"{name} is {given!r}; it must be a whole number or a table of them")
    if values.ndim and values.shape != shape:
        raise ModelError(
            f"{name} has shape {values.shape}; give one number, or {_meaning(name)}: {shape}"
        )
    if np.any(values < 0):
        raise ModelError(f"{name} is {given!r}; it must be 0 or more")
    return np.broadcast_to(values.astype(np.int64), shape)


def _meaning(name: str) -> str:
    per = {"na": "outputs x outputs", "nc": "one per output"}
    return per.get(name, "outputs x inputs")
