"""Forces that repeat along a position, as the cogging of a motor's magnets or a gear's teeth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sysid.judging.disturbed import DisturbedRun
from sysid.judging.suspects import Suspect, of_terms, physical_equations
from sysid.problem.terms import AddedTerm

_MOST_CYCLES = 40  # within the range of a position, or in a turn
_FEWEST_SAMPLES = 4.0  # a cycle, where the position moves fast
_FAST = 0.95  # share of the samples in which it moves no faster
_PROPORTIONAL = 1e-9
# Cycles in the range of a position by which a period found is told more closely.
_CLOSER = np.linspace(-0.3, 0.3, 13)
_TURNS = {"rad": 2.0 * math.pi, "deg": 360.0}  # a turn of an angle in its unit


def cycle_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Sines of a position, of any phase, added to the equation of its speed.

    Periods are half a cycle apart in the range that the position runs through; of an angle that
    turns round they are whole parts of a turn.
    """
    for position, speed in _positions(runs):
        along = np.concatenate([run.states[:, position] for run in runs])
        steps = np.concatenate([np.abs(np.diff(run.states[:, position])) for run in runs])
        extent, fast = float(np.ptp(along)), float(np.quantile(steps, _FAST))
        if not extent > 0.0:
            continue
        turn = _TURNS.get(runs[0].model.states[position].unit, math.inf)
        for cycles in _cycles(extent, turn):
            if cycles * _FEWEST_SAMPLES * fast > extent:
                break
            suspect = _cycle(runs, position, speed, extent / cycles)
            if extent > turn:
                yield suspect
            else:
                periods = [extent / (cycles + part) for part in _CLOSER.tolist()]
                yield replace(suspect, closer=partial(_sized, runs, position, speed, periods))


def _cycles(extent: float, turn: float) -> list[float]:
    """Cycles in the range of a position that are tested, the fewest first."""
    if extent > turn:
        return [n * extent / turn for n in range(1, _MOST_CYCLES + 1)]
    return [0.5 * k for k in range(2, 2 * _MOST_CYCLES + 1)]


def _sized(
    runs: Sequence[DisturbedRun], position: int, speed: int, periods: Sequence[float]
) -> list[Suspect]:
    return [_cycle(runs, position, speed, period) for period in periods]


def _cycle(runs: Sequence[DisturbedRun], position: int, speed: int, period: float) -> Suspect:
    """A sine and a cosine of this period in the position's unit."""
    model, scale = runs[0].model, period / (2.0 * math.pi)
    equation, of = model.states[speed].name, model.states[position].name
    terms = tuple(
        AddedTerm(equation, of, "sine", scale, -1.0, 1.0, centre)
        for centre in (0.0, -0.25 * period)
    )
    return of_terms(runs, speed, position, terms)


def _positions(runs: Sequence[DisturbedRun]) -> Iterator[tuple[int, int]]:
    """States whose rate is in proportion to another in whose equation a parameter acts."""
    physical = physical_equations(runs[0])
    states = np.concatenate([run.states for run in runs])
    rates = np.concatenate([run.rates for run in runs])
    for position in range(states.shape[1]):
        rate = rates[:, position]
        if position in physical or not np.any(rate):
            continue
        for speed in physical:
            factor = (rate @ states[:, speed]) / max(states[:, speed] @ states[:, speed], 1e-300)
            if np.abs(rate - factor * states[:, speed]).max() < _PROPORTIONAL * np.abs(rate).max():
                yield position, speed
