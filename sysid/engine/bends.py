"""Inputs that are no straight lines between samples.

From sample k one is u_k + (u_(k+1) - u_k) r + a (r^2 - r) + b (r^3 - r), 0 <= r <= 1. a and b are
those of a cubic spline, or such that the input has the mean that a record says: -6 times what that
is more than the straight line's, and none.
"""

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.data import Dataset
from sysid.problem.model import ProcessModel


def splines_of(model: ProcessModel) -> list[int]:
    """Places of the inputs that are no straight lines."""
    return [j for j, signal in enumerate(model.inputs) if signal.hold == "spline"]


@functools.lru_cache(maxsize=8)  # one model for the same question: its kernels are kept by it
def bent(model: ProcessModel) -> ProcessModel:
    """The model with inputs that records bend where a state reacts on them."""
    inputs = [replace(u, hold="spline") if u.reaction else u for u in model.inputs]
    return replace(model, inputs=tuple(inputs))


def in_parts(model: ProcessModel, inputs: FloatArray, parts: int) -> FloatArray:
    """Inputs as of ``with_bends`` of all splines in parts of samples, (parts (n_samples - 1) + 1,).

    >>> from sysid.examples import lag
    >>> model = lag().with_holds({"u": "spline"})
    >>> in_parts(model, np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 0.0]]), 2)
    array([[ 0.   ,  0.25 ,  0.125],
           [-0.125,  0.625,  0.125],
           [ 1.   ,  0.   ,  0.   ]])
    """
    samples, steps = np.divmod(np.arange((len(inputs) - 1) * parts + 1), parts)
    r = steps / parts
    fine, behind = inputs[samples], inputs[np.minimum(samples + 1, len(inputs) - 1)]
    for j, signal in enumerate(model.inputs):
        if signal.hold != "zoh":
            fine[:, j] += r * (behind[:, j] - fine[:, j])
    for place, j in enumerate(splines_of(model)):
        square, cube = fine[:, len(model.inputs) + 2 * place :].T[:2]
        fine[:, j] += r * (r - 1.0) * (square + cube * (r + 1.0))
        square += 3.0 * r * cube
        square /= parts**2
        cube /= parts**3
    return fine


def with_changes(fine: FloatArray, record: Dataset, parts: int) -> FloatArray:
    """Inputs as of ``in_parts`` with what held ones do between the samples of a record.

    >>> held = Dataset(np.zeros(3), np.zeros(3), 0.1, changes=np.ones((3, 1)),
    ...     last_part=np.array([0.25]))
    >>> with_changes(np.zeros((9, 1)), held, 4)[:, 0].tolist()
    [-0.25, -0.25, -0.25, 0.75, -0.25, -0.25, -0.25, 0.75, 0.0]
    """
    fine = fine.copy()
    for j in np.flatnonzero(record.last_part).tolist():
        beside_mean = _later(record.last_part[j], parts) - record.last_part[j]
        fine[:-1, j] += np.outer(record.changes[:-1, j], beside_mean).ravel()
    return fine


def _later(last_part: float, parts: int) -> FloatArray:
    """How much of a change has come in each part, (parts,), where it comes for the last part.

    Of the part in which it comes its share; those beside it such that it has come in the mean when
    it has.
    """
    first = parts * (1.0 - last_part)
    later: FloatArray = np.clip(np.arange(1.0, parts + 1.0) - first, 0.0, 1.0)
    place = min(int(first), parts - 1)
    before, after = max(place - 1, 0), min(place + 1, parts - 1)
    missed = 0.5 * later[place] * (1.0 - later[place]) / (after - before)
    later[before] -= missed
    later[after] += missed
    return later


def with_bends(model: ProcessModel, record: Dataset, splines: Sequence[int]) -> FloatArray:
    """Inputs of a record, and behind them a and b of each of the splines, by their places.

    >>> from sysid.examples import lag
    >>> record = Dataset(np.zeros(3), np.zeros(3), 0.1, between=np.array([[0.5], [0.0], [0.0]]))
    >>> model = replace(lag(), inputs=(replace(lag().inputs[0], reaction=("y", 1.0)),))
    >>> with_bends(model, record, [0])[0]
    array([ 0., -3.,  0.])
    """
    bends = np.zeros((record.n_samples, 2 * len(splines)))
    for place, j in enumerate(splines):
        if record.between.size and model.inputs[j].reaction:
            bends[:, 2 * place] = -6.0 * record.between[:, j]
        else:
            from scipy.interpolate import CubicSpline

            pieces = CubicSpline(np.arange(record.n_samples), record.inputs[:, j]).c
            bends[:-1, 2 * place], bends[:-1, 2 * place + 1] = pieces[1], pieces[0]
    return np.ascontiguousarray(np.hstack([record.inputs, bends])) if splines else record.inputs
