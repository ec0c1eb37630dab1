"""Channels of a unit that have changed places in the log.

A model fits exchanged speeds of a shaft's two ends nearly as well as the right ones, by a stiffness
and inertias that are not the plant's; no small change of a channel leads from the one to the other.
So where something is left, and it may be that, the model is fitted to the data with the two
exchanged as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Literal

import numpy as np

from sysid.arrays import FloatArray
from sysid.judging.findings import Finding
from sysid.judging.mended_data import explained_mended
from sysid.judging.residual_tests import residual_test
from sysid.problem.data import Dataset
from sysid.problem.metrics import fit_percent
from sysid.problem.model import Input, Output
from sysid.uncertainty import Uncertainty

if TYPE_CHECKING:
    from sysid.gassi import GASSI

_WHITE = 0.75  # share of autocorrelations inside their band, above which nothing is left
_ALIKE = 0.5  # correlation of two outputs, below which a model that took one for the other fails
_POOR = 50.0  # fit [%] below which channels that are not alike may have been exchanged

Side = Literal["inputs", "outputs"]


def exchanged_channels(
    estimator: GASSI,
    uncertainty: Uncertainty,
    training: Sequence[Dataset],
    runs: Sequence[FloatArray] | None = None,
) -> Finding | None:
    """The pair of channels that training records have exchanged, if there is one.

    runs: what the estimator predicts of each of them, where that is at hand.
    """
    runs = runs or [estimator.predict(record) for record in training]
    left = [record.outputs - run for record, run in zip(training, runs, strict=True)]
    best = None
    for side, i, j in _pairs(estimator, training, left):
        pair = _signals(estimator, side)[i].name, _signals(estimator, side)[j].name
        finding = _tested(estimator, uncertainty, training, left, (side, i, j), pair)
        if finding is not None and (best is None or finding.share > best.share):
            best = finding
    return best


def _pairs(
    estimator: GASSI, training: Sequence[Dataset], left: Sequence[FloatArray]
) -> Iterator[tuple[Side, int, int]]:
    """Channels of one unit that may have been exchanged, by side and places."""
    tests = [residual_test(e, r.inputs).white for e, r in zip(left, training, strict=True)]
    unexplained = np.mean(tests, axis=0) < _WHITE
    runs = zip(left, training, strict=True)
    fits = np.mean([fit_percent(r.outputs, r.outputs - e) for e, r in runs], axis=0)
    outputs = np.concatenate([record.outputs for record in training])
    whole = outputs[np.isfinite(outputs).all(axis=1)]
    for i, j in _of_one_unit(_signals(estimator, "outputs")):
        alike = abs(float(np.corrcoef(whole[:, [i, j]].T)[0, 1])) > _ALIKE
        if unexplained[[i, j]].any() and (alike or fits[[i, j]].min() < _POOR):
            yield "outputs", i, j
    if (unexplained & (fits < _POOR)).any():
        for i, j in _of_one_unit(_signals(estimator, "inputs")):
            yield "inputs", i, j


def _tested(
    estimator: GASSI,
    uncertainty: Uncertainty,
    training: Sequence[Dataset],
    left: Sequence[FloatArray],
    channels: tuple[Side, int, int],
    names: tuple[str, str],
) -> Finding | None:
    """The finding of an exchange; None where it does not explain the records much better."""
    side, *pair = channels
    mended = [_with_exchanged(record, *channels) for record in training]

    def as_logged(residual: FloatArray) -> FloatArray:
        return _exchanged(residual, *pair) if side == "outputs" else residual

    explained = explained_mended(estimator, uncertainty, left, mended, as_logged)
    if explained is None:
        return None
    share, chance, moves = explained.share, explained.p_value, explained.moves
    return Finding("exchange", " and ".join(names), "", 1.0, chance, share, moves)


def _signals(estimator: GASSI, side: Side) -> Sequence[Input | Output]:
    signals: Sequence[Input | Output] = getattr(estimator.simulator().model, side)
    return signals


def _of_one_unit(signals: Sequence[Input | Output]) -> list[tuple[int, int]]:
    pairs = combinations(range(len(signals)), 2)
    return [(i, j) for i, j in pairs if signals[i].unit == signals[j].unit]


def _with_exchanged(record: Dataset, side: Side, i: int, j: int) -> Dataset:
    """A record with two channels of one side exchanged, and all that is known of them."""
    if side == "inputs":
        return replace(
            record,
            inputs=_exchanged(record.inputs, i, j),
            input_noise=_exchanged(record.input_noise, i, j),
            input_zero=_exchanged(record.input_zero, i, j),
        )
    return replace(
        record,
        outputs=_exchanged(record.outputs, i, j),
        output_noise=_exchanged(record.output_noise, i, j),
        output_zero=_exchanged(record.output_zero, i, j),
        windows=_exchanged(record.windows, i, j, axis=1),
        jitter=_exchanged(record.jitter, i, j),
        jitter_colour=_exchanged(record.jitter_colour, i, j),
    )


def _exchanged(values: FloatArray, i: int, j: int, axis: int = -1) -> FloatArray:
    """Values of channels along an axis with two of them exchanged, if there are any."""
    if not values.size:
        return values
    order = np.arange(values.shape[axis])
    order[[i, j]] = j, i
    return np.take(values, order, axis)
