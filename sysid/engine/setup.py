"""A record as the batch kernels take it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.problem.data import Dataset
from sysid.problem.model import ProcessModel


@dataclass(frozen=True)
class Setup:
    """What every simulation on a record needs of it.

    start: (n_states,). inputs: (n_samples, ...), behind those of splines how they bend. measured,
    weights: (n_samples, n_outputs), residuals being (simulated - measured) * weights; 0 where a
    sample was lost. weight, peak: (n_outputs,), largest of the weights and measured size.
    extremes: samples where an input is largest, and the first.
    """

    record: Dataset
    start: FloatArray
    inputs: FloatArray
    measured: FloatArray
    weights: FloatArray
    weight: FloatArray
    peak: FloatArray
    extremes: IntArray

    @classmethod
    def of(cls, model: ProcessModel, record: Dataset, scale: FloatArray | None) -> Setup:
        """With a scale (n_outputs,) residuals count; without, residuals are the outputs."""
        missing = ~np.isfinite(record.outputs)
        measured = np.where(missing, 0.0, record.outputs)
        # Where an input is largest is where a model driven through it is fastest.
        peaks = np.argmax(np.abs(record.inputs), axis=0) if record.inputs.shape[1] else []
        weights = np.ones_like(measured) if scale is None else np.where(missing, 0.0, 1.0 / scale)
        return cls(
            record,
            record.initial_state(model),
            _with_bends(model, record.inputs),
            np.zeros_like(measured) if scale is None else measured,
            weights,
            weights.max(axis=0),
            np.abs(measured).max(axis=0),
            np.unique(np.array([0, *peaks], dtype=np.int64)),
        )


def _with_bends(model: ProcessModel, inputs: FloatArray) -> FloatArray:
    """Inputs, and behind them the squares' and cubes' coefficients of those that are splines.

    From sample k a spline is u_k + (u_k+1 - u_k) r + a (r^2 - r) + b (r^3 - r), 0 <= r <= 1.
    """
    splines = [j for j, signal in enumerate(model.inputs) if signal.hold == "spline"]
    if not splines:
        return inputs
    from scipy.interpolate import CubicSpline

    pieces = CubicSpline(np.arange(len(inputs)), inputs[:, splines]).c
    bends = np.zeros((len(inputs), 2 * len(splines)))
    bends[:-1, 0::2], bends[:-1, 1::2] = pieces[1], pieces[0]
    return np.ascontiguousarray(np.hstack([inputs, bends]))
