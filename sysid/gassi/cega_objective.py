"""The objective of CEGA, (4.6) to (4.8): fast samples count more, squares are not rooted.

    e = sum_j w_j (1/n_j) sum_k |v_k| ((y_sim - y_exp) / d_j)^2
    |v_k| = |2 (v - min v) / (max v - min v) - 1|,    d_j = max y_j - min y_j

with v the velocity, w_j the outputs' weights and n_j their samples. (4.7) prints max v below the
line, with which weights of a motion to and fro turn negative; its own range is meant, as for d.
"""

from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchResult
from sysid.fitting.objective import Objective

VELOCITIES = ("rad/s", "m/s", "mm/s")
_BATCH_BYTES = 2**27  # residuals held at once


class CegaObjective(Objective):
    """``Objective`` by (4.6), over all outputs of all records.

    The velocity is the first of the model's signals, inputs before outputs, with its unit; without
    one all samples count alike. A sample whose velocity was lost does not count.
    """

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        outputs = np.concatenate([record.outputs for record in self.records])
        span = np.nanmax(outputs, axis=0) - np.nanmin(outputs, axis=0)
        self.scales = [np.where(span > 0.0, span, 1.0)] * len(self.records)
        self.emphasis = self._emphasis()

    def evaluate(self, chromosomes: FloatArray) -> tuple[FloatArray, BatchResult]:
        """Error of each chromosome, (n,), infinite where its simulation failed; and the batch."""
        result = super().evaluate(chromosomes)[1]
        errors = np.full(len(chromosomes), np.inf)
        usable = np.flatnonzero(np.isfinite(result.sse).all(axis=(1, 2)))
        count = max(1, _BATCH_BYTES // (8 * self.n_residuals))
        for rows in np.split(usable, range(count, len(usable), count)):
            if len(rows):
                steps = self.steps_needed(chromosomes[rows])
                values = self.residuals(chromosomes[rows], steps).values
                means = np.einsum("t,tqn->nq", self.emphasis, values**2)
                errors[rows] = self.error_of(means / np.maximum(self.counts, 1))
        return errors, result

    def _emphasis(self) -> FloatArray:
        """|v_k| of every row, records one after another, (n_rows,)."""
        model = self.simulator.model
        units = [signal.unit for signal in model.inputs] + [y.unit for y in model.outputs]
        tables = [np.column_stack((record.inputs, record.outputs)) for record in self.records]
        place = next((j for j, unit in enumerate(units) if unit in VELOCITIES), None)
        if place is None:
            return np.ones(sum(map(len, tables)))
        velocity = np.concatenate(tables)[:, place]
        low, high = np.nanmin(velocity), np.nanmax(velocity)
        if low == high:
            return np.ones(len(velocity))
        return np.nan_to_num(np.abs(2.0 * (velocity - low) / (high - low) - 1.0))
