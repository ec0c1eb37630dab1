"""Motion for which the model has no state: an inertia behind what gives, a body that follows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from sysid.arrays import FloatArray
from sysid.judging.disturbed import DisturbedRun
from sysid.judging.suspects import Suspect, added_rates, physical_equations

_APART = 1.12  # ratio of frequencies that are tested, a tenth of which a resonance is wide
_DAMPING = 0.1  # damping ratio of those
# Ratios of frequencies and damping ratios by which a resonance is told more closely.
_CLOSER, _DAMPINGS = np.linspace(0.94, 1.06, 7), (0.02, 0.05, 0.1, 0.2, 0.4)
_CYCLES = 3.0  # in the shortest record, at least
_FASTEST = 0.3  # cycles in a sample
_LONGER = 2.0  # ratio of time constants that are tested
_CLOSER_TIMES = np.geomspace(0.75, 1.4, 8)
_TIMES = 2.0, 0.25  # the shortest in samples, the longest in parts of the shortest record

Filter = tuple[FloatArray, FloatArray]  # numerator and denominator in s


def hidden_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """What hangs on a state that nobody modelled: it swings, or follows with a time constant.

    Both are driven by the state and act in its equation, as reaction to what they are driven by.
    """
    shortest = min(run.record.n_samples * run.record.dt for run in runs)
    sample = max(run.record.dt for run in runs)
    for i in physical_equations(runs[0]):
        for time in _between(_TIMES[0] * sample, _TIMES[1] * shortest, _LONGER):
            yield replace(
                _following(runs, i, time),
                closer=partial(_followings, runs, i, (time * _CLOSER_TIMES).tolist()),
            )
        for frequency in _between(_CYCLES / shortest, _FASTEST / sample, _APART):
            yield replace(
                _swinging(runs, i, frequency, _DAMPING),
                closer=partial(_swingings, runs, i, (frequency * _CLOSER).tolist()),
            )


def _between(low: float, high: float, ratio: float) -> list[float]:
    """Numbers from low to high, each so many times the one before; none where low is beyond."""
    if not low < high:
        return []
    count = 1 + math.ceil(math.log(high / low) / math.log(ratio))
    return [float(number) for number in np.geomspace(low, high, count)]


def _followings(runs: Sequence[DisturbedRun], i: int, times: Sequence[float]) -> list[Suspect]:
    return [_following(runs, i, time) for time in times]


def _following(runs: Sequence[DisturbedRun], i: int, time: float) -> Suspect:
    """A body that follows state i with a time constant [s], and pulls at it as it does."""
    follows = np.array([-time, 0.0]), np.array([time, 1.0])
    return _suspect("follower", runs, i, [follows], time, "s")


def _swingings(runs: Sequence[DisturbedRun], i: int, frequencies: Sequence[float]) -> list[Suspect]:
    return [_swinging(runs, i, frequency, d) for frequency in frequencies for d in _DAMPINGS]


def _swinging(runs: Sequence[DisturbedRun], i: int, frequency: float, damping: float) -> Suspect:
    """What swings at a frequency [Hz] with state i, and acts by its way and by its speed."""
    omega = 2.0 * math.pi * frequency
    denominator = np.array([1.0, 2.0 * damping * omega, omega**2])
    way, speed = np.array([-omega, 0.0]), np.array([-1.0, 0.0, 0.0])
    swings = [(way, denominator), (speed, denominator)]
    return _suspect("resonance", runs, i, swings, frequency, "Hz")


def _suspect(
    kind: Literal["follower", "resonance"],
    runs: Sequence[DisturbedRun],
    i: int,
    filters: Sequence[Filter],
    size: float,
    unit: str,
) -> Suspect:
    changes = added_rates(runs, i, [partial(_filtered, i, each) for each in filters])
    return Suspect(kind, runs[0].model.states[i].name, unit, changes, size=size)


def _filtered(i: int, transfer: Filter, run: DisturbedRun) -> FloatArray:
    """State i of a run through a filter that stands still before, (n_samples,)."""
    from scipy.signal import cont2discrete, lfilter  # slow, and seldom needed

    signal = run.states[:, i] - run.states[0, i]
    numerator, denominator, _ = cont2discrete(transfer, run.record.dt, method="foh")
    passed: FloatArray = lfilter(np.ravel(numerator), denominator, signal)
    return passed
