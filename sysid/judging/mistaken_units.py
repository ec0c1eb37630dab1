"""Outputs that were logged in another unit than the model takes them for.

A speed in rpm for rad/s is 9.55 times as large. What parameters in their ranges make up for of that
hides how much it is, so the model is searched anew with the unit that it may be.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from sysid.arrays import FloatArray
from sysid.judging.findings import Finding
from sysid.judging.mended_data import Explained, explained_mended
from sysid.problem.data import Dataset
from sysid.problem.metrics import fit_percent, mean_known
from sysid.problem.model import Output
from sysid.uncertainty import Uncertainty

if TYPE_CHECKING:
    from sysid.gassi import GASSI

_POOR = 70.0  # fit [%] of an output below which its unit may be another
_ALL = 0.9  # of the residuals' squares that the right one explains at least


@dataclass(frozen=True)
class _Unit:
    """A unit in which numbers are so many times as large as in the model's, and so much more."""

    name: str
    times: float
    more: float = 0.0


_DEG, _TURN = _Unit("deg", 180.0 / math.pi), _Unit("turn", 0.5 / math.pi)
_PREFIXES = {"m": 1e3, "k": 1e-3}
_TAKEN_FOR = {
    "rad/s": (
        _Unit("rpm", 30.0 / math.pi),
        replace(_DEG, name="deg/s"),
        replace(_TURN, name="turn/s"),
    ),
    "rad": (_DEG, _TURN),
    "degC": (_Unit("degF", 1.8, 32.0), _Unit("K", 1.0, 273.15)),
    "K": (_Unit("degC", 1.0, -273.15), _Unit("degF", 1.8, -459.67)),
    "m": (_Unit("mm", 1e3), _Unit("cm", 1e2)),
    "m/s": (_Unit("mm/s", 1e3), _Unit("cm/s", 1e2), _Unit("km/h", 3.6)),
    **{
        name: tuple(_Unit(prefix + name, times) for prefix, times in _PREFIXES.items())
        for name in ("A", "V", "N*m", "N", "Pa")
    },
}


def output_in_another_unit(
    estimator: GASSI, uncertainty: Uncertainty, training: Sequence[Dataset]
) -> tuple[Finding, ...]:
    """Gain and offset of the output whose unit is another, none where no other explains all."""
    best = tuple[Finding, ...]()
    runs = [estimator.predict(record) for record in training]
    left = [record.outputs - run for record, run in zip(training, runs, strict=True)]
    pairs = zip(training, runs, strict=True)
    fits = mean_known(np.stack([fit_percent(record.outputs, run) for record, run in pairs]), 0)
    for j in np.flatnonzero(fits < _POOR).tolist():
        output = estimator.simulator().model.outputs[j]
        for unit in _TAKEN_FOR.get(output.unit, ()):
            mended = [_converted(record, j, unit) for record in training]
            explained = explained_mended(
                estimator, uncertainty, left, mended, partial(_as_logged, j, unit)
            )
            least = best[0].share if best else _ALL
            if explained is not None and explained.share > least:
                best = tuple(_findings(output, unit, explained))
    return best


def _findings(output: Output, unit: _Unit, explained: Explained) -> Iterator[Finding]:
    """Gain and offset between a unit and the model's, without what is none."""
    share, chance, moves = explained.share, explained.p_value, explained.moves
    if unit.times != 1.0:
        gain = unit.times - 1.0
        yield Finding("gain", output.name, unit.name, gain, chance, share, moves)
    if unit.more:
        yield Finding("offset", output.name, output.unit, unit.more, chance, share, moves)


def _as_logged(j: int, unit: _Unit, residual: FloatArray) -> FloatArray:
    logged = residual.copy()
    logged[:, j] *= unit.times
    return logged


def _converted(record: Dataset, j: int, unit: _Unit) -> Dataset:
    """A record whose output j is in the model's unit, where numbers were in another."""
    outputs, noise = record.outputs.copy(), record.output_noise.copy()
    outputs[:, j] = (outputs[:, j] - unit.more) / unit.times
    noise[j] /= unit.times
    return replace(record, outputs=outputs, output_noise=noise)
