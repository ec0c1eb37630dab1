"""Ranks and null spaces of matrices of balls, by Gaussian elimination with full pivoting.

A pivot's ball excludes zero, so that the rank is proven from below; what is left when none does
is zero to hundreds of digits.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from flint import arb, arb_mat

Rows = npt.NDArray[Any]  # of arb


@dataclass(frozen=True)
class Elimination:
    """Rank and null space of a matrix.

    rank: of all rows. basis: (n_null, n_columns) of ``arb``. settled: whether the late rows add
    nothing to the rank of the early ones. gap: decades between the smallest pivot and the largest
    number taken for zero.
    """

    rank: int
    basis: Rows
    settled: bool
    gap: float


def null_space(early: Rows, late: Rows, rng: np.random.Generator) -> Elimination:
    """Null space of early and late rows, (n, n_columns) of ``arb`` each.

    Random mixtures stand for the rows: they span the same space, and are no more of them than
    that has dimensions.
    """
    parts = [_mixed(early, early.shape[1] + 2, rng), _mixed(late, 3, rng)]
    work = np.concatenate(parts)
    scale = np.array([_size(column) if _size(column) > 0 else arb(1) for column in work.T])
    work = work / scale
    pivots: list[tuple[int, int]] = []
    settled = True
    for end in (len(parts[0]), len(work)):
        while (place := _largest(work[:end], pivots)) is not None:
            settled = settled and end == len(parts[0])
            pivots.append(place)
            _eliminate(work, pivots)
    basis = _basis(work, pivots) / scale
    return Elimination(len(pivots), basis, settled, _gap(work, pivots))


def reduced(rows: Rows) -> Rows:
    """Independent rows that span the same space, each with a one in a column of its own."""
    pivots: list[tuple[int, int]] = []
    work = rows.copy()
    while (place := _largest(work, pivots)) is not None:
        row, column = place
        work[row] = work[row] / work[row, column]
        pivots.append(place)
        for i in range(len(work)):
            if i != row and work[i, column] != 0:
                work[i] = work[i] - work[i, column] * work[row]
    return _cleaned(work[[row for row, _ in pivots]])


def _mixed(rows: Rows, count: int, rng: np.random.Generator) -> Rows:
    """Random mixtures of rows, each brought to size one before."""
    sizes = [_size(row) for row in rows]
    kept = [row / size for row, size in zip(rows, sizes, strict=True) if size > 0]
    if len(kept) <= count:
        return np.array(kept, dtype=object).reshape(len(kept), rows.shape[1])
    weights = rng.integers(-99, 100, (count, len(kept))).tolist()
    mixture = arb_mat(weights) * arb_mat([list(row) for row in kept])
    return np.array(mixture.tolist(), dtype=object)


def _size(entries: Rows) -> arb:
    return max((abs(e.mid()) for e in entries), default=arb(0))


def _largest(work: Rows, pivots: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
    """Place of the largest entry that is not zero, in no row or column of a pivot."""
    rows, columns = ({place[axis] for place in pivots} for axis in (0, 1))
    rest = [j for j in range(work.shape[1]) if j not in columns]
    largest, place = arb(0), None
    for i in range(len(work)):
        for j in rest if i not in rows else ():
            size = work[i, j].abs_lower()
            if size > largest:
                largest, place = size, (i, j)
    return place


def _eliminate(work: Rows, pivots: Sequence[tuple[int, int]]) -> None:
    """Take the last pivot's column out of the rows that have none."""
    row, column = pivots[-1]
    before = {i for i, _ in pivots}
    for i in range(len(work)):
        if i not in before and work[i, column] != 0:
            work[i] = work[i] - work[i, column] / work[row, column] * work[row]
            work[i, column] = arb(0)


def _basis(work: Rows, pivots: Sequence[tuple[int, int]]) -> Rows:
    n_columns, columns = work.shape[1], [column for _, column in pivots]
    rest = [j for j in range(n_columns) if j not in columns]
    basis = np.full((len(rest), n_columns), arb(0), dtype=object)
    for k, j in enumerate(rest):
        basis[k, j] = arb(1)
    if pivots and rest:
        rows = work[[row for row, _ in pivots]]
        triangle = arb_mat([list(row) for row in rows[:, columns]])
        solution = triangle.solve(arb_mat([list(row) for row in rows[:, rest]]))
        basis[:, columns] = -np.array(solution.transpose().tolist(), dtype=object)
    return _cleaned(basis)


def _cleaned(rows: Rows) -> Rows:
    """With what is zero but for rounding exactly so."""
    for place, entry in np.ndenumerate(rows):
        if entry.contains(0):
            rows[place] = arb(0)
    return rows


def _gap(work: Rows, pivots: Sequence[tuple[int, int]]) -> float:
    rows = {row for row, _ in pivots}
    least = min((abs(work[place].mid()) for place in pivots), default=arb(1))
    rest = [e.abs_upper() for i, row in enumerate(work) if i not in rows for e in row]
    most = max(rest, default=arb(0))
    return float((least / most).log() / arb(10).log()) if most > 0 else float("inf")
