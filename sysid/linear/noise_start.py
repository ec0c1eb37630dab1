"""Where the search for C(q) starts: the method of Hannan and Rissanen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.linear.orders import Orders
from sysid.linear.regression import Equations, delayed, equations, least_squares
from sysid.problem.data import Dataset


def first_guesses(
    records: Sequence[Dataset], orders: Orders, rows: Sequence[Equations]
) -> list[list[FloatArray]]:
    """For each output, coefficients of C to start from; none where data are too few.

    A long ARX model makes the noise visible, whose past then counts as one more measured
    signal. Hannan & Rissanen, Biometrika 69 (1982) 81-94; Ljung, System Identification,
    section 10.4.
    """
    guesses: list[list[FloatArray]] = []
    noise: tuple[IntArray, FloatArray] | None = None
    for row, found in enumerate(rows):
        nc = int(orders.nc[row])
        if nc and noise is None:
            noise = _visible_noise(records, orders)
        guesses.append([] if not nc or noise is None else _guess(found, nc, row, *noise))
    return guesses


def _visible_noise(
    records: Sequence[Dataset], orders: Orders
) -> tuple[IntArray, FloatArray] | None:
    """Residuals of a long ARX model of all outputs, with their instants: (n,), (n, q)."""
    q, m = orders.n_outputs, orders.n_inputs
    n_rows = sum(record.n_samples for record in records)
    # The noise's past must fit into the ARX order, and the ARX model into the data.
    wanted = max(orders.lag + int(orders.nc.max()), round(3.0 * np.log(max(n_rows, 2))))
    length = min(wanted, n_rows // (4 * (q + m)))
    if length < 1:
        return None
    nk = np.minimum(orders.nk, length)
    long = Orders.of(q, m, na=length, nb=length + 1 - nk, nc=0, nk=nk, offset=orders.offset)
    found = [equations(records, long, row, long.lag) for row in range(q)]
    position = found[0].position
    for other in found[1:]:
        position = np.intersect1d(position, other.position, assume_unique=True)
    if len(position) < 2 * found[0].regressors.shape[1]:
        return None
    common = [other.take(np.isin(other.position, position)) for other in found]
    targets = np.column_stack([other.target for other in common])
    return position, least_squares(common[0].regressors, targets).residual


def _guess(
    rows: Equations, nc: int, row: int, position: IntArray, noise: FloatArray
) -> list[FloatArray]:
    shared, at_rows, at_noise = np.intersect1d(
        rows.position, position, assume_unique=True, return_indices=True
    )
    past = [delayed(noise[at_noise, row], shared, lag) for lag in range(1, nc + 1)]
    regressors = np.column_stack((rows.regressors[at_rows], *past))
    if len(shared) <= regressors.shape[1]:
        return []
    return [least_squares(regressors, rows.target[at_rows]).solution[-nc:]]
